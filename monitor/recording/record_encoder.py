"""Everything that a monitor receives and computes, as records, each encoded once for all files."""

from __future__ import annotations

import contextlib
import functools
import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any, Final, NamedTuple, Self, TypeAlias

import numpy as np

from adapters.batch import Batch, Columns, each
from adapters.encoding.message_record import encode
from adapters.encoding.protobuf_types import (
    TIMESTAMP,
    Field,
    ProtobufScalar,
    identifiers,
    message_class,
    protobuf_schema,
)
from adapters.encoding.record import Schema
from adapters.encoding.typed_record import columns_class
from adapters.message import SECOND_NS, Message
from adapters.sample import Samples
from adapters.source import MAVLINK
from monitor.bus.payload import to_json
from monitor.bus.schemas import ALARM_SCHEMA
from monitor.core.protobuf_rows import RowEncoder
from monitor.estimate import Estimates, Layout
from monitor.event import ALARM_FIELDS, AlarmEvent

EncodedRecord: TypeAlias = tuple[int, bytes, int]
"""Number of the topic, data, log time in Unix nanoseconds (0 <= time < 2^63).

The black box holds 20,000 of them per vehicle. A full collection of Python's garbage collector visits every object that
it tracks: with 80,000 records held for four vehicles it took 0.1 s, in which no alarm could be raised. CPython stops
tracking a tuple of nothing but numbers and bytes (not an instance of a class) at the first collection that meets it.
"""


@dataclass(slots=True)
class EncodedRecords:
    """Encoded records in their order, as lists: a recording is written 1.7 times as fast as from tuples."""

    topics: list[int]  # numbers of the topics
    data: list[bytes]
    times_ns: list[int]  # log times

    @classmethod
    def of(cls, records: Iterable[EncodedRecord]) -> Self:
        """Return single records together."""
        topics, data, times_ns = [*zip(*records, strict=True)] or ((), (), ())
        return cls([*topics], [*data], [*times_ns])

    def __len__(self) -> int:
        return len(self.topics)

    def __getitem__(self, part: slice) -> EncodedRecords:
        return EncodedRecords(self.topics[part], self.data[part], self.times_ns[part])

    def __iter__(self) -> Iterator[EncodedRecord]:
        return zip(self.topics, self.data, self.times_ns, strict=True)


class Topic(NamedTuple):
    """What all records of one sender on one topic have in common, as in :class:`~adapters.encoding.record.Record`."""

    name: str
    encoding: str
    schema: Schema | None
    component: int = 0


_NO_TIME = -1
"""Time of a message that no record can hold."""

_TIMES = (Field("time", TIMESTAMP), Field("vehicle_time_ns", "int64"), Field("index", "int64"))


OWN_TOPICS: Final = "/fauio/"

_ALARM_JSON = Topic(
    f"{OWN_TOPICS}alarm_json", "json", Schema("fauio.Alarm", "jsonschema", json.dumps(ALARM_SCHEMA).encode())
)


class _RowType:
    """``fauio.<observer>.<name>``: an observer's rows, with times, and fields named like the columns of rows.

    Characters that protobuf does not allow become underscores.
    """

    def __init__(self, layout: Layout, name: str, fields: Sequence[Field]) -> None:
        self.pb_class = message_class(f"fauio.{identifiers((layout.observer,))[0]}", name, (*_TIMES, *fields))
        self._columns = [field.name for field in fields]
        self._rows = RowEncoder(self.pb_class)

    def rows(self, samples: Samples, values: Samples | Estimates) -> list[bytes]:
        """Return the serialized messages of the values at samples."""
        timestamps = np.empty((len(samples), 2), np.int64)
        np.divmod(samples.time_ns, SECOND_NS, out=(timestamps[:, 0], timestamps[:, 1]))
        columns = (getattr(values, name) for name in self._columns)
        return self._rows.encode((timestamps, samples.vehicle_time_ns, samples.index, *columns), len(samples))


def _types(layout: Layout) -> tuple[_RowType, _RowType]:
    """Return the protobuf types of an observer's samples (u, y), and of its states, faults and residuals."""
    faults, outputs = _numbers(layout.faults), _numbers(layout.outputs)
    u_y = (Field("u", _numbers(layout.inputs)), Field("y", outputs))
    flags = (Field("restart", "bool"), Field("complete", "bool"), Field("measured", "bool"))
    estimate = (
        Field("x", _numbers(layout.states)),
        Field("fault", faults),
        Field("isolated", faults),
        Field("residual", outputs),
        Field("armed", "bool"),
        Field("sd", faults),
        Field("coasted_s", "double"),
    )
    return _RowType(layout, "Sample", (*u_y, *flags)), _RowType(layout, "Estimate", estimate)


def _numbers(names: tuple[str, ...]) -> tuple[Field, ...]:
    return tuple(Field(name, "double") for name in identifiers(names))


@functools.cache
def _alarm_class() -> Any:
    """Return ``fauio.Alarm``; fields that are None in an event are absent."""
    kinds: dict[type, ProtobufScalar] = {str: "string", bool: "bool", int: "int64", float: "double"}
    fields = [Field(name, kinds[field.kind], optional=field.optional) for name, field in ALARM_FIELDS.items()]
    return message_class("fauio", "Alarm", fields)


