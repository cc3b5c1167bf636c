"""The daemon's health as one frozen snapshot, and which parts of it are problems of the monitor itself."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from adapters.link_figures import LinkFigures
from monitor.event import Severity
from monitor.notify.messenger import OutletHealth
from monitor.recording.archive import ArchiveStatistics
from monitor.recording.journal import JournalStatistics
from monitor.service.latency import LatencyBuckets, LatencyStatistics

VehicleState = Literal["starting", "monitoring", "blind", "degraded", "stale"]
LATE_S = 2.0
"""Mean delay of a link over the last minute that is reported as a problem. Chosen: a silence of that length makes
telemetry stale."""
LOOP_LIMIT_S = 5.0
"""Time without a turn of the main loop that is reported as a problem. Chosen: far longer than any turn takes, and
shorter than systemd's watchdog waits (systemd/fauio@.service)."""

_LINK_LOSSES = ("lost", "unknown", "bad_checksums", "damaged", "overruns", "dropped", "oversized", "malformed")
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


def resident_bytes() -> int:
    """Return the resident memory of this process, or 0 if the system does not tell it."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * _PAGE_BYTES
    except (OSError, ValueError, IndexError):
        return 0


@dataclass(frozen=True, slots=True)
class ObserverHealth:
    """One observer of a vehicle."""

    name: str
    samples: int = 0  # samples that it processed
    # lost measurements by reason (``late``, ``invalid``, ``skipped`` ...)
    losses: Mapping[str, int] = field(default_factory=dict)
    share: float = 0.0  # share of the last minute in which it had evidence
    evidence_age_s: float | None = None  # time since it last had evidence; None: it never had any


@dataclass(frozen=True, slots=True)
class ChannelHealth:
    """One alarm channel of a vehicle."""

    observer: str
    name: str
    unit: str = ""  # unit of the following sizes; empty: the channel has no size
    estimate: float | None = None  # size that is attributed to it now
    threshold: float | None = None
    severity: Severity | None = None  # severity of its alarm; None: no active alarm, or a shelved one
    usual_command: float | None = None  # usual command of an actuator: a loss is given as a share of it


@dataclass(frozen=True, slots=True)
class VehicleHealth:
    """One vehicle."""

    name: str
    state: VehicleState  # as in its status topic
    blind: str | None = None  # what is not watched although it flies, and why; None: everything is watched
    impostor: str | None = None  # evidence that another sender uses its id; None: no evidence
    messages: int = 0  # messages that its pipeline processed
    dropped: int = 0  # messages for it that were dropped before
    events: int = 0
    active: Mapping[str, int] = field(default_factory=dict)  # active alarms by severity
    observers: tuple[ObserverHealth, ...] = ()
    channels: tuple[ChannelHealth, ...] = ()
    # from the arrival of a message to its result, over the last interval
    latency: LatencyStatistics = field(default_factory=LatencyStatistics)
    latency_buckets: LatencyBuckets | None = None  # the same since the start
    recorder: ArchiveStatistics | None = None  # its recording; None: nothing is recorded


@dataclass(frozen=True, slots=True)
class LinkHealth:
    """One link."""

    name: str  # its URL or key expression
    connected: bool = True  # whether it is open; a UDP socket always is
    messages: int = 0
    # messages that were lost or refused, by reason (``lost``, ``damaged``, ``unknown`` ...)
    losses: Mapping[str, int] = field(default_factory=dict)
    # packets missing by their sequence numbers, for each MAVLink system that lost any
    lost_by_system: Mapping[int, int] = field(default_factory=dict)
    figures: LinkFigures = field(default_factory=LinkFigures)  # delay, jitter and lost share of the last minute
    unread: int = 0  # packets of the last minute that the kernel, or the link's queue, dropped before they were read
    answers: bool = True  # whether its thread answers: a thread that hangs reads nothing


Figures = Callable[[str, int, int | None], LinkFigures]


def link_health(name: str, statistics: Any, figures: Figures) -> LinkHealth:
    """Return the health of a link from its counts; ``figures`` gives its figures by name, packets received and lost."""
    counts = asdict(statistics)
    losses = {key: counts[key] for key in _LINK_LOSSES if key in counts}
    losses |= {key: value for key, value in counts.get("signing", {}).items() if isinstance(value, int)}
    connected = bool(counts.get("connected", counts.get("connections", 1)))
    measured = figures(name, counts.get("messages", 0), counts.get("lost"))
    return LinkHealth(name, connected, counts.get("messages", 0), losses, counts.get("lost_by_system", {}), measured)


@dataclass(frozen=True, slots=True)
class ProcessHealth:
    """The process."""

    loop_age_s: float = 0.0  # time since the last turn of the main loop, seconds
    # messages between the links and the main loop, and their limit
    inbox_depth: int = 0
    inbox_capacity: int = 0
    inbox_dropped: int = 0  # messages that were dropped because there were too many, or they were too old
    inbox_dropped_minute: int = 0  # messages dropped in the last minute
    resident_bytes: int = field(default_factory=resident_bytes)  # resident memory; 0: unknown
    cpu_s: float = field(default_factory=time.process_time)  # processor time used so far, seconds


@dataclass(frozen=True, slots=True)
class Health:
    """The health of everything at one moment."""

    process: ProcessHealth
    vehicles: tuple[VehicleHealth, ...] = ()
    links: tuple[LinkHealth, ...] = ()
    journal: JournalStatistics | None = None  # the journal; None: there is none
    outlets: tuple[OutletHealth, ...] = ()  # where notices are sent


def problems(health: Health) -> list[str]:
    """Return what keeps the monitor from its work now, a line for each problem.

    A flying vehicle that is not watched is a problem, also where its telemetry ended. A vehicle that is silent on the
    ground, faulty or lacks some telemetry is none: its alarms and its status report that.
    """
    found = []
    process = health.process
    if process.loop_age_s > LOOP_LIMIT_S:
        found.append(f"the main loop has not run for {process.loop_age_s:.0f} s")
    if process.inbox_capacity and process.inbox_depth >= process.inbox_capacity:
        found.append(f"the inbox is full ({process.inbox_depth} messages): messages are dropped")
    found += troubles(health)
    for vehicle in health.vehicles:
        if vehicle.impostor is not None:
            found.append(f"{vehicle.name}: a second sender uses its id: {vehicle.impostor}")
        if vehicle.blind is not None:
            found.append(f"{vehicle.name}: {vehicle.blind}")
        if vehicle.recorder is not None and vehicle.recorder.trouble is not None:
            found.append(f"{vehicle.name} is not recorded: {vehicle.recorder.trouble}")
    journal = health.journal
    if journal is not None and not journal.open:
        found.append(f"the journal cannot be opened: {journal.last_error}")
    return found


def troubles(health: Health) -> list[str]:
    """Return the problems that concern all vehicles, for the status of each."""
    found = [f"link {link.name} does not answer" for link in health.links if not link.answers]
    late = {link.name: link.figures.delay_s or 0.0 for link in health.links}
    found += [f"telemetry of {link} comes {s:.1f} s late by its own clock" for link, s in late.items() if s > LATE_S]
    drops = {f"packets of {link.name} dropped unread": link.unread for link in health.links}
    drops = {"messages dropped": health.process.inbox_dropped_minute} | drops
    found += [f"the monitor does not keep up: {n} {what} in the last minute" for what, n in drops.items() if n]
    journal = health.journal
    if journal is not None and journal.pending:
        found.append(f"{journal.pending} alarm events wait for the journal: {journal.last_error}")
    return found


def health_json(health: Health) -> dict[str, Any]:
    """Return the answer of ``/healthz``."""
    found = problems(health)
    return {
        "status": "trouble" if found else "ok",
        "problems": found,
        "vehicles": {
            vehicle.name: {
                "state": vehicle.state,
                "active_alarms": sum(vehicle.active.values()),
                "watching": {
                    observer.name: {"share": observer.share, "evidence_age_s": observer.evidence_age_s}
                    for observer in vehicle.observers
                },
            }
            for vehicle in health.vehicles
        },
        "links": {link.name: {"connected": link.connected, "messages": link.messages} for link in health.links},
        "loop_age_s": round(health.process.loop_age_s, 3),
    }
