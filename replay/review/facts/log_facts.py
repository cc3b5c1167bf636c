"""The facts that a log states: the signals that findings compare, on the log's own clock, for every kind of log."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from math import inf
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from adapters.batch import Batch
from adapters.channels import Angle
from adapters.logs.log_parameters import PARAMETER_MESSAGES, parameter
from adapters.logs.log_telemetry import rotation_angle
from monitor.alarms.command_watch import COMMANDS, CommandSent, StreamFilter
from monitor.vehicles.kinds import KINDS

Floats = NDArray[np.float64]
Changes = Sequence[tuple[float, float]]
"""Times at which a value changed, and the new values."""
Spans = Sequence[tuple[float, float]]
"""Begins and ends of a state, in order."""
ANGLES: tuple[Angle, ...] = ("roll", "pitch", "yaw")
RATIOS = ("velocity", "position", "height")
SUBMARINE = "submarine"


@dataclass(frozen=True, slots=True, eq=False)
class LogSignal:
    """A signal: quantities over time; false if it has no values."""

    time_s: Floats  # seconds since the log's begin, ascending (n,)
    values: Floats  # a column for each name (n, k); NaN: unknown
    names: tuple[str, ...]  # names of the columns
    unit: str
    origin: str  # name of its record in the log

    def __bool__(self) -> bool:
        """Return whether there are values."""
        return len(self.time_s) > 0

    def during(self, start_s: float, end_s: float) -> LogSignal:
        """Return the part from one time on and before another."""
        part = slice(*np.searchsorted(self.time_s, (start_s, end_s)))
        return replace(self, time_s=self.time_s[part], values=self.values[part])

    def at(self, times_s: Floats) -> Floats:
        """Return the last known values at m times (m, k), NaN before the first."""
        unknown = np.full((1, self.values.shape[1]), np.nan)
        return np.concatenate([unknown, self.values])[np.searchsorted(self.time_s, times_s, side="right")]

    @property
    def rate_hz(self) -> float:
        """Its usual rate."""
        return float(1.0 / max(np.median(np.diff(self.time_s)), 1e-9)) if len(self.time_s) > 1 else 0.0

    @property
    def only(self) -> Floats:
        """The first column (n,)."""
        return np.asarray(self.values[:, 0], np.float64)

    def changes(self, of: Callable[[Floats], NDArray[Any]] = np.asarray) -> list[tuple[float, float]]:
        """Return the times at which a function of the first column changed, and its values, the first included."""
        values = of(self.only)
        new = np.concatenate([[True], values[1:] != values[:-1]])[: len(values)]
        return [(float(self.time_s[row]), float(values[row])) for row in np.flatnonzero(new)]

    def each_sample(self, name: str, of: Callable[..., Floats]) -> LogSignal:
        """Return one column of several: ``of`` (``np.max``, ``np.sum``) of each sample."""
        return replace(self, values=of(self.values, axis=1, keepdims=True), names=(name,))

    def above_begin(self) -> LogSignal:
        """Return a height above its median over the first seconds."""
        begin = self.values[self.time_s < self.time_s[:1] + BEGIN_S]
        return replace(self, values=self.values - np.nanmedian(begin, axis=0)) if self else self

    def angles_deg(self) -> LogSignal:
        """Return roll, pitch and yaw of quaternions (w, x, y, z), degrees."""
        angles = np.stack([rotation_angle(self.values, which) for which in ANGLES], axis=1)
        return replace(self, values=np.degrees(angles), names=ANGLES, unit="deg")

    def way(self) -> LogSignal:
        """Return the path north and east (m) from latitude, longitude (degrees or 1e-7 of one) and kind of fix."""
        degrees = self.values[:, :2]
        degrees = degrees * np.where(np.nanmax(np.abs(degrees), initial=0.0) > _MOST_DEGREES, 1e-7, 1.0)
        known = np.isfinite(degrees).all(axis=1) & (self.values[:, 2] >= FIX_3D)
        degrees = degrees[known]
        off = degrees - degrees[:1]
        # the shorter way across the date line
        off[:, 1] = (off[:, 1] + 180.0) % 360.0 - 180.0
        metres = _DEGREE_M * off * [1.0, np.cos(np.radians(degrees[0, 0])) if known.any() else 1.0]
        return replace(self, time_s=self.time_s[known], values=metres, names=("north", "east"), unit="m")

    def climb(self) -> LogSignal:
        """Return the vertical speed upwards (m/s) from a receiver's speed downwards and kind of fix."""
        known = self.values[:, -1] >= FIX_3D
        return replace(self, time_s=self.time_s[known], values=-self.values[known, :1], names=("climb",), unit="m/s")


