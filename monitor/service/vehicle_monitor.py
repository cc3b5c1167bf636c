"""One monitored vehicle: its pipeline, its recording and publishing, its status.

An event is on disk before it is published: in the recording and in the journal, then on Zenoh; the monitor does not
wait for a slow disk. While another monitor of the vehicle is active, this one is on standby, and continues the other's
alarms when that one is gone.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Protocol, get_args

import numpy as np

from adapters.batch import Batch, chosen, pack
from adapters.message import silence
from adapters.source import JOURNAL, OPERATOR
from monitor.alarms.desk import FLOOD_KEY
from monitor.bus.payload import estimate_json
from monitor.conditions.condition import latest_conditions
from monitor.estimate import Estimates
from monitor.event import AlarmEvent, Severity
from monitor.pipeline import Pipeline, handover_message
from monitor.recording.archive import ArchiveStatistics
from monitor.service.election import first_number
from monitor.service.health import ChannelHealth, LinkHealth, ObserverHealth, VehicleHealth, VehicleState
from monitor.service.latency import Latencies
from monitor.service.telemetry_watch import TelemetryWatch
from monitor.service.vehicle_facts import VehicleFacts

if TYPE_CHECKING:
    from monitor.bus.publisher import Publisher
    from monitor.recording.background import BackgroundJournal
    from monitor.recording.journal import Journal

# read once, since it is in a file of the installation
_VERSION = version("fauio")
_SILENCE_NS = 100_000_000
"""Silence after which messages of its own advance the pipeline's time: a tenth of the shortest time that an alarm
counts (1 s)."""
_BEHIND_S = 1.0
"""Delay from which the status reports it: the inbox then begins to drop messages (``OLDEST_S`` of its module)."""
_FENCE_NS = 1_000_000_000
"""Time without an answer of the election after which nothing is published: another monitor takes over after 2 s."""
_LARGEST_SEQ = 1 << 53
"""Largest number of an event that JSON readers with floating-point numbers keep exact."""
_MOST_CHANNELS = 4096
"""Most channels of another monitor whose events are kept; a profile has some tens, a stranger may send any."""
_LOSSES = ("late", "invalid", "untimed", "doubted", "incomplete", "skipped")


class BatchSink(Protocol):
    """Records or shows everything of one vehicle."""

    def batch(self, batch: Batch) -> None: ...  # noqa: D102
    def estimates(self, estimates: Estimates) -> None: ...  # noqa: D102
    def event(self, event: AlarmEvent) -> None: ...  # noqa: D102
    def flush(self) -> None: ...  # noqa: D102


@dataclass(slots=True)
class _Second:
    """Counts since the last status."""

    started_ns: int  # of the monotonic clock
    messages: int = 0
    samples: int = 0


class VehicleMonitor:
    """State of one monitored vehicle.

    ``archives`` record and show it, ``journal`` keeps its alarm events permanently, ``on_event`` is called with every
    event that this monitor publishes. ``settle`` waits for the disk before events are published. ``now_ns`` is the Unix
    time of the start.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        archives: Sequence[BatchSink],
        journal: BackgroundJournal | Journal | None,
        on_event: Callable[[AlarmEvent], None],
        now_ns: int,
        settle: Callable[[], object] = lambda: None,
    ) -> None:
        self._settle = settle
        self.pipeline = pipeline
        self.latency = Latencies()
        self.alarm_latency = Latencies()
        self._archives = tuple(archives)
        self._journal = journal
        self._on_event = on_event
        self._outlet: Publisher | None = None
        self._peer_events: dict[tuple[str, str], AlarmEvent] = {}
        self._peer_seq = 0
        self._confirmed_ns: int | None = None
        self._shelved: Mapping[str, int] = {}
        self._layouts = {layout.observer: layout for layout in pipeline.layouts}
        self._latest: dict[str, Estimates] = {}
        self._watch = TelemetryWatch(pipeline.profile.observers, pipeline.needs, now_ns)
        self._facts = VehicleFacts()
        self._second = _Second(time.monotonic_ns())
        self.messages = self.samples = self.events = 0

    @property
    def name(self) -> str:
        """The vehicle's name."""
        return self.pipeline.vehicle

    @property
    def active(self) -> bool:
        """Whether this monitor publishes for the vehicle; otherwise it is on standby."""
        return self._outlet is not None

    def activate(
        self,
        outlet: Publisher,
        now_ns: int,
        alarms: Sequence[AlarmEvent] = (),
        seq: int = 0,
        shelved: Mapping[str, int] = MappingProxyType({}),
    ) -> None:
        """Begin to publish, continuing the active alarms of an earlier run or of another monitor.

        ``alarms`` are the last events of the active alarms in the journal, and ``seq`` is the number of its last event,
        after which a new term of numbers begins. ``shelved`` has the channels that operators had shelved in it, and
        until when. Events received from another monitor are known already. :meth:`deactivate` closes the outlet.
        """
        self._outlet = outlet
        received = [event for event in self._peer_events.values() if event.state != "cleared"]
        active = {event.id: event for event in (*alarms, *received)}
        seq = first_number(max(seq, self._peer_seq, self.pipeline.desk.seq), now_ns)
        self._peer_events = {}
        in_order = sorted(active.values(), key=lambda event: event.seq)
        self.process(pack([handover_message(in_order, seq, now_ns, shelved)]))

    def confirm(self, steady_ns: int) -> None:
        """Note the steady time at which this monitor was confirmed to be active; without a call, it always is."""
        self._confirmed_ns = steady_ns

    def deactivate(self) -> None:
        """Stop publishing; continue to monitor on standby."""
        if self._outlet is not None:
            self._outlet.close()
            self._outlet = None
            # The last published events remain valid until another monitor publishes others.
            self._peer_events = {(event.observer, event.channel): event for event in self.pipeline.desk.active}
            self._peer_seq = self.pipeline.desk.seq

    def on_peer_event(self, event: AlarmEvent) -> None:
        """Keep an event that another monitor of this vehicle has published."""
        if self._outlet is not None or event.vehicle != self.name or not 0 < event.seq < _LARGEST_SEQ:
            return
        self._peer_seq = max(self._peer_seq, event.seq)
        key = event.observer, event.channel
        known = self._peer_events.get(key)
        if known is None:
            is_news = len(self._peer_events) < _MOST_CHANNELS
        else:
            # History may arrive after live events; after a partition both monitors may have used the same seq.
            is_news = event.seq > known.seq or event.time_ns > known.time_ns
        if is_news:
            # An operator's action has a sentence of its own; the alarm keeps its.
            acted = known is not None and known.id == event.id and event.state in ("acknowledged", "shelved")
            self._peer_events[key] = replace(event, message=known.message) if acted and known else event
        if self._journal is not None:
            self._journal.write(event)

    def process(self, batch: Batch, ages_ns: Callable[[Sequence[int]], list[int]] | None = None) -> list[AlarmEvent]:
        """Run a batch through the pipeline, record and publish the results; return the published events.

        Messages are in order of arrival, of this vehicle or of others. ``ages_ns`` is the age of times of arrival, from
        which the delays of messages and events are measured.
        """
        outputs = self.pipeline.run(batch)
        own = chosen(batch, self.pipeline.accepts)
        self.messages += own.count
        self._second.messages += own.count
        telemetry: list[int] = []
        for columns in own.columns:
            times = columns.received_ns.tolist()
            telemetry += times
            self._watch.count_messages(columns.name, times[-1], len(times), columns.fields)
        commanded = False
        for message in own.others.values():
            if message.source.is_telemetry:
                telemetry.append(message.received_ns)
                self._watch.count_messages(message.name, message.received_ns)
            commanded |= message.source in (OPERATOR, JOURNAL)
        self._facts.take(own)
        if own.count:
            for archive in self._archives:
                archive.batch(own)
        events = self._publish(outputs)
        if commanded:
            self._note_shelved()
        if ages_ns is not None and telemetry:
            self.latency.add(ages_ns(telemetry))
            if events:
                # The packet that caused an event is in this batch, whatever the vehicle's clock shows.
                first_ns, last_ns = min(telemetry), max(telemetry)
                self.alarm_latency.add(ages_ns([min(max(event.time_ns, first_ns), last_ns) for event in events]))
        return events

    def pass_time(self, now_ns: int) -> None:
        """Let the pipeline know that time has passed without telemetry; record it if that changed anything."""
        # A time far before the latest message shows that the clock was set back: the pipeline counts from there on. A
        # little before it there may be messages that links still hold.
        if abs(now_ns - self._watch.latest_ns) < _SILENCE_NS:
            return
        batch = pack([silence(now_ns)])
        outputs = self.pipeline.run(batch)
        if outputs:
            for archive in self._archives:
                archive.batch(batch)
        self._publish(outputs)

    def freeze_frame(self, event: AlarmEvent) -> dict[str, Any]:
        """Return all known values at the time an alarm was raised: inputs, outputs, estimates and thresholds."""
        frame: dict[str, Any] = {"time_ns": event.time_ns, "observers": {}}
        for name, estimates in self._latest.items():
            layout, samples = self._layouts[name], estimates.samples
            row = max(int(np.searchsorted(samples.time_ns, event.time_ns, side="right")) - 1, 0)
            frame["observers"][name] = {
                **estimate_json(layout, estimates, row),
                "u": dict(zip(layout.inputs, samples.u[row].tolist(), strict=True)),
                "y": dict(zip(layout.outputs, samples.y[row].tolist(), strict=True)),
                "thresholds": {
                    channel: size for (owner, channel), size in self.pipeline.thresholds.items() if owner == name
                },
            }
        return frame

    def status(self, now_ns: int, troubles: Sequence[str] = (), links: Sequence[LinkHealth] = ()) -> dict[str, Any]:
        """Return the status object and begin the next interval.

        ``troubles`` are those around the vehicle (links, disks), ``links`` those that its telemetry may come over.
        """
        self._note_shelved()
        steady_ns = time.monotonic_ns()
        elapsed_s = max((steady_ns - self._second.started_ns) / 1e9, 1e-9)
        recent = self.latency.end_interval()
        state, reasons = self._state(now_ns, recent.p99_s, troubles)
        active = self.pipeline.desk.active
        status = {
            "state": state,
            "role": "active" if self.active else "standby",
            "reasons": reasons,
            "vehicle": self.name,
            "system": self.pipeline.system,
            "time_ns": now_ns,
            "messages": self.messages,
            "messages_per_s": round(self._second.messages / elapsed_s, 1),
            "samples": self.samples,
            "samples_per_s": round(self._second.samples / elapsed_s, 1),
            "foreign_messages": self.pipeline.foreign,
            "lost": sum(link.lost_by_system.get(self.pipeline.system, 0) for link in links),
            "links": {
                link.name: {
                    "connected": link.connected,
                    "messages": link.messages,
                    "losses": dict(link.losses),
                    **link.figures.rounded(),
                }
                for link in links
            },
            "latency_ms": round(recent.max_s * 1e3, 3),
            "latency_p99_ms": round(recent.p99_s * 1e3, 3),
            "alarm_latency_p99_ms": round(self.alarm_latency.statistics().p99_s * 1e3, 3),
            "active_alarms": len(active),
            "shelved": dict(self.pipeline.desk.shelved),
            "out_of_service": sorted(self.pipeline.desk.rule.out_of_service),
            "watching": {name: asdict(watching) for name, watching in self.pipeline.watching(now_ns).items()},
            "observers": {name: asdict(counts) for name, counts in self.pipeline.statistics().items()},
            "channels": self._channels(),
            "facts": {
                **self._facts.status(),
                "conditions": [condition.to_json() for condition in latest_conditions(self.pipeline.conditions)],
            },
            "profile": self.pipeline.profile.digest,
            "versions": {"fauio": _VERSION},
        }
        self._second = _Second(steady_ns)
        if self._outlet is not None:
            self._outlet.status(status)
        return status

    def _state(self, now_ns: int, behind_s: float, troubles: Sequence[str]) -> tuple[VehicleState, list[str]]:
        """Return the vehicle's state while the monitor is that far behind, and its reasons."""
        pipeline, reasons = self.pipeline, [*troubles]
        behind = behind_s > _BEHIND_S
        if behind or pipeline.stale:
            # While the monitor lags, messages may be queued, not missing.
            self._watch.pause(now_ns)
            lacks = []
        else:
            lacks = self._watch.lacks(now_ns)
            reasons += pipeline.contradictions
        if pipeline.stale or not behind:
            reasons += lacks if pipeline.blind is None else [pipeline.blind]
        if behind:
            reasons.append(f"the monitor does not keep up: {behind_s:.1f} s behind")
        if (mismatch := pipeline.mismatch) is not None:
            reason = f"not watched: {mismatch}" if pipeline.refused else mismatch
            reasons = [reason, *(other for other in reasons if other != reason)]
        if pipeline.stale:
            return "stale", reasons
        if pipeline.blind is not None:
            return "blind", reasons
        if self.samples or pipeline.refused:
            return "degraded" if reasons else "monitoring", [*reasons, *pipeline.outside]
        return "starting", reasons

    def _channels(self) -> dict[str, dict[str, Any]]:
        """Return thresholds, units and usual commands of fault channels by observer."""
        thresholds = self.pipeline.thresholds
        return {
            name: {
                channel: {"threshold": thresholds.get((name, channel)), "unit": unit, "usual_command": command}
                for channel, unit, command in zip(layout.faults, layout.fault_units, layout.usual_commands, strict=True)
            }
            for name, layout in self._layouts.items()
        }

    def health(self, state: VehicleState, recorder: ArchiveStatistics | None, now_ns: int) -> VehicleHealth:
        """Return the vehicle's health at a Unix time, in a state of its last status, with its recording, if any."""
        watching = self.pipeline.watching(now_ns)
        severities = [event.severity for event in self.pipeline.desk.active]
        return VehicleHealth(
            name=self.name,
            state=state,
            blind=self.pipeline.blind,
            impostor="; ".join(self.pipeline.contradictions) or None,
            messages=self.messages,
            events=self.events,
            active={severity: severities.count(severity) for severity in get_args(Severity)},
            observers=tuple(
                ObserverHealth(
                    name,
                    counts.samples,
                    {key: getattr(counts, key) for key in _LOSSES},
                    share=watching[name].share,
                    evidence_age_s=watching[name].age_s(now_ns),
                )
                for name, counts in self.pipeline.statistics().items()
            ),
            channels=self._channel_health(),
            latency=self.latency.interval,
            latency_buckets=self.latency.buckets(),
            recorder=recorder,
        )

    def _channel_health(self) -> tuple[ChannelHealth, ...]:
        """Return every channel that can be an alarm, with its size if it has one."""
        raised = {
            (event.observer, event.channel): event.severity
            for event in self.pipeline.desk.active
            if event.shelved_until_ns is None
        }
        sizes: dict[tuple[str, str], tuple[str, float | None, float | None]] = {}
        for name, layout in self._layouts.items():
            latest = self._latest.get(name)
            now = [None] * len(layout.faults) if latest is None else latest.isolated[-1].tolist()
            named = zip(layout.faults, layout.fault_units, now, layout.usual_commands, strict=True)
            sizes |= {(name, channel): (unit, size, command) for channel, unit, size, command in named}
        thresholds = self.pipeline.thresholds
        keys = sorted({*self.pipeline.channels, *sizes, FLOOD_KEY})
        return tuple(
            ChannelHealth(*key, unit, size, thresholds.get(key), raised.get(key), command)
            for key in keys
            for unit, size, command in (sizes.get(key, ("", None, None)),)
        )

    def flush(self) -> None:
        """Hand everything recorded so far to the operating system."""
        for archive in self._archives:
            archive.flush()

    def _publish(self, outputs: Sequence[Estimates | AlarmEvent]) -> list[AlarmEvent]:
        """Record all outputs, and publish them if this monitor is active; return the published events."""
        outlet = self._outlet
        if self._confirmed_ns is not None and time.monotonic_ns() - self._confirmed_ns > _FENCE_NS:
            # This monitor was stopped for a while: another monitor may be active by now.
            outlet = None
        events = []
        for output in outputs:
            if isinstance(output, AlarmEvent):
                events.append(output)
                continue
            count = len(output)
            self._second.samples += count
            self.samples += count
            self._latest[output.observer] = output
            self._watch.count_samples(output.observer, count)
            for archive in self._archives:
                archive.estimates(output)
            if outlet is not None:
                outlet.estimates(output)
        if outlet is not None and self._journal is not None:
            # The journal first: while it waits for the disk, the recording is encoded.
            for event in events:
                self._journal.write(event, self.freeze_frame(event) if event.state == "raised" else None)
        for archive in self._archives:
            for event in events:
                archive.event(event)
        if not events or outlet is None:
            return []
        self.flush()
        self.events += len(events)
        self._settle()
        for event in events:
            outlet.event(event)
            self._on_event(event)
        return events

    def _note_shelved(self) -> None:
        """Report the channels that operators have shelved to the journal, if they changed."""
        shelved = self.pipeline.desk.shelved_by_operators
        if shelved != self._shelved:
            self._shelved = shelved
            if self._journal is not None:
                self._journal.shelve(self.name, shelved)
