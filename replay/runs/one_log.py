"""Replay one log and write its files: its results as one small object, its failure as one line."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from adapters.errors import FauioError, OtherVehicleError
from adapters.logs.damage import Damage
from adapters.logs.recordings import Recording, recorded_metadata, recording_kind
from adapters.output_file import write_file
from monitor.event import AlarmEvent
from monitor.fitting.progress import recording_bytes, track
from monitor.profile import Profile
from monitor.sampling.slow_telemetry import seldom_text
from monitor.trace import MAX_ROWS
from monitor.views.panels import RunView
from replay.attacks.inject import known_truth
from replay.inspection.log_info import first_raised
from replay.player import Replay, interests, play_batches
from replay.reports.findings import effects, findings
from replay.reports.levels import WearLevel, flight_levels
from replay.reports.recording_facts import RecordingFacts, RecordingMeter
from replay.reports.report import Run, recording_report
from replay.reports.verdict import alarm_summary, run_sentence, stated_facts

if TYPE_CHECKING:
    from replay.runs.live_replay import LiveReplay


FEW_ROWS = 200_000
"""Estimates of each observer that are kept for the sizes of alarms. Chosen: all of 33 min at 100 Hz, in 100 MB; medians
of longer flights use every second, every fourth estimate and so on."""


@dataclass(frozen=True, slots=True)
class LogTask:
    """A log to replay, and the files to write about it."""

    log: str  # the log as the user named it, for reports
    path: Path
    vehicle: str | None = None  # vehicle's name in events; None: as a monitor recorded it, else the profile's
    # MCAP recording, plot, Rerun recording and page to write
    record: Path | None = None
    plot: Path | None = None
    rrd: Path | None = None
    report: Path | None = None
    dark: bool = False  # whether to plot on a dark background
    mapping: Path | None = None  # file that maps an onboard log's records to messages, if the default mapping is wrong
    folder: Path | None = None  # the profile's folder, in which a report looks for the report of the fit
    force: bool = False  # whether to go on if the recording reports another vehicle than the profile's

    @property
    def targets(self) -> tuple[Path, ...]:
        """The files to write."""
        return tuple(path for path in (self.record, self.plot, self.rrd, self.report) if path is not None)


@dataclass(frozen=True, slots=True)
class LogOutcome(Replay):
    """Result of the replay of one log, without its traces."""

    log: str = ""  # the log as the user named it
    kind: str = ""  # kind of recording; empty if unknown
    error: str | None = None  # why the log could not be replayed, one line with the log's name; None: it was replayed
    verdict: str = ""  # sentence with the number of alarms and what was not watched
    sentence: str = ""  # sentence about what happened; empty if nothing was found
    alarms: tuple[str, ...] = ()  # a line for each alarm: begin, end, channel, size
    # Unix times of the first and the last message that was read, nanoseconds
    start_ns: int = 0
    end_ns: int = 0
    damage: tuple[Damage, ...] = ()  # its unreadable parts
    levels: tuple[WearLevel, ...] = ()  # levels of wear in the flight
    processor_s: float = 0.0  # processor time of the replay with all of its outputs, seconds

    @property
    def raised(self) -> tuple[AlarmEvent, ...]:
        """The events that raised an alarm, one for each alarm."""
        return tuple(first_raised(self.events))

    def to_json(self) -> dict[str, Any]:
        """Return the JSON object for ``--json``."""
        found: dict[str, Any] = {"log": self.log}
        if self.error is not None:
            found["error"] = self.error
        found |= {"samples": self.samples, "evidence": self.evidence, "watched_s": round(self.watched_s, 3)}
        unwatched = self.unwatched(self.end_ns)
        found["unwatched"] = [{"why": why, "seconds": round(seconds, 3)} for why, seconds in unwatched]
        found["lacking"] = {name: list(lacks) for name, lacks in self.lacking.items()}
        if self.mismatch is not None:
            found["mismatch"] = self.mismatch
        found["verdict"] = self.sentence or self.verdict
        found["conditions"] = [condition.to_json() for condition in self.conditions]
        found["damage"] = [part.to_json() for part in self.damage]
        return found | {"alarms": [event.to_json() for event in self.events]}


def replay_log(
    profile: Profile,
    task: LogTask,
    on_event: Callable[[AlarmEvent], None] | None = None,
    *,
    live: LiveReplay | None = None,
    progress: bool = False,
) -> LogOutcome:
    """Replay a log and write the requested files; an error of this log is returned, not raised.

    ``on_event`` is called with each event as it arises, ``live`` replays the log as if live, ``progress`` shows the
    progress on a terminal.
    """
    started_s = time.thread_time()
    try:
        return _replay(profile, task, on_event, live, progress, started_s)
    except Exception as error:
        spent_s, mismatch = time.thread_time() - started_s, str(error) if isinstance(error, OtherVehicleError) else None
        return LogOutcome(log=task.log, error=_reason(task, error), mismatch=mismatch, processor_s=spent_s)


def _replay(
    profile: Profile,
    task: LogTask,
    on_event: Callable[[AlarmEvent], None] | None,
    live: LiveReplay | None,
    progress: bool,
    started_s: float,
) -> LogOutcome:
    vehicle = task.vehicle or recorded_metadata(task.path).get("vehicle")
    recording = Recording(task.path, None if task.record else interests(profile), task.mapping)
    batches = recording.batches() if live is None else live.batches(profile, task, vehicle)
    if live is None and progress:
        size = recording_bytes(task.path)
        batches = track(batches, Path(task.log).name, total_bytes=size, weigh=lambda batch: batch.count)
    meter, drawn = RecordingMeter(), bool(task.plot or task.rrd or task.report)
    found = play_batches(
        profile,
        meter.watch(batches),
        vehicle=vehicle,
        record=task.record,
        keep_traces=True,
        trace_rows=MAX_ROWS if drawn else FEW_ROWS,
        on_event=on_event,
        force=task.force,
    )
    run = Run(
        profile=profile,
        folder=task.folder or Path(profile.name),
        log=task.path,
        vehicle=vehicle or profile.name,
        verdict=_verdict(found, profile, meter.facts()),
        replay=found,
        recording=meter.facts(),
        damage=recording.damage(),
        truth=known_truth(task.path, found.traces) if drawn else {},
        facts=stated_facts(task.path) if task.report else None,
    )
    verdict = f"{Path(task.log).name}: {run.verdict}"
    _write(task, run, verdict)
    return _outcome(task, run, verdict, started_s)


def _outcome(task: LogTask, run: Run, verdict: str, started_s: float) -> LogOutcome:
    """Return what is told of a run, without its traces."""
    found, profile = run.replay, run.profile
    results = findings(profile, found.events, found.traces)
    told = {each.name: getattr(found, each.name) for each in fields(Replay)} | {"traces": ()}
    return LogOutcome(
        **told,
        log=task.log,
        kind=recording_kind(task.path),
        error=None if found.samples else verdict,
        verdict=verdict,
        sentence=run_sentence(results, run.facts) if results else "",
        alarms=tuple(map(alarm_summary, results)),
        start_ns=run.recording.first_ns or 0,
        end_ns=run.recording.last_ns or 0,
        damage=run.damage,
        levels=tuple(flight_levels(profile, found.events, found.traces)),
        processor_s=time.thread_time() - started_s,
    )


def _write(task: LogTask, run: Run, title: str) -> None:
    """Write the requested plot, Rerun recording and report."""
    found = run.replay
    shown = RunView(found.traces, found.events, found.thresholds, run.truth, effects(run.profile))
    if task.plot:
        from replay.reports.plot import plot_png

        plot_png(task.plot, shown, title, dark=task.dark)
    if task.rrd:
        from monitor.views.rerun_view import write_rrd
        from monitor.views.way import WAY_MESSAGES, way_of

        write_rrd(task.rrd, shown._replace(way=way_of(Recording(task.path, WAY_MESSAGES, task.mapping).batches())))
    if task.report:
        write_file(task.report, recording_report(run))


def _verdict(found: Replay, profile: Profile, facts: RecordingFacts) -> str:
    """Return the result of a replay as a sentence."""
    blind = "".join(f"; {name} saw nothing (no {', '.join(lacks)})" for name, lacks in found.lacking.items())
    if not found.samples:
        channels = (channel for observer in profile.observers for channel in observer.source.channels)
        needed = ", ".join(sorted({channel.message for channel in channels}))
        return f"no samples; the log lacks channels of the profile (needed: {needed}){blind}"
    if not found.evidence and found.mismatch is not None:
        return f"nothing was watched; {found.mismatch}"
    if not found.evidence:
        return (
            "nothing was watched; the vehicle was never seen in flight: is it the profile's vehicle? "
            "(see [phase] in the profile)"
        )
    other = f"; {found.mismatch}" if found.mismatch is not None else ""
    raised = len(first_raised(found.events))
    alarms = {0: "no alarm", 1: "1 alarm"}.get(raised, f"{raised} alarms")
    there = (observer for observer in profile.observers if observer.name not in found.lacking)
    sparse = (seldom_text(observer.name, observer.source, observer.rate_hz, facts.rates) for observer in there)
    late = "".join(f"; {line}" for line in sparse if line)
    unwatched_s = sum(seconds for _, seconds in found.unwatched(facts.last_ns or 0))
    part = f"; not all was watched for {unwatched_s:.0f} s of flight" if unwatched_s else ""
    return f"{alarms} in {found.watched_s:.0f} s of watched flight{blind}{part}{late}{other}"


def _reason(task: LogTask, error: Exception) -> str:
    """Return one line that tells why a log could not be replayed."""
    if isinstance(error, FauioError):
        text = str(error)
    elif isinstance(error, OSError):
        text = f"{error.filename}: {error.strerror}" if error.filename else str(error)
    else:
        place = traceback.extract_tb(error.__traceback__)[-1]
        text = f"{type(error).__name__}: {error} (in {Path(place.filename).name}, line {place.lineno})"
    line = " ".join(text.split()).replace(str(task.path), task.log)
    return line if task.log in line else f"{task.log}: {line}"