NO_SIGNAL = LogSignal(np.empty(0), np.empty((0, 1)), ("",), "", "")
"""A signal that the log does not have: one column without a row."""
UNKNOWN_LEVEL = 8
"""Severity of a text in a log without severities; MAVLink's end with 7."""


@dataclass(frozen=True, slots=True)
class Statement:
    """An event that the log states at a time: a text, a mode, a failsafe."""

    time_s: float
    kind: str  # text, mode, arming, landing, failsafe, command, parameter
    text: str
    # of a text: MAVLink's severity, or UNKNOWN_LEVEL; of a state: 1: it begins, 0: it ends
    level: int = 0


@dataclass(frozen=True, slots=True)
class LearnedAlarm:
    """An alarm of a profile learned from the flight itself: its typical size, and its peak relative to its threshold.

    ``possible`` tells whether an actuator can lose as much as that size.
    """

    start_s: float
    end_s: float
    observer: str
    channel: str
    share: float
    text: str
    size: float = 0.0
    possible: bool = True
    onset_s: float = inf  # time from which on its estimate was larger than before, if sooner than the alarm


@dataclass(frozen=True, slots=True)
class LearnedWatch:
    """Results for the rest of the flight of a profile learned until a time."""

    until_s: float
    alarms: tuple[LearnedAlarm, ...]


@dataclass(frozen=True, slots=True, eq=False)
class LogFacts:
    """The facts by which findings are judged."""

    # PX4 or ArduPilot; multirotor or another word; empty if the log does not state it
    autopilot: str
    vehicle: str
    start_ns: int  # Unix time of the log's begin, by its own clock
    duration_s: float  # from its first to its last record
    # when the vehicle was armed, and when it was in flight by the log's own landing detector
    armed: tuple[tuple[float, float], ...]
    flight: tuple[tuple[float, float], ...]
    signals: Mapping[str, LogSignal]  # signals that the log has, by the names of SIGNALS
    statements: tuple[Statement, ...] = ()  # in order
    commands: tuple[CommandSent, ...] = ()  # in order
    parameters: Mapping[str, float] = field(default_factory=dict)  # parameters of the autopilot at the log's begin
    # reason why a signal is missing or tells nothing, by its name
    lacks: Mapping[str, str] = field(default_factory=dict)
    watch: LearnedWatch | None = None  # results of a profile learned from the flight's own begin

    def signal(self, name: str) -> LogSignal:
        """Return a signal, one without a row if the log does not have it."""
        return self.signals.get(name, NO_SIGNAL)

    @property
    def flies(self) -> bool:
        """Whether a vehicle of its kind leaves the ground."""
        return self.vehicle != SUBMARINE and all(kind.flies for kind in KINDS if kind.name == self.vehicle)

    def in_flight(self, time_s: Floats) -> NDArray[np.bool_]:
        """Return which of n times are in flight (n,)."""
        return inside(time_s, self.flight)

    @property
    def flight_s(self) -> float:
        """Duration of its flight."""
        return sum(end - start for start, end in self.flight)

    @property
    def when(self) -> str:
        """When findings are looked for: in flight, or while a vehicle that does not fly is armed."""
        return "in flight" if self.flies else "while armed"

    @property
    def flight_text(self) -> str:
        """Duration of its flight, or for a vehicle that does not fly, of the time armed."""
        return f"{self.flight_s:.0f} s {'of flight' if self.flies else 'armed'}"


