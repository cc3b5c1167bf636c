"""Records of an onboard log -> the corresponding MAVLink messages, each with the time of the record that makes it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from math import tau
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch, Columns, arrival_times, cut, each, gathered, one_message, rows_of
from adapters.channels import CLOCK_UNITS_NS, MAX_VALUE, Angle, follow
from adapters.logs.log_mapping import PARAMETERS, FieldRule, LogMapping, MessageRule
from adapters.logs.log_parameters import parameter
from adapters.logs.onboard_log import NO_TIME, own_stamps_ns
from adapters.message import Message
from adapters.source import MAVLINK

# Ids of the vehicle: logs do not hold them, and those of autopilots are 1, 1 unless configured otherwise.
_SYSTEM = _COMPONENT = 1
_LOOKED_AT_NS = 5_000_000_000
"""Time from the begin of a log that is read before the records that fill messages are chosen. Chosen: long enough to
tell rates of 1 Hz apart, short enough to hold in memory."""
_LOOKED_AT = 20_000
"""Most records that are read before that choice: 4,000 a second for that time, in some 20 MB."""
_LONGEST_NS = 1_000_000_000
"""Longest gap that is interpolated across. Chosen: ten intervals of the slowest record that a message needs for it
(ArduPilot's ATT, logged at 10 Hz), two of the slowest optional one (PX4's vehicle_magnetometer, at 2 Hz)."""
_REACH = 20_000
"""Records after the one that makes a message in which records to join are searched for. Chosen: some seconds of any
log, short enough to hold in memory."""
_NEAR_NS = 1_000_000_000
"""Largest difference of a stamp from the log's clock: the one that the monitor accepts at once. A larger one is another
clock's, or from long before it was logged, and the time of the record replaces it."""
# Settings by which ArduPilot logs before it is armed: the parameter, and a bit of the mask in earlier versions.
_LOGGED_DISARMED = {"LOG_DISARMED": 0xFF, "LOG_BITMASK": 1 << 16}
_LONG_AGO_NS = -(1 << 60)
_LARGEST_QUATERNION = 2.0
"""Limit of a quaternion's elements: a rotation has length one, and NaN is not below the limit either."""
_SEARCHED = 64
"""Records in which the next repeat of a state is searched for first; then in twice as many, and so on."""

Integers = NDArray[np.int64]
Floats = NDArray[np.float64]


def telemetry(
    batches: Iterable[Batch],
    mapping: LogMapping,
    only: Collection[str] | None,
    anew: Callable[[Collection[str]], Iterable[Batch]],
    chosen: dict[str, str] | None = None,
) -> Iterator[Batch]:
    """Return a log's records and, after each, the MAVLink messages that it makes.

    The record that fills a message is chosen from the first 5 s of the log, or when the first record that can fill it
    comes.

    ``only`` names records and MAVLink messages wanted, None wants all; messages of other sources pass. ``anew`` reads
    the log once more, only records of some names: the first record of arming or disarming shows whether the vehicle is
    armed at the begin of the log, and the whole log shows which of a topic's instances moves. ``chosen`` gets the name
    of the record that fills each message.
    """
    making = _Telemetry(mapping, only, anew, {} if chosen is None else chosen)
    remaining = iter(batches)
    ahead: list[Batch] = []
    for batch in remaining:
        ahead.append(batch)
        if making.look_at(batch):
            break
    making.choose()
    making.begin()
    for batch in chain(ahead, remaining):
        yield from making.run(batch)
    yield from making.finish()


