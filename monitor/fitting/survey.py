"""What a recording holds: message names and rates, how servo outputs moved, what the vehicle says it is."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from adapters.channels import Channel
from adapters.mavlink.vehicle_type import vehicle_type
from adapters.message import LATEST_NS, Message

MOTOR_MESSAGE = "SERVO_OUTPUT_RAW"
MAX_OUTPUTS = 16
"""Outputs in a SERVO_OUTPUT_RAW."""
MOTION_MESSAGES = frozenset({MOTOR_MESSAGE, "ATTITUDE", "ATTITUDE_QUATERNION", "HIGHRES_IMU", "SCALED_IMU", "RAW_IMU"})
"""Messages that only an autopilot sends: the first system with one of them is the vehicle."""

_GPS_MESSAGE = "GPS_RAW_INT"
_UNKNOWN = 65_535
"""MAVLink's value of an unknown speed or course, and the largest that a servo output can hold."""
_PULSES_US = (800, 2200)
"""Pulses that servos and speed controllers accept: 1000 to 2000 us with the trims that autopilots allow."""
_MANY_VALUES = 8
"""A motor in flight takes more values; an output that is off, at idle, or switched between positions takes a few."""


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
            for number in range(1, MAX_OUTPUTS + 1):
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
        if system is None and message.name in MOTION_MESSAGES:
            system = message.system
        if message.system == system:
            yield message


def common_rate_hz(surveys: Sequence[Survey], channels: Sequence[Channel]) -> float:
    """Return the rate of the grid: the slowest channel's in the slowest log, rounded to a whole number of hertz."""
    slowest = min(found.rate_hz[channel.message] for found in surveys for channel in channels)
    return float(max(1, round(slowest)))