SIGNALS: Mapping[str, str] = {
    "motors": "motor commands",
    "rpm": "motor speeds measured by ESCs",
    "throttle": "motor commands or throttle",
    "attitude": "attitude",
    "attitude_wanted": "attitude that the autopilot wanted",
    "height": "barometer height",
    "height_estimate": "height by the estimator",
    "climb": "vertical speed by the estimator",
    "climb_wanted": "vertical speed that the autopilot wanted",
    "climb_received": "vertical speed by GPS",
    "acceleration": "accelerations",
    "battery": "battery voltage",
    "gps": "GPS fix",
    "position": "GPS positions",
    "position_apart": "position of the controller beside the estimator's",
    "ratios": "innovation test ratios of the estimator",
    "resets": "counter of the estimator's resets",
    "reset_steps": "sizes of the estimator's resets",
    "vibration": "vibration level",
    "watch": "a profile learned from the flight's own begin",
    "clipping": "count of clipped accelerometer samples",
}
"""The signals that findings know, with a description."""


def first_known(*signals: LogSignal) -> LogSignal:
    """Return the first signal with values, the last one if none has any."""
    return next(filter(None, signals), signals[-1])


def inside(time_s: Floats, spans: Iterable[tuple[float, float]]) -> NDArray[np.bool_]:
    """Return which of n times are in one of the spans (n,)."""
    within = np.zeros(len(time_s), np.bool_)
    for start, end in spans:
        within |= (time_s >= start) & (time_s < end)
    return within


def spans_where(time_s: Floats, holds: NDArray[np.bool_], least_s: float = 0.0) -> list[tuple[float, float]]:
    """Return the spans in which a condition, given for n samples, held without a break, if they are long enough.

    A single sample has no duration.
    """
    if not len(time_s):
        return []
    edges = np.flatnonzero(np.diff(np.concatenate([[False], holds, [False]]).astype(np.int8)))
    last = len(time_s) - 1
    runs = zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
    spans = ((float(time_s[a]), float(time_s[min(b, last)])) for a, b in runs if b - a > 1 or not least_s)
    return [(start, end) for start, end in spans if end - start >= least_s]


def off_ground(armed: Spans, height: LogSignal, receiver: LogSignal = NO_SIGNAL) -> list[tuple[float, float]]:
    """Return when a vehicle was in flight by its height above the place of arming, if the log does not state it.

    The height of its ``receiver`` is used if there is no other.
    """
    known, lifted = (height, _LIFTED) if height or not receiver else (receiver, _LIFTED_BY_GPS)
    spans: list[tuple[float, float]] = []
    for start, end in armed:
        flown = known.during(start, end)
        ground = known.during(start - BEGIN_S, start) or known.during(start, start + BEGIN_S)
        above = flown.only - np.median(ground.only) if ground else flown.only
        spans += spans_where(flown.time_s, above > lifted, 2.0)
    return spans


def flown(facts: LogFacts) -> list[tuple[float, float]]:
    """Return the parts of a flight in which the vehicle did not stand on the ground, whatever the log states."""
    flight = list(facts.flight)
    for standing in (_idle(facts.signal("motors")), list(_unmoved(facts))):
        edges = [(-np.inf, 1.0), *(edge for start, end in standing for edge in ((start, 0.0), (end, 1.0)))]
        flight = overlap(flight, state_spans(edges, np.inf))
    return [(start, end) for start, end in flight if end - start >= _HOP_S and _carried(facts, start, end)]


def _carried(facts: LogFacts, start_s: float, end_s: float) -> bool:
    """Return whether the motors of a multirotor may have carried it: above idle half of the time, or it rose."""
    motors = facts.signal("motors").during(start_s, end_s)
    height = facts.signal("height").during(start_s, end_s).only
    if len(motors.names) < _FEWEST_ROTORS or not motors or not len(height):
        return True
    return bool(np.median(motors.values.mean(axis=1)) > _IDLE_COMMAND or np.ptp(height) > _LIFTED)


