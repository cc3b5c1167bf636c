"""Convert any readable recording to MCAP: every message, typed, with its time of arrival."""

from collections.abc import Iterable
from importlib.metadata import version
from itertools import chain, islice
from pathlib import Path

from adapters.batch import Batch
from adapters.encoding.record import Record
from adapters.logs.recordings import ONBOARD_LOG
from monitor.recording.record_encoder import RecordEncoder
from monitor.recording.recorder import RecordFile


def convert(entries: Iterable[Batch | Record], source: str, target: Path, onboard: str | None = None) -> int:
    """Write all messages to an MCAP file and return their number; the file is made once the recording proves readable.

    A record is written unchanged. The file's metadata holds ``source``, the recording's name, and the kind of an
    onboard log, because a reader has to know what the log's records mean.

    Raises
    ------
    TelemetryError
        The recording cannot be read, or the file cannot be written.
    """
    remaining = iter(entries)
    first = list(islice(remaining, 1))
    encoder = RecordEncoder(())
    kind = {} if onboard is None else {ONBOARD_LOG: onboard}
    metadata = {"fauio": version("fauio"), "converted_from": source, **kind}
    with RecordFile(target, encoder.topics, metadata, {}) as file:
        for entry in chain(first, remaining):
            if isinstance(entry, Record):
                file.write_record(entry)
            else:
                file.add(file.recordable(encoder.batch(entry)))
        return file.records
