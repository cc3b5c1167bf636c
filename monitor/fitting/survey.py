"""The contents of a recording: message names and rates, how servo outputs moved, what the vehicle reports."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch, Columns, cut, gathered, one_message
from adapters.channels import ANY_CLOCK, CLOCK_UNITS_NS, STANDARD_GRAVITY, Channel
from adapters.errors import TelemetryError
from adapters.logs.log_parameters import PARAMETER_MESSAGES, parameter
from adapters.mavlink.heartbeat import ARMED, NO_AUTOPILOT, PX4, vehicle_type
from adapters.message import LATEST_NS, Message
from monitor.sampling.supply import BATTERY_MESSAGE, CELLS_MESSAGE

_SHORTEST_GAP_NS = 5_000_000_000
"""A step of 5 s and of ten usual ones is a gap: nothing was recorded, as between two flights in a log. Chosen: a
shorter loss comes from a bad link, and lowers its rate."""
_GAP_STEPS = 10.0
"""See there."""
_RESTART_NS = -1_000_000_000
"""Least step back, nanoseconds, that shows a clock that began anew; a packet that came late is nearer."""
_BINS_PER_OCTAVE = 4
"""Bins for each octave of steps. Steps are counted by their logarithm, so that a recording of any length needs the same
memory. Chosen: the usual step is then known to a fifth."""
_BINS = 64 * _BINS_PER_OCTAVE


class FlightRate:
    """Counts the steps from stamp to stamp of one message.

    With ``repeats``, messages of the same time count as they arrive together; without, they are one measurement.
    """

    def __init__(self, *, repeats: bool = False) -> None:
        self._repeats = repeats
        self._last_ns: int | None = None
        self._counts = np.zeros(_BINS, np.int64)
        self._sums_ns = np.zeros(_BINS, np.float64)
        # number of steps back, from messages that overtake each other
        self._late = 0
        self._late_ns = 0.0

    def add(self, stamps_ns: NDArray[np.int64]) -> None:
        """Count the stamps (n,) of messages in the order in which they arrived."""
        if not len(stamps_ns):
            return
        before = stamps_ns[:1] if self._last_ns is None else np.array([self._last_ns])
        steps = np.diff(np.concatenate([before, stamps_ns])).astype(np.float64)
        steps = steps[self._last_ns is None :]
        self._last_ns = int(stamps_ns[-1])
        late = steps[(steps <= 0.0 if self._repeats else steps < 0.0) & (steps > _RESTART_NS)]
        self._late += len(late)
        self._late_ns += float(late.sum())
        ahead = steps[steps > 0.0]
        place = (_BINS_PER_OCTAVE * np.log2(ahead)).astype(np.int64)
        self._counts += np.bincount(place, minlength=_BINS)
        self._sums_ns += np.bincount(place, ahead, _BINS)

    @property
    def hz(self) -> float | None:
        """Messages per second without the gaps, None if there are fewer than two."""
        total = int(self._counts.sum())
        if not total:
            return None
        usual = int(np.searchsorted(np.cumsum(self._counts), 0.5 * total))
        longest_ns = max(_GAP_STEPS * 2.0 ** ((usual + 1) / _BINS_PER_OCTAVE), _SHORTEST_GAP_NS)
        kept = np.arange(_BINS) <= _BINS_PER_OCTAVE * np.log2(longest_ns)
        seconds = 1e-9 * (float(self._sums_ns[kept].sum()) + self._late_ns)
        return float(self._counts[kept].sum() + self._late) / seconds if seconds > 0.0 else None


MOTOR_MESSAGE = "SERVO_OUTPUT_RAW"
MAX_OUTPUTS = 16
"""Outputs in a SERVO_OUTPUT_RAW."""
IMUS = {"HIGHRES_IMU": 1.0, **dict.fromkeys(("SCALED_IMU", "RAW_IMU"), STANDARD_GRAVITY / 1000.0)}
"""Messages of an IMU, the preferred ones first, and the units of their accelerations, m/s^2."""
MOTION_MESSAGES = frozenset({MOTOR_MESSAGE, "ATTITUDE", "ATTITUDE_QUATERNION", *IMUS})
"""Messages that only an autopilot sends: the first system with one of them is the vehicle."""

ESC_MESSAGES = tuple(f"ESC_TELEMETRY_{first}_TO_{first + 3}" for first in (1, 5, 9, 13))
"""Messages with the measurements of ArduPilot's speed controllers, four in each. They carry no time, so that of arrival
is used."""
_PX4_VTOLS = (2, 3, 4)
"""PX4's CA_AIRFRAME of standard VTOLs, those that tilt their rotors, and tailsitters."""
_GPS_MESSAGE = "GPS_RAW_INT"
_HEARTBEAT = "HEARTBEAT"
_UNKNOWN = 65_535
"""MAVLink's value of an unknown speed or course, and the largest value of a servo output."""
_PULSES_US = (800, 2200)
"""Pulses of servos and speed controllers, microseconds. Chosen: 1000 to 2000 with room for trims."""
IDLE_US = 1050
"""Pulse up to which an output idles, microseconds. Chosen: an output that is not above 5 % of the range lifts no
vehicle."""
_MANY_VALUES = 8
"""Number of values from which an output counts as a motor in flight; one that is off, at idle, or switched between
positions takes fewer."""


