"""The size of each fault that is detected, and the delay: each fault is injected into a healthy recording.

Each trial plays a window around one onset through the pipeline: healthy flight, so that the observers settle, then the
fault. If a healthy window raises an alarm without the fault, the trial is void: it tells nothing about the fault.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from math import ceil, inf
from pathlib import Path
from typing import Any

import numpy as np

from adapters.errors import OtherVehicleError, UsageError
from adapters.logs.recordings import read_batches
from adapters.message import SECOND_NS
from monitor.alarms.alarm import AlarmRule
from monitor.display import size_text
from monitor.pipeline import Pipeline
from monitor.profile import ObserverProfile, Profile, newly_watched, read_profile
from replay.attacks.attack import ATTACK_KINDS, Attack
from replay.attacks.injector import plan
from replay.sensitivity.healthy import Healthy, free_spans, onsets, play_healthy
from replay.sensitivity.trial import Outcome, Task, run_task

_STEPS = (0.5, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0)
"""Sizes to try, in units of the size that raises the alarm: from one that has to be missed to an obvious one."""
_RATES = (0.25, 0.5, 1.0, 2.0, 4.0)
"""Rates of ramps, in such units per second: they reach that size within a quarter of a second to four seconds."""
_SPOOF_RATES = (0.5, 1.0, 2.0, 5.0)
"""Final speeds of spoofs, m/s: from the drift of a receiver to the pace of a vehicle."""
_SCALES = (0.5, 0.8, 0.9, 1.1, 1.2, 1.5)
"""Factors on a measurement, between half and one and a half of it."""
_DELAYS_S = (0.05, 0.1, 0.2, 0.5, 1.0)
"""Delays of measurements, from those of slow links to those of an operator's reaction, seconds."""
_SMALLEST_COMMAND = 0.05
"""Smallest mean command, of full command, by which a threshold is divided: with a smaller one the loss would be too
large to try."""
_SIZELESS = ("freeze", "drop", "replay")
_SCENE_MESSAGES = frozenset({"ATTITUDE", "GPS_RAW_INT"})

TrialTrack = Callable[..., Iterable[Any]]


@dataclass(frozen=True, slots=True)
class Sweep:
    """What to try."""

    channels: tuple[str, ...] = ()  # alarm channels; empty: all of the profile
    kinds: tuple[str, ...] | None = None  # kinds of fault; None: loss for actuators, bias and ramp for sensors
    # sizes (of ramp and spoof: rates); None: multiples of each channel's threshold
    sizes: tuple[float, ...] | None = None
    onsets: int = 5  # times of onset for each size, spread over the watched flight
    # lengths of the window around an onset
    before_s: float = 10.0
    after_s: float = 10.0
    jobs: int = 1  # processes


@dataclass(frozen=True, slots=True)
class Row:
    """Result for one size of one kind of fault on one channel."""

    # the fault
    channel: str
    kind: str
    size: float | None  # its size (of ramp and spoof: rate); None for kinds without one
    unit: str  # unit of the size
    # trials that count, and void ones, whose window raised an alarm before the onset
    trials: int
    void: int
    missed: int  # trials in which the channel's alarm was not raised within the window
    # time from onset to alarm that half, and 90 %, of the trials do not exceed; None if they do
    delay_median_s: float | None
    delay_90_s: float | None
    isolated: float | None  # share of the detected trials in which no other alarm was raised
    others: tuple[str, ...]  # channels whose alarms were raised too, or instead
    # root mean square error of the estimate over the second half of the window, in ``unit`` (of a ramp or spoof: in the
    # unit of the growing quantity); None if the kind has no size to compare with
    estimate_error: float | None


@dataclass(frozen=True, slots=True)
class Detectability:
    """Result of a sweep."""

    # names of profile and recording
    profile: str
    log: str
    window_s: tuple[float, float]  # time before and after an onset
    healthy_alarms: int  # alarms of the recording without a fault; windows with one were not used
    rows: tuple[Row, ...]
    skipped: tuple[str, ...]  # attacks that were not tried, and why


