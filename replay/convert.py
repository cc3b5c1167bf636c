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


def convert(entries: Iterable[Batch | Record], source: str, target: Path, onboard: str | None = None) -> int:
    """Write all messages to an MCAP file; return how many were written.

    Parameters
    ----------
    entries : Iterable[Message | Record]
        The recording; a record is written as it is.
    source : str
        Name of the recording, kept in the file's metadata.
    target : Path
        File to create, once the recording has shown that it can be read.
    onboard : str | None
        Kind of onboard log, where the recording is one: a reader has to know what its records stand for.

    Raises
    ------
    TelemetryError
        The recording cannot be read, or the file cannot be written.
    """
    remaining = iter(entries)
    first = list(islice(remaining, 1))
    with MessageLogWriter(target) as writer:
        if onboard is not None:
            writer.add_metadata("fauio", {ONBOARD_LOG: onboard})
        encoder = RecordEncoder(())
        for entry in chain(first, remaining):
            if isinstance(entry, Record):
                writer.write_record(entry)
                continue
            for number, data, time_ns in encoder.batch(entry):
                topic = encoder.topics[number]
                channel = writer.channel(topic.name, topic.encoding, topic.schema)
                if channel is not None:
                    writer.add(channel, data, time_ns)
        writer.add_metadata("fauio", {"fauio": version("fauio"), "converted_from": source})
        return writer.statistics().records
