"""One monitored vehicle: its pipeline, what it says to the world, and how it is doing.

An event is on disk before anybody hears of it: first the recording, then the journal, then Zenoh. Where another monitor
speaks for the vehicle, this one watches in silence, and goes on from the other's alarms when that one falls silent.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from types import MappingProxyType
from typing import Any, Protocol

from adapters.message import Message, silence
from adapters.source import JOURNAL, OPERATOR
from monitor.bus.payload import estimate_json
from monitor.estimate import Estimate
from monitor.event import AlarmEvent
from monitor.pipeline import Output, Pipeline, handover_message
from monitor.service.health import LinkHealth
from monitor.service.latency import LatencyHistogram
from monitor.service.telemetry_watch import TelemetryWatch

# read once: it stands in a file of the installation
_VERSION = version("fauio")
_SILENCE_NS = 100_000_000
_BEHIND_S = 1.0
# Numbers that are left out after another monitor: it may have given some away before anybody heard of them.
_UNHEARD = 100
_LARGEST_SEQ = 1 << 53
_MOST_CHANNELS = 4096


class Archive(Protocol):
    """Where everything is recorded."""

    def message(self, message: Message) -> None: ...  # noqa: D102
    def estimate(self, estimate: Estimate) -> None: ...  # noqa: D102
    def event(self, event: AlarmEvent) -> None: ...  # noqa: D102
    def flush(self) -> None: ...  # noqa: D102


class Journal(Protocol):
    """Where alarm events are kept."""

    def write(self, event: AlarmEvent, frame: Mapping[str, Any] | None = None) -> None: ...  # noqa: D102
    def shelve(self, vehicle: str, channels: Mapping[str, int]) -> None: ...  # noqa: D102


class Voice(Protocol):
    """What speaks for the vehicle."""

    def event(self, event: AlarmEvent) -> None: ...  # noqa: D102
    def estimate(self, estimate: Estimate) -> None: ...  # noqa: D102
    def status(self, status: Mapping[str, Any]) -> None: ...  # noqa: D102
    def close(self) -> None: ...  # noqa: D102


@dataclass(slots=True)
class _Second:
    """Counts since the last status."""

    started_ns: int
    messages: int = 0
    samples: int = 0


class VehicleMonitor:
    """State of one monitored vehicle.

    Parameters
    ----------
    pipeline : Pipeline
        The vehicle's pipeline.
    archives : Sequence[Archive]
        Recording, black box, live view: whatever takes all that comes and goes.
    journal : Journal | None
        Alarm events for ever; None keeps none.
    on_event : Callable[[AlarmEvent], None]
        Called with every event this monitor says, for the log.
    now_ns : int
        Unix time of the start.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        archives: Sequence[Archive],
        journal: Journal | None,
        on_event: Callable[[AlarmEvent], None],
        now_ns: int,
    ) -> None:
        self.pipeline = pipeline
        self.latency = LatencyHistogram()
        self.alarm_latency = LatencyHistogram()
        self._archives = tuple(archives)
        self._journal = journal
        self._on_event = on_event
        self._voice: Voice | None = None
        self._theirs: dict[tuple[str, str], AlarmEvent] = {}
        self._their_seq = 0
        self._shelved: Mapping[str, int] = {}
        self._layouts = {layout.observer: layout for layout in pipeline.layouts}
        self._latest: dict[str, Estimate] = {}
        self._watch = TelemetryWatch(pipeline.profile.observers, pipeline.needs, now_ns)
        self._second = _Second(now_ns)
        self.messages = self.samples = 0

    @property
    def name(self) -> str:
        """The vehicle's name."""
        return self.pipeline.vehicle

    @property
    def speaks(self) -> bool:
        """Whether this monitor speaks for the vehicle; otherwise it watches in silence."""
        return self._voice is not None

    def speak(
        self,
        voice: Voice,
        now_ns: int,
        alarms: Sequence[AlarmEvent] = (),
        seq: int = 0,
        shelved: Mapping[str, int] = MappingProxyType({}),
    ) -> None:
        """Begin to speak, going on from alarms that a former run or another monitor left standing.

        Parameters
        ----------
        voice : Voice
            What speaks; closed by :meth:`hush`.
        now_ns : int
            Unix time.
        alarms : Sequence[AlarmEvent]
            Last events of alarms in the journal; those heard from another monitor are known already.
        seq : int
            Number of the journal's last event.
        shelved : Mapping[str, int]
            Channels in the journal that operators had shelved, and until when.
        """
        self._voice = voice
        heard = [event for event in self._theirs.values() if event.state != "cleared"]
        standing = {event.id: event for event in (*alarms, *heard)}
        seq = max(seq, self._their_seq + _UNHEARD if self._theirs else 0)
        self._theirs = {}
        if standing or seq or shelved or self.pipeline.desk.active:
            in_order = sorted(standing.values(), key=lambda event: event.seq)
            self.take(handover_message(in_order, seq, now_ns, shelved))

    def hush(self) -> None:
        """Stop speaking; go on watching."""
        if self._voice is not None:
            self._voice.close()
            self._voice = None
            # what was said last stands until another says otherwise
            self._theirs = {(event.observer, event.channel): event for event in self.pipeline.desk.active}
            self._their_seq = self.pipeline.desk.seq

    def hear(self, event: AlarmEvent) -> None:
        """Take an event that another monitor of this vehicle has said."""
        if self._voice is not None or event.vehicle != self.name or not 0 < event.seq < _LARGEST_SEQ:
            return
        self._their_seq = max(self._their_seq, event.seq)
        key = event.observer, event.channel
        known = self._theirs.get(key)
        if known is None:
            is_news = len(self._theirs) < _MOST_CHANNELS
        else:
            # The past may come after the present; and two that were apart have each counted on by themselves.
            is_news = event.seq > known.seq or event.time_ns > known.time_ns
        if is_news:
            self._theirs[key] = _with_own_sentence(event, known)
        if self._journal is not None:
            self._journal.write(event)

    def take(self, message: Message, clock: Callable[[], int] | None = None) -> list[AlarmEvent]:
        """Take one message; return the events said. ``clock`` gives Unix time, to measure how late they are."""
        accepted = self.pipeline.accepts(message)
        outputs = self.pipeline.feed(message)
        if accepted:
            self.messages += 1
            self._second.messages += 1
            if message.source.is_telemetry:
                self._watch.hear(message.name, message.received_ns)
            for archive in self._archives:
                archive.message(message)
        events = self._say(outputs)
        if message.source in (OPERATOR, JOURNAL):
            self._note_shelved()
        if clock is not None and message.source.is_telemetry:
            late_ns = clock() - message.received_ns
            self.latency.add(late_ns)
            if events:
                self.alarm_latency.add(late_ns)
        return events

    def pass_time(self, now_ns: int) -> None:
        """Let the pipeline know that time passes where nothing comes; record it where that changed something."""
        if now_ns - self._watch.heard_ns < _SILENCE_NS:
            return
        message = silence(now_ns)
        outputs = self.pipeline.feed(message)
        if outputs:
            for archive in self._archives:
                archive.message(message)
        self._say(outputs)

    def freeze_frame(self, event: AlarmEvent) -> dict[str, Any]:
        """Return all that was known when an alarm was raised: inputs, outputs, estimates and thresholds."""
        frame: dict[str, Any] = {"time_ns": event.time_ns, "observers": {}}
        for name, estimate in self._latest.items():
            layout = self._layouts[name]
            frame["observers"][name] = {
                **estimate_json(layout, estimate),
                "u": dict(zip(layout.inputs, estimate.sample.u.tolist(), strict=True)),
                "y": dict(zip(layout.outputs, estimate.sample.y.tolist(), strict=True)),
                "thresholds": {
                    channel: size for (owner, channel), size in self.pipeline.thresholds.items() if owner == name
                },
            }
        return frame

    def status(self, now_ns: int, troubles: Sequence[str] = (), links: Sequence[LinkHealth] = ()) -> dict[str, Any]:
        """Return the status object and begin the next interval.

        Parameters
        ----------
        now_ns : int
            Unix time.
        troubles : Sequence[str]
            What is wrong around the vehicle: links, disks.
        links : Sequence[LinkHealth]
            The links that its telemetry may come over.
        """
        self._note_shelved()
        elapsed_s = max((now_ns - self._second.started_ns) / 1e9, 1e-9)
        recent = self.latency.end_interval()
        behind = recent.p99_s > _BEHIND_S
        reasons = [*troubles]
        if behind or self.pipeline.stale:
            # What it is behind with it cannot miss.
            self._watch.pause(now_ns)
        else:
            reasons += self._watch.lacks(now_ns)
        if behind:
            reasons.append(f"the monitor does not keep up: {recent.p99_s:.1f} s behind")
        if (mismatch := self.pipeline.mismatch) is not None:
            reasons.append(mismatch)
        state = "starting"
        if self.pipeline.stale:
            state = "stale"
        elif self.samples:
            state = "degraded" if reasons else "monitoring"
        standing = self.pipeline.desk.active
        status = {
            "state": state,
            "role": "active" if self.speaks else "standby",
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
                link.name: {"connected": link.connected, "messages": link.messages, "losses": dict(link.losses)}
                for link in links
            },
            "latency_ms": round(recent.max_s * 1e3, 3),
            "latency_p99_ms": round(recent.p99_s * 1e3, 3),
            "alarm_latency_p99_ms": round(self.alarm_latency.statistics().p99_s * 1e3, 3),
            "active_alarms": len(standing),
            "shelved": dict(self.pipeline.desk.shelved),
            "out_of_service": sorted(self.pipeline.desk.rule.out_of_service),
            "observers": {name: asdict(counts) for name, counts in self.pipeline.statistics().items()},
            "profile": self.pipeline.profile.digest,
            "versions": {"fauio": _VERSION},
        }
        self._second = _Second(now_ns)
        if self._voice is not None:
            self._voice.status(status)
        return status

    def flush(self) -> None:
        """Hand everything recorded so far to the operating system."""
        for archive in self._archives:
            archive.flush()

    def _say(self, outputs: Sequence[Output]) -> list[AlarmEvent]:
        voice = self._voice
        events = []
        for output in outputs:
            if isinstance(output, Estimate):
                self._second.samples += 1
                self.samples += 1
                self._latest[output.observer] = output
                self._watch.sampled(output.observer)
                for archive in self._archives:
                    archive.estimate(output)
                if voice is not None:
                    voice.estimate(output)
                continue
            for archive in self._archives:
                archive.event(output)
            if voice is not None:
                events.append(output)
        if not events or voice is None:
            return []
        self.flush()
        for event in events:
            if self._journal is not None:
                self._journal.write(event, self.freeze_frame(event) if event.state == "raised" else None)
            voice.event(event)
            self._on_event(event)
        return events

    def _note_shelved(self) -> None:
        """Let the journal know what operators have shelved, where that changed."""
        shelved = self.pipeline.desk.shelved_by_operators
        if shelved != self._shelved:
            self._shelved = shelved
            if self._journal is not None:
                self._journal.shelve(self.name, shelved)


def _with_own_sentence(event: AlarmEvent, known: AlarmEvent | None) -> AlarmEvent:
    """Return an event with what its alarm says, where the event itself says what an operator did."""
    if known is None or known.id != event.id or event.state not in ("acknowledged", "shelved"):
        return event
    return replace(event, message=known.message)