@dataclass(frozen=True, slots=True)
class _Subject:
    """A channel to attack: its observer, its alarm, and the attacks without their times."""

    observer: ObserverProfile
    rule: AlarmRule
    attacks: tuple[Attack, ...]


def detectability(folder: Path, log: Path, sweep: Sweep, track: TrialTrack = lambda items, *_: items) -> Detectability:
    """Sweep size and kind of faults over a profile's alarm channels.

    ``track`` shows progress; it is called with the items, the name of their whole, and their own name.

    Raises
    ------
    UsageError
        A channel or kind is unknown or does not go with the other, or too little flight was watched.
    TelemetryError, ProfileError
        The recording or the profile cannot be read.
    """
    profile = read_profile(folder)
    if not (sweep.before_s > 0.0 and sweep.after_s > 0.0):
        raise UsageError("--before and --after are seconds above zero; their sum is the window of a trial")
    chosen = _chosen(profile, sweep.channels)
    unknown = [kind for kind in sweep.kinds or () if kind not in ATTACK_KINDS]
    if unknown:
        raise UsageError(f"--kinds {unknown[0]}: no such kind; use some of {', '.join(ATTACK_KINDS)}")
    wanted = Pipeline(profile).interests | _SCENE_MESSAGES
    try:
        healthy = play_healthy(profile, track(read_batches(log, wanted), f"reading {log.name}", "batches"))
    except OtherVehicleError as error:
        raise OtherVehicleError(f"{log.name}: {error}") from error
    names = healthy.names
    skipped: list[str] = []
    subjects = [
        _Subject(observer, rule, attacks)
        for observer, rule in chosen
        if (attacks := _attacks(profile, observer, rule, sweep, healthy, names, skipped))
    ]
    if not subjects:
        raise UsageError(skipped[0] if skipped else f"{folder}: the profile has no alarm to test")
    return Detectability(
        profile=profile.name,
        log=log.name,
        window_s=(sweep.before_s, sweep.after_s),
        healthy_alarms=len(healthy.alarms_ns),
        rows=tuple(_tried(profile, subjects, healthy, sweep, log, track)),
        skipped=tuple(skipped),
    )


def _tried(
    profile: Profile, subjects: Sequence[_Subject], healthy: Healthy, sweep: Sweep, log: Path, track: TrialTrack
) -> list[Row]:
    """Run each attack at each of its observer's onsets; return the result of each attack."""
    onsets_ns = {s.observer.name: _onsets(s.observer.name, healthy, sweep, log) for s in subjects}
    before_ns, after_ns = round(sweep.before_s * SECOND_NS), round(sweep.after_s * SECOND_NS)
    cut = {
        onset: healthy.window(onset - before_ns, onset, onset + after_ns)
        for onset in sorted(set().union(*onsets_ns.values()))
    }
    tasks = [
        Task(
            profile=profile,
            observer=subject.observer.name,
            system=healthy.system,
            window=cut[onset],
            attacks=tuple(_at(attack, onset, onset + after_ns, sweep) for attack in subject.attacks),
        )
        for subject in subjects
        for onset in onsets_ns[subject.observer.name]
    ]
    outcomes = iter(list(track(_run(tasks, sweep.jobs), f"{len(tasks)} windows", "windows")))
    rows: list[Row] = []
    for subject in subjects:
        trials_of = [next(outcomes) for _ in onsets_ns[subject.observer.name]]
        for attack, trials in zip(subject.attacks, zip(*trials_of, strict=True), strict=True):
            rows.append(_row(attack, _unit(attack, subject.rule), trials))
    return rows


