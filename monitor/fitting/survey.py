"""What a recording holds: message names, senders, rates; and which of them can feed a multirotor's channels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import log10
from typing import Any

from adapters.channels import Channel
from adapters.errors import TelemetryError
from adapters.mavlink.vehicle_type import vehicle_type
from adapters.message import LATEST_NS, Message
from monitor.sampling.phase import FlightPhase
from monitor.vehicles.inertial.strapdown_channels import INERTIAL_MESSAGES

MOTOR_MESSAGE = "SERVO_OUTPUT_RAW"
_GPS_MESSAGE = "GPS_RAW_INT"
_UNKNOWN = 65_535
_OUTPUTS_PER_MESSAGE = 16
_GRAVITY = 9.80665
_STILL_US = 0.5
_IDLE_US = 1050.0
_PULSES_US = (800, 2200)
_FEW_OUTSIDE = 0.01
_PULSE_RANGE = (1000.0, 2000.0)
_GAZEBO_RANGE = (150.0, 1000.0)
"""SIM_GZ_EC_MIN and SIM_GZ_EC_MAX of PX4's gz_x500: what its commands 0 to 1 of motors become."""
_FEWEST_MOTORS = 3
_MANY_VALUES = 8
"""A motor in flight takes more values; an output that is off, at idle, or switches between such takes a few."""
_ALIKE = 2.0
"""How far an output's mean may be from the median of all that move, as a factor, to be one of the motors."""

_RATES = (
    ("ATTITUDE", ("rollspeed", "pitchspeed", "yawspeed"), 1.0),
    ("HIGHRES_IMU", ("xgyro", "ygyro", "zgyro"), 1.0),
    ("ATTITUDE_QUATERNION", ("rollspeed", "pitchspeed", "yawspeed"), 1.0),
)
_VERTICAL = (
    ("HIGHRES_IMU", "zacc", 1.0),
    ("SCALED_IMU", "zacc", _GRAVITY / 1000.0),
    ("RAW_IMU", "zacc", _GRAVITY / 1000.0),
)
_SPEED_MESSAGES = frozenset({"VFR_HUD", "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT"})
_CHANNEL_MESSAGES = frozenset({MOTOR_MESSAGE} | {name for name, *_ in (*_RATES, *_VERTICAL)})
FIT_MESSAGES = _CHANNEL_MESSAGES | _SPEED_MESSAGES | INERTIAL_MESSAGES | FlightPhase.interests


@dataclass(frozen=True, slots=True)
class Output:
    """How one servo output moved while armed, as MAVLink gives it: pulses in microseconds, or what a simulator sends.

    Parameters
    ----------
    mean, spread : float
        Mean and standard deviation.
    low, high : int
        Smallest and largest value, zero (no output) left out.
    outside : float
        Share of its values that no pulse of a motor or servo has.
    many : bool
        It took more values than an output does that is switched.
    """

    mean: float
    spread: float
    low: int
    high: int
    outside: float
    many: bool


@dataclass(frozen=True, slots=True)
class CommandRange:
    """Which outputs are motors, and what of their values is no command and full command.

    Parameters
    ----------
    motors : tuple[int, ...]
        Numbers of the outputs.
    stop, full : float
        Values that stand for 0 and for 1.
    """

    motors: tuple[int, ...]
    stop: float
    full: float

    @property
    def pulses(self) -> bool:
        """Whether they are pulses of 1000 to 2000 microseconds."""
        return (self.stop, self.full) == _PULSE_RANGE


@dataclass(frozen=True, slots=True)
class Survey:
    """Counts of a recording's messages by name, their largest rates, and how each servo output moved while armed.

    Parameters
    ----------
    counts : dict[str, int]
        Messages by name.
    rate_hz : dict[str, float]
        Messages per second of the vehicle's clock, by name, for those that carry a time.
    outputs : dict[int, Output]
        How servo outputs moved while armed, by number.
    examples : dict[str, Mapping[str, Any]]
        Fields of the last message of each name while armed; of the GPS, the last that knew speed and course.
    vehicle_types : frozenset[str]
        What the autopilot's heartbeats say it is (``quadrotor``).
    """

    counts: dict[str, int]
    rate_hz: dict[str, float]
    outputs: dict[int, Output]
    examples: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    vehicle_types: frozenset[str] = frozenset()


