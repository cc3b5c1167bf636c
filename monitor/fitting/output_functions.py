"""Find the actuator of each servo output, by the functions that an autopilot's parameters give its outputs.

ArduPilot gives output n ``SERVOn_FUNCTION``. PX4 gives the outputs of each driver ``PWM_MAIN_FUNCn`` and the like: 101
is its first motor, 201 the first servo, whose surface ``CA_SV_CS0_TYPE`` states. Of several drivers the one that drives
most of the requested actuators counts, since a log's outputs are those of the driver that moves most.

PX4's logs also hold what its controllers ask for about each axis, 50 times a second where outputs come 10 times, and
whatever the mixer makes of it (elevons, V-tails).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from adapters.channels import Channel
from adapters.errors import TelemetryError
from monitor.fitting.survey import MAX_OUTPUTS, MOTOR_MESSAGE, Survey, required
from monitor.sampling.scaled import Mix

MOTOR, SERVO = 101, 201
"""PX4's function numbers of its first motor and first servo."""
CONTROLS_MESSAGE = "ACTUATOR_CONTROL_TARGET"
_CLEARLY = 1.5
"""Ratio of rates from which controls replace outputs: the outputs are nearer to the surfaces, and a link has them."""
_DRIVERS = ("PWM_MAIN_FUNC", "PWM_AUX_FUNC", "HIL_ACT_FUNC", "SIM_GZ_SV_FUNC")
_ROTORS, _SURFACES = 12, 8
"""``CA_ROTOR0`` to ``CA_ROTOR11`` and ``CA_SV_CS0`` to ``CA_SV_CS7``: as many as PX4's control allocation has."""
_AIRFRAMES: Mapping[float, tuple[tuple[int, ...], tuple[int, ...]]] = {
    1101: ((2, 3, 4), (201, 202, 203, 101)),  # simulated planes
    10041: ((15, 3, 4), (201, 202, 203, 101)),
    1030: ((1, 2, 3, 4), (0, 0, 204, 0, 101, 201, 202, 203)),
    2100: ((15, 3, 4), (201, 202, 101, 203)),  # the standard plane
}
"""By SYS_AUTOSTART, kinds of the surfaces and functions of the main outputs that PX4's airframes begin with: unless it
is asked for more, PX4 sends over a link only the parameters that were changed since, and SYS_AUTOSTART."""
_COMMANDED = 9
"""First output of a servo if the outputs of a log are made of PX4's commands to motors (1 to 8) and servos."""
_FIRST_PORT = (("port", 0),)
"""MAVLink's number of the main outputs: the second port has those of an auxiliary processor."""
_LARGEST = 2.0**16
"""Size of a parameter of an output from which it is damaged: pulses in microseconds, a bit for each of 16 outputs."""
_PULSES = {True: (1000.0, 1000.0), False: (1500.0, 500.0)}
"""Pulses of no deflection, and their difference from those of a full one, microseconds: of actuators that go one way
only (True), and of others."""


@dataclass(frozen=True, slots=True)
class Actuator:
    """An actuator that moves a vehicle about one axis, and how its output is found."""

    name: str
    usual: int  # its output in ArduPilot's usual order, if no parameter names it
    ardupilot: tuple[int, ...]  # its SERVOn_FUNCTION, the preferred ones first
    surfaces: tuple[int, ...] = ()  # its CA_SV_CSn_TYPE, likewise
    px4: int = 0  # PX4's function of its output, if it is no surface
    one_way: bool = False
    control: int = 0  # its element of ``controls`` in PX4's logs

    def channel(self, number: int, one_way: bool) -> Channel:
        """Return an output as a share of full deflection."""
        centre, span = _PULSES[one_way]
        field = (f"servo{number}_raw",)
        return Channel(self.name, MOTOR_MESSAGE, field, scale=1.0 / span, offset=-centre / span, where=_FIRST_PORT)


class MixedOutputs(NamedTuple):
    """Two outputs that act about two axes at once: elevons, a V-tail, wheels of two sides."""

    mix: Mix
    first: Actuator
    second: Actuator


