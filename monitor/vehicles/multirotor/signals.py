"""Which messages hold a multirotor's motor commands, body rates and vertical acceleration, and in which units."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from math import log10

from adapters.channels import Channel, field_steps
from adapters.errors import TelemetryError
from adapters.logs.log_parameters import PARAMETER_MESSAGES
from monitor.fitting.survey import (
    ESC_MESSAGES,
    IDLE_US,
    IMUS,
    MAX_OUTPUTS,
    MOTION_MESSAGES,
    MOTOR_MESSAGE,
    MotorOutput,
    Survey,
    common_rate_hz,
    in_every,
    least_hz,
    required,
)
from monitor.sampling.phase import FlightPhase
from monitor.sampling.supply import BATTERY_MESSAGE, CELLS_MESSAGE
from monitor.vehicles.base import Preview
from monitor.vehicles.multirotor.frames import frame_of, is_helicopter, lifting_outputs
from monitor.vehicles.multirotor.speeds import esc_signals
from monitor.vehicles.multirotor.trim import SLOW_COMMANDS_HZ

MESSAGES = (
    MOTION_MESSAGES
    | FlightPhase.interests
    | PARAMETER_MESSAGES
    | {"ESC_STATUS", *ESC_MESSAGES, "VIBRATION", BATTERY_MESSAGE, CELLS_MESSAGE}
)

_FEW_OUTSIDE = 0.01
"""Largest share of values outside the range of pulses for which an output holds pulses: these may be lost or damaged
packets."""
_PULSE_RANGE = (1000.0, 2000.0)
"""Pulses of zero and of full command, microseconds: the defaults of ArduPilot and PX4."""
_GAZEBO_RANGE = (150.0, 1000.0)
"""SIM_GZ_EC_MIN and SIM_GZ_EC_MAX of PX4's gz_x500: the values of its motor commands 0 and 1."""
_UNKNOWN = 65_535
"""Value of MAVLink for the voltage of a cell that is not measured, or does not exist."""
_FEWEST_MOTORS = 3
"""Smallest number of motors of a multirotor, that of a tricopter."""
_ALIKE = 2.0
"""Largest ratio of a motor output's mean to the median of all outputs that move, in either direction."""

# Messages and fields of body rates, the preferred ones first.
_RATES = {
    "ATTITUDE": ("rollspeed", "pitchspeed", "yawspeed"),
    "HIGHRES_IMU": ("xgyro", "ygyro", "zgyro"),
    "ATTITUDE_QUATERNION": ("rollspeed", "pitchspeed", "yawspeed"),
}


@dataclass(frozen=True, slots=True)
class CommandRange:
    """The outputs that are motors, and their values for no command and full command."""

    motors: tuple[int, ...]  # numbers of the outputs
    # values for commands 0 and 1
    stop: float
    full: float

    @property
    def pulses(self) -> bool:
        """Whether the values are pulses of 1000 to 2000 microseconds."""
        return (self.stop, self.full) == _PULSE_RANGE


def preview(survey: Survey) -> Preview:
    """Return what could be watched with the messages of a recording."""
    inputs, outputs = multirotor_channels([survey])
    channels = (*inputs, *outputs)
    watches = (*(channel.name for channel in inputs), "gyro_x", "gyro_y", "gyro_z")
    return Preview(watches, channels, common_rate_hz([survey], channels), facts=_facts(survey, inputs))


def _facts(survey: Survey, inputs: Sequence[Channel]) -> tuple[str, ...]:
    frame = frame_of(survey.parameters, [int(channel.name.removeprefix("motor")) for channel in inputs])
    facts = ["frame: not in the recording; the motion has to tell which way each motor turns the vehicle"]
    if frame is not None:
        facts = [f"frame: {frame.name}, of the vehicle's parameters"]
    if survey.is_vtol:
        facts.append("watched where its rotors alone carry it: in forward flight and transitions not")
    if (escs := esc_signals([survey], len(inputs))) is not None:
        measured = f"{escs.speed[0].message} at {escs.rate_hz:.3g} Hz"
        facts.append(f"speed controllers: whether speeds follow commands, and currents speeds, by {measured}")
    if survey.rate_hz[MOTOR_MESSAGE] < SLOW_COMMANDS_HZ:
        facts.append("compares mean command and mean motion, in seconds: motor commands come slowly")
    return tuple(facts)


