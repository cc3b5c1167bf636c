"""Log lines on stderr: readable on a terminal, JSON lines otherwise; limited in rate, and never blocking the monitor.

Built on :mod:`logging`; lines of libraries have the same form. A line that cannot be written (stderr closed, disk full,
a pipe that nobody reads) is dropped and counted.
"""

from __future__ import annotations

import json
import logging
import math
import select
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, TextIO

from adapters.errors import printable
from monitor.event import AlarmEvent

Level = Literal["debug", "info", "warning", "error"]

BURST = 10
"""Lines of one name that are written at once; then one a second. Chosen: enough for an error with its consequences."""
MAX_NAMES = 1000
"""Most names that are remembered: names may come from the network."""
MAX_TEXT = 400
"""Most letters of a value. Chosen: longer than any value of ours, short enough for a line of a log."""

_REFILL_NS = 1_000_000_000
"""Time for one more line of a name that has used up its burst."""
_RESERVED = ("time_ns", "level", "event", "suppressed")


@dataclass(slots=True)
class ServiceLogStatistics:
    """Counts of the lines."""

    written: int = 0
    suppressed: int = 0  # lines left out because there were too many of their name
    dropped: int = 0  # lines that could not be written


class ServiceLog:
    """The daemon's log; one per process.

    Ten lines of each event name, and of each alarm channel, are written at once, then one a second; the next line
    states how many were left out. Lines are JSON objects (``time_ns``, ``level``, ``event`` and its fields), or text
    for people. That text has no control characters: input from a network must not control the terminal. ``stream``
    receives the lines; None takes the current ``sys.stderr``. ``clock`` gives the monotonic time of the rate limit in
    nanoseconds.
    """

    def __init__(
        self, as_json: bool, stream: TextIO | None = None, clock: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._handler = _Handler(as_json, stream, _RateLimit(clock))
        self._logger = logging.Logger("fauio")
        self._logger.addHandler(self._handler)
        logging.getLogger().addHandler(self._handler)

    def say(self, name: str, *, level: Level = "info", **details: Any) -> None:
        """Write a line: an event in a word or two, its level, and its fields."""
        self._write(name, level, name, details, None)

    def event(self, event: AlarmEvent) -> None:
        """Write an alarm event."""
        seconds = event.vehicle_time_ms / 1000
        message = _text(event.message)
        what = f"{event.observer}/{event.channel} {event.state} ({event.severity}): {message}"
        text = f"{seconds:.3f} s  {event.vehicle}  {what}"
        limited_by = f"alarm {event.vehicle} {event.observer}/{event.channel}"
        self._write("alarm", "info", limited_by, {"alarm": event.to_json()}, text)

    def statistics(self) -> ServiceLogStatistics:
        """Return the counts so far."""
        return replace(self._handler.counts)

    def close(self) -> None:
        """Remove the log from :mod:`logging`; the stream stays open."""
        self._logger.removeHandler(self._handler)
        logging.getLogger().removeHandler(self._handler)

    def _write(self, name: str, level: Level, limited_by: str, details: Mapping[str, Any], text: str | None) -> None:
        extra = {"limited_by": limited_by, "details": details, "text": text}
        self._logger.log(logging.getLevelNamesMapping()[level.upper()], name, extra=extra)


class _RateLimit:
    """A token bucket for each name."""

    def __init__(self, clock: Callable[[], int]) -> None:
        self._clock = clock
        # for each name: tokens in nanoseconds of refilling, when they were counted, lines left out since the last line
        self._buckets: dict[str, tuple[int, int, int]] = {}

    def admit(self, name: str) -> int | None:
        """Return how many lines of a name were left out before this one, or None if this one is left out, too."""
        now = self._clock()
        tokens, counted, left_out = self._buckets.pop(name, (BURST * _REFILL_NS, now, 0))
        tokens = min(tokens + now - counted, BURST * _REFILL_NS)
        if len(self._buckets) >= MAX_NAMES:
            del self._buckets[next(iter(self._buckets))]
        if tokens < _REFILL_NS:
            self._buckets[name] = (tokens, now, left_out + 1)
            return None
        self._buckets[name] = (tokens - _REFILL_NS, now, 0)
        return left_out


class _Handler(logging.Handler):
    """Formats records and writes them, without raising and without waiting."""

    def __init__(self, as_json: bool, stream: TextIO | None, limit: _RateLimit) -> None:
        super().__init__()
        self.counts = ServiceLogStatistics()
        self._format = _json_line if as_json else _line_for_people
        self._stream = stream
        self._limit = limit

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record, or count why it was not written."""
        try:
            left_out = self._limit.admit(getattr(record, "limited_by", record.name))
            if left_out is None:
                self.counts.suppressed += 1
                return
            _write(self._stream or sys.stderr, self._format(record, left_out) + "\n")
        except Exception:
            # whatever the stream or a field did: a failing log must not stop monitoring
            self.counts.dropped += 1
        else:
            self.counts.written += 1


def _write(stream: TextIO, line: str) -> None:
    """Write a line if that does not wait for a reader; raise OSError or ValueError if it cannot be written."""
    if not _ready(stream):
        raise BlockingIOError("nobody reads")
    stream.write(line)
    stream.flush()


def _ready(stream: TextIO) -> bool:
    """Return whether a stream has room for a page, so for a line (POLLOUT in pipe(7)); True if it is no file."""
    try:
        descriptor = stream.fileno()
    except (OSError, ValueError):
        return True
    waiting = select.poll()
    waiting.register(descriptor, select.POLLOUT)
    return bool(waiting.poll(0))


def _json_line(record: logging.LogRecord, left_out: int) -> str:
    name, details = _content(record)
    line = {"time_ns": int(record.created * 1e9), "level": record.levelname.lower(), "event": name}
    line |= {key: _plain(value) for key, value in details.items() if key not in _RESERVED}
    if left_out:
        line["suppressed"] = left_out
    # JSON in ASCII, so without control characters but DEL, which is escaped here
    return json.dumps(line).replace("\x7f", "\\u007f")


def _line_for_people(record: logging.LogRecord, left_out: int) -> str:
    name, details = _content(record)
    text = getattr(record, "text", None)
    if text is None:
        text = "  ".join(f"{key} {_text(value)}" for key, value in details.items())
    level = "" if record.levelno < logging.WARNING else f" {record.levelname}"
    more = f"  ({left_out} more like it left out)" if left_out else ""
    clock = time.strftime("%H:%M:%S", time.localtime(record.created))
    line = f"{clock}{level} {name}  {text}{more}"
    return printable(line)


def _content(record: logging.LogRecord) -> tuple[str, Mapping[str, Any]]:
    """Return a line's name and fields, ours or a library's."""
    details = getattr(record, "details", None)
    if details is not None:
        return record.msg, details
    error = record.exc_info[1] if record.exc_info else None
    said = {"logger": record.name, "message": record.getMessage()}
    return "log", said if error is None else said | {"error": f"{type(error).__name__}: {error}"}


def _plain(value: Any) -> Any:
    """Return a value as JSON can hold it: no NaN, and texts of limited length."""
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if isinstance(value, int | None) else _text(value)


def _text(value: Any) -> str:
    text = str(value)
    return text if len(text) <= MAX_TEXT else text[:MAX_TEXT] + "..."
