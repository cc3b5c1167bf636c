"""Records that viewers draw by themselves: lines of a log and places on a map, in Foxglove's schemas.

https://docs.foxglove.dev/docs/sdk/schemas: ``foxglove.Log`` and ``foxglove.LocationFix``, as JSON.
"""

import json
import math
from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch, Columns
from adapters.encoding.record import Schema
from adapters.errors import printable
from adapters.message import LATEST_NS, SECOND_NS
from monitor.bus.payload import to_json
from monitor.estimate import Estimates
from monitor.event import AlarmEvent
from monitor.recording.record_encoder import OWN_TOPICS, EncodedRecord, RecordEncoder, Topic

_DEBUG, _INFO, _WARNING, _ERROR, _FATAL = range(1, 6)
"""Levels of ``foxglove.Log``."""
_LEVELS = (_FATAL, _FATAL, _FATAL, _ERROR, _WARNING, _INFO, _INFO, _DEBUG)
"""Foxglove's levels by MAV_SEVERITY, from emergency to debugging."""
PULLED = ("gps_north", "gps_east")
"""Fault channels that are errors of the GPS position."""
_MOST_WAITING = 10_000
"""Most places that wait for estimates; the oldest are dropped. Chosen: more than a replay's batch holds."""
EARTH_M = 6378137.0
"""The equator's radius of WGS 84."""
_FIX_2D = 2
"""GPS_FIX_TYPE from which a position is one. Receivers without a fix repeat the last one, or send anything."""
_TIME = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
_NUMBER, _TEXT = {"type": "number"}, {"type": "string"}


def _topic(name: str, schema: str, properties: Mapping[str, Any]) -> Topic:
    content = {"title": schema, "type": "object", "properties": {"timestamp": _TIME} | dict(properties)}
    return Topic(f"{OWN_TOPICS}{name}", "json", Schema(schema, "jsonschema", json.dumps(content).encode()))


_FIX: Final[Mapping[str, Any]] = {
    "frame_id": _TEXT,
    "latitude": _NUMBER,
    "longitude": _NUMBER,
    "altitude": _NUMBER,
    "position_covariance": {"type": "array", "items": _NUMBER, "minItems": 9, "maxItems": 9},
    "position_covariance_type": {"type": "integer"},
}
_LINE: Final[Mapping[str, Any]] = dict.fromkeys(("message", "name", "file"), _TEXT) | {
    key: {"type": "integer"} for key in ("level", "line")
}
LOG: Final = _topic("log", "foxglove.Log", _LINE)
"""Every alarm event."""
TEXTS: Final = _topic("texts", "foxglove.Log", _LINE)
"""Texts of the autopilot: a topic of their own, so that the order of neither depends on how the stream is cut."""
GPS: Final = _topic("gps", "foxglove.LocationFix", _FIX)
"""Position by GPS."""
TRACK: Final = _topic("track", "foxglove.LocationFix", _FIX)
"""Position by GPS less the estimated fault of GPS."""