@dataclass(frozen=True, slots=True)
class MotorOutput:
    """How one servo output moved while armed, in microseconds of pulses, or in a simulator's unit."""

    mean: float
    running: float  # mean of its values above idle, if there are any
    # smallest and largest value, zero (no output) left out
    low: int
    high: int
    outside: float  # share of its values that are outside of the pulses of motors and servos
    many: bool  # it took more values than a switched output does


@dataclass(frozen=True, slots=True)
class Survey:
    """Counts of a recording's messages by name, their largest rates, and how each servo output moved while armed."""

    counts: dict[str, int]  # messages by name
    # measurements per second of the vehicle's clock within flights, by name, for messages that carry a time; messages
    # of speed controllers and the battery do not, so their rate is that of arrival
    rate_hz: dict[str, float]
    outputs: dict[int, MotorOutput]  # how servo outputs moved while armed, by number
    # fields of the last message of each name while armed, or of all messages if the vehicle never was; of the GPS, of
    # the last message with speed and course
    examples: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    vehicle_types: frozenset[str] = frozenset()  # the kind of vehicle in the autopilot's heartbeats (``quadrotor``)
    # the vehicle's parameters by name, as far as the recording holds them, each with its last value
    parameters: Mapping[str, float] = field(default_factory=dict)
    never_armed: bool = False  # heartbeats came, and in none the vehicle is armed
    px4: bool = False  # the autopilot is PX4
    onboard: bool = False  # it is an onboard log, or was converted from one

    @property
    def idle(self) -> bool:
        """Whether the vehicle was never armed, or none of its outputs took as many values as a motor in flight does."""
        return self.never_armed or (bool(self.outputs) and not any(output.many for output in self.outputs.values()))

    @property
    def is_vtol(self) -> bool:
        """Whether it has rotors and wings, by its heartbeats or its parameters."""
        by_type = any("vtol" in name for name in self.vehicle_types)
        return by_type or self.parameters.get("Q_ENABLE", 0) > 0 or self.parameters.get("CA_AIRFRAME") in _PX4_VTOLS


def survey(batches: Iterable[Batch]) -> Survey:
    """Read a whole recording once."""
    surveyor = _Surveyor()
    for batch in batches:
        surveyor.add(batch)
    return surveyor.survey()


@dataclass(frozen=True, slots=True)
class _Group:
    """Messages of one name: their indices in the batch and arrival (m,), the fields of each, and all their numbers."""

    name: str
    position: NDArray[np.int64]
    received_ns: NDArray[np.int64]
    fields_at: Callable[[int], Mapping[str, Any]]
    values: Mapping[str, NDArray[np.generic]]