class _Telemetry:
    """The rules in use, and the data that decide on the others."""

    def __init__(
        self,
        mapping: LogMapping,
        only: Collection[str] | None,
        anew: Callable[[Collection[str]], Iterable[Batch]],
        chosen: dict[str, str],
    ) -> None:
        rules = {name: tried for name, tried in mapping.rules.items() if only is None or name in only}
        self._only = only
        self._anew, self._chosen = anew, chosen
        self._states = {
            name: _first_state(tried, anew) for name, tried in rules.items() if any(rule.before for rule in tried)
        }
        self._open = LogMapping({name: tried for name, tried in rules.items() if name not in self._states})
        self._counts: Counter[str] = Counter()
        self._examples: dict[str, Mapping[str, Any]] = {}
        self._fillers: list[_Filler] = []
        self._logged_disarmed = self._begun = False
        self._relations: Counter[int] = Counter()
        self._looked_at = 0
        self._first_ns: int | None = None
        # number of earlier records, and the messages that follow an incomplete message
        self._passed = 0
        self._later: tuple[list[Columns], dict[int, Message]] = [], {}

    @property
    def _relevant(self) -> frozenset[str]:
        """Names of the records that may decide from which records a message is filled."""
        return self._open.topics(self._open.rules.keys())

    def look_at(self, batch: Batch) -> bool:
        """Count records at the begin of a log; return whether they suffice to choose."""
        times_ns, start = arrival_times(batch), 0
        if self._first_ns is None:
            relevant = self._relevant
            start = min((int(at[0]) for name, at in _positions(batch) if name in relevant), default=batch.count)
            if start < batch.count:
                self._first_ns = int(times_ns[start])
        stop = _LOOKED_AT - self._looked_at
        if self._first_ns is not None:
            far = np.flatnonzero(times_ns[start:] - self._first_ns >= _LOOKED_AT_NS)
            stop = min(stop, start + int(far[0]) + 1) if len(far) else stop
        self._looked_at += batch.count
        begin = cut(batch, 0, min(stop, batch.count))
        self._count(begin)
        self._learn(begin)
        return stop <= batch.count

    def _learn(self, batch: Batch) -> None:
        """Find from the begin of a log its clock, and whether it was begun at arming."""
        for columns in batch.columns:
            stamps_ns = own_stamps_ns(columns.fields, len(columns.position))
            timed = stamps_ns != NO_TIME
            relations = np.unique(columns.received_ns[timed] - stamps_ns[timed], return_counts=True)
            self._relations.update(dict(zip(*(relation.tolist() for relation in relations), strict=True)))
        for message in batch.others.values():
            known = parameter(message) if message.name == PARAMETERS else None
            if known is not None and int(known[1]) & _LOGGED_DISARMED.get(known[0], 0):
                self._logged_disarmed = True

    def _count(self, batch: Batch) -> None:
        relevant = self._relevant
        for entry in batch.entries:
            if entry.name in relevant:
                self._counts[entry.name] += len(entry.position) if isinstance(entry, Columns) else 1
                first = one_message(entry, 0) if isinstance(entry, Columns) else entry
                self._examples[entry.name] = first.fields

    def choose(self) -> None:
        """Choose rules for the messages that the counted records can fill."""
        for name, rule in self._open.guess(self._counts, self._examples).items():
            further = (addition for addition in rule.further if addition.fillable(self._examples))
            for filled in (self._moving(rule), *further):
                self._fillers.append(self._filler(filled))
            self._open = LogMapping({key: tried for key, tried in self._open.rules.items() if key != name})

    def _moving(self, rule: MessageRule) -> MessageRule:
        """Return the rule for the instance of its topic that moves most; the first one if several do."""
        there = [topic for topic in rule.instances if topic in self._examples or self._begun]
        if rule.moves is None or len(there) < 2:
            return rule
        spans: dict[str, tuple[NDArray[Any], NDArray[Any]]] = {}
        for batch in self._anew(there):
            for topic in there:
                values = _Recorded.of(batch, topic).at((rule.moves,))
                if values is not None and values.ndim == 2 and len(values):
                    low, high = np.fmin.reduce(values), np.fmax.reduce(values)
                    before = spans.get(topic, (low, high))
                    spans[topic] = np.fmin(low, before[0]), np.fmax(high, before[1])
        moving = {topic: int((high > low).sum()) for topic, (low, high) in spans.items()}
        return rule.of_instance(max(there, key=lambda topic: moving.get(topic, 0)))

    def begin(self) -> None:
        """Set with the first record the values that states have until the first record that changes them."""
        self._begun = True
        for rule, first in self._states.values():
            self._fillers.append(self._filler(rule))
            if rule.before is not None:
                values = rule.before
                begin = values[self._logged_disarmed] if first is None else values[first == values[0]]
                self._fillers[-1].begin({field.name: begin for field in rule.fields if field.before})

    def _filler(self, rule: MessageRule) -> _Filler:
        self._chosen[rule.message] = rule.topic
        relation = self._relations.most_common(1)
        return _Filler(rule, len(self._fillers), relation[0][0] if relation else None)

    def run(self, batch: Batch) -> Iterator[Batch]:
        """Return the wanted records of a batch and the messages that they make."""
        relevant = self._relevant - self._examples.keys()
        news = sorted({int(at[0]) for name, at in _positions(batch) if name in relevant})
        start, counted = 0, 0
        # a rule may be chosen with the first record of a name, and applies from this record on
        for first in news:
            yield from self._run(cut(batch, start, first), counted)
            self._count(cut(batch, first, first + 1))
            self.choose()
            start, counted = first, 1
        yield from self._run(cut(batch, start, batch.count) if start else batch, counted)

    def _run(self, batch: Batch, counted: int) -> Iterator[Batch]:
        """Return the messages by the rules in use; the first ``counted`` records are counted already."""
        self._count(cut(batch, counted, batch.count) if counted else batch)
        times_ns = arrival_times(batch)
        columns = [column for filler in self._fillers for column in filler.run(batch, times_ns, self._passed)]
        only = self._only
        for group in batch.columns:
            if only is None or group.name in only:
                columns.append(group._replace(position=_place(self._passed + group.position)))
        others = {
            int(_place(self._passed + at)): message
            for at, message in batch.others.items()
            if only is None or message.name in only
        }
        self._passed += batch.count
        end = _place(self._passed)
        yield from self._in_order(
            columns, others, min((filler.complete_until(end) for filler in self._fillers), default=end)
        )

    def finish(self) -> Iterator[Batch]:
        """Return the messages that still wait."""
        made = [column for filler in self._fillers for column in filler.finish()]
        yield from self._in_order(made, {}, _place(self._passed))

    def _in_order(self, columns: Sequence[Columns], others: Mapping[int, Message], end: int) -> Iterator[Batch]:
        """Return present and kept messages whose place (see :func:`_place`) is before ``end``; keep the rest."""
        columns = [*self._later[0], *columns]
        others = {**self._later[1], **others}
        cuts = [int(np.searchsorted(column.position, end)) for column in columns]
        now = [rows_of(column, slice(0, at)) for column, at in zip(columns, cuts, strict=True) if at]
        later = [
            rows_of(column, slice(at, None))
            for column, at in zip(columns, cuts, strict=True)
            if at < len(column.position)
        ]
        self._later = later, {at: message for at, message in others.items() if at >= end}
        batch = gathered(now, {at: message for at, message in others.items() if at < end})
        if batch.count:
            yield batch