def _idle(motors: LogSignal) -> list[tuple[float, float]]:
    """Return when all motors of a multirotor idled with the same command."""
    if len(motors.names) < _FEWEST_ROTORS:
        return []
    idle = (np.ptp(motors.values, axis=1) < _ALIKE) & (motors.values.max(axis=1) < _IDLE_COMMAND)
    return spans_where(motors.time_s, idle, _STANDS_S)


def _unmoved(facts: LogFacts) -> Iterator[tuple[float, float]]:
    """Yield when a vehicle did not turn at all although it had to, which happens only on the ground.

    Either an attitude far away was wanted, or one of four motors was stopped. A stopped motor is a test on the ground:
    it includes the time before and after in which the attitude stays the same.
    """
    attitude, wanted, motors = (facts.signal(name) for name in ("attitude", "attitude_wanted", "motors"))
    every = max(1, round(_STEP_S * attitude.rate_hz))
    times, angles = attitude.time_s[::every], np.unwrap(attitude.values[::every], period=360.0, axis=0)

    def spans(must: NDArray[np.bool_], least_s: float, still_deg: float) -> list[tuple[float, float]]:
        # windows of samples instead of a grid of times: one damaged stamp would make the grid endless
        samples = round(least_s / _STEP_S)
        if len(times) < samples:
            return []
        # all axes: a vehicle that lost a rotor may keep roll and pitch, but spins
        still = (np.ptp(sliding_window_view(angles, samples, axis=0), axis=-1) < still_deg).all(axis=1)
        stands = np.convolve(still & sliding_window_view(must, samples).all(axis=-1), np.ones(samples)) > 0.5
        # the first sample shows how it came to the ground, and belongs to the flight
        stands[1:] &= stands[:-1].copy()
        return spans_where(times, stands)

    if wanted:
        far = degrees_apart(wanted.at(times)[:, :2], angles[:, :2]).max(axis=1) > _ASKED_DEG
        yield from spans(far, _STANDS_S, _STILL_DEG)
    if len(motors.names) == _QUAD:
        commands = motors.at(times)
        stopped = (commands.min(axis=1) < _STOPPED) & (commands.max(axis=1) > _IDLE_COMMAND)
        for start, end in spans(stopped, _STOPPED_S, _STOPPED_DEG):
            within = (times >= start) & (times <= end)
            away = times[(np.abs(angles - angles[within].mean(axis=0))[:, :2] > _STILL_DEG).any(axis=1) & ~within]
            before, after = away[away < start], away[away > end]
            yield float(np.max(before, initial=times[0])), float(np.min(after, initial=times[-1]))


def degrees_apart(first: Floats, second: Floats) -> Floats:
    """Return the differences of angles by the shorter way round: at half a turn roll jumps from +180 to -180."""
    return np.asarray(np.abs((first - second + 180.0) % 360.0 - 180.0))


