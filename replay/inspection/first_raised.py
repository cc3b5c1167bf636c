"""Which alarms a replay raised or a recording holds: the first event of each."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

from monitor.event import AlarmEvent

Event = TypeVar("Event", AlarmEvent, dict[str, Any])


def first_raised(events: Iterable[Event]) -> list[Event]:
    """Return the first event of each alarm that was raised: an alarm is raised again when an operator unshelves it.

    Parameters
    ----------
    events : Iterable[AlarmEvent] | Iterable[dict]
        Alarm events, or their JSON objects from a recording, which may hold anything where it is damaged.
    """
    found: dict[str, Event] = {}
    for event in events:
        if isinstance(event, Mapping):
            state, number = event.get("state"), repr(event.get("id"))
        else:
            state, number = event.state, event.id
        if state == "raised":
            found.setdefault(number, event)
    return list(found.values())
