"""Opens a recording of any known kind as messages; its suffix says which kind it is."""

from __future__ import annotations

import os
from collections.abc import Container, Iterator
from pathlib import Path
from typing import Literal

from adapters.errors import TelemetryError
from adapters.message import Message

RecordingKind = Literal["tlog", "mcap"]


def recording_kind(path: str | os.PathLike[str]) -> RecordingKind:
    """Return what kind of recording a file is.

    Raises
    ------
    TelemetryError
        The suffix is none of ``.tlog`` and ``.mcap``, plain or with ``.xz`` or ``.gz`` behind, or there is no
        such file.
    """
    file = Path(path)
    plain = file.with_suffix("") if file.suffix.lower() in (".xz", ".gz") else file
    kind = plain.suffix.lower()
    if kind not in (".tlog", ".mcap"):
        raise TelemetryError(f"{path}: unknown kind of recording; use .tlog or .mcap, plain or with .xz or .gz behind")
    if not file.is_file():
        raise TelemetryError(f"{path}: no such file")
    return "tlog" if kind == ".tlog" else "mcap"


def read_recording(path: str | os.PathLike[str], only: Container[str] | None = None) -> Iterator[Message]:
    """Return the messages of a recording in the order they arrived.

    Parameters
    ----------
    path : str | PathLike
        The recording.
    only : Container[str] | None
        Names of the messages wanted; None wants all.

    Raises
    ------
    TelemetryError
        See :func:`recording_kind`; on iteration, where the file holds nothing of its kind.
    """
    if recording_kind(path) == "tlog":
        from adapters.tlog import read_tlog

        return read_tlog(path, only)
    from adapters.mcap_log import read_mcap_messages

    return (message for message in read_mcap_messages(path) if only is None or message.name in only)