def multirotor_channels(surveys: Sequence[Survey]) -> tuple[tuple[Channel, ...], tuple[Channel, ...]]:
    """Choose the input and output channels of a multirotor from what every recording holds.

    Motors are the servo outputs that :func:`motor_commands` finds, numbered after the output.

    Raises
    ------
    TelemetryError
        A message that is needed is missing; the text says which to stream.
    """
    rates, vertical = required(surveys, _RATES, "body rates"), in_every(surveys, IMUS)
    required(surveys, [MOTOR_MESSAGE], "motor commands")
    commands = motor_commands(surveys)
    span = commands.full - commands.stop
    scale, offset = (0.001, -1.0) if commands.pulses else (1.0 / span, -commands.stop / span)
    usual = float(f"{scale * hover_pulse(surveys, commands) + offset:.3g}")
    inputs = tuple(
        Channel(
            f"motor{number}",
            MOTOR_MESSAGE,
            (f"servo{number}_raw",),
            scale=scale,
            offset=offset,
            where=(("port", 0),),
            stopped_as=usual,
        )
        for number in commands.motors
    )
    names = ("roll_rate", "pitch_rate", "yaw_rate")
    outputs = tuple(Channel(name, rates, (field,)) for name, field in zip(names, _RATES[rates], strict=True))
    if vertical is None:
        return inputs, outputs
    return inputs, (*outputs, Channel("vertical_acceleration", vertical, ("zacc",), scale=IMUS[vertical]))


def battery_channels(surveys: Sequence[Survey]) -> tuple[tuple[Channel, ...], float]:
    """Return the channels of a battery's voltage, current and charge, and their rate, hertz.

    Of the two messages, the one that comes more often is used; the message of cells has a channel for the voltage of
    each further cell.
    """
    message = max((BATTERY_MESSAGE, CELLS_MESSAGE), key=partial(least_hz, surveys))
    in_cells = message == CELLS_MESSAGE
    volts = "voltages[0]" if in_cells else "voltage_battery"
    taken = [("volts", volts, 0.001), ("amps", "current_battery", 0.01), ("left", "battery_remaining", 0.01)]
    if in_cells:
        cells = [survey.examples.get(message, {}).get("voltages") or () for survey in surveys]
        further = min(sum(0 < cell < _UNKNOWN for cell in volts_of[1:]) for volts_of in cells)
        taken += [(f"volts{at + 1}", f"voltages[{at}]", 0.001) for at in range(1, further + 1)]
    channels = tuple(
        Channel(
            name,
            message,
            field_steps(field),
            scale=scale,
            where=(("id", 0),) if in_cells else (),
            interpolation="previous",
        )
        for name, field, scale in taken
    )
    return channels, least_hz(surveys, message)


def hover_pulse(surveys: Sequence[Survey], commands: CommandRange) -> float:
    """Return the mean of the motors' values while armed; for vehicles with wings, of the values above idle."""
    outputs = [(survey.outputs[number], survey.is_vtol) for survey in surveys for number in commands.motors]
    return sum(output.running if winged else output.mean for output, winged in outputs) / len(outputs)