def survey(messages: Iterable[Message]) -> Survey:
    """Go through a recording once."""
    counts: Counter[str] = Counter()
    spans: dict[str, tuple[int, int]] = {}
    tallies: dict[int, _Tally] = {}
    armed = True
    clock = Channel("clock", "", ("",))
    examples: dict[str, Mapping[str, Any]] = {}
    types: set[int] = set()
    for message in messages:
        counts[message.name] += 1
        if armed and not (message.name == _GPS_MESSAGE and _UNKNOWN in map(message.fields.get, ("vel", "cog"))):
            examples[message.name] = message.fields
        stamp = clock.stamp_ns(message.fields)
        if stamp and abs(stamp) < LATEST_NS:
            first, _ = spans.get(message.name, (stamp, stamp))
            spans[message.name] = (first, stamp)
        if message.name == "HEARTBEAT" and message.fields.get("autopilot") != 8:
            mode = message.fields.get("base_mode")
            armed = isinstance(mode, int) and bool(mode & 128)
            if isinstance(kind := message.fields.get("type"), int):
                types.add(kind)
        elif message.name == MOTOR_MESSAGE and armed and not message.fields.get("port"):
            for number in range(1, _OUTPUTS_PER_MESSAGE + 1):
                pulse = message.fields.get(f"servo{number}_raw")
                if isinstance(pulse, int) and 0 < pulse <= _UNKNOWN:
                    tallies.setdefault(number, _Tally()).add(pulse)
    rates = {name: (counts[name] - 1) * 1e9 / (last - first) for name, (first, last) in spans.items() if last > first}
    outputs = {number: tally.output() for number, tally in sorted(tallies.items())}
    vehicle_types = frozenset(map(vehicle_type, types)) - {""}
    return Survey(dict(counts), rates, outputs, examples, vehicle_types)


class _Tally:
    """Sums over one output's values."""

    def __init__(self) -> None:
        self.total = [0.0, 0.0, 0.0]
        self.low, self.high, self.outside = _UNKNOWN, 0, 0
        self.values: set[int] = set()

    def add(self, pulse: int) -> None:
        total = self.total
        total[0] += 1
        total[1] += pulse
        total[2] += pulse * pulse
        self.low, self.high = min(self.low, pulse), max(self.high, pulse)
        self.outside += not _PULSES_US[0] <= pulse <= _PULSES_US[1]
        if len(self.values) < _MANY_VALUES:
            self.values.add(pulse)

    def output(self) -> Output:
        count, total, square = self.total
        spread = max(0.0, square / count - (total / count) ** 2) ** 0.5
        many = len(self.values) >= _MANY_VALUES
        return Output(total / count, spread, self.low, self.high, self.outside / count, many)


def of_one_vehicle(messages: Iterable[Message]) -> Iterator[Message]:
    """Yield the messages of the first system that sends motor commands, rates or accelerations, from then on."""
    system: int | None = None
    for message in messages:
        if system is None and message.name in _CHANNEL_MESSAGES:
            system = message.system
        if message.system == system:
            yield message


def multirotor_channels(surveys: Sequence[Survey]) -> tuple[tuple[Channel, ...], tuple[Channel, ...]]:
    """Choose the input and output channels of a multirotor from what every recording holds.

    Motors are the servo outputs that :func:`motor_commands` finds, numbered after the output.

    Raises
    ------
    TelemetryError
        A message that is needed is missing; the text says which to stream.
    """
    common = set.intersection(*(set(found.rate_hz) for found in surveys))
    rates = next((source for source in _RATES if source[0] in common), None)
    vertical = next((source for source in _VERTICAL if source[0] in common), None)
    if rates is None:
        raise TelemetryError(f"no body rates in every log; record one of {', '.join(s[0] for s in _RATES)} at 50 Hz+")
    if vertical is None:
        raise TelemetryError(
            f"no vertical acceleration in every log; record one of {', '.join(s[0] for s in _VERTICAL)} at 50 Hz+"
        )
    if MOTOR_MESSAGE not in common:
        raise TelemetryError(f"no motor commands in every log; record {MOTOR_MESSAGE} at 50 Hz or more")
    commands = motor_commands(surveys)
    span = commands.full - commands.stop
    scale, offset = (0.001, -1.0) if commands.pulses else (1.0 / span, -commands.stop / span)
    inputs = tuple(
        Channel(
            f"motor{number}",
            MOTOR_MESSAGE,
            (f"servo{number}_raw",),
            scale=scale,
            offset=offset,
            where=(("port", 0),),
        )
        for number in commands.motors
    )
    names = ("roll_rate", "pitch_rate", "yaw_rate")
    outputs = tuple(
        Channel(name, rates[0], (field,), scale=rates[2]) for name, field in zip(names, rates[1], strict=True)
    )
    message, field, scale = vertical
    return inputs, (*outputs, Channel("vertical_acceleration", message, (field,), scale=scale))