DIFFERENTIAL = 6.0
"""CA_AIRFRAME of PX4's rovers that are steered by the difference of their sides."""
NO_OUTPUT = 0.0
"""Scale of the channel of an actuator that no output drives: it never moves."""


def actuator_channels(
    surveys: Sequence[Survey], actuators: Sequence[Actuator], mixes: Sequence[MixedOutputs]
) -> tuple[dict[str, Channel], dict[str, float]]:
    """Return the channel of each actuator by its name, and the parameters of the transform for mixed outputs.

    The channels of mixed outputs stand in place of those of the two actuators. An actuator that no output drives has a
    channel that never moves.

    Raises
    ------
    TelemetryError
        No log has controls, and nothing names the output of any actuator: every airframe of PX4 has its own order.
    """
    # a VTOL's first controls are those of its rotors
    asked = all(
        survey.px4 and survey.onboard and not survey.is_vtol and CONTROLS_MESSAGE in survey.rate_hz
        for survey in surveys
    )
    controls = {a.name: Channel(a.name, CONTROLS_MESSAGE, ("controls", a.control)) for a in actuators}
    if asked and all(
        survey.rate_hz[CONTROLS_MESSAGE] >= _CLEARLY * survey.rate_hz.get(MOTOR_MESSAGE, 0.0) for survey in surveys
    ):
        return controls, {}
    try:
        return _output_channels(surveys, actuators, mixes)
    except TelemetryError:
        if not asked:
            raise
        return controls, {}


def _output_channels(
    surveys: Sequence[Survey], actuators: Sequence[Actuator], mixes: Sequence[MixedOutputs]
) -> tuple[dict[str, Channel], dict[str, float]]:
    required(surveys, [MOTOR_MESSAGE], "servo outputs")
    completed = [_completed(survey) for survey in surveys]
    survey = next((found for found in completed if found.px4 and "CA_AIRFRAME" in found.parameters), completed[0])
    # A log of the outputs themselves also has unused ones, at the pulse of a disarmed output.
    moved = [number for number, output in survey.outputs.items() if output.low < output.high]
    commanded = survey.px4 and survey.onboard and any(number >= _COMMANDED for number in moved)
    if survey.px4 and survey.parameters.get("CA_AIRFRAME") != DIFFERENTIAL:
        mixes = [pair for pair in mixes if not pair.first.px4]
    sides = [side for pair in mixes for side in (pair.first, pair.second)]
    driver, functions = _functions(survey, [*actuators, *sides], commanded)
    if survey.px4 and not functions:
        raise TelemetryError(
            "no parameter of PX4 in the logs says which output drives what (CA_AIRFRAME, CA_SV_CS*_TYPE, "
            "PWM_MAIN_FUNC*, or a SYS_AUTOSTART that is known; each airframe has its own order); fit a .ulg, or "
            "telemetry that holds the parameters"
        )
    found = {a.name: _output(functions, _wanted(survey, a)) for a in (*actuators, *sides)}
    channels, parameters = {}, {}
    for mix, first, second in mixes:
        outputs = found[first.name], found[second.name]
        if found[mix.difference] is None and outputs[0] is not None and outputs[1] is not None:
            channels[mix.difference] = _side(survey, driver, commanded, first.name, outputs[0])
            channels[mix.mean] = _side(survey, driver, commanded, second.name, outputs[1])
            parameters[mix.parameter] = 1.0
    unmixed = [actuator for actuator in actuators if actuator.name not in channels]
    for actuator in unmixed:
        number = found[actuator.name]
        if number is None and not survey.px4 and actuator.usual not in functions:
            number = actuator.usual  # a link may lose parameters: an output without one is as usual
        if number is not None:
            one_way = actuator.one_way or (commanded and number < _COMMANDED)
            channels[actuator.name] = actuator.channel(number, one_way)
    if not channels:
        raise TelemetryError(
            f"by the vehicle's parameters no output of {MOTOR_MESSAGE} drives "
            f"{' or '.join(actuator.name for actuator in actuators)}; --vehicle inertial watches the sensors"
        )
    moves = next(iter(channels.values()))
    silent = {a.name: replace(moves, name=a.name, scale=NO_OUTPUT, offset=0.0) for a in unmixed}
    return silent | channels, parameters