class _Surveyor:
    """Counts and sums over the batches of a recording."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._rates: dict[str, FlightRate] = {}
        self._types: set[int] = set()
        self._autopilot: int | None = None
        self._parameters: dict[str, Message] = {}
        self._onboard = False
        # whether the vehicle is armed is not known before its first heartbeat
        self._armed: bool | None = None
        self._while: dict[bool | None, _State] = {state: _State() for state in (None, False, True)}

    def add(self, batch: Batch) -> None:
        """Count the messages of a batch."""
        others = sorted(batch.others.items())
        groups = [*map(_group, batch.columns), *(_single(*place) for place in others)]
        for _, message in others:
            self._onboard |= message.source.is_onboard_log
            if message.name in PARAMETER_MESSAGES and (known := parameter(message)) is not None:
                self._parameters[known[0]] = message
        stamps: dict[str, list[tuple[NDArray[np.int64], NDArray[np.int64]]]] = {}
        for group in groups:
            self._counts[group.name] += len(group.position)
            stamps.setdefault(group.name, []).append(_stamps(group))
        for name, parts in stamps.items():
            position, times_ns = (np.concatenate(column) for column in zip(*parts, strict=True))
            self._rates.setdefault(name, FlightRate()).add(times_ns[np.argsort(position, kind="stable")])
        for start, stop, armed in self._phases(batch.count, [group for group in groups if group.name == _HEARTBEAT]):
            for group in groups:
                first, last = np.searchsorted(group.position, (start, stop))
                self._while[armed].add(group, int(first), int(last))

    def survey(self) -> Survey:
        """Return the survey of the batches so far."""
        rates = {name: hz for name, rate in self._rates.items() if (hz := rate.hz) is not None}
        armed = self._while[True]
        never_armed = self._armed is not None and not armed.examples
        flown = self._while[None] if self._armed is None else armed
        seen = self._while[False] if never_armed else flown
        outputs = {number: tally.output() for number, tally in sorted(flown.tallies.items())}
        vehicle_types = frozenset(map(vehicle_type, self._types)) - {""}
        # integers may be sent byte by byte, which is known once the autopilot's kind is
        px4 = self._autopilot == PX4
        parameters = dict(filter(None, (parameter(values, px4=px4) for values in self._parameters.values())))
        return Survey(
            counts=dict(self._counts),
            rate_hz=rates,
            outputs=outputs,
            examples=seen.examples,
            vehicle_types=vehicle_types,
            parameters=parameters,
            never_armed=never_armed,
            px4=px4,
            onboard=self._onboard,
        )

    def _phases(self, count: int, heartbeats: Sequence[_Group]) -> Iterator[tuple[int, int, bool | None]]:
        """Yield the parts of a batch with whether the vehicle was armed, and follow its heartbeats."""
        reports = [(int(at), group.fields_at(row)) for group in heartbeats for row, at in enumerate(group.position)]
        start = 0
        for index, fields in sorted(reports, key=lambda report: report[0]):
            if fields.get("autopilot") == NO_AUTOPILOT:
                continue
            mode = fields.get("base_mode")
            armed = isinstance(mode, int) and bool(mode & ARMED)
            if armed is not self._armed:
                yield start, index + 1, self._armed
                start, self._armed = index + 1, armed
            if isinstance(kind := fields.get("type"), int):
                self._types.add(kind)
            self._autopilot = fields.get("autopilot", self._autopilot)
        yield start, count, self._armed


def _group(columns: Columns) -> _Group:
    def fields_at(row: int) -> Mapping[str, Any]:
        return one_message(columns, row).fields

    return _Group(columns.name, columns.position, columns.received_ns, fields_at, columns.fields)


def _single(index: int, message: Message) -> _Group:
    numbers = {name: np.array([value]) for name, value in message.fields.items() if type(value) is int}
    received_ns = np.array([message.received_ns])
    return _Group(message.name, np.array([index]), received_ns, lambda _: message.fields, numbers)


def _is_fix(fields: Mapping[str, Any]) -> bool:
    """Return whether a GPS message holds speed and course."""
    return _UNKNOWN not in (fields.get("vel"), fields.get("cog"))


def _stamps(group: _Group) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return indices and time stamps, vehicle nanoseconds, of the messages that have one (k,)."""
    if group.name in (*ESC_MESSAGES, BATTERY_MESSAGE, CELLS_MESSAGE):
        return group.position, group.received_ns
    times_ns = np.full(len(group.position), np.nan)
    columns = ((name, group.values[name]) for name in CLOCK_UNITS_NS if name in group.values)
    clock = next((name for name, column in columns if column.dtype.kind in "iuf" and column.ndim == 1), None)
    if clock is not None:
        times_ns = group.values[clock].astype(np.float64) * CLOCK_UNITS_NS[clock]
    elif len(times_ns) == 1:
        stamp_ns = ANY_CLOCK.stamp_ns(group.fields_at(0))
        times_ns[0] = np.nan if stamp_ns is None or abs(stamp_ns) >= LATEST_NS else stamp_ns
    # zero stands for no time
    good = (times_ns != 0.0) & (np.abs(times_ns) < LATEST_NS)
    return group.position[good], times_ns[good].astype(np.int64)


class _State:
    """Counts while the vehicle was armed, was not, or had not reported either.

    ``examples`` are fields of the last message by name, ``tallies`` sums of the servo outputs by number.
    """

    def __init__(self) -> None:
        self.examples: dict[str, Mapping[str, Any]] = {}
        self.tallies: dict[int, _Tally] = {}

    def add(self, group: _Group, first: int, last: int) -> None:
        """Count the messages first <= row < last of a group."""
        rows = range(last - 1, first - 1, -1)
        row = next((row for row in rows if group.name != _GPS_MESSAGE or _is_fix(group.fields_at(row))), None)
        if row is not None:
            self.examples[group.name] = group.fields_at(row)
        if group.name == MOTOR_MESSAGE:
            self._add_outputs({name: values[first:last] for name, values in group.values.items()})

    def _add_outputs(self, values: Mapping[str, NDArray[np.generic]]) -> None:
        port = values.get("port")
        for number in range(1, MAX_OUTPUTS + 1):
            column = values.get(f"servo{number}_raw")
            if column is not None and column.dtype.kind in "iu":
                pulses = column.astype(np.int64)
                moved = pulses[(pulses > 0) & (pulses <= _UNKNOWN) & (True if port is None else port == 0)]
                if len(moved):
                    self.tallies.setdefault(number, _Tally()).add(moved)