def common_rate_hz(surveys: Sequence[Survey], channels: Sequence[Channel]) -> float:
    """Return the rate of the grid: the slowest channel's in the slowest log, rounded to a whole number of hertz."""
    slowest = min(found.rate_hz[channel.message] for found in surveys for channel in channels)
    return float(max(1, round(slowest)))


def motor_commands(surveys: Sequence[Survey]) -> CommandRange:
    """Find the outputs that are motors, and the range of their commands.

    Pulses above idle that moved while armed are motors, from 1000 to 2000 microseconds. Simulators send speeds of the
    speed controllers in place of pulses, logs of some autopilots DShot values: where fewer than three
    pulses move, those outputs are motors whose values are no pulses and many in every log, and of about the same mean.
    Within 150 to 1000 they are taken for those of PX4 with Gazebo, which has that range. Else zero is no command, and
    full the largest value seen, rounded up to 1, 2 or 5 times a power of ten.

    Raises
    ------
    TelemetryError
        Fewer than three move; the text says what each output did.
    """
    pulses = _in_every_log(surveys, _moves_as_pulse)
    if len(set(pulses).difference(_in_every_log(surveys, _is_no_pulse))) >= _FEWEST_MOTORS:
        return CommandRange(tuple(pulses), *_PULSE_RANGE)
    moving = _in_every_log(surveys, lambda output: output.many and _is_no_pulse(output))
    if moving:
        means = {n: sum(found.outputs[n].mean for found in surveys) / len(surveys) for n in moving}
        middle = sorted(means.values())[len(means) // 2]
        moving = [number for number in moving if middle / _ALIKE <= means[number] <= middle * _ALIKE]
    if len(moving) < _FEWEST_MOTORS:
        seen = {number: _seen(surveys, number) for number in range(1, _OUTPUTS_PER_MESSAGE + 1)}
        told = ", ".join(f"servo{number} {span}" for number, span in seen.items() if span)
        raise TelemetryError(
            f"{MOTOR_MESSAGE} shows {max(len(pulses), len(moving))} outputs that move in flight; a multirotor has "
            f"more. Seen while armed: {told or 'nothing but zero'}; record a flight in the air, with the outputs that "
            "its motors are on"
        )
    low, high = _extremes(surveys, moving)
    known = _GAZEBO_RANGE[0] <= low and high <= _GAZEBO_RANGE[1]
    return CommandRange(tuple(moving), *(_GAZEBO_RANGE if known else (0.0, _rounded_up(high))))


def range_text(commands: CommandRange, surveys: Sequence[Survey]) -> str:
    """Return, for people, what was taken as the range of commands that are no pulses."""
    low, high = _extremes(surveys, commands.motors)
    return (
        f"motor commands are no pulses of 1000 to 2000 us but {low} to {high}: "
        f"{commands.stop:g} is taken as no command, {commands.full:g} as full command"
    )


def _in_every_log(surveys: Sequence[Survey], moves: Callable[[Output], bool]) -> list[int]:
    numbers = range(1, _OUTPUTS_PER_MESSAGE + 1)
    return [n for n in numbers if all(n in found.outputs and moves(found.outputs[n]) for found in surveys)]


def _moves_as_pulse(output: Output) -> bool:
    return output.mean > _IDLE_US and output.spread > _STILL_US


def _extremes(surveys: Sequence[Survey], numbers: Sequence[int]) -> tuple[int, int]:
    found = [one.outputs[number] for one in surveys for number in numbers]
    return min(one.low for one in found), max(one.high for one in found)


def _is_no_pulse(output: Output) -> bool:
    return output.outside > _FEW_OUTSIDE or output.high <= _IDLE_US


def _seen(surveys: Sequence[Survey], number: int) -> str:
    """Return the range of an output over all logs, empty where it gave nothing."""
    found = [one.outputs[number] for one in surveys if number in one.outputs]
    if not found:
        return ""
    low, high = min(one.low for one in found), max(one.high for one in found)
    return f"{low} to {high}" if high > low else f"always {low}"


def _rounded_up(value: float) -> float:
    """Return the next of 1, 2 and 5 times a power of ten."""
    power = 10.0 ** int(log10(value))
    return next(step * power for step in (1.0, 2.0, 5.0, 10.0) if value <= step * power)