class LogRecords:
    """The records of a log by name, as columns, on the time since its begin."""

    def __init__(self, batches: Iterable[Batch]) -> None:
        self._columns: dict[tuple[str, int], list[tuple[NDArray[np.int64], Mapping[str, NDArray[Any]]]]] = {}
        self.rows: dict[tuple[str, int], list[tuple[int, int, Mapping[str, Any]]]] = {}
        self.parameters: dict[str, float] = {}
        # later values: time of arrival, name, value before and value
        self.changed: list[tuple[int, str, float, float]] = []
        latest: dict[str, float] = {}
        streams = StreamFilter()
        for batch in batches:
            for group in batch.columns:
                if not len(group.position):
                    continue
                self._columns.setdefault((group.name, group.system), []).append((group.received_ns, group.fields))
                if group.name in ROWS:
                    kept = streams.rows(group)
                    self.rows.setdefault((group.name, group.system), []).extend(
                        (int(at), group.component, {key: column[row].tolist() for key, column in kept.fields.items()})
                        for row, at in enumerate(kept.received_ns)
                    )
            for message in batch.others.values():
                if message.name in PARAMETER_MESSAGES and (known := parameter(message)) is not None:
                    name, value = known
                    self.parameters.setdefault(name, value)
                    if (before := latest.get(name, value)) != value:
                        self.changed.append((message.received_ns, name, before, value))
                    latest[name] = value
                    continue
                entry = message.received_ns, message.component, message.fields
                self.rows.setdefault((message.name, message.system), []).append(entry)
        columns = (times_ns for parts in self._columns.values() for times_ns, _ in parts)
        rows = (np.array([at for at, *_ in entries], np.int64) for entries in self.rows.values())
        times = np.sort(np.concatenate([np.empty(0, np.int64), *columns, *rows]))
        together = max(np.split(times, np.flatnonzero(np.diff(times) > _APART_NS) + 1), key=len)
        self.strays = len(times) - len(together)
        self.first_ns, last_ns = (int(together[0]), int(together[-1])) if len(together) else (0, 0)
        self.duration_s = (last_ns - self.first_ns) / 1e9
        if self.strays:
            self._keep(self.first_ns, last_ns)

    def _keep(self, first_ns: int, last_ns: int) -> None:
        """Leave out the records stamped before the first or after the last time."""
        for entries in self.rows.values():
            entries[:] = [entry for entry in entries if first_ns <= entry[0] <= last_ns]
        for parts in self._columns.values():
            for k, (times_ns, fields) in enumerate(parts):
                kept = (times_ns >= first_ns) & (times_ns <= last_ns)
                parts[k] = times_ns[kept], {name: column[kept] for name, column in fields.items()}

    def time_s(self, time_ns: int) -> float:
        """Return a time of arrival as seconds since the log's begin."""
        return (time_ns - self.first_ns) / 1e9

    def names(self) -> Iterator[tuple[str, int]]:
        """Yield the names and systems of the log's records."""
        yield from {**dict.fromkeys(self._columns), **dict.fromkeys(self.rows)}

    def signal(
        self,
        name: str,
        columns: Sequence[str],
        shown: Sequence[str] = (),
        unit: str = "",
        scale: float = 1.0,
        system: int = 0,
    ) -> LogSignal:
        """Return fields of a record as a signal, without values if the log has no such record or field.

        ``columns`` are names of fields, followed by ``[k]`` for an element of a list, and ``shown`` the names shown.
        """
        parts = self._columns.get((name, system), [])
        taken: list[tuple[NDArray[np.int64], Floats]] = []
        for times_ns, fields in parts:
            values = [_column(fields, place) for place in columns]
            if all(value is not None for value in values):
                taken.append((times_ns, np.stack([column for column in values if column is not None], axis=1)))
        times = np.concatenate([np.empty(0, np.int64), *(times_ns for times_ns, _ in taken)])
        order = np.argsort(times, kind="stable")
        values_of = np.concatenate([np.empty((0, len(columns))), *(rows for _, rows in taken)])[order] * scale
        return LogSignal((times[order] - self.first_ns) / 1e9, values_of, tuple(shown or columns), unit, name)

    def listed(self, name: str, system: int = 0) -> list[tuple[float, Mapping[str, Any]]]:
        """Return a record's fields row by row, with the time of each row, in order."""
        rows = sorted(((at, row) for at, _, row in self.rows.get((name, system), [])), key=lambda entry: entry[0])
        return [(self.time_s(at), row) for at, row in rows]


ROWS = COMMANDS | {"vehicle_command", "MAVC"}
"""Records that are also kept row by row, beside their columns."""


def _column(fields: Mapping[str, NDArray[Any]], place: str) -> Floats | None:
    name, bracket, index = place.partition("[")
    values = fields.get(name)
    if values is None:
        return None
    if bracket:
        number = int(index[:-1])
        if values.ndim < 2 or values.shape[1] <= number:
            return None
        values = values[:, number]
    return None if values.ndim > 1 or values.dtype.kind not in "iufb" else values.astype(np.float64)


