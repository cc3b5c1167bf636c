"""How a daemon is doing, gathered from its parts for metrics and /healthz."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, Protocol

from monitor.recording.journal import JournalStatistics
from monitor.service.health import Health, LinkHealth, ObserverHealth, ProcessHealth, RecorderHealth, VehicleHealth
from monitor.service.inbox import Inbox
from monitor.service.vehicle_service import VehicleService

_MEASUREMENT_LOSSES = ("late", "invalid", "untimed", "doubted", "incomplete", "skipped")
_LINK_LOSSES = ("lost", "unknown", "damaged", "overruns", "dropped", "oversized", "malformed")


class Counting(Protocol):
    """A link that says what went through it."""

    def statistics(self) -> Any: ...  # noqa: D102


Links = Mapping[str, Counting]


def take_health(
    services: Sequence[VehicleService],
    inbox: Inbox,
    links: Links,
    journal: JournalStatistics | None,
    events: Mapping[str, int],
) -> Health:
    """Return the health of everything at this moment.

    Parameters
    ----------
    services : Sequence[VehicleService]
        The vehicles.
    inbox : Inbox
        Between links and vehicles.
    links : Links
        The links by name.
    journal : JournalStatistics | None
        What the journal counted.
    events : Mapping[str, int]
        Alarm events said so far, by vehicle.
    """
    waiting = inbox.statistics()
    process = ProcessHealth(inbox_depth=waiting.waiting, inbox_capacity=inbox.limit, inbox_dropped=waiting.dropped)
    return Health(
        process,
        tuple(_vehicle(service, events.get(service.monitor.name, 0)) for service in services),
        tuple(_link(name, link.statistics()) for name, link in links.items()),
        journal,
    )


def _vehicle(service: VehicleService, events: int) -> VehicleHealth:
    monitor = service.monitor
    active = dict.fromkeys(("warning", "critical"), 0)
    for event in monitor.pipeline.desk.active:
        active[event.severity] += 1
    observers = tuple(
        ObserverHealth(name, counts.samples, {key: getattr(counts, key) for key in _MEASUREMENT_LOSSES})
        for name, counts in monitor.pipeline.statistics().items()
    )
    recorder = None
    if service.archive is not None:
        found = service.archive.statistics()
        recorder = RecorderHealth(found.records, found.lost, found.trouble)
    return VehicleHealth(
        name=monitor.name,
        state=service.last_status.get("state", "starting"),
        messages=monitor.messages,
        events=events,
        active=active,
        observers=observers,
        latency=monitor.latency.interval(),
        latency_buckets=monitor.latency.buckets(),
        recorder=recorder,
    )


def _link(name: str, statistics: Any) -> LinkHealth:
    counts = asdict(statistics)
    losses = {key: counts[key] for key in _LINK_LOSSES if key in counts}
    losses |= {key: value for key, value in counts.get("signing", {}).items() if isinstance(value, int)}
    connected = bool(counts.get("connected", counts.get("connections", 1)))
    return LinkHealth(name, connected, counts.get("messages", 0), losses, counts.get("lost_by_system", {}))
