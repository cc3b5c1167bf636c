"""Log lines on stderr: for people on a terminal, JSON lines otherwise; rate-limited, and never in the monitor's way.

Built on :mod:`logging`; what libraries log comes out in the same form. A line that cannot be written (stderr closed,
disk full, a pipe that nobody reads) is dropped and counted.
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
"""Lines of one name that pass at once; then one a second. Chosen: an error with its consequences passes whole."""
MAX_NAMES = 1000
"""Names may come from the network: the memory for them has to end."""
MAX_TEXT = 400
"""Letters of a value. Chosen: longer than any of our own, short enough for a line of a log."""

_REFILL_NS = 1_000_000_000
"""Of one more line for a name whose burst is used up."""
_RESERVED = ("time_ns", "level", "event", "suppressed")


@dataclass(slots=True)
class ServiceLogStatistics:
    """What became of the lines."""

    written: int = 0
    suppressed: int = 0  # lines left out because there were too many of their name
    dropped: int = 0  # lines that could not be written


class ServiceLog:
    """The daemon's log; one per process.

    Of each event name, and of each alarm channel, ten lines come at once and then one a second; the next line that
    comes says how many did not. Lines are JSON objects (``time_ns``, ``level``, ``event`` and its fields), or for
    people, without control characters: what came over a network shall not drive the terminal.

    They go to ``stream``; None takes ``sys.stderr`` as it is at the time. ``clock`` gives the rate limit's monotonic
    time in nanoseconds.
    """

    def __init__(
        self, as_json: bool, stream: TextIO | None = None, clock: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._handler = _Handler(as_json, stream, _RateLimit(clock))
        self._logger = logging.Logger("fauio")
        self._logger.addHandler(self._handler)
        logging.getLogger().addHandler(self._handler)

    def say(self, name: str, *, level: Level = "info", **details: Any) -> None:
        """Write a line: what happened, in a word or two, how bad it is, and its fields."""
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
        """Take the log out of :mod:`logging`; the stream stays open."""
        self._logger.removeHandler(self._handler)
        logging.getLogger().removeHandler(self._handler)

    def _write(self, name: str, level: Level, limited_by: str, details: Mapping[str, Any], text: str | None) -> None:
        extra = {"limited_by": limited_by, "details": details, "text": text}
        self._logger.log(logging.getLevelNamesMapping()[level.upper()], name, extra=extra)


class _RateLimit:
    """A token bucket for each name."""

    def __init__(self, clock: Callable[[], int]) -> None:
        self._clock = clock
        # name: tokens in nanoseconds of refilling, when they were counted, lines left out since the last that came
        self._buckets: dict[str, tuple[int, int, int]] = {}

    def admit(self, name: str) -> int | None:
        """Return how many lines of a name were left out before this one, None where it is to be left out too."""
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
    """Formats records and writes them where that neither raises nor waits."""

    def __init__(self, as_json: bool, stream: TextIO | None, limit: _RateLimit) -> None:
        super().__init__()
        self.counts = ServiceLogStatistics()
        self._format = _json_line if as_json else _line_for_people
        self._stream = stream
        self._limit = limit

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record, or count why not."""
        try:
            left_out = self._limit.admit(getattr(record, "limited_by", record.name))
            if left_out is None:
                self.counts.suppressed += 1
                return
            _write(self._stream or sys.stderr, self._format(record, left_out) + "\n")
        except Exception:
            # whatever the stream or a field did: the log is no reason to stop monitoring
            self.counts.dropped += 1
        else:
            self.counts.written += 1


def _write(stream: TextIO, line: str) -> None:
    """Write a line unless that would wait for a reader: raise OSError or ValueError where it cannot be written."""
    if not _ready(stream):
        raise BlockingIOError("nobody reads")
    stream.write(line)
    stream.flush()


def _ready(stream: TextIO) -> bool:
    """Return whether a stream has room for a page, so for a line (POLLOUT in pipe(7)); true of what is no file."""
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
    # ASCII, so no control character of any kind; the one that is ASCII is escaped too
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
    """Return a value as JSON can hold it: no NaN, no texts of any length."""
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