def motor_commands(surveys: Sequence[Survey]) -> CommandRange:
    """Find the outputs that are motors, and the range of their commands.

    Motors are the outputs that move and, by the vehicle's parameters, drive lifting motors, from 1000 to 2000
    microseconds. Without parameters, they are the pulses above idle that moved while armed.

    Simulators send speeds for the speed controllers in place of pulses, logs of some autopilots DShot values. If fewer
    than three pulses move, motors are the outputs with other values than pulses, many in every log and of about the
    same mean. Values within 150 to 1000 are taken for those of PX4 with Gazebo, which has that range. Otherwise zero is
    no command, and full command is the largest value seen, rounded up to 1, 2 or 5 times a power of ten.

    Raises
    ------
    TelemetryError
        Fewer than three outputs move (the text describes each output), or the vehicle is a helicopter, or it has rotors
        and wings and nothing shows which outputs drive its rotors.
    """
    lifting = (lifting_outputs(found.parameters, "tricopter" in found.vehicle_types) for found in surveys)
    rotors: frozenset[int] = next(filter(None, lifting), frozenset())
    moving = _in_every_log(surveys, lambda output: output.running > 0.0 and output.many)
    pulses = [number for number in moving if number in rotors]
    if len(pulses) < _FEWEST_MOTORS:
        _check_rotors(surveys)
        pulses = _in_every_log(surveys, lambda output: output.many and output.mean > IDLE_US)
    if len(set(pulses).difference(_in_every_log(surveys, _is_no_pulse))) >= _FEWEST_MOTORS:
        return CommandRange(tuple(pulses), *_PULSE_RANGE)
    moving = _in_every_log(surveys, lambda output: output.many and _is_no_pulse(output))
    if moving:
        means = {n: sum(found.outputs[n].mean for found in surveys) / len(surveys) for n in moving}
        middle = sorted(means.values())[len(means) // 2]
        moving = [number for number in moving if middle / _ALIKE <= means[number] <= middle * _ALIKE]
    if len(moving) < _FEWEST_MOTORS:
        seen = {number: _seen(surveys, number) for number in range(1, MAX_OUTPUTS + 1)}
        told = ", ".join(f"servo{number} {span}" for number, span in seen.items() if span)
        if any(found.never_armed for found in surveys):
            raise TelemetryError("the vehicle is never armed; record a flight")
        raise TelemetryError(
            f"{MOTOR_MESSAGE} shows {max(len(pulses), len(moving))} outputs that move in flight; a multirotor has "
            f"more. Seen while armed: {told or 'nothing but zero'}; record a flight in the air, with the outputs that "
            "its motors are on"
        )
    low, high = _extremes(surveys, moving)
    known = _GAZEBO_RANGE[0] <= low and high <= _GAZEBO_RANGE[1]
    return CommandRange(tuple(moving), *(_GAZEBO_RANGE if known else (0.0, _rounded_up(high))))


def _check_rotors(surveys: Sequence[Survey]) -> None:
    """Refuse a helicopter, and a vehicle with wings if no parameter shows which outputs are its rotors."""
    if any("helicopter" in found.vehicle_types or is_helicopter(found.parameters) for found in surveys):
        raise TelemetryError(
            "the vehicle is a helicopter: servos turn its blades, not motors, and they are not watched; --vehicle "
            "inertial watches its sensors"
        )
    if any(survey.is_vtol for survey in surveys):
        raise TelemetryError(
            "the vehicle has rotors and wings, and no three outputs are known to drive motors that lift, by its "
            "parameters (SERVO*_FUNCTION of ArduPilot, PWM_MAIN_FUNC* of PX4) if a log holds them; --vehicle inertial "
            "watches its sensors"
        )


def range_text(commands: CommandRange, surveys: Sequence[Survey]) -> str:
    """Return the assumed range of commands that are no pulses, for people."""
    low, high = _extremes(surveys, commands.motors)
    return (
        f"motor commands are no pulses of 1000 to 2000 us but {low} to {high}: "
        f"{commands.stop:g} is taken as no command, {commands.full:g} as full command"
    )


def _in_every_log(surveys: Sequence[Survey], moves: Callable[[MotorOutput], bool]) -> list[int]:
    numbers = range(1, MAX_OUTPUTS + 1)
    return [n for n in numbers if all(n in found.outputs and moves(found.outputs[n]) for found in surveys)]


def _extremes(surveys: Sequence[Survey], numbers: Sequence[int]) -> tuple[int, int]:
    ranges = [survey.outputs[number] for survey in surveys for number in numbers]
    return min(limits.low for limits in ranges), max(limits.high for limits in ranges)


def _is_no_pulse(output: MotorOutput) -> bool:
    return output.outside > _FEW_OUTSIDE or output.high <= IDLE_US


def _seen(surveys: Sequence[Survey], number: int) -> str:
    """Return the range of an output over all logs, empty if it has no values."""
    seen = [survey for survey in surveys if number in survey.outputs]
    if not seen:
        return ""
    low, high = _extremes(seen, [number])
    return f"{low} to {high}" if high > low else f"always {low}"


def _rounded_up(value: float) -> float:
    """Return the next of 1, 2 and 5 times a power of ten."""
    power = 10.0 ** int(log10(value))
    return next(step * power for step in (1.0, 2.0, 5.0, 10.0) if value <= step * power)
