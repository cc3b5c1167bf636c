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

# a file has no more than so many
_NO_CHANNEL = 0


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
        channels: dict[int, int] = {}
        for entry in chain(first, remaining):
            if isinstance(entry, Record):
                writer.write_record(entry)
                continue
            records = encoder.batch(entry)
            for number in {number for number, _, _ in records} - channels.keys():
                topic = encoder.topics[number]
                channels[number] = writer.channel(topic.name, topic.encoding, topic.schema) or _NO_CHANNEL
            kept = [record for record in records if channels[record[0]] != _NO_CHANNEL]
            writer.add_all(
                [channels[number] for number, _, _ in kept],
                [data for _, data, _ in kept],
                [time_ns for _, _, time_ns in kept],
            )
        return writer.statistics().records