# Places after each record for all messages that it makes: repeated and made ones, of each filler.
_REPEATED, _MADE = 1, 2
_ROOM = 1 << 16
_STAGE = 1 << 14


def _place(position: Any, stage: int = 0, filler: int = 0) -> Any:
    """Return a sort key for messages that a record at a position makes: only the order of such keys has a meaning."""
    return position * _ROOM + stage * _STAGE + filler


def _positions(batch: Batch) -> Iterator[tuple[str, Integers]]:
    """Yield the names of a batch's messages and their positions."""
    for columns in batch.columns:
        yield columns.name, columns.position
    for at, message in batch.others.items():
        yield message.name, np.array([at])


@dataclass(frozen=True, slots=True)
class _Series:
    """n records of one name: positions in the log, times, and values of some rules' fields."""

    position: Integers  # (n,)
    received_ns: Integers
    # by field of the rule (n,): measured numbers, NaN if missing, or numbers in the type of the message
    values: Mapping[str, NDArray[Any]]

    def __len__(self) -> int:
        return len(self.position)

    def rows(self, index: Any) -> _Series:
        """Return some of the records."""
        return _Series(
            self.position[index],
            self.received_ns[index],
            {name: values[index] for name, values in self.values.items()},
        )

    def followed_by(self, later: _Series) -> _Series:
        """Return these records and later ones."""
        return _Series(
            np.concatenate([self.position, later.position]),
            np.concatenate([self.received_ns, later.received_ns]),
            {name: np.concatenate([values, later.values[name]]) for name, values in self.values.items()},
        )


