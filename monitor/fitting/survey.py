"""What a recording holds: message names and rates, how servo outputs moved, what the vehicle says it is."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch, Columns, cut, gathered, one_message
from adapters.channels import Channel
from adapters.logs.log_parameters import PARAMETER_MESSAGES, parameter
from adapters.mavlink.heartbeat import vehicle_type
from adapters.message import LATEST_NS, Message

MOTOR_MESSAGE = "SERVO_OUTPUT_RAW"
MAX_OUTPUTS = 16
"""Outputs in a SERVO_OUTPUT_RAW."""
MOTION_MESSAGES = frozenset({MOTOR_MESSAGE, "ATTITUDE", "ATTITUDE_QUATERNION", "HIGHRES_IMU", "SCALED_IMU", "RAW_IMU"})
"""Messages that only an autopilot sends: the first system with one of them is the vehicle."""

_GPS_MESSAGE = "GPS_RAW_INT"
_HEARTBEAT = "HEARTBEAT"
_NO_AUTOPILOT = 8
"""MAV_AUTOPILOT_INVALID: the sender of such a heartbeat is no autopilot."""
_PX4 = 12
"""MAV_AUTOPILOT_PX4."""
_ARMED = 128
"""MAV_MODE_FLAG_SAFETY_ARMED of ``base_mode``."""
_ANY_CLOCK = Channel("clock", "", ("",))
_UNKNOWN = 65_535
"""MAVLink's value of an unknown speed or course, and the largest that a servo output can hold."""
_PULSES_US = (800, 2200)
"""Pulses of servos and speed controllers, microseconds. Chosen: 1000 to 2000 with room for trims."""
_MANY_VALUES = 8
"""A motor in flight takes more values; an output that is off, at idle, or switched between positions takes a few."""


@dataclass(frozen=True, slots=True)
class MotorOutput:
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
    outputs : dict[int, MotorOutput]
        How servo outputs moved while armed, by number.
    examples : dict[str, Mapping[str, Any]]
        Fields of the last message of each name while armed; of the GPS, the last that knew speed and course.
    vehicle_types : frozenset[str]
        What the autopilot's heartbeats say it is (``quadrotor``).
    parameters : Mapping[str, float]
        The vehicle's parameters by name, as far as the recording holds them, each with the last value that it had.
    """

    counts: dict[str, int]
    rate_hz: dict[str, float]
    outputs: dict[int, MotorOutput]
    examples: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    vehicle_types: frozenset[str] = frozenset()
    parameters: Mapping[str, float] = field(default_factory=dict)


def survey(batches: Iterable[Batch]) -> Survey:
    """Go through a recording once."""
    surveyor = _Surveyor()
    for batch in batches:
        surveyor.add(batch)
    return surveyor.survey()


@dataclass(frozen=True, slots=True)
class _Group:
    """Messages of one name: their indices in the batch (m,), the fields of each, and all values of its numbers."""

    name: str
    position: NDArray[np.int64]
    fields_at: Callable[[int], Mapping[str, Any]]
    values: Mapping[str, NDArray[np.generic]]


class _Surveyor:
    """Counts and sums over the batches of a recording."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._spans: dict[str, tuple[int, int]] = {}
        self._tallies: dict[int, _Tally] = {}
        self._examples: dict[str, Mapping[str, Any]] = {}
        self._types: set[int] = set()
        self._autopilot: int | None = None
        self._parameters: dict[str, Message] = {}
        self._armed = True

    def add(self, batch: Batch) -> None:
        """Count the messages of a batch."""
        groups = [*map(_group, batch.columns), *(_single(*place) for place in batch.others.items())]
        armed = self._armed_at(batch.count, [group for group in groups if group.name == _HEARTBEAT])
        for _, message in sorted(batch.others.items()):
            if message.name in PARAMETER_MESSAGES and (known := parameter(message)) is not None:
                self._parameters[known[0]] = message
        newest: dict[str, int] = {}
        stamps: dict[str, list[tuple[int, int]]] = {}
        for group in groups:
            name, position = group.name, group.position
            self._counts[name] += len(position)
            candidates = (row for row in range(len(position) - 1, -1, -1) if armed[position[row]])
            row = next((row for row in candidates if name != _GPS_MESSAGE or _is_fix(group.fields_at(row))), None)
            if row is not None and position[row] >= newest.get(name, 0):
                newest[name], self._examples[name] = int(position[row]), group.fields_at(row)
            stamps.setdefault(name, []).extend(_first_and_last_stamp(group))
            if name == MOTOR_MESSAGE:
                self._add_outputs(group.values, armed[position])
        for name, found in stamps.items():
            if found:
                first, last = min(found)[1], max(found)[1]
                self._spans[name] = self._spans.get(name, (first, last))[0], last

    def survey(self) -> Survey:
        """Return the survey of the batches so far."""
        rates = {
            name: (self._counts[name] - 1) * 1e9 / (last - first)
            for name, (first, last) in self._spans.items()
            if last > first
        }
        outputs = {number: tally.output() for number, tally in sorted(self._tallies.items())}
        vehicle_types = frozenset(map(vehicle_type, self._types)) - {""}
        # whether integers are sent byte by byte is known once the autopilot has said what it is
        parameters = dict(
            filter(None, (parameter(one, px4=self._autopilot == _PX4) for one in self._parameters.values()))
        )
        return Survey(dict(self._counts), rates, outputs, self._examples, vehicle_types, parameters)

    def _armed_at(self, count: int, heartbeats: Sequence[_Group]) -> NDArray[np.bool_]:
        """Return whether the vehicle was armed when each message arrived (count,), and follow its heartbeats."""
        armed = np.empty(count, np.bool_)
        reports = [(int(at), group.fields_at(row)) for group in heartbeats for row, at in enumerate(group.position)]
        start = 0
        for index, fields in sorted(reports, key=lambda report: report[0]):
            if fields.get("autopilot") == _NO_AUTOPILOT:
                continue
            armed[start : index + 1] = self._armed
            mode, start = fields.get("base_mode"), index + 1
            self._armed = isinstance(mode, int) and bool(mode & _ARMED)
            if isinstance(kind := fields.get("type"), int):
                self._types.add(kind)
            self._autopilot = fields.get("autopilot", self._autopilot)
        armed[start:] = self._armed
        return armed

    def _add_outputs(self, values: Mapping[str, NDArray[np.generic]], armed: NDArray[np.bool_]) -> None:
        for number in range(1, MAX_OUTPUTS + 1):
            column = values.get(f"servo{number}_raw")
            if column is not None and column.dtype.kind in "iu":
                port = values.get("port")
                used = armed if port is None else armed & (port == 0)
                pulses = column.astype(np.int64)
                moved = pulses[used & (pulses > 0) & (pulses <= _UNKNOWN)]
                if len(moved):
                    self._tallies.setdefault(number, _Tally()).add(moved)


