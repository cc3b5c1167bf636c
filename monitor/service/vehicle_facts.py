"""Keep what a vehicle reports about itself, to be shown beside its alarms: position, flight mode, messages."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from adapters.batch import Batch, Columns
from adapters.errors import printable
from adapters.mavlink.heartbeat import NO_AUTOPILOT
from monitor.recording.foxglove_records import places

_TEXTS = 20
"""Number of messages that are kept. Chosen: an autopilot sends fewer in a minute."""
_MAX_TEXT = 254
"""Largest length of a message: five of MAVLink's chunks of 50, more than autopilots send."""
_CHUNK = 50
"""Length of a STATUSTEXT that continues in the next one."""
_NAMES = ("HEARTBEAT", "GLOBAL_POSITION_INT", "GPS_RAW_INT")


class VehicleFacts:
    """Keeps the latest reports of a vehicle about itself."""

    def __init__(self) -> None:
        self._facts: dict[str, Any] = {}
        self._texts: deque[dict[str, Any]] = deque(maxlen=_TEXTS)
        self._chunks: tuple[int, str] = (0, "")
        self._unread: dict[tuple[str, int], Columns] = {}

    def take(self, own: Batch) -> None:
        """Process messages of the vehicle."""
        for columns in own.columns:
            if columns.source.is_telemetry and (columns.name in _NAMES or "latitude" in columns.fields):
                # of the messages between two statuses only the newest is shown
                self._unread[columns.name, columns.component] = columns
        for message in own.others.values():
            if message.name == "STATUSTEXT":
                self._text(message.received_ns, message.fields)

    def status(self) -> dict[str, Any]:
        """Return the known facts, as they stand in the status."""
        for columns in self._unread.values():
            if columns.name == "HEARTBEAT":
                self._heartbeat(columns.fields)
            which = "position" if columns.name == "GLOBAL_POSITION_INT" else "gps"
            for _, latitude, longitude, altitude in places(columns):
                self._facts[which] = [round(latitude, 7), round(longitude, 7), round(altitude, 2)]
        self._unread.clear()
        return self._facts | {"texts": list(self._texts)}

    def _heartbeat(self, fields: Mapping[str, Any]) -> None:
        keys = ("type", "autopilot", "base_mode", "custom_mode")
        beat = [float(np.ravel(fields[key][-1])[0]) if key in fields else np.nan for key in keys]
        if beat[1] != NO_AUTOPILOT and np.isfinite(beat).all():
            self._facts["heartbeat"] = dict(zip(keys, map(int, beat), strict=True))

    def _text(self, received_ns: int, fields: Mapping[str, Any]) -> None:
        text, severity = fields.get("text"), fields.get("severity")
        if not isinstance(text, str) or type(severity) is not int:
            return
        number = fields.get("id", 0)
        before = self._chunks[1] if number and number == self._chunks[0] and self._texts else ""
        whole = (before + printable(text))[:_MAX_TEXT]
        self._chunks = (number, whole) if number and len(text) == _CHUNK else (0, "")
        if before:
            self._texts[-1] |= {"text": whole}
        else:
            self._texts.append({"time_ns": received_ns, "severity": severity, "text": whole})