class RecordEncoder:
    """Encodes one vehicle's messages, estimates and alarm events.

    Topics: ``/mavlink/<MESSAGE>`` and ``/zenoh/<key>`` telemetry as received (and ``/link``, ``/operator`` and the like
    for the pipeline's other inputs); ``/fauio/<observer>/sample`` and ``/fauio/<observer>/estimate``; ``/fauio/alarm``
    (protobuf) and ``/fauio/alarm_json``. The time of a record is the time of arrival for telemetry and the Unix time of
    the sample for the monitor's results. ``unrecordable`` counts what no record can hold: values no JSON knows, clocks
    that run out of 63 bits.
    """

    def __init__(self, layouts: Sequence[Layout]) -> None:
        self.topics: list[Topic] = []
        self.unrecordable = 0
        self.faults = {layout.observer: layout.faults for layout in layouts}
        self._types = {layout.observer: _types(layout) for layout in layouts}
        self._known: dict[Topic, int] = {}
        self._numbers: dict[tuple[str, Any, int], int] = {}

    def batch(self, batch: Batch) -> EncodedRecords:
        """Return the records of telemetry, in the order of arrival."""
        records = EncodedRecords([0] * batch.count, [b""] * batch.count, [_NO_TIME] * batch.count)
        for columns in batch.columns:
            encoded = self._encoded(columns)
            if encoded is None:
                self._encode_singly(zip(columns.position.tolist(), each(columns), strict=True), records)
                continue
            topic, data = encoded
            for place, row, time_ns in zip(columns.position.tolist(), data, columns.received_ns.tolist(), strict=True):
                records.topics[place], records.data[place], records.times_ns[place] = topic, row, time_ns
        self._encode_singly(batch.others.items(), records)
        return self._recordable(records)

    def estimates(self, estimates: Estimates) -> EncodedRecords:
        """Return the records of the samples that estimates were computed from, and of the estimates."""
        name, samples = estimates.observer, estimates.samples
        sample_type, estimate_type = self._types[name]
        sample_topic = self._topic(f"{OWN_TOPICS}{name}/sample", sample_type.pb_class)
        estimate_topic = self._topic(f"{OWN_TOPICS}{name}/estimate", estimate_type.pb_class)
        pairs = zip(sample_type.rows(samples, samples), estimate_type.rows(samples, estimates), strict=True)
        topics, times_ns = [sample_topic, estimate_topic] * len(samples), np.repeat(samples.time_ns, 2).tolist()
        return self._recordable(EncodedRecords(topics, [*chain.from_iterable(pairs)], times_ns))

    def event(self, event: AlarmEvent) -> EncodedRecords:
        """Return an alarm event as protobuf and as JSON."""
        time_ns = event.time_ns
        try:
            if time_ns < 0:
                raise ValueError("MCAP has no times before 1970")
            record = _alarm_class()(**event.to_json())
        except ValueError:
            self.unrecordable += 1
            return EncodedRecords([], [], [])
        topics = [self._topic(f"{OWN_TOPICS}alarm", type(record)), self.number(_ALARM_JSON)]
        return EncodedRecords(topics, [record.SerializeToString(), to_json(event.to_json())], [time_ns] * 2)

    def _encoded(self, columns: Columns) -> tuple[int, list[bytes]] | None:
        """Return the number of the topic and the data of columns, None where no protobuf type can hold them."""
        ids = (columns.system, columns.component) if columns.source is MAVLINK else ()
        try:
            pb_class = columns_class(columns)
            rows = _row_encoder(pb_class)
            fields = [columns.fields[name] for name in rows.names[len(ids) :]]
            if len(fields) < len(columns.fields):
                return None
            data = rows.encode((*ids, *fields), len(columns.position))
        except (KeyError, ValueError):
            return None
        return self._topic(f"/{columns.source}/{columns.name}", pb_class, columns.component), data

    def _encode_singly(self, messages: Iterable[tuple[int, Message]], records: EncodedRecords) -> None:
        """Store the records of messages at their indices."""
        for place, message in messages:
            with contextlib.suppress(ValueError):
                record = encode(message)
                topic = self.number(Topic(record.topic, record.encoding, record.schema, record.component))
                records.topics[place], records.data[place], records.times_ns[place] = topic, record.data, record.time_ns

    def _recordable(self, records: EncodedRecords) -> EncodedRecords:
        """Leave out the records of times before 1970 and those without one, and count them."""
        if min(records.times_ns, default=0) >= 0:
            return records
        kept = EncodedRecords.of(record for record in records if record[2] >= 0)
        self.unrecordable += len(records) - len(kept)
        return kept

    def number(self, topic: Topic) -> int:
        """Return a topic's number; topics are numbered from 0 as they first occur."""
        number = self._known.setdefault(topic, len(self.topics))
        if number == len(self.topics):
            self.topics.append(topic)
        return number

    def _topic(self, name: str, pb_class: Any, component: int = 0) -> int:
        """Return the number of a topic of protobuf records."""
        key = name, pb_class, component
        number = self._numbers.get(key)
        if number is None:
            topic = Topic(name, "protobuf", protobuf_schema(pb_class), component)
            number = self._numbers[key] = self.number(topic)
        return number


_row_encoder = functools.cache(RowEncoder)
