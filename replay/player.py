"""Play a recording through a vehicle's pipeline and hand out the results."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from adapters.batch import Batch, cut, pack
from adapters.batch import messages as messages_of
from adapters.errors import OtherVehicleError
from adapters.logs.recordings import packed
from adapters.message import Message
from monitor.blind import CHANNEL, OBSERVER
from monitor.conditions.condition import FlightCondition
from monitor.estimate import Estimates
from monitor.event import AlarmEvent
from monitor.pipeline import Pipeline, interests_of
from monitor.profile import Profile
from monitor.sampling.sampler import SamplerStatistics
from monitor.trace import MAX_ROWS, Trace, TraceBuilder, alarm_spans

if TYPE_CHECKING:
    from monitor.recording.archive import Archive


@dataclass(frozen=True, slots=True)
class Watch:
    """Statistics of one observer over a recording."""

    samples: int
    evidence: int  # samples from which alarms could be raised
    coasted: int  # samples without measurements, stepped by its model alone
    rate_hz: float
    sampling: SamplerStatistics  # statistics of its messages

    @property
    def watched_s(self) -> float:
        """Time over which alarms could be raised, seconds."""
        return self.evidence / self.rate_hz


@dataclass(frozen=True, slots=True)
class Replay:
    """Result of a replay."""

    events: tuple[AlarmEvent, ...] = ()  # in order
    traces: tuple[Trace, ...] = ()  # estimates by observer; empty unless they were asked for
    samples: int = 0  # samples of all observers
    evidence: int = 0  # samples among them from which alarms could be raised
    watched_s: float = 0.0  # vehicle time over which alarms could be raised, of the observer that watched longest
    messages: int = 0  # messages that were read from the recording
    # alarm thresholds by observer and channel
    thresholds: Mapping[tuple[str, str], float] = field(default_factory=dict)
    # by observer, the messages that the recording lacks; such an observer could watch nothing
    lacking: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    watches: Mapping[str, Watch] = field(default_factory=dict)  # statistics by observer
    foreign: int = 0  # messages of other systems or components, which were left out
    mismatch: str | None = None  # why the vehicle seems to be another than the profile's; None if nothing suggests that
    # by observer, how long, in seconds, and how far the flight was outside of the fitted ones
    outside: Mapping[str, tuple[float, str]] = field(default_factory=dict)
    conditions: tuple[FlightCondition, ...] = ()  # observed conditions that are no faults, in their order

    def unwatched(self, end_ns: int) -> list[tuple[str, float]]:
        """Return why nothing was watched, and for how many seconds each; the recording ends at ``end_ns``."""
        spans = [span for span in alarm_spans(self.events) if (span.observer, span.channel) == (OBSERVER, CHANNEL)]
        return [
            (span.history[0].message, max(0, (end_ns if span.end_ns is None else span.end_ns) - span.start_ns) / 1e9)
            for span in spans
        ]


def play(profile: Profile, messages: Iterable[Message], **options: Any) -> Replay:
    """Run recorded messages through the pipeline, as :func:`play_batches` does."""
    return play_batches(profile, packed(messages), **options)


def play_batches(
    profile: Profile,
    batches: Iterable[Batch],
    *,
    vehicle: str | None = None,
    record: Path | None = None,
    keep_traces: bool = False,
    trace_rows: int = MAX_ROWS,
    on_event: Callable[[AlarmEvent], None] | None = None,
    force: bool = False,
) -> Replay:
    """Run a recording through the pipeline.

    The options are those of :func:`replay.api.replay`. At most ``trace_rows`` estimates of each observer are kept;
    longer traces are thinned.

    Raises
    ------
    OtherVehicleError
        The recording reports another vehicle, and ``force`` is not set; no file ``record`` is left.
    """
    pipeline = Pipeline(profile, vehicle, force=force)
    kept = _Kept(pipeline, trace_rows if keep_traces else 0)
    with ExitStack() as stack:
        recorder = _recorder(stack, record, pipeline) if record is not None else None
        for batch in batches:
            kept.messages += batch.count
            kept.names |= batch.names
            if recorder is not None:
                _record(recorder, pipeline, batch)
            outputs = pipeline.run(batch)
            if pipeline.refused is not None:
                if record is not None:
                    stack.pop_all().close()
                    record.unlink(missing_ok=True)
                raise OtherVehicleError(f"{pipeline.refused}; take its own profile, or go on with --force")
            for output in outputs:
                kept.add(output)
                if isinstance(output, AlarmEvent):
                    if recorder is not None:
                        recorder.event(output)
                    if on_event is not None:
                        on_event(output)
                elif recorder is not None:
                    recorder.estimates(output)
        if recorder is not None:
            recorder.add_metadata(pipeline.metadata())
    return kept.replay()


class _Kept:
    """What is kept of a recording and of the pipeline's outputs: at most ``trace_rows`` estimates of each observer."""

    def __init__(self, pipeline: Pipeline, trace_rows: int) -> None:
        self._pipeline = pipeline
        self._traces = {one.observer: TraceBuilder(one, trace_rows) for one in pipeline.layouts if trace_rows}
        self._rows = {one.observer: (0, 0, 0) for one in pipeline.layouts}  # samples, evidence and coasted
        self._events: list[AlarmEvent] = []
        self.messages = 0
        self.names: set[str] = set()

    def add(self, output: Estimates | AlarmEvent) -> None:
        """Count and keep an output."""
        if isinstance(output, AlarmEvent):
            self._events.append(output)
            return
        samples, evidence, coasted = self._rows[output.observer]
        evidence += int(np.count_nonzero(output.armed))
        coasted += int(np.count_nonzero(output.coasted_s))
        self._rows[output.observer] = samples + len(output), evidence, coasted
        if self._traces:
            self._traces[output.observer].extend(output)

    def replay(self) -> Replay:
        """Return the result, at the recording's end."""
        pipeline = self._pipeline
        sampling = pipeline.statistics()
        watches = {
            one.observer: Watch(*self._rows[one.observer], one.rate_hz, sampling[one.observer])
            for one in pipeline.layouts
        }
        lacking = {observer: tuple(sorted(needs - self.names)) for observer, needs in pipeline.needs.items()}
        return Replay(
            events=tuple(self._events),
            traces=tuple(builder.build() for builder in self._traces.values()),
            samples=sum(watch.samples for watch in watches.values()),
            evidence=sum(watch.evidence for watch in watches.values()),
            watched_s=max((watch.watched_s for watch in watches.values()), default=0.0),
            messages=self.messages,
            thresholds=pipeline.thresholds,
            lacking={observer: names for observer, names in lacking.items() if names},
            watches=watches,
            foreign=pipeline.foreign,
            mismatch=pipeline.mismatch,
            outside=pipeline.furthest,
            conditions=tuple(pipeline.conditions),
        )