def _chosen(profile: Profile, channels: Sequence[str]) -> list[tuple[ObserverProfile, AlarmRule]]:
    """Return the alarms to test: if two observers watch an actuator, that of the first one."""
    actuators = newly_watched(
        [f.name for f in observer.faults if f.kind == "actuator"] for observer in profile.observers
    )
    chosen = [
        (observer, rule)
        for observer, new in zip(profile.observers, actuators, strict=True)
        for rule in observer.alarms
        if rule.channel in new or rule.channel in {fault.name for fault in observer.faults if fault.kind == "sensor"}
    ]
    known = [rule.channel for _, rule in chosen]
    for channel in channels:
        if channel not in known:
            raise UsageError(
                f"--channel {channel}: the profile has no such alarm; it has {', '.join(dict.fromkeys(known))}"
            )
    return [(o, rule) for o, rule in chosen if not channels or rule.channel in channels]


def _attacks(
    profile: Profile,
    observer: ObserverProfile,
    rule: AlarmRule,
    sweep: Sweep,
    healthy: Healthy,
    names: frozenset[str],
    skipped: list[str],
) -> tuple[Attack, ...]:
    """Return the attacks to try on one channel, without their times; report the kinds that do not go with it."""
    threshold = rule.threshold or 1.0
    fault = next(fault for fault in observer.faults if fault.name == rule.channel)
    if rule.kind == "actuator" and fault.input is not None:
        flight = healthy.flights[observer.name]
        commands = flight.samples.u[flight.armed, fault.input]
        threshold /= max(abs(float(np.mean(commands))) if len(commands) else 0.0, _SMALLEST_COMMAND)
    usual = ("loss",) if fault.input is not None else ("bias", "ramp")
    collected: list[Attack] = []
    for kind in sweep.kinds or usual:
        sizes: Sequence[float | None] = sweep.sizes or _sizes(kind, threshold)
        attacks = [_attack(rule.channel, kind, size) for size in (sizes if kind not in _SIZELESS else (None,))]
        try:
            if not all(plan(attack, names, profile).messages & names for attack in attacks):
                raise UsageError(f"--channel {rule.channel}: no message of the log carries it")
        except UsageError as error:
            skipped.append(str(error))
            continue
        collected += attacks
    return tuple(collected)


def _attack(channel: str, kind: str, size: float | None) -> Attack:
    rated = kind in ("ramp", "spoof")
    return Attack(
        channel=channel,
        kind=kind,  # type: ignore[arg-type]
        start_ns=0,
        end_ns=1,
        size=None if rated else size,
        rate=size if rated else None,
        source_ns=-1 if kind == "replay" else None,
    )


def _at(attack: Attack, start_ns: int, end_ns: int, sweep: Sweep) -> Attack:
    """Return the attack with its times; a replay repeats the second half of the healthy part of the window."""
    source_ns = start_ns - round(sweep.before_s / 2 * SECOND_NS) if attack.kind == "replay" else None
    return replace(attack, start_ns=start_ns, end_ns=end_ns, source_ns=source_ns)


def _sizes(kind: str, threshold: float) -> tuple[float, ...]:
    """Return the default sizes to try: around the size that raises the alarm, rounded to two digits."""
    fixed = {"scale": _SCALES, "delay": _DELAYS_S, "spoof": _SPOOF_RATES}
    if kind in fixed:
        return fixed[kind]
    sizes = [float(f"{step * threshold:.2g}") for step in (_RATES if kind == "ramp" else _STEPS)]
    return tuple(dict.fromkeys(min(size, 1.0) if kind == "loss" else size for size in sizes))


def _onsets(name: str, healthy: Healthy, sweep: Sweep, log: Path) -> list[int]:
    before_ns, after_ns = round(sweep.before_s * SECOND_NS), round(sweep.after_s * SECOND_NS)
    spans_ns = healthy.spans_ns(name)
    free = free_spans(spans_ns, healthy.alarms_ns, before_ns, after_ns)
    onsets_ns = [onset_ns for _, onset_ns in onsets([free], sweep.onsets)]
    if not onsets_ns:
        longest = max((b - a for a, b in spans_ns), default=0) / SECOND_NS
        raise UsageError(
            f"{log}: no {sweep.before_s + sweep.after_s:g} s of watched flight without an alarm for '{name}' (longest "
            f"stretch {longest:.0f} s); give smaller --before and --after, or a longer healthy log"
        )
    return onsets_ns