# places, times and fields of some messages
_Piece: TypeAlias = tuple[Integers, Integers, Mapping[str, NDArray[Any]]]


class _Filler:
    """Fills one kind of message by a rule; waits for later records between which values are interpolated.

    ``number`` is its index among all fillers, whose order it sets. ``unix_minus_boot_ns`` relates the records' times of
    arrival to the log's clock, None if no record tells it.
    """

    def __init__(self, rule: MessageRule, number: int, unix_minus_boot_ns: int | None) -> None:
        self._rule = rule
        self._number = number
        self._unix_minus_boot_ns = unix_minus_boot_ns
        self._own = [field for field in rule.fields if field.channel is None or not field.joined]
        self._linear = {
            topic: [
                field for field in rule.fields if field.topic == topic and field.joined and field.channel is not None
            ]
            for topic in sorted(rule.linear)
        }
        held = {
            field.topic for field in rule.fields if field.joined and field.channel is not None
        } - self._linear.keys()
        self._held = {
            topic: [field for field in rule.fields if field.joined and field.topic == topic] for topic in held
        }
        self._last_held: dict[str, _Series] = {}
        # records between which values are interpolated, and messages that wait for more of them
        self._rows: dict[str, _Series] = {}
        self._waiting: _Series | None = None
        self._last: tuple[int, dict[str, NDArray[Any]]] | None = None

    def begin(self, begin: Mapping[str, int]) -> None:
        """Begin with a message at the first record, with the given values."""
        values = {
            field.name: begin.get(field.name, field.unknown if field.constant is None else field.constant)
            for field in self._rule.fields
        }
        fields = {field.name: np.array([values[field.name]], np.dtype(f"<{field.code}")) for field in self._rule.fields}
        self._last = _LONG_AGO_NS, fields

    def run(self, batch: Batch, times_ns: Integers, passed: int) -> Iterator[Columns]:
        """Return the messages that the records of a batch make, complete or repeat, at places of :func:`_place`.

        ``times_ns`` are the records' times of arrival (batch.count,), ``passed`` is the number of earlier records of
        the log.
        """
        made = self._made(batch, passed)
        if self._linear:
            made = self._interpolated(batch, made, passed)
        pieces: list[_Piece] = [(self._places(made), made.received_ns, made.values)] if len(made) else []
        if self._rule.repeat_ns is not None:
            pieces += self._repeated(made, times_ns, passed)
        yield from self._columns(pieces)

    def complete_until(self, end: int) -> int:
        """Return the place of the first message that waits, or ``end`` if none waits."""
        return end if self._waiting is None or not len(self._waiting) else int(self._places(self._waiting)[0])

    def finish(self) -> Iterator[Columns]:
        """Return the messages that wait; missing values stay unknown."""
        waiting = self._waiting
        if waiting is not None and len(waiting):
            filled = self._joined(waiting, None)
            yield from self._columns([(self._places(filled), filled.received_ns, filled.values)])

    def _places(self, made: _Series) -> Integers:
        return np.asarray(_place(made.position, _MADE, self._number), np.int64)

    def _columns(self, pieces: Sequence[_Piece]) -> Iterator[Columns]:
        if pieces:
            place = np.concatenate([at for at, _, _ in pieces])
            order = np.argsort(place)
            fields: dict[str, NDArray[Any]] = {}
            arrays: dict[str, list[NDArray[Any]]] = {}
            for field in self._rule.fields:
                values = np.concatenate([values[field.name] for _, _, values in pieces])[order]
                if field.array is None:
                    fields[field.name] = values
                else:
                    arrays.setdefault(field.array, []).append(values)
            fields |= {name: np.stack(elements, axis=1) for name, elements in arrays.items()}
            received_ns = np.concatenate([times for _, times, _ in pieces])[order]
            yield Columns(MAVLINK, self._rule.message, _SYSTEM, _COMPONENT, place[order], received_ns, fields)

    def _made(self, batch: Batch, passed: int) -> _Series:
        """Return the messages that records of a batch make, without interpolated values."""
        records = _Recorded.of(batch, self._rule.topic)
        count = len(records.position)
        values: dict[str, NDArray[Any]] = {}
        valid = np.ones(count, np.bool_)
        for field in self._own:
            number = _values(field, records)
            values[field.name] = self._stamped(field, _carried(field, number), records.received_ns)
            if field.channel is not None and field.values is not None:
                valid &= ~np.isnan(number)
        for topic, fields in self._held.items():
            row, held = self._newest(batch, topic, fields, records.position)
            for field in fields:
                number = np.where(row >= 0, held.values[field.name][row], np.nan) if len(held) else _nothing(count)
                values[field.name] = _carried(field, number)
        return _Series(records.position + passed, records.received_ns, values).rows(valid)

    def _stamped(self, field: FieldRule, values: NDArray[Any], received_ns: Integers) -> NDArray[Any]:
        """Return a field's values (n,); a stamp that is not of the log's clock becomes the record's time of arrival."""
        unit_ns = CLOCK_UNITS_NS.get(field.name)
        if unit_ns is None or self._unix_minus_boot_ns is None:
            return values
        boot_ns = received_ns - self._unix_minus_boot_ns
        near = (values > 0) & (np.abs(values.astype(np.float64) * unit_ns - boot_ns) <= _NEAR_NS)
        stamp = np.maximum(boot_ns, 0)
        return np.where(near, values, stamp / unit_ns if field.code == "d" else stamp // unit_ns).astype(values.dtype)

    def _newest(
        self, batch: Batch, topic: str, fields: Sequence[FieldRule], position: Integers
    ) -> tuple[Integers, _Series]:
        """Return the row of a topic's newest record at each position (-1: none), and these records."""
        series = _series(_Recorded.of(batch, topic), fields)
        before = self._last_held.get(topic)
        carried = 0 if before is None else len(before)
        row = np.searchsorted(series.position, position) - 1 + carried
        held = series if before is None else before.followed_by(series)
        self._last_held[topic] = held.rows(slice(-1, None))
        return row, held

    def _interpolated(self, batch: Batch, made: _Series, passed: int) -> _Series:
        """Return the messages that are complete."""
        for topic, fields in self._linear.items():
            series = _series(_Recorded.of(batch, topic), fields)
            series = replace(series, position=series.position + passed)
            before = self._rows.get(topic)
            both = series if before is None else before.followed_by(series)
            again = np.diff(both.received_ns, prepend=both.received_ns[:1] - 1) == 0
            self._rows[topic] = both.rows(~again)
        waiting = made if self._waiting is None else self._waiting.followed_by(made)
        return self._joined(waiting, passed + batch.count)

    def _joined(self, waiting: _Series, end: int | None) -> _Series:
        """Return the messages that are complete, and keep the rest; ``end`` is that of :meth:`_Join.of`.

        A message that is older than all records of a topic that it needs is discarded.
        """
        joins = [_Join.of(self._rows[topic], waiting, self._rule.linear[topic], end) for topic in self._linear]
        final = np.logical_and.reduce([join.final for join in joins])
        count = len(final) if final.all() else int(np.argmin(final))
        given_up = np.logical_or.reduce([join.early for join in joins])
        rows = np.flatnonzero(~given_up[:count])
        pairs = np.stack([join.pair[rows] for join in joins], axis=1)
        filled = self._between(waiting.rows(rows), pairs)
        self._waiting = waiting.rows(slice(count, None))
        for topic, join in zip(self._linear, joins, strict=True):
            self._rows[topic] = self._rows[topic].rows(slice(int(join.kept[count]), None))
        return filled

    def _between(self, made: _Series, pair: Integers) -> _Series:
        """Return messages with interpolated values; ``pair`` (n, topics, 2) has the rows on either side, -1: none."""
        values = dict(made.values)
        for k, (topic, fields) in enumerate(self._linear.items()):
            left, right = pair[:, k, 0], pair[:, k, 1]
            rows = self._rows.get(topic)
            for field in fields:
                number = _nothing(len(made))
                if rows is not None and len(rows):
                    number = np.where(left >= 0, _between(field, rows, left, right, made.received_ns), np.nan)
                values[field.name] = _carried(field, number)
        return _Series(made.position, made.received_ns, values)

    def _repeated(self, made: _Series, times_ns: Integers, passed: int) -> list[_Piece]:
        """Return a repeat of the state at each record that arrives ``repeat_ns`` after the state was sent last."""
        every_ns = self._rule.repeat_ns or 0
        pieces: list[_Piece] = []
        start = 0
        for number, position in enumerate([*(made.position - passed).tolist(), len(times_ns) - 1]):
            if self._last is not None:
                sent_ns, values = self._last
                due = []
                while (at := _due(times_ns, start, position + 1, sent_ns, every_ns)) is not None:
                    sent_ns = int(times_ns[at])
                    due.append(at)
                    start = at + 1
                if due:
                    again = {name: np.repeat(value, len(due)) for name, value in values.items()}
                    at_once = np.array(due)
                    pieces.append((_place(passed + at_once, _REPEATED, self._number), times_ns[at_once], again))
                    self._last = sent_ns, values
            if number < len(made):
                row = slice(number, number + 1)
                self._last = int(made.received_ns[number]), {name: values[row] for name, values in made.values.items()}
                start = position + 1
        return pieces


def _due(times_ns: Integers, start: int, stop: int, sent_ns: int, every_ns: int) -> int | None:
    """Return the first position whose time differs enough from the last for a state to be repeated, or None."""
    width = _SEARCHED
    while start < stop:
        # the width doubles: the cost is proportional to the distance of the position
        far = np.abs(times_ns[start : min(stop, start + width)] - sent_ns) >= every_ns
        if far.any():
            return start + int(far.argmax())
        start += width
        width *= 2
    return None


@dataclass(frozen=True, slots=True)
class _Join:
    """The records of a topic on either side of n messages."""

    pair: Integers  # their rows (n, 2), -1 if there is none; the one before twice if it stands for both
    final: NDArray[np.bool_]  # whether no later record can change the pair (n,)
    early: NDArray[np.bool_]  # whether the message is older than all records of a topic that it needs (n,)
    kept: Integers  # the first row that each message, and later ones, still need (n + 1,)

    @classmethod
    def of(cls, rows: _Series, messages: _Series, required: bool, end: int | None) -> _Join:
        """Return the records around messages.

        Rows that follow each other in time are a run; a clock that goes back ends it, and so does a gap if the message
        needs the topic. A message belongs to the run of the record before it.

        No two neighbours of ``rows`` have the same time. If the messages do not need the topic (``required``), the
        record before replaces a later one that does not come, or that is too far away. ``end`` is how many records of
        the log are known, None for all.
        """
        count, times_ns, position = len(messages), messages.received_ns, messages.position
        passed = np.full(count, end is None) if end is None else position + _REACH < end
        if not len(rows):
            nothing = np.full((count, 2), -1)
            return cls(nothing, passed | (not required), np.zeros(count, np.bool_), np.zeros(count + 1, np.int64))
        step_ns = np.diff(rows.received_ns)
        breaks = np.flatnonzero((step_ns < 0) | (required & (step_ns >= _LONGEST_NS))) + 1
        starts, ends = np.concatenate([[0], breaks]), np.concatenate([breaks, [len(rows)]])
        last = np.append(np.searchsorted(rows.position, position) - 1, len(rows) - 1)
        run = np.searchsorted(starts, np.maximum(last, 0), "right") - 1
        oldest_ns = rows.received_ns[last] - _LONGEST_NS
        left, right, kept = np.zeros(count, np.int64), np.zeros(count, np.int64), np.zeros(count + 1, np.int64)
        for number in np.unique(run):
            start, stop = starts[number], ends[number]
            run_ns = rows.received_ns[start:stop]
            of_run = run == number
            kept[of_run] = start + np.maximum(np.searchsorted(run_ns, oldest_ns[of_run], "right") - 1, 0)
            of_run = of_run[:-1]
            left[of_run] = start + np.searchsorted(run_ns, times_ns[of_run], "right") - 1
            right[of_run] = start + np.searchsorted(run_ns, times_ns[of_run], "left")
        kept[last < 0] = 0
        before, run = last[:-1] >= 0, run[:-1]
        usable = (before | required) & ~(before & (oldest_ns[:-1] >= times_ns))
        reach = position + _REACH
        near = rows.position[np.minimum(right, len(rows) - 1)] <= reach
        has_right = usable & (right < ends[run]) & near
        has_left = usable & (left >= starts[run]) & (rows.position[np.maximum(left, 0)] <= reach)
        gap_ns = rows.received_ns[np.minimum(right, len(rows) - 1)] - rows.received_ns[np.maximum(left, 0)]
        between = has_left & has_right & (gap_ns < _LONGEST_NS)
        held = has_left & (not required or between)
        pair = np.stack([np.where(held, left, -1), np.where(between, right, np.where(held, left, -1))], axis=1)
        final = has_right | ~usable | (run < len(starts) - 1) | passed
        return cls(pair, final, required & has_right & ~has_left, kept)


@dataclass(frozen=True, slots=True)
class _Recorded:
    """The records of one name in a batch: their columns, or messages if they are not in columns."""

    position: Integers
    received_ns: Integers
    columns: Columns | None
    messages: Sequence[Message]

    @classmethod
    def of(cls, batch: Batch, name: str) -> _Recorded:
        """Return the records of a name in a batch."""
        groups = [group for group in batch.columns if group.name == name]
        others = {at: message for at, message in batch.others.items() if message.name == name}
        if len(groups) == 1 and not others:
            return cls(groups[0].position, groups[0].received_ns, groups[0], ())
        for group in groups:
            others |= zip(group.position.tolist(), each(group), strict=True)
        at = sorted(others)
        messages = [others[position] for position in at]
        times_ns = np.array([message.received_ns for message in messages], np.int64)
        return cls(np.array(at, np.int64), times_ns, None, messages)

    def at(self, path: tuple[str | int, ...]) -> NDArray[Any] | None:
        """Return the values at a path: numbers (n,) or lists of numbers (n, length), or None if there are none."""
        if self.columns is not None:
            first, *steps = path
            values = self.columns.fields.get(str(first)) if isinstance(first, str) else None
            if values is None or not steps:
                return values
            place = steps[0]
            if len(steps) > 1 or not isinstance(place, int) or values.ndim < 2 or place >= values.shape[1]:
                return None
            return values[:, place]
        raw = [follow(message.fields, path) for message in self.messages]
        if raw and all(isinstance(value, list) and len(value) == len(raw[0]) for value in raw):
            values = np.array(raw)
        elif all(type(value) is bool for value in raw):
            values = np.array(raw, np.bool_)
        elif all(isinstance(value, int) for value in raw):
            values = np.array([int(value) for value in raw])
        else:
            values = np.array([value if type(value) in (int, float) else np.nan for value in raw], np.float64)
        return values if values.dtype.kind in "biuf" else None


def _series(records: _Recorded, fields: Sequence[FieldRule]) -> _Series:
    """Return the values of some fields of records."""
    values = {field.name: _values(field, records) for field in fields}
    return _Series(records.position, records.received_ns, values)


def _nothing(count: int) -> Floats:
    """Return ``count`` unknown numbers (NaN)."""
    return np.full(count, np.nan)


def _values(field: FieldRule, records: _Recorded) -> Floats:
    """Return the numbers of a field (n,) in the message's unit, NaN for missing ones."""
    number = _nothing(len(records.position))
    if field.channel is None:
        return number if field.constant is None else np.full(len(number), float(field.constant))
    values = records.at(field.channel.path)
    if field.values is not None:
        if values is not None and values.ndim == 1 and values.dtype.kind in "biu":
            for raw in np.unique(values).tolist():
                number[values == raw] = field.values.get(str(int(raw)), np.nan)
        unlisted = np.isnan(number)
        if field.otherwise is None or not unlisted.any():
            return number
        return np.where(unlisted, _values(field.otherwise, records), number)
    if values is None:
        return number
    if field.angle is not None:
        return rotation_angle(values, field.angle)
    if values.ndim > 1 or values.dtype.kind == "b":
        return number
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = field.channel.scale * values.astype(np.float64) + field.channel.offset
    return np.where(np.abs(scaled) <= MAX_VALUE, scaled, np.nan)


def rotation_angle(quaternion: NDArray[Any], which: Angle) -> Floats:
    """Return an angle of rotations (w, x, y, z) (n, 4) from body (x ahead, z down) to earth axes, radians."""
    if quaternion.ndim != 2 or quaternion.shape[1] != 4 or quaternion.dtype.kind != "f":
        return _nothing(len(quaternion))
    known = (np.abs(quaternion) < _LARGEST_QUATERNION).all(axis=1)
    parts: Floats = np.where(known[:, None], quaternion, np.nan).astype(np.float64)
    w, x, y, z = parts.T
    if which == "roll":
        angle = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    elif which == "yaw":
        angle = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    else:
        angle = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    return np.asarray(angle, np.float64)


def _between(field: FieldRule, rows: _Series, left: Integers, right: Integers, time_ns: Integers) -> Floats:
    """Return values at times (n,) from those on either side, the shorter way round for values that wrap."""
    values = rows.values[field.name]
    left_ns, right_ns = rows.received_ns[left], rows.received_ns[right]
    before, after = values[left], values[right]
    period = tau if field.angle else field.channel.period if field.channel is not None else None
    span_ns = np.maximum(right_ns - left_ns, 1)
    with np.errstate(over="ignore", invalid="ignore"):
        step = after - before
        if period is not None:
            step = (step + 0.5 * period) % period - 0.5 * period
        number = before + step * (time_ns - left_ns) / span_ns
    # at the time of a record its value is used, whatever the other one is
    return np.where(time_ns == left_ns, before, np.where(time_ns == right_ns, after, number))


def _carried(field: FieldRule, values: Floats) -> NDArray[Any]:
    """Return numbers in the type of the message, rounded for whole numbers; one that does not fit is unknown."""
    code = field.code
    dtype = np.dtype(f"<{code}")
    if code in "fd":
        with np.errstate(over="ignore"):
            carried = values.astype(dtype)
        fits = np.isfinite(carried)
    else:
        period = None if field.channel is None or code.islower() else field.channel.period
        whole = np.rint(values if period is None else values % period)
        limits = np.iinfo(dtype)
        # 2^64 - 1 is not a float: the limit is the largest float below 2^64
        fits = (whole >= limits.min) & (whole <= limits.max) & (whole < float(limits.max) + 1.0)
        carried = np.where(fits, whole, 0).astype(dtype)
    return np.where(fits, carried, np.array(field.unknown, dtype))


def _first_state(
    rules: Sequence[MessageRule], anew: Callable[[Collection[str]], Iterable[Batch]]
) -> tuple[MessageRule, int | None]:
    """Return which way to fill a state's message comes first in a log, and the state's first value.

    Without any record it is the first way, and None.
    """
    for batch in anew({rule.topic for rule in rules}):
        starts: list[tuple[int, int, int]] = []
        for k, rule in enumerate(rules):
            records = _Recorded.of(batch, rule.topic)
            for field in rule.fields:
                if field.before:
                    number = _values(field, records)
                    known = np.flatnonzero(~np.isnan(number))
                    starts += [(int(records.position[row]), k, int(number[row])) for row in known[:1]]
        if starts:
            _, k, value = min(starts)
            return rules[k], value
    return rules[0], None