def state_statements(arming: Changes, landing: Changes) -> Iterator[Statement]:
    """Yield the log's statements about arming and landing, from the changes of either."""
    for kind, entries, words in (
        ("arming", arming, ("disarmed", "armed")),
        ("landing", landing, ("in the air", "landed")),
    ):
        for at, value in entries:
            yield Statement(at, kind, words[bool(value)], int(value))


def state_spans(edges: Changes, end_s: float, state: bool = True) -> list[tuple[float, float]]:
    """Return the spans in which a state held, from its changes, until the log's end."""
    spans: list[tuple[float, float]] = []
    for (time_s, value), (next_s, _) in pairwise([*edges, (end_s, not state)]):
        holds = bool(value) is state
        if holds and spans and spans[-1][1] == time_s:
            spans[-1] = spans[-1][0], next_s
        elif holds:
            spans.append((time_s, next_s))
    return spans


def overlap(first: Iterable[tuple[float, float]], second: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the spans in which spans of both kinds overlap."""
    parts = ((max(a, c), min(b, d)) for a, b in first for c, d in second)
    return [(start, end) for start, end in parts if start < end]


_APART_NS = 86_400_000_000_000
"""Largest gap between stamps, a day: no vehicle flies that long without a record. Stamps further apart are damaged, of
a clock that was set, or of another day's recording in the same file."""
_FEWEST_ROTORS = 3
"""Fewest rotors of a multirotor: fewer outputs that are equal prove nothing."""
_QUAD, _STOPPED = 4, 0.02
"""Rotors of which none can be spared, and the largest command of a stopped one, of full command: motors idle at 0.05
and more."""
_ALIKE = 0.005
"""Largest difference of equal commands, of full command: half a step of 8 bits. The controllers' demands make the
commands differ while the motors carry a vehicle."""
_IDLE_COMMAND = 0.15
"""Largest command of idle motors, of full command: motors idle at 0.05 to 0.13. Strong vehicles hover there, but never
with all motors equal."""
_STOPPED_S, _STOPPED_DEG = 1.0, 10.0
"""Shortest stop of a motor that shows the ground, seconds, and the largest turn meanwhile, degrees. In flight a quarter
of the lift lacks at an arm r: the vehicle turns with about g / (4 r), by 70 degrees in a second if r is a metre."""
_HOP_S = 1.0
"""Shortest flight, seconds. Chosen: a shorter one is a withdrawn report, or a touch of the throttle."""
_STANDS_S = 3.0
"""Shortest stand on the ground, seconds: a vehicle without thrust falls 44 m in it, so if all motors idle that long, it
stands on the ground."""
_STEP_S = 0.2
"""Step of the checked attitudes, seconds. Chosen: half as often as logs hold the attitude."""
_STILL_DEG, _ASKED_DEG = 1.0, 10.0
"""Largest motion of a vehicle that is held, and smallest demand meanwhile, degrees. Chosen: a flying vehicle is never
that still for 3 s while ten times as much is demanded; one held by the ground is. Measured on flights of a simulator
that met the ground with wrong positions: 0.3 degrees, 30 demanded."""
_LIFTED = 1.0
"""Smallest height of flight above the place of arming, metres, if the log does not state flight. Chosen: twice a
barometer's drift."""
_LIFTED_BY_GPS = 15.0
"""The same by GPS, metres: heights of a receiver that does not move drift by some metres; three times its horizontal 5
m."""
_DEGREE_M = 111_195.0
"""Metres per degree on a sphere of the Earth's mean radius, 6371 km: the error on a map is 0.3 % at most."""
FIX_3D = 3
"""A fix in three dimensions: MAVLink's GPS_FIX_TYPE, which PX4 and ArduPilot use, too."""
_MOST_DEGREES = 360.0
"""Largest number in degrees: MAVLink and logs count in 1e-7 of a degree."""
BEGIN_S = 2.0
"""Begin of a log that counts as ground, seconds. Chosen: logs begin at arming, a vehicle takes off some seconds later;
ten samples of the slowest barometer."""