def _run(tasks: Sequence[Task], jobs: int) -> Iterator[list[Outcome]]:
    if jobs == 1 or len(tasks) == 1:
        yield from map(run_task, tasks)
        return
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    from replay.runs.many_logs import deaf_to_interrupts

    with ProcessPoolExecutor(min(jobs, len(tasks)), mp_context=get_context("spawn")) as pool:
        with deaf_to_interrupts():
            outcomes = pool.map(run_task, tasks)
        yield from outcomes


def _unit(attack: Attack, rule: AlarmRule) -> str:
    known = {"loss": "share of the command", "spoof": "m/s", "scale": "times", "delay": "s", "drop": "share"}
    grows = f"{rule.unit}^2" if rule.unit.endswith("/s") else f"{rule.unit}/s"
    return known.get(attack.kind, grows if attack.kind == "ramp" else rule.unit)


def _row(attack: Attack, unit: str, trials: Sequence[Outcome]) -> Row:
    counted = [trial for trial in trials if trial.delay_s is not None]
    delays = sorted(inf if trial.delay_s is None else trial.delay_s for trial in counted)
    seen = [trial for trial in counted if trial.delay_s != inf]
    errors = [trial.error for trial in counted if trial.error is not None]
    return Row(
        channel=attack.channel,
        kind=attack.kind,
        size=attack.magnitude,
        unit=unit,
        trials=len(counted),
        void=len(trials) - len(counted),
        missed=len(counted) - len(seen),
        delay_median_s=_within(delays, 0.5),
        delay_90_s=_within(delays, 0.9),
        isolated=sum(not trial.others for trial in seen) / len(seen) if seen else None,
        others=tuple(sorted(frozenset().union(*(trial.others for trial in counted)))),
        estimate_error=float(np.sqrt(np.mean(np.square(errors)))) if errors else None,
    )


def _within(delays: Sequence[float], share: float) -> float | None:
    """Return the delay that a share of the trials does not exceed, None if they do."""
    if not delays:
        return None
    delay = delays[ceil(share * len(delays)) - 1]
    return None if delay == inf else delay


_HEADER = ("channel", "kind", "size", "missed", "median", "90 %", "only it", "error of estimate", "also raised")


def result_json(result: Detectability) -> dict[str, Any]:
    """Return the result as one JSON object."""
    rows = [{**asdict(row), "miss_rate": row.missed / row.trials if row.trials else None} for row in result.rows]
    return {**asdict(result), "rows": rows}


def result_lines(result: Detectability) -> list[str]:
    """Return the result as lines of text."""
    before_s, after_s = result.window_s
    trials = max((row.trials + row.void for row in result.rows), default=0)
    lines = [
        f"{result.profile} on {result.log}: {trials} onsets each, {before_s:g} s before and {after_s:g} s after; "
        "delays from onset to alarm"
    ]
    if result.healthy_alarms:
        alarms = "1 alarm" if result.healthy_alarms == 1 else f"{result.healthy_alarms} alarms"
        lines.append(f"the log itself raises {alarms}; is it healthy? Windows around them were left out")
    lines += _table([_HEADER, *(_cells(row) for row in result.rows)])
    void = sum(row.void for row in result.rows)
    if void:
        lines.append(f"{void} trials do not count: an alarm was raised before the onset")
    return lines + [f"left out: {reason}" for reason in result.skipped]


def _cells(row: Row) -> tuple[str, ...]:
    return (
        row.channel,
        row.kind,
        "" if row.size is None else size_text(row.size, row.unit),
        f"{row.missed} of {row.trials}",
        _seconds(row.delay_median_s),
        _seconds(row.delay_90_s),
        "" if row.isolated is None else f"{100 * row.isolated:.0f} %",
        "" if row.estimate_error is None else size_text(row.estimate_error, row.unit),
        ", ".join(row.others),
    )


def _seconds(delay: float | None) -> str:
    return "never" if delay is None else f"{delay:.2f} s"


def _table(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
