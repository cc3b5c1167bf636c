"""One readable line per alarm event, for people at a terminal."""

from datetime import UTC, datetime

from adapters.errors import printable
from monitor.event import AlarmEvent


def alarm_line(event: AlarmEvent) -> str:
    """Return time, vehicle, channel, state, size and message of an event in one line.

    Text that came over a network is printed without control characters: it must not control the terminal.
    """
    parts = (
        utc(event.time_ns),
        event.vehicle,
        f"{event.observer}/{event.channel}",
        f"{event.state:<7}",
        f"{event.severity:<8}",
        event.display,
        event.message,
    )
    return printable("  ".join(part for part in parts if part))


def utc(time_ns: int) -> str:
    """Return a Unix time as ISO 8601 in UTC with milliseconds; the number itself if no calendar has that time."""
    try:
        day = datetime.fromtimestamp(time_ns // 1_000_000_000, UTC)
    except (OverflowError, OSError, ValueError):
        return f"{time_ns} ns"
    return f"{day:%Y-%m-%dT%H:%M:%S}.{time_ns // 1_000_000 % 1000:03d}Z"