class FoxgloveRecords:
    """Makes these records from an archive's other records; the encoder numbers their topics."""

    def __init__(self, encoder: RecordEncoder) -> None:
        self._encoder = encoder
        self._faults = {name: faults for name, faults in encoder.faults.items() if set(PULLED) <= set(faults)}
        # places that wait for an estimate: time, latitude, longitude, altitude
        self._last: tuple[int, NDArray[np.float64]] = (0, np.zeros(len(PULLED)))
        self._waiting: deque[tuple[int, float, float, float]] = deque(maxlen=_MOST_WAITING)

    def batch(self, batch: Batch) -> list[EncodedRecord]:
        """Return the records of a batch's texts and places of GPS."""
        records = [
            self._line(TEXTS, message.received_ns, _LEVELS[severity], text, "autopilot")
            for message in batch.others.values()
            if message.name == "STATUSTEXT"
            and isinstance(text := message.fields.get("text"), str)
            and type(severity := message.fields.get("severity")) is int
            and 0 <= severity < len(_LEVELS)
        ]
        for columns in batch.columns:
            if columns.source.is_telemetry and (columns.name == "GPS_RAW_INT" or "latitude" in columns.fields):
                fixes = [*places(columns)]
                records += [self._fix(GPS, *place) for place in fixes]
                if self._faults:
                    self._waiting += fixes
        return [record for record in records if 0 <= record[2] < LATEST_NS]

    def estimates(self, estimates: Estimates) -> list[EncodedRecord]:
        """Return the corrected places of those that waited for these estimates."""
        faults = self._faults.get(estimates.observer)
        times_ns = estimates.samples.time_ns
        if faults is None or not len(times_ns):
            return []
        # The row before counts too, so that the result does not depend on how the stream is cut.
        before_ns, before = self._last
        # An estimate that is no evidence, as on the ground, corrects nothing.
        pulls = np.where(estimates.armed[:, None], estimates.isolated[:, [faults.index(name) for name in PULLED]], 0.0)
        pulls = np.vstack((before, pulls))
        times_ns = np.concatenate(([before_ns], times_ns))
        self._last = int(times_ns[-1]), pulls[-1]
        records = []
        while self._waiting and self._waiting[0][0] <= times_ns[-1]:
            time_ns, latitude, longitude, altitude = self._waiting.popleft()
            north, east = pulls[max(int(np.searchsorted(times_ns, time_ns, "right")) - 1, 0)].tolist()
            if time_ns >= 0 and math.isfinite(north + east):
                latitude -= math.degrees(north / EARTH_M)
                longitude -= math.degrees(east / (EARTH_M * math.cos(math.radians(latitude))))
                records.append(self._fix(TRACK, time_ns, latitude, longitude, altitude))
        return records

    def event(self, event: AlarmEvent) -> list[EncodedRecord]:
        """Return the log line of an alarm event."""
        quiet = event.state in ("acknowledged", "shelved", "cleared")
        level = _INFO if quiet else _ERROR if event.severity == "critical" else _WARNING
        size = f" ({event.display})" if event.display else ""
        line = f"{event.channel} {event.state}: {event.message}{size}"
        return [self._line(LOG, event.time_ns, level, line, event.observer)]

    def _line(self, topic: Topic, time_ns: int, level: int, text: str, name: str) -> EncodedRecord:
        content = {"level": level, "message": printable(text), "name": name, "file": "", "line": 0}
        return self._record(topic, time_ns, content)

    def _fix(self, topic: Topic, time_ns: int, latitude: float, longitude: float, altitude: float) -> EncodedRecord:
        place = {"latitude": latitude, "longitude": longitude, "altitude": altitude}
        unknown = {"position_covariance": [0.0] * 9, "position_covariance_type": 0}
        return self._record(topic, time_ns, {"frame_id": "gps"} | place | unknown)

    def _record(self, topic: Topic, time_ns: int, content: Mapping[str, Any]) -> EncodedRecord:
        seconds, nanoseconds = divmod(time_ns, SECOND_NS)
        timestamp = {"timestamp": {"sec": seconds, "nsec": nanoseconds}}
        return self._encoder.number(topic), to_json(timestamp | dict(content)), time_ns


def places(columns: Columns) -> Iterator[tuple[int, float, float, float]]:
    """Yield times, latitudes, longitudes and altitudes of a receiver's messages."""
    names, scales = ("latitude", "longitude", "altitude"), (1.0, 1.0, 1.0)
    if "latitude" not in columns.fields:
        # MAVLink's units: 1e-7 degrees, and millimetres.
        names, scales = ("lat", "lon", "alt"), (1e-7, 1e-7, 1e-3)
    if not columns.fields.keys() >= set(names):
        return
    rows = len(columns.received_ns)
    numbers = [np.asarray(columns.fields[name], np.float64).reshape(rows, -1)[:, 0] for name in names]
    fix = np.asarray(columns.fields.get("fix_type", np.full(rows, _FIX_2D))).reshape(rows, -1)[:, 0]
    fixed = ~(fix < _FIX_2D)
    for time_ns, place in zip(columns.received_ns[fixed].tolist(), np.column_stack(numbers)[fixed], strict=True):
        latitude, longitude, altitude = (place * scales).tolist()
        # A receiver without a fix sends zero for both.
        if math.isfinite(sum(place)) and (latitude or longitude) and abs(latitude) < 90.0 and abs(longitude) <= 180.0:
            yield time_ns, latitude, longitude, altitude