class _Tally:
    """Number and sum of the values of one output: of all, and of those above idle."""

    def __init__(self) -> None:
        self.total, self.above = (0, 0), (0, 0)
        self.low, self.high, self.outside = _UNKNOWN, 0, 0
        self.values: set[int] = set()

    def add(self, pulses: NDArray[np.int64]) -> None:
        """Count values (m,)."""
        above = pulses[pulses > IDLE_US]
        self.total = self.total[0] + len(pulses), self.total[1] + int(pulses.sum())
        self.above = self.above[0] + len(above), self.above[1] + int(above.sum())
        self.low, self.high = min(self.low, int(pulses.min())), max(self.high, int(pulses.max()))
        self.outside += int(np.count_nonzero((pulses < _PULSES_US[0]) | (pulses > _PULSES_US[1])))
        if len(self.values) < _MANY_VALUES:
            self.values.update(np.unique(pulses).tolist())

    def output(self) -> MotorOutput:
        """Return how the output moved."""
        (count, total), (above, above_sum) = self.total, self.above
        many, running = len(self.values) >= _MANY_VALUES, above_sum / (above or 1)
        return MotorOutput(total / count, running, self.low, self.high, self.outside / count, many)


def of_one_vehicle(batches: Iterable[Batch], names: Collection[str] = MOTION_MESSAGES) -> Iterator[Batch]:
    """Yield the messages of the first system that sends one of these messages, from then on.

    Its earlier parameters are included, since logs begin with them; so is telemetry that carries no ids, as that of ROS
    2, which belongs to the vehicle of the recording.
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
                if free := {at: message for at, message in batch.others.items() if _has_no_ids(message)}:
                    yield gathered([], free)
                continue
            system = min(senders)[1]
            if kept := [message for message in early if _is_of(message, system)]:
                yield Batch(len(kept), (), dict(enumerate(kept)))
        remaining = cut(batch, first, batch.count)
        columns = [columns for columns in remaining.columns if columns.system == system]
        others = {index: message for index, message in remaining.others.items() if _is_of(message, system)}
        yield gathered(columns, others)


def _is_of(message: Message, system: int) -> bool:
    """Return whether a message belongs to a system; a log's parameters carry no ids."""
    own = message.system == system or _has_no_ids(message)
    return own or (message.source.is_onboard_log and message.name in PARAMETER_MESSAGES)


def _has_no_ids(message: Message) -> bool:
    """Return whether a message is telemetry that never carries ids, other than a log's own records."""
    source = message.source
    return source.is_telemetry and not source.has_ids and not source.is_onboard_log


def in_every(surveys: Sequence[Survey], messages: Iterable[str]) -> str | None:
    """Return the first of some messages whose rate is known in every recording, None if there is none."""
    return next((name for name in messages if least_hz(surveys, name) > 0.0), None)


def required(surveys: Sequence[Survey], messages: Collection[str], holds: str, rate: str = "50 Hz") -> str:
    """Return the first of some messages that every recording has; raise TelemetryError, which says what to record."""
    if (found := in_every(surveys, messages)) is None:
        where, which = (" in every log", "one of ") if len(messages) > 1 else ("", "")
        raise TelemetryError(f"no {holds}{where}; record {which}{', '.join(messages)} at {rate} or more")
    return found


def least_hz(surveys: Sequence[Survey], message: str) -> float:
    """Return the lowest rate of a message over the recordings; 0 if one recording has none of it."""
    return min(found.rate_hz.get(message, 0.0) for found in surveys)


def fitted_rates(surveys: Sequence[Survey], channels: Sequence[Channel]) -> dict[str, float]:
    """Return, for the messages of channels, the lowest rate of each over the recordings."""
    names = sorted({channel.message for channel in channels})
    return {name: float(f"{least_hz(surveys, name):.3g}") for name in names}


def common_rate_hz(surveys: Sequence[Survey], channels: Sequence[Channel]) -> float:
    """Return the rate of the grid: the slowest channel's in the slowest log, rounded to a whole number of hertz."""
    slowest = min(found.rate_hz[channel.message] for found in surveys for channel in channels)
    return float(max(1, round(slowest)))
