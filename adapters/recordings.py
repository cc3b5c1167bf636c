"""Opens a recording of any known kind as messages, by its suffix."""

from __future__ import annotations

import os
from collections.abc import Container, Iterator
from pathlib import Path

from adapters.errors import TelemetryError
from adapters.message import Message


def read_recording(path: str | os.PathLike[str], only: Container[str] | None = None) -> Iterator[Message]:
    """Return the messages of a recording in the order they arrived.

    Parameters
    ----------
    path : str | PathLike
        ``.tlog`` or ``.mcap``, plain or with ``.xz`` or ``.gz`` behind.
    only : Container[str] | None
        Names of the messages wanted; None wants all.

    Raises
    ------
    TelemetryError
        The suffix is none of these, or the file cannot be opened or holds nothing of its kind (on iteration).
    """
    suffixes = [suffix for suffix in Path(path).suffixes[-2:] if suffix not in (".xz", ".gz")]
    kind = suffixes[-1].lower() if suffixes else ""
    if kind == ".tlog":
        from adapters.tlog import read_tlog

        return read_tlog(path, only)
    if kind == ".mcap":
        from adapters.mcap_log import read_mcap_messages

        return (message for message in read_mcap_messages(path) if only is None or message.name in only)
    raise TelemetryError(
        f"{path}: unknown kind of recording; use .tlog or .mcap, plain or with .xz or .gz behind"
    )
