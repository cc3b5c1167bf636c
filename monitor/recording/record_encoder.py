"""Everything a monitor sees and says as records, encoded once for however many files will hold them."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np

from adapters.batch import Batch, one_message
from adapters.encoding.message_record import encode, encode_columns
from adapters.encoding.protobuf_types import descriptor_set
from adapters.encoding.record import Record, Records, Schema, single
from adapters.message import Message
from monitor.bus.payload import ALARM_SCHEMA, to_json
from monitor.estimate import Estimate, Estimates, Layout
from monitor.event import AlarmEvent
from monitor.recording.protobuf_schema import EstimateType, SampleType, alarm_record

OWN_TOPICS: Final = "/fauio/"
ALARM_TOPICS: Final = frozenset({f"{OWN_TOPICS}alarm", f"{OWN_TOPICS}alarm_json"})

_ALARM_JSON = Schema("fauio.Alarm", "jsonschema", json.dumps(ALARM_SCHEMA).encode())


class RecordEncoder:
    """Encodes one vehicle's messages, estimates and alarm events.

    Topics: ``/mavlink/<MESSAGE>`` and ``/zenoh/<key>`` telemetry as received (and ``/link``, ``/operator`` and the
    like for what else the pipeline is fed); ``/fauio/<observer>/sample`` and ``/fauio/<observer>/estimate``;
    ``/fauio/alarm`` (protobuf) and ``/fauio/alarm_json``. The time of a record is the time of arrival for telemetry
    and the Unix time of the sample for what the monitor made of it.

    Parameters
    ----------
    layouts : Sequence[Layout]
        The observers whose estimates will be encoded.

    Attributes
    ----------
    unrecordable : int
        What no record can hold: values no JSON knows, clocks that run out of 64 bits.
    """

    def __init__(self, layouts: Sequence[Layout]) -> None:
        self.unrecordable = 0
        self._samples = {layout.observer: SampleType(layout) for layout in layouts}
        self._estimates = {layout.observer: EstimateType(layout) for layout in layouts}
        self._sample_schemas = {name: _schema(kind.pb_class) for name, kind in self._samples.items()}
        self._estimate_schemas = {name: _schema(kind.pb_class) for name, kind in self._estimates.items()}
        self._alarm_schema: Schema | None = None

    def message(self, message: Message) -> tuple[Record, ...]:
        """Return telemetry as a record; nothing where it cannot be recorded, here and below."""
        try:
            return (encode(message),)
        except ValueError:
            self.unrecordable += 1
            return ()

    def estimate(self, estimate: Estimate) -> tuple[Record, ...]:
        """Return the sample an estimate was computed from, and the estimate."""
        name = estimate.observer
        time_ns = estimate.sample.time_ns
        try:
            sample = self._samples[name].record(estimate.sample)
            found = self._estimates[name].record(estimate)
        except ValueError:
            self.unrecordable += 1
            return ()
        return (
            Record(f"{OWN_TOPICS}{name}/sample", "protobuf", self._sample_schemas[name], _bytes(sample), time_ns),
            Record(f"{OWN_TOPICS}{name}/estimate", "protobuf", self._estimate_schemas[name], _bytes(found), time_ns),
        )

    def block(self, block: Batch) -> list[Records]:
        """Return the records of a stretch of telemetry by topic."""
        found: list[Records] = []
        for columns in block.columns:
            records = encode_columns(columns)
            if records is not None:
                found.append(records)
            else:
                places = enumerate(columns.position.tolist())
                found += self._singly((place, one_message(columns, row)) for row, place in places)
        return [*found, *self._singly(block.others.items())]

    def _singly(self, messages: Iterable[tuple[int, Message]]) -> list[Records]:
        return [single(record, place) for place, message in messages for record in self.message(message)]

    def estimates(self, estimates: Estimates) -> list[Records]:
        """Return the samples that estimates were computed from, and the estimates, as :meth:`estimate` does."""
        name, time_ns = estimates.observer, estimates.samples.time_ns
        place = 2 * np.arange(len(estimates))
        topic, schema = f"{OWN_TOPICS}{name}/sample", self._sample_schemas[name]
        samples = Records(topic, "protobuf", schema, self._samples[name].rows(estimates.samples), time_ns, place)
        topic, schema = f"{OWN_TOPICS}{name}/estimate", self._estimate_schemas[name]
        return [samples, Records(topic, "protobuf", schema, self._estimates[name].rows(estimates), time_ns, place + 1)]

    def event(self, event: AlarmEvent) -> tuple[Record, ...]:
        """Return an alarm event as protobuf and as JSON."""
        try:
            found = alarm_record(event)
        except ValueError:
            self.unrecordable += 1
            return ()
        schema = self._alarm_schema = self._alarm_schema or _schema(type(found))
        data = to_json(event.to_json())
        return (
            Record(f"{OWN_TOPICS}alarm", "protobuf", schema, _bytes(found), event.time_ns),
            Record(f"{OWN_TOPICS}alarm_json", "json", _ALARM_JSON, data, event.time_ns),
        )


def _schema(pb_class: Any) -> Schema:
    return Schema(str(pb_class.DESCRIPTOR.full_name), "protobuf", descriptor_set(pb_class))


def _bytes(record: Any) -> bytes:
    return bytes(record.SerializeToString())