def _record(recorder: Archive, pipeline: Pipeline, batch: Batch) -> None:
    """Record the messages of a batch that come from the monitored vehicle, before the pipeline processes them."""
    place, known = 0, pipeline.system
    if not known:
        # each message may be the one that reveals the vehicle's system id
        for message in messages_of(batch):
            place += 1
            if pipeline.accepts(message):
                recorder.batch(pack([message]))
            if pipeline.system:
                break
    rest = cut(batch, place, batch.count)
    columns = tuple(group for group in rest.columns if pipeline.accepts(group))
    others = {at: message for at, message in rest.others.items() if pipeline.accepts(message)}
    recorder.batch(Batch(rest.count, columns, others))
    # the pipeline has to find the vehicle by itself: messages before its first channel do not belong to it
    pipeline.system = known


def _recorder(stack: ExitStack, path: Path, pipeline: Pipeline) -> Archive:
    from monitor.recording.archive import Archive
    from monitor.recording.record_encoder import RecordEncoder
    from monitor.recording.recorder import Recorder

    encoder = RecordEncoder(pipeline.layouts)
    recorder = Recorder(path, encoder.topics, pipeline.metadata(), pipeline.profile.files, strict=True)
    archive = Archive(encoder, recorder)
    stack.callback(archive.close)
    return archive


def interests(profile: Profile) -> frozenset[str]:
    """Return the names of the messages that a profile's pipeline reads; skipping all others changes no result."""
    return interests_of(profile)
