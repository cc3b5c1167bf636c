"""Convert any readable recording to MCAP: every message, typed, with its time of arrival."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path

from adapters.mcap_log import MessageLogWriter
from adapters.message import Message


def convert(messages: Iterable[Message], source: str, target: Path) -> int:
    """Write all messages to an MCAP file; return how many were written.

    Parameters
    ----------
    messages : Iterable[Message]
        The recording.
    source : str
        Name of the recording, kept in the file's metadata.
    target : Path
        File to create.

    Raises
    ------
    TelemetryError
        The file cannot be written.
    """
    with MessageLogWriter(target) as writer:
        for message in messages:
            writer.write(message)
        writer.add_metadata("fauio", {"fauio": version("fauio"), "converted_from": source})
        return writer.statistics().records