def _group(columns: Columns) -> _Group:
    return _Group(columns.name, columns.position, lambda row: one_message(columns, row).fields, columns.fields)


def _single(index: int, message: Message) -> _Group:
    numbers = {name: np.array([value]) for name, value in message.fields.items() if type(value) is int}
    return _Group(message.name, np.array([index]), lambda _: message.fields, numbers)


def _is_fix(fields: Mapping[str, Any]) -> bool:
    """Return whether a GPS message knows speed and course."""
    return _UNKNOWN not in (fields.get("vel"), fields.get("cog"))


def _first_and_last_stamp(group: _Group) -> list[tuple[int, int]]:
    """Return index and time stamp, vehicle nanoseconds, of the first and of the last message that has one."""
    rows = range(len(group.position))
    found = []
    for ordered in (rows, reversed(rows)):
        stamps = ((row, _ANY_CLOCK.stamp_ns(group.fields_at(row))) for row in ordered)
        row, stamp = next(((row, stamp) for row, stamp in stamps if stamp and abs(stamp) < LATEST_NS), (0, None))
        if stamp is None:
            break
        found.append((int(group.position[row]), stamp))
    return found


class _Tally:
    """Sums over one output's values."""

    def __init__(self) -> None:
        self.total = [0.0, 0.0, 0.0]
        self.low, self.high, self.outside = _UNKNOWN, 0, 0
        self.values: set[int] = set()

    def add(self, pulses: NDArray[np.int64]) -> None:
        """Count values (m,)."""
        self.total = [
            now + float(more)
            for now, more in zip(self.total, (len(pulses), pulses.sum(), (pulses**2).sum()), strict=True)
        ]
        self.low, self.high = min(self.low, int(pulses.min())), max(self.high, int(pulses.max()))
        self.outside += int(np.count_nonzero((pulses < _PULSES_US[0]) | (pulses > _PULSES_US[1])))
        if len(self.values) < _MANY_VALUES:
            self.values.update(np.unique(pulses).tolist())

    def output(self) -> MotorOutput:
        """Return how the output moved."""
        count, total, square = self.total
        spread = max(0.0, square / count - (total / count) ** 2) ** 0.5
        many = len(self.values) >= _MANY_VALUES
        return MotorOutput(total / count, spread, self.low, self.high, self.outside / count, many)


def of_one_vehicle(batches: Iterable[Batch], names: Collection[str] = MOTION_MESSAGES) -> Iterator[Batch]:
    """Yield the messages of the first system that sends one of these messages, from then on.

    Its parameters come along from before, too: logs begin with them.
    """
    system: int | None = None
    early: list[Message] = []
    for batch in batches:
        first = 0
        if system is None:
            senders = [(int(columns.position[0]), columns.system) for columns in batch.columns if columns.name in names]
            senders += [(at, message.system) for at, message in batch.others.items() if message.name in names]
            first = min(senders)[0] if senders else batch.count
            early += [m for at, m in sorted(batch.others.items()) if at < first and m.name in PARAMETER_MESSAGES]
            if not senders:
                continue
            system = min(senders)[1]
            if kept := [message for message in early if _is_of(message, system)]:
                yield Batch(len(kept), (), dict(enumerate(kept)))
        remaining = cut(batch, first, batch.count)
        columns = [columns for columns in remaining.columns if columns.system == system]
        others = {index: message for index, message in remaining.others.items() if _is_of(message, system)}
        yield gathered(columns, others)


def _is_of(message: Message, system: int) -> bool:
    """Return whether a message is of a system; a log's parameters carry no ids."""
    return message.system == system or (message.source.is_onboard_log and message.name in PARAMETER_MESSAGES)


def common_rate_hz(surveys: Sequence[Survey], channels: Sequence[Channel]) -> float:
    """Return the rate of the grid: the slowest channel's in the slowest log, rounded to a whole number of hertz."""
    slowest = min(found.rate_hz[channel.message] for found in surveys for channel in channels)
    return float(max(1, round(slowest)))
