"""The monitor's own records in its recordings."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path

from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader


def own_records(files: Sequence[Path]) -> dict[str, list[bytes]]:
    """Return what a monitor recorded of its own conclusions, by topic, byte for byte; files may break off."""
    found: dict[str, list[bytes]] = {}
    for file in files:
        with file.open("rb") as stream, contextlib.suppress(McapError):
            for _, channel, message in NonSeekingReader(stream).iter_messages(log_time_order=False):
                if channel.topic.startswith("/fauio/"):
                    found.setdefault(channel.topic, []).append(message.data)
    return found
