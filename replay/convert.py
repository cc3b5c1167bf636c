"""Convert any readable recording to MCAP: every message, typed, with its time of arrival."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.metadata import version
from itertools import chain, islice
from pathlib import Path

from adapters.batch import Batch
from adapters.encoding.record import Record
from adapters.logs.mcap_log import MessageLogWriter
from adapters.logs.recordings import ONBOARD_LOG
from monitor.recording.record_encoder import RecordEncoder
from monitor.recording.recorder import Channels, add_records, recordable


def convert(entries: Iterable[Batch | Record], source: str, target: Path, onboard: str | None = None) -> int:
    """Write all messages to an MCAP file, made once the recording has shown that it can be read; return how many.

    A record is written as it is. ``source``, the recording's name, is kept in the file's metadata, and so is the kind
    of onboard log, where it is one: a reader has to know what its records stand for.

    Raises
    ------
    TelemetryError
        The recording cannot be read, or the file cannot be written.
    """
    remaining = iter(entries)
    first = list(islice(remaining, 1))
    with MessageLogWriter(target) as writer:
        kind = {} if onboard is None else {ONBOARD_LOG: onboard}
        writer.add_metadata("fauio", {"fauio": version("fauio"), "converted_from": source, **kind})
        encoder = RecordEncoder(())
        channels: Channels = {}
        for entry in chain(first, remaining):
            if isinstance(entry, Record):
                writer.write_record(entry)
                continue
            add_records(writer, recordable(writer, encoder.batch(entry), encoder.topics, channels), channels)
        return writer.statistics().records