def _side(survey: Survey, driver: str, commanded: bool, name: str, number: int) -> Channel:
    """Return one of two mixed outputs as a share of full deflection, in the direction in which it was commanded."""
    parameters = {key: value for key, value in survey.parameters.items() if abs(value) < _LARGEST}
    (centre, span), reversed_ = _PULSES[commanded and number < _COMMANDED], False
    if not survey.px4:
        servo = f"SERVO{number}_"
        reversed_ = parameters.get(f"{servo}REVERSED", 0.0) > 0.0
        centre = parameters.get(f"{servo}TRIM", centre)
        travel = parameters.get(f"{servo}MAX", centre + span) - parameters.get(f"{servo}MIN", centre - span)
        span = 0.5 * travel if travel >= 1.0 else span
    elif not commanded:
        reversed_ = bool(int(parameters.get(f"{driver.removesuffix('FUNC')}REV", 0.0)) >> (number - 1) & 1)
    scale = (-1.0 if reversed_ else 1.0) / span
    return Channel(name, MOTOR_MESSAGE, (f"servo{number}_raw",), scale=scale, offset=-centre * scale, where=_FIRST_PORT)


def _completed(survey: Survey) -> Survey:
    """Return the survey of a PX4 recording with the parameters that its airframe begins with."""
    number = survey.parameters.get("SYS_AUTOSTART", 0.0)
    if not survey.px4 or number not in _AIRFRAMES:
        return survey
    kinds, functions = _AIRFRAMES[number]
    begins = {f"CA_SV_CS{k}_TYPE": float(kind) for k, kind in enumerate(kinds)}
    begins |= {f"{_DRIVERS[0]}{n}": float(function) for n, function in enumerate(functions, 1)}
    return replace(survey, parameters={"CA_AIRFRAME": 1.0, **begins, **survey.parameters})


def _output(functions: Mapping[int, float], codes: Sequence[int]) -> int | None:
    """Return the first output with the first of some functions that any output has, None if there is none."""
    return next((number for code in codes for number, function in functions.items() if function == code), None)


def _functions(survey: Survey, actuators: Sequence[Actuator], commanded: bool) -> tuple[str, Mapping[int, float]]:
    """Return the prefix of the parameters that name functions of outputs, and those functions by number.

    No functions if no parameter gives an output one of the requested functions.
    """
    if commanded:
        return "", {n: MOTOR + n - 1 if n < _COMMANDED else SERVO + n - _COMMANDED for n in range(1, MAX_OUTPUTS + 1)}
    names = {driver: f"{driver}{{}}" for driver in _DRIVERS} if survey.px4 else {"": "SERVO{}_FUNCTION"}
    asked = {code for actuator in actuators for code in _wanted(survey, actuator)}
    tables = {}
    for driver, name in names.items():
        said = {n: survey.parameters.get(name.format(n)) for n in range(1, MAX_OUTPUTS + 1)}
        tables[driver] = {n: function for n, function in said.items() if function is not None}
    best = max(tables, key=lambda driver: len(asked.intersection(tables[driver].values())))
    return best, tables[best] if asked.intersection(tables[best].values()) else {}


def _wanted(survey: Survey, actuator: Actuator) -> Sequence[int]:
    """Return the functions of an actuator's output, the preferred ones first."""
    if not survey.px4:
        return actuator.ardupilot
    parameters = survey.parameters
    if actuator.px4 == MOTOR and survey.is_vtol:
        # rotors that push along the nose; others lift
        ahead = (abs(parameters.get(f"CA_ROTOR{k}_AX", 0.0)) for k in range(_ROTORS))
        return [MOTOR + k for k, x in enumerate(ahead) if x > abs(parameters.get(f"CA_ROTOR{k}_AZ", -1.0))]
    surfaces = [parameters.get(f"CA_SV_CS{k}_TYPE") for k in range(_SURFACES)]
    found = [SERVO + k for kind in actuator.surfaces for k, its in enumerate(surfaces) if its == kind]
    return [*found, *((actuator.px4,) if actuator.px4 and "CA_AIRFRAME" in parameters else ())]
