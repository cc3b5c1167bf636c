"""The daemon: one link in, one pipeline, Zenoh and MCAP out, until it is told to stop.

Everything that decides sits in the pipeline, which reads no clock; the daemon moves messages, keeps the
recording on disk at most half a second behind, and says once a second how it is doing.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Any, Protocol

from adapters.message import Message, silence
from monitor.chain import Output
from monitor.estimate import Estimate
from monitor.event import AlarmEvent
from monitor.pipeline import Pipeline
from monitor.publisher import Publisher
from monitor.recorder import Recorder

_POLL_S = 0.1
_FLUSH_NS = 500_000_000
_STATUS_NS = 1_000_000_000


class Link(Protocol):
    """Where messages come from."""

    def receive(self, timeout_s: float) -> list[Message]:
        """Return the messages that are there, waiting at most ``timeout_s`` for the first."""
        ...


@dataclass(slots=True)
class _Second:
    """Counts since the last status."""

    messages: int = 0
    samples: int = 0
    worst_latency_ns: int = 0
    started_ns: int = field(default_factory=time.time_ns)


class Daemon:
    """Runs one vehicle's pipeline on a live link.

    Parameters
    ----------
    pipeline : Pipeline
        The vehicle's pipeline.
    link : Link
        Source of messages.
    publisher : Publisher
        Zenoh outputs.
    recorder : Recorder | None
        MCAP recording, None for none.
    on_event : Callable[[AlarmEvent], None]
        Called with every alarm event, for the log.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        link: Link,
        publisher: Publisher,
        recorder: Recorder | None,
        on_event: Callable[[AlarmEvent], None],
    ) -> None:
        self._pipeline = pipeline
        self._link = link
        self._publisher = publisher
        self._recorder = recorder
        self._on_event = on_event
        self._stopping = False
        self._active: set[str] = set()
        self._second = _Second()
        self._messages = 0
        self._samples = 0
        self._flushed_ns = self._second.started_ns

    def stop(self) -> None:
        """Ask :meth:`run` to return after the message in hand."""
        self._stopping = True

    def run(self) -> None:
        """Monitor until :meth:`stop`."""
        self._publisher.status(self.status(time.time_ns()))
        while not self._stopping:
            messages = self._link.receive(_POLL_S)
            for message in messages:
                self._take(message)
            now = time.time_ns()
            if not messages:
                self._note_silence(now)
            if self._recorder is not None and now - self._flushed_ns >= _FLUSH_NS:
                self._recorder.flush()
                self._flushed_ns = now
            if now - self._second.started_ns >= _STATUS_NS:
                self._publisher.status(self.status(now))
                self._second = _Second(started_ns=now)
        if self._recorder is not None:
            self._recorder.add_metadata(self._pipeline.metadata())

    def status(self, now_ns: int) -> dict[str, Any]:
        """Return the status object: state, rates, losses, latency, versions."""
        elapsed_s = max((now_ns - self._second.started_ns) / 1e9, 1e-9)
        statistics = self._pipeline.statistics()
        state = "starting"
        if self._pipeline.stale:
            state = "stale"
        elif self._samples:
            state = "monitoring"
        return {
            "state": state,
            "vehicle": self._pipeline.vehicle,
            "time_ns": now_ns,
            "messages": self._messages,
            "messages_per_s": round(self._second.messages / elapsed_s, 1),
            "samples": self._samples,
            "samples_per_s": round(self._second.samples / elapsed_s, 1),
            "foreign_messages": self._pipeline.foreign,
            "latency_ms": round(self._second.worst_latency_ns / 1e6, 3),
            "active_alarms": len(self._active),
            "observers": {name: _as_mapping(counts) for name, counts in statistics.items()},
            "profile": self._pipeline.profile.digest,
            "versions": {"fauio": version("fauio")},
        }

    def _note_silence(self, now_ns: int) -> None:
        """Let the pipeline know that time passes; record it where that changed something."""
        message = silence(now_ns)
        outputs = self._pipeline.feed(message)
        if outputs and self._recorder is not None:
            self._recorder.message(message)
        self._emit(outputs, now_ns)

    def _take(self, message: Message) -> None:
        self._messages += 1
        self._second.messages += 1
        outputs = self._pipeline.feed(message)
        if self._recorder is not None and self._pipeline.accepts(message):
            self._recorder.message(message)
        self._emit(outputs, time.time_ns(), message.received_ns)

    def _emit(self, outputs: Sequence[Output], now_ns: int, received_ns: int | None = None) -> None:
        for output in outputs:
            if isinstance(output, Estimate):
                self._samples += 1
                self._second.samples += 1
                self._publisher.estimate(output)
                if self._recorder is not None:
                    self._recorder.estimate(output)
                continue
            if output.state == "cleared":
                self._active.discard(output.id)
            else:
                self._active.add(output.id)
            self._publisher.event(output)
            if self._recorder is not None:
                self._recorder.event(output)
            self._on_event(output)
        if received_ns is not None:
            self._second.worst_latency_ns = max(self._second.worst_latency_ns, now_ns - received_ns)


def _as_mapping(counts: object) -> Mapping[str, int]:
    names = getattr(type(counts), "__dataclass_fields__", {})
    return {name: getattr(counts, name) for name in names}
