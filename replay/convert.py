"""Convert any readable recording to MCAP: every message, typed, with its time of arrival."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path

from adapters.mcap_log import MessageLogWriter
from adapters.message import Message
from adapters.recordings import ONBOARD_LOG


def convert(messages: Iterable[Message], source: str, target: Path, onboard: str | None = None) -> int:
    """Write all messages to an MCAP file; return how many were written.

    Parameters
    ----------
    messages : Iterable[Message]
        The recording.
    source : str
        Name of the recording, kept in the file's metadata.
    target : Path
        File to create.
    onboard : str | None
        Kind of onboard log, where the recording is one: a reader has to know what its records stand for.

    Raises
    ------
    TelemetryError
        The file cannot be written.
    """
    with MessageLogWriter(target) as writer:
        if onboard is not None:
            writer.add_metadata("fauio", {ONBOARD_LOG: onboard})
        for message in messages:
            writer.write(message)
        writer.add_metadata("fauio", {"fauio": version("fauio"), "converted_from": source})
        return writer.statistics().records
