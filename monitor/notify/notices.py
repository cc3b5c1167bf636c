"""Notices to people who watch no screen: the alarm events that deserve one, once each, and their words."""

from collections.abc import Collection, Sequence
from typing import Literal, NamedTuple, get_args

from adapters.errors import printable
from monitor.alarms.desk import AS_BEFORE
from monitor.bus.alarm_text import utc
from monitor.event import AlarmEvent

Occasion = Literal["raised", "critical", "cleared", "blind"]
OCCASIONS: tuple[Occasion, ...] = get_args(Occasion)

_MAX_ALARMS = 10_000
"""Largest number of remembered alarms. Chosen: more than are active at once, in bounded memory."""
_MOST_LINES = 10
"""Lines of a summary. Chosen: those that a telephone shows."""


class Notice(NamedTuple):
    """A notice to a person."""

    occasion: Occasion
    event: AlarmEvent

    @property
    def title(self) -> str:
        """The event and its vehicle, in a few words."""
        event = self.event
        words = {"blind": "flies and is not watched", "cleared": f"{event.channel} cleared"}
        what = words.get(self.occasion, f"{event.channel} {event.severity}")
        return printable(f"{event.vehicle}: {what}")

    @property
    def body(self) -> str:
        """The alarm's sentence, its observer and when it happened."""
        event = self.event
        return printable(f"{event.message} ({event.observer}/{event.channel}, {utc(event.time_ns)})")


class Notices:
    """Makes notices of events, for the configured occasions; an alarm makes one notice per occasion."""

    def __init__(self, occasions: Collection[Occasion] = OCCASIONS) -> None:
        self._wanted = frozenset(occasions)
        self._known: dict[str, set[Occasion]] = {}

    def take(self, event: AlarmEvent) -> Notice | None:
        """Return the notice of an event, or None if there is nothing new."""
        if event.state == "cleared":
            known = self._known.pop(event.id, set())
            return Notice("cleared", event) if known and "cleared" in self._wanted else None
        if event.state not in ("raised", "updated"):
            return None
        occasion: Occasion = "raised"
        if event.kind == "blind":
            occasion = "blind"
        elif event.severity == "critical" and ("critical" in self._wanted or event.state == "updated"):
            occasion = "critical"
        is_new = event.id not in self._known
        if is_new and event.state == "updated" and not event.message.endswith(AS_BEFORE) and occasion == "raised":
            return None
        known = self._known.setdefault(event.id, set())
        if len(self._known) > _MAX_ALARMS:
            del self._known[next(iter(self._known))]
        if occasion in known or (occasion == "raised" and known) or occasion not in self._wanted:
            return None
        known.add(occasion)
        # the alarm is older than this monitor: the people notified then are not notified again
        return None if event.message.endswith(AS_BEFORE) else Notice(occasion, event)


def summary(notices: Sequence[Notice]) -> tuple[str, str]:
    """Return title and body of one message for several notices; a single notice keeps its own."""
    if len(notices) == 1:
        return notices[0].title, notices[0].body
    vehicles = sorted({notice.event.vehicle for notice in notices})
    where = vehicles[0] if len(vehicles) == 1 else f"{len(vehicles)} vehicles"
    critical = sum(notice.occasion in ("critical", "blind") for notice in notices)
    urgent = f", {critical} critical" if critical else ""
    # critical alarms first, in the order in which they happened
    ordered = sorted(notices, key=lambda notice: notice.occasion not in ("critical", "blind"))
    lines = [f"{notice.title}: {notice.event.message}" for notice in ordered[:_MOST_LINES]]
    if len(ordered) > _MOST_LINES:
        lines.append(f"and {len(ordered) - _MOST_LINES} more")
    return printable(f"{where}: {len(notices)} messages{urgent}"), "\n".join(map(printable, lines))
