"""Which kinds of faults are seen and named rightly, each put exactly into a flight left out of the fit.

    python bench/names.py FLIGHTS... [--only GROUP] [--kinds KIND...] [--write] [--jobs 2]

FLIGHTS are folders of recordings and their truth, as of ``bench/rates.py``. Per vehicle and kind of recording the first
healthy flight is left out, a profile is fitted on the others, and each fault of :data:`CASES` is put into the one left
out, a minute after take-off. ``--write`` writes docs/names.md, without it the page is printed.

With ``--deviations`` it is measured instead whether the published standard deviations are true (docs/sizes.md): faults
of :data:`SIZES` begin at several times, and recorded ones whose size is known are added.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import cycle
from math import radians
from pathlib import Path

import numpy as np
from accounting import AFTERMATH_S, Spell, spells
from flights import Flight, Truth
from numpy.typing import NDArray
from rates import HOVER, recordings

from adapters.batch import messages as messages_of
from adapters.batch import pack
from adapters.errors import UsageError
from adapters.logs.recordings import read_batches
from adapters.message import Message
from monitor.alarms.alarm import AFFECTED
from monitor.estimate import Estimates
from monitor.event import AlarmEvent
from monitor.pipeline import Pipeline
from monitor.profile import FaultChannel, Profile, read_profile
from monitor.vehicles.kinds import fit_messages
from replay.attacks.attack import Attack
from replay.attacks.injector import WITHOUT_PAST, Injector, inject, plan, profile_clocks
from replay.attacks.instruments import INSTRUMENTS
from replay.fit import fit_profile
from replay.player import interests
from replay.sensitivity.healthy import Healthy, play_healthy

ROOT = Path(__file__).parent.parent
LEAD_S, FAULT_S, TAIL_S = 60.0, 30.0, 35.0
"""Healthy flight before a fault, its length, and the flight after it: alarms clear within seconds or never."""
SETTLED_NS = 5_000_000_000
"""Time for estimates to settle before their uncertainty is judged."""
MOTORS = ("motor1", "motor2", "motor3", "motor4", "motor5", "motor6")
_ALL = (
    *(f"GPS_RAW_INT.{name}" for name in ("lat", "lon", "alt", "vel", "cog")),
    "baro",
    "compass",
    "gyro_x",
    "gyro_y",
    "gyro_z",
    "accel_x",
    "accel_y",
    "accel_z",
    "attitude_roll",
    "attitude_pitch",
)


@dataclass(frozen=True, slots=True)
class Case:
    """A kind of fault: what is altered, and the alarm channels that name it, any of them.

    ``sizes`` are the true sizes by channel, in its unit, of motors a share of the command.
    """

    name: str
    attacks: Callable[[Profile, frozenset[str]], list[Attack]]
    channels: frozenset[str]
    sizes: dict[str, float]


def _parts(motor: str) -> list[str]:
    """Return what a motor's loss is where speeds are known, which stay as recorded: a speed controller's."""
    return [motor.replace("motor", part) for part in ("esc", "prop")] if motor.startswith("motor") else []


def _one(channel: str, size: float, names: Sequence[str] = (), kind: str = "bias", **numbers: float) -> Case:
    """Return a case of one channel, named by itself or by others."""
    attack = Attack(channel, kind, 0, 1, size=None if kind in ("ramp", "spoof", "freeze") else size, **numbers)  # type: ignore[arg-type]
    right = frozenset(names or (channel, *_parts(channel)))
    sizes = {channel: size} if kind == "bias" else {}
    if kind == "loss":
        sizes = {channel: -size}
    return Case(f"{channel} {kind} {numbers.get('rate', size):g}", lambda *_: [attack], right, sizes)


def _raw(axis: str, size: float) -> Case:
    """Return a bias of a gyro that the IMU's message alone shows: the autopilot flies by another."""

    def attacks(_: Profile, names: frozenset[str]) -> list[Attack]:
        imus = [f"{imu}.{axis}gyro" for imu in ("HIGHRES_IMU", "RAW_IMU", "SCALED_IMU") if imu in names]
        return [Attack(name, "bias", 0, 1, size=size * (1.0 if "HIGHRES" in name else 1000.0)) for name in imus]

    return Case(f"gyro_{axis} of one IMU of two {size:g}", attacks, frozenset({f"gyro_{axis}"}), {f"gyro_{axis}": size})


def _motors(share: float, *numbers: int) -> Case:
    """Return losses of several motors by their numbers; none: of all."""

    def attacks(profile: Profile, _: frozenset[str]) -> list[Attack]:
        faults = {fault.name for observer in profile.observers for fault in observer.faults}
        named = [motor for n, motor in enumerate(MOTORS, 1) if motor in faults and (n in numbers or not numbers)]
        return [Attack(motor, "loss", 0, 1, size=share) for motor in named]

    what = " and ".join(f"motor{n}" for n in numbers) or "all motors"
    right = frozenset(
        {"unexplained", "thrust", "motors", "payload"}
        | {f"{part}{n}" for n in numbers or range(1, 7) for part in ("motor", "esc", "prop")}
    )
    return Case(f"{what} loss {share:g}", attacks, right, {})


def _whole(kind: str) -> Case:
    """Return frozen or replayed measurements, all of them."""
    numbers = {"source_ns": -20} if kind == "replay" else {}
    attacks = [Attack(channel, kind, 0, 1, **numbers) for channel in (*_ALL, "ATTITUDE.yaw")]  # type: ignore[arg-type]
    return Case(
        f"all measurements {kind}", lambda *_: attacks, frozenset({"telemetry", "frozen", "blind", "impostor"}), {}
    )


CASES: tuple[Case, ...] = (
    *(_one(f"gyro_{axis}", size) for axis in "xyz" for size in (0.02, 0.08)),
    _raw("x", 0.05),
    *(_one(f"accel_{axis}", 0.6) for axis in "xyz"),
    *(_one("compass", radians(angle)) for angle in (20.0, 60.0)),
    _one("gps_north", 0.5, kind="ramp", rate=0.5),
    _one("gps_east", 5.0),
    _one("gps_down", 5.0),
    _one("baro", 5.0),
    _one("baro", 0.0, kind="freeze"),
    _one(
        "gps_north",
        10.0,
        ("gps_north", "gps_velocity_north", "motion_north"),
        kind="spoof",
        rate=10.0,
        acceleration=0.5,
    ),
    _one("motor2", 0.15, kind="loss"),
    _one("motor2", -0.15, kind="loss"),
    _one("motor2", 0.05, kind="loss"),
    _one("motor2", -0.05, kind="loss"),
    _motors(0.1, 1, 2),
    _motors(0.2, 1, 2),
    _motors(0.1, 1, 3),
    _motors(0.1),
    Case(
        "vibration 25 m/s2",
        lambda *_: [Attack(f"VIBRATION.vibration_{axis}", "bias", 0, 1, size=25.0) for axis in "xyz"],
        frozenset({"vibration"}),
        {},
    ),
    Case("GPS silent", lambda *_: [Attack("gps_north", "drop", 0, 1)], frozenset({"blind"}), {}),
    Case(
        "GPS without fix",
        lambda *_: [Attack("GPS_RAW_INT.fix_type", "scale", 0, 1, size=0.0)],
        frozenset({"blind"}),
        {},
    ),
    Case(
        "GPS stuck",
        lambda *_: [Attack(f"GPS_RAW_INT.{name}", "freeze", 0, 1) for name in ("lat", "lon", "alt", "vel", "cog")],
        frozenset({"gps_north", "gps_east", "gps_velocity_north", "gps_velocity_east", "gps_down"}),
        {},
    ),
    _whole("freeze"),
    _whole("replay"),
)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of a case: delay until the right name, other names, cleared after the end (None: not), sizes."""

    group: str
    flight: str
    case: str
    refused: str = ""
    delay_s: float | None = None
    named: tuple[str, ...] = ()
    others: tuple[str, ...] = ()
    as_set: str = ""  # the first alarm's channel and the one that it says may be responsible instead
    cleared_s: float | None = None
    size: str = ""
    covered: float | None = None
    texts: tuple[str, ...] = ()
    said: str = ""  # what was given as information of the time of the fault, no alarm


def try_case(case: Case, group: str, one: Flight, profile: Profile, healthy: Healthy) -> Outcome:
    """Put a case's fault into the flight's minutes after take-off; return what the monitor said."""
    first_ns = (one.takeoff_ms or 0) * 1_000_000
    start_ns, end_ns = (first_ns + round(seconds * 1e9) for seconds in (LEAD_S, LEAD_S + FAULT_S))
    stop_ns = min(end_ns + round(TAIL_S * 1e9), (one.touchdown_ms or 1 << 43) * 1_000_000)
    try:
        pipeline, outputs = play_fault(case, profile, healthy, start_ns, end_ns, stop_ns)
    except UsageError as error:
        return Outcome(group, one.name, case.name, refused=str(error))
    events = [output for output in outputs if isinstance(output, AlarmEvent)]
    off = sizes_off(case, profile, [o for o in outputs if isinstance(o, Estimates)], start_ns, end_ns)
    said = [found.text for found in pipeline.conditions if found.name in case.channels]
    judged = _judged(case, group, one, events, start_ns // 1_000_000, end_ns // 1_000_000)
    covered = float((np.abs(off) <= 2.0).mean()) if len(off) else None
    return replace(judged, covered=covered, said=said[0] if said else "")


def play_fault(
    case: Case, profile: Profile, healthy: Healthy, start_ns: int, end_ns: int, stop_ns: int
) -> tuple[Pipeline, list[AlarmEvent | Estimates]]:
    """Play a healthy recording with a case's fault in it, and return what came out.

    Raises
    ------
    UsageError
        The recording does not hold what the fault alters.
    """
    window = healthy.window(0, start_ns, stop_ns)
    clocks = profile_clocks(profile)
    pipeline = Pipeline(profile)
    outputs = pipeline.run(window.lead)
    tail: list[Message] = list(window.tail)
    attacks = case.attacks(profile, window.names)
    injectors = []
    for attack in attacks:
        source_ns = attack.source_ns and start_ns + attack.source_ns * 1_000_000_000
        timed = replace(attack, start_ns=start_ns, end_ns=end_ns, source_ns=source_ns)
        if timed.channel in INSTRUMENTS and not any(q.message in window.names for q in INSTRUMENTS[timed.channel]):
            continue
        made = plan(timed, window.names, profile)
        if made.messages & window.names:
            injectors.append(Injector(timed, made, healthy.system, clocks))
    past = list(window.newest() if all(attack.kind in WITHOUT_PAST for attack in attacks) else messages_of(window.lead))
    for injector in injectors:
        for message in past:
            injector.feed(message)
        tail = list(inject(tail, injector))
    if not sum(injector.altered for injector in injectors):
        raise UsageError("the recording does not hold it")
    return pipeline, [*outputs, *pipeline.run(pack(tail))]


def sizes_off(
    case: Case, profile: Profile, runs: Sequence[Estimates], start_ns: int, end_ns: int
) -> NDArray[np.float64]:
    """Return by how many standard deviations a fault's sizes are off, from :data:`SETTLED_NS` after its onset on."""
    off = [np.empty(0)]
    for run in runs:
        faults = _faults(profile, run.observer)
        stamps = run.samples.vehicle_time_ns
        for index, fault in enumerate(faults):
            if fault.name not in case.sizes:
                continue
            named = run.armed & (stamps > start_ns + SETTLED_NS) & (stamps < end_ns) & (run.isolated[:, index] != 0.0)
            truth = np.full(int(named.sum()), case.sizes[fault.name])
            if fault.input is not None:
                truth *= run.samples.u[named, fault.input]
            off.append((run.isolated[named, index] - truth) / run.sd[named, index])
    return np.concatenate(off)


@dataclass(frozen=True, slots=True)
class Errors:
    """Errors of one channel in published standard deviations (n,): of what, and in which kind of recording."""

    group: str
    channel: str
    what: str
    off: NDArray[np.float64]


def deviations(group: str, fit: Sequence[Flight], out: Flight, faulty: Sequence[Flight], folder: str) -> list[Errors]:
    """Return the errors of a healthy flight, of faults put into it, and of recorded faults."""
    profile = profile_of(out.kind, fit, Path(folder))
    healthy = play_healthy(profile, read_batches(out.log, interests(profile)))
    pipeline, stop_ns = Pipeline(profile), (out.touchdown_ms or 1 << 43) * 1_000_000
    runs = [run for batch in healthy.batches for run in pipeline.run(batch) if isinstance(run, Estimates)]
    errors = [
        Errors(group, fault.name, "healthy", (run.fault[rows, index] / run.sd[rows, index]))
        for run in runs
        for rows in [run.armed & (run.samples.vehicle_time_ns < stop_ns)]
        for index, fault in enumerate(_faults(profile, run.observer))
        if rows.any() and fault.name in SIZES
    ]
    end_ns = min(stop_ns, max(int(times[-1]) for times in healthy.newest_ns if len(times)))
    begin_ns = (out.takeoff_ms or 0) * 1_000_000 + SOONEST_NS
    onsets_ns = range(begin_ns, end_ns - LASTS_NS, EVERY_NS)[:ONSETS]
    scaling = {fault.name for watch in profile.observers for fault in watch.faults if fault.input is not None}
    for channel, sizes in SIZES.items():
        unit = "share" if channel in scaling else "SI"
        for size, start_ns in zip(cycle(sizes), onsets_ns, strict=False):
            case = _one(channel, size, kind="loss" if channel in scaling else "bias")
            span = start_ns, start_ns + LASTS_NS
            try:
                _, outputs = play_fault(case, profile, healthy, *span, span[1])
            except UsageError:
                continue
            errors += _errors_of(group, profile, outputs, Truth(channel, unit, size), span)
    for one in faulty:
        pipeline = Pipeline(profile)
        outputs = [output for batch in read_batches(one.log, interests(profile)) for output in pipeline.run(batch)]
        for fault in one.faults:
            if fault.truth is not None:
                span = fault.on_ms * 1_000_000, min(fault.off_ms * 1_000_000, fault.on_ms * 1_000_000 + LONGEST_NS)
                errors += _errors_of("recorded", profile, outputs, fault.truth, span)
    return errors


def _faults(profile: Profile, observer: str) -> Sequence[FaultChannel]:
    return next(watch.faults for watch in profile.observers if watch.name == observer)


def _errors_of(
    group: str, profile: Profile, outputs: Sequence[AlarmEvent | Estimates], truth: Truth, span: tuple[int, int]
) -> Iterator[Errors]:
    """Yield the errors of the sizes of a fault's alarms, and of its estimates from the first alarm on."""
    raised: dict[str, int] = {}
    for event in outputs:
        if not isinstance(event, AlarmEvent) or event.channel != truth.channel or event.state == "cleared":
            continue
        now_ns = event.vehicle_time_ms * 1_000_000
        if not span[0] - ONSET_NS <= now_ns <= span[1] or event.estimate is None or not event.sd:
            continue
        raised.setdefault(event.observer, now_ns)
        size = float(truth.after(np.array([(now_ns - span[0]) / 1e9]))[0])
        off = event.estimate - size
        if truth.unit == "share":
            if not event.relative:
                continue
            off = (event.relative + size) * abs(event.estimate / event.relative)
        yield Errors(group, truth.channel, "alarms", np.array([off / event.sd]))
    for observer, since_ns in raised.items():
        parts = [np.empty(0)]
        for run in (run for run in outputs if isinstance(run, Estimates) and run.observer == observer):
            index = [fault.name for fault in _faults(profile, observer)].index(truth.channel)
            times_ns, source = run.samples.vehicle_time_ns, _faults(profile, observer)[index].input
            rows = run.armed & (times_ns >= since_ns) & (times_ns < span[1]) & (run.isolated[:, index] != 0.0)
            sizes = truth.after((times_ns[rows] - span[0]) / 1e9)
            if source is not None:
                sizes = -sizes * np.abs(run.samples.u[rows, source])
            parts.append((run.isolated[rows, index] - sizes) / run.sd[rows, index])
        if len(joined := np.concatenate(parts)):
            yield Errors(group, truth.channel, "estimates", joined)


def sizes_page(errors: Sequence[Errors]) -> str:
    """Return the page of the deviations, misses first."""
    groups = [*dict.fromkeys(one.group for one in errors if one.group != "recorded"), "recorded"]
    lines, missed = [], []
    for what, title in WHATS.items():
        own = [one for one in errors if one.what == what]
        lines += ["", f"## {title}", "", f"| channel | {' | '.join(groups)} | all |", f"|{'---|' * (len(groups) + 2)}"]
        for channel in dict.fromkeys(one.channel for one in own):
            mine = [one for one in own if one.channel == channel]
            cells = [_deviation([one for one in mine if one.group == group]) for group in groups]
            lines.append(f"| {channel} | {' | '.join(text for text, _ in cells)} | {_deviation(mine)[0]} |")
            text, share = _deviation(mine)
            if share is not None and not 90.0 <= share <= 98.0:
                missed.append(f"- {title[0].lower()}{title[1:]}: {channel} {text}")
    return "\n".join([SIZES_INTRODUCTION, *missed, *lines]) + "\n"


def _deviation(errors: Sequence[Errors]) -> tuple[str, float | None]:
    """Return the share within two deviations and the root mean square, each fault counting once, and the share."""
    known = [off for one in errors if len(off := one.off[np.isfinite(one.off)])]
    if not known:
        return "", None
    weights = [len(off) if errors[0].what == "healthy" else 1 for off in known]
    share = 100.0 * float(np.average([np.mean(np.abs(off) <= 2.0) for off in known], weights=weights))
    square = np.average([np.mean(np.minimum(np.abs(off), LARGEST) ** 2) for off in known], weights=weights)
    count = "" if errors[0].what == "healthy" else f" ({len(known)})"
    return f"{share:.0f} %, {float(np.sqrt(square)):.2g}{count}", share


def _judged(case: Case, group: str, one: Flight, events: Sequence[AlarmEvent], on_ms: int, off_ms: int) -> Outcome:
    sets = {
        (event.channel, event.vehicle_time_ms): event.instead
        for event in events
        if event.state == "raised" and event.instead in case.channels
    }
    during = [spell for spell in _spells(events) if on_ms <= spell.raised_ms <= off_ms + AFTERMATH_S * 1000]
    ended = [event for event in events if event.state == "cleared" and event.message.startswith(EXPLAINED)]
    listed = {(event.channel, event.vehicle_time_ms) for event in ended}
    affected = {
        name
        for event in events
        if event.channel in case.channels
        for name in event.message.partition(AFFECTED)[2].split(", ")
    }
    named = [s for s in during if s.channel in case.channels or (s.channel, s.raised_ms) in sets]
    right = [spell for spell in named if spell.raised_ms <= off_ms]
    ends = [spell.cleared_ms for spell in during]
    cleared = None if None in ends or not ends else (max(e for e in ends if e is not None) - off_ms) / 1e3
    last = {
        event.channel: event for event in events if event.state != "cleared" and on_ms < event.vehicle_time_ms <= off_ms
    }
    shown = {name: event.estimate if event.relative is None else event.relative for name, event in last.items()}
    sizes = [f"{name} {shown[name]:.3g} of {truth:.3g}" for name, truth in case.sizes.items() if name in shown]
    return Outcome(
        group,
        one.name,
        case.name,
        delay_s=(right[0].raised_ms - on_ms) / 1e3 if right else None,
        named=tuple(dict.fromkeys(spell.channel for spell in during)),
        others=tuple(
            dict.fromkeys(
                spell.channel
                for spell in during
                if spell not in named
                and (spell.channel, spell.cleared_ms) not in listed
                and not (spell.cleared_ms and spell.channel in affected)
            )
        ),
        as_set=f"{right[0].channel} or {sets[key]}"
        if right and (key := (right[0].channel, right[0].raised_ms)) in sets
        else "",
        cleared_s=cleared,
        size=", ".join(sizes),
        texts=tuple(
            f"{(e.vehicle_time_ms - on_ms) / 1e3:+.2f} {e.observer}/{e.channel} {e.state}: {e.message}"
            for e in events
            if e.state != "updated" and e.vehicle_time_ms >= on_ms
        ),
    )


def _spells(events: Sequence[AlarmEvent]) -> list[Spell]:
    """Return the alarms, those of silence among them."""
    plain = [replace(event, kind="sensor") if event.kind in ("stale", "blind") else event for event in events]
    return spells(plain)


def make(group: str, fit: Sequence[Flight], out: Flight, folder: str, kinds: Sequence[str]) -> list[Outcome]:
    """Fit a profile and try every case on the flight that was left out."""
    try:
        profile = profile_of(out.kind, fit, Path(folder))
    except ValueError as error:
        return [Outcome(group, out.name, "fit", refused=str(error))]
    healthy = play_healthy(profile, read_batches(out.log, interests(profile)))
    cases = [case for case in CASES if not kinds or any(kind in case.name for kind in kinds)]
    return [try_case(case, group, out, profile, healthy) for case in cases]


def profile_of(kind: str, fit: Sequence[Flight], path: Path) -> Profile:
    """Return the profile of a folder, fitted if there is none."""
    if not (path / "profile.toml").exists():
        fit_profile(kind, [partial(read_batches, one.log, fit_messages()) for one in fit], path, "it")
    return read_profile(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "flights", type=Path, nargs="+", metavar="FLIGHTS", help="folders of recordings and their truth"
    )
    parser.add_argument("--only", nargs="*", default=[], help="groups with these words alone")
    parser.add_argument("--kinds", nargs="*", default=[], help="cases with these words alone")
    parser.add_argument("--profiles", type=Path, help="folder to keep the profiles in, and to take them from")
    parser.add_argument("--write", action="store_true", help="write docs/names.md (docs/sizes.md)")
    parser.add_argument("--deviations", action="store_true", help="measure the standard deviations instead")
    parser.add_argument("--jobs", type=int, default=2, help="processes (2)")
    args = parser.parse_args()
    jobs = [job for folder in args.flights for job in jobs_of(folder, args.deviations) if _wanted(job[0], args.only)]
    context = multiprocessing.get_context("spawn")
    outcomes: list[Outcome] = []
    with tempfile.TemporaryDirectory() as temporary, ProcessPoolExecutor(args.jobs, mp_context=context) as pool:
        folders = [
            str((args.profiles or Path(temporary)) / "".join(c if c.isalnum() else "_" for c in job[0])) for job in jobs
        ]
        if args.deviations:
            measured = [pool.submit(deviations, *job, folder) for job, folder in zip(jobs, folders, strict=True)]
            text = sizes_page([error for future in measured for error in future.result()])
            (ROOT / "docs/sizes.md").write_text(text, encoding="utf-8") if args.write else sys.stdout.write(text)
            return
        made = [
            pool.submit(make, group, fit, out, folder, args.kinds)
            for (group, fit, out, _), folder in zip(jobs, folders, strict=True)
        ]
        for future in made:
            outcomes += future.result()
            for text in (line for outcome in future.result() for line in (outcome.case, *outcome.texts)):
                print(text, file=sys.stderr)
    if args.write:
        (ROOT / "docs/names.md").write_text(page(outcomes), encoding="utf-8")
    else:
        sys.stdout.write(page(outcomes))


def jobs_of(folder: Path, alone: bool = False) -> Iterator[tuple[str, list[Flight], Flight, list[Flight]]]:
    """Yield each vehicle and kind of recording with the healthy flights to fit, the one left out, and the faulty ones.

    With ``alone`` a single healthy flight is fitted; left out is a faulty one until its fault.
    """
    flights = [replace(one, group=one.group.replace(*_FAST)) for one in recordings(folder)]
    for group in dict.fromkeys(one.group for one in flights):
        healthy = [one for one in flights if one.group == group and one.healthy]
        flown = [one for one in healthy if not one.name.endswith(HOVER) and "noisy" not in one.name]
        faulty = [one for one in flights if one.group == group and one.faults and "noisy" not in one.name]
        if len(flown) > 1:
            yield group, flown[1:], flown[0], faulty
        elif alone and flown and faulty:
            yield group, flown, replace(faulty[0], touchdown_ms=faulty[0].faults[0].on_ms), faulty


def _wanted(group: str, words: Sequence[str]) -> bool:
    return not words or any(word in group for word in words)


def page(outcomes: Sequence[Outcome]) -> str:
    """Return the page, misses first."""
    groups = list(dict.fromkeys(outcome.group for outcome in outcomes))
    cases = list(dict.fromkeys(outcome.case for outcome in outcomes))
    found = {(outcome.case, outcome.group): outcome for outcome in outcomes}
    lines = [INTRODUCTION, *misses(outcomes), "", "## By kind", "", BY_KIND, ""]
    lines += [f"| fault | {' | '.join(groups)} |", f"|{'---|' * (len(groups) + 1)}"]
    for case in cases:
        cells = [_cell(found[case, group]) if (case, group) in found else "" for group in groups]
        lines.append(f"| {case} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def misses(outcomes: Sequence[Outcome]) -> list[str]:
    """Return what was not seen, not named, not alone or did not clear."""
    lines = []
    for outcome in outcomes:
        where = f"{outcome.case} ({outcome.group})"
        if outcome.refused:
            lines.append(f"- not tried: {where}: {outcome.refused.partition(';')[0]}")
        elif outcome.delay_s is None and not outcome.said:
            lines.append(
                f"- named wrongly: {where} {', '.join(outcome.named)}" if outcome.named else f"- not seen: {where}"
            )
        elif outcome.others:
            lines.append(f"- not alone: {where}, also {', '.join(outcome.others)}")
        if outcome.named and (outcome.cleared_s is None or outcome.cleared_s > SLOW_TO_CLEAR_S):
            after = "never" if outcome.cleared_s is None else f"only after {outcome.cleared_s:.1f} s"
            lines.append(f"- cleared {after}: {where}")
    return sorted(lines, key=lambda line: ("not seen" not in line, "named wrongly" not in line, "alone" not in line))


def _cell(outcome: Outcome) -> str:
    if outcome.refused:
        return "not tried"
    missed = f"no alarm, reported: {outcome.said}" if outcome.said else "MISSED"
    parts = [missed if outcome.delay_s is None else f"{outcome.delay_s:.2f} s"]
    if outcome.as_set:
        parts[0] += f" as {outcome.as_set}"
    if outcome.others:
        parts.append(f"{'also' if outcome.delay_s is not None else 'but'} {', '.join(outcome.others)}")
    if outcome.size:
        parts.append(outcome.size)
    if outcome.covered is not None:
        parts.append(f"2 sd: {100.0 * outcome.covered:.0f} %")
    if outcome.named:
        parts.append("never cleared" if outcome.cleared_s is None else f"cleared {outcome.cleared_s:.1f} s")
    return "; ".join(parts)


SIZES: dict[str, tuple[float, ...]] = {
    **{f"motor{n}": (0.06, 0.15) if n % 2 else (0.1, 0.2) for n in range(1, 5)},
    **dict.fromkeys(("aileron", "elevator", "rudder", "throttle", "steering"), (0.3, 0.5)),
    **dict.fromkeys(("gyro_x", "gyro_y", "gyro_z"), (0.03, -0.08)),
    **dict.fromkeys(("accel_x", "accel_y", "accel_z"), (0.6, -1.0)),
    **dict.fromkeys(("gps_north", "gps_east", "gps_down", "baro"), (5.0, -12.0)),
    "compass": (0.35, -0.8),
}
"""True sizes of faults by channel, by turns; of actuators the share of the command that is lost."""
SOONEST_NS, EVERY_NS, LASTS_NS, ONSETS = 35_000_000_000, 25_000_000_000, 12_000_000_000, 4
"""First onset after take-off, time between onsets, length and number of faults: all within three minutes of flight."""
LONGEST_NS = 60_000_000_000
"""Most of a recorded fault that counts."""
ONSET_NS = 50_000_000
"""An alarm that is sooner by less belongs to the fault: its onset is known to one command of the simulator."""
LARGEST = 10.0
"""Errors count as at most so many deviations: a single one that is wrong altogether would hide all others."""
WHATS = {
    "alarms": "Sizes of alarms, raised and updated",
    "estimates": "Estimates from the alarm on",
    "healthy": "Estimates in healthy flight",
}

_FAST = ("ArduPilot quad, link, motors 10 Hz", "ArduPilot quad, link, 100 Hz")
"""The flights whose only recording is a fast link."""
EXPLAINED = "explained by "
"""How the text of an alarm begins that ended as a consequence of another one, which lists it."""
SLOW_TO_CLEAR_S = 5.0
"""As in bench/detection.py."""

INTRODUCTION = f"""# Kinds of faults and their names

This page shows which kinds of faults are seen, which get the right name, and which alarms clear late, for each vehicle
and kind of recording. A profile is fitted on all healthy flights but the first. Each fault is put into that first
flight, {LEAD_S:g} s after take-off, for {FAULT_S:g} s; alarms up to {TAIL_S:g} s after its end count.

    python bench/names.py FLIGHTS... --write

makes this page. Faults of sensors alter the measurements only: the vehicle does not react to them, and the autopilot's
attitude stays right. A motor's fault is answered by its command at once (`replay/attacks/plant_response.py`). The
recorded faults of [detection](detection.md) and [rates](rates.md) have both reactions.

## What is wrong

"not alone" means that other channels were named too, and not listed under the right one later ("explained by",
"affected").
"""

SIZES_INTRODUCTION = f"""# How true the standard deviations are

    python bench/names.py FLIGHTS... --deviations --write

makes this page. Profiles and flights are those of [names](names.md), and kinds with a single healthy flight: there the
profile is that flight's, and faults are put into a faulty flight before its own. Per channel up to {ONSETS} faults of
{LASTS_NS / 1e9:g} s are put in, of two sizes by turns; "recorded" are flights with a fault of known size, of all kinds
of recordings. A cell has the share of errors within two published standard deviations (95 % would be right), their root
mean square in deviations (1 would be right; each counts as at most {LARGEST:g}), and the number of faults or events.
Each fault counts once, however long it lasts. Faults put in are exact and come at once; recorded ones are neither.

Healthy accelerometers x and y have no error, as their estimate is zero until one is held responsible. Known causes:

- A flight tells only within a minute how large its own errors are; until then the fitted flights decide. Of ArduPilot's
  logs the flight left out is four times calmer than they are.
- The size of a GPS step on PX4 wanders with the receiver since its onset.
- The navigation counts no receiver's speed as better than 0.05 m/s; simulated ones are.
- The first size of an accelerometer z on PX4 misses by more than it seems to move.
- A radio's motors differ more from flight to flight than within the one that was fitted.
- North and east of a GPS position share a deviation, but on ArduPilot's simulator one of them errs more than the other.

## Misses

Channels with less than 90 % or more than 98 % over all kinds of recordings:
"""

BY_KIND = f"""A cell has, in this order:

- the delay until the right name, or an alarm that says it is one of two, and the other names raised until
  {AFTERMATH_S:g} s after the end;
- the last size shown during the fault, and its truth;
- the share of estimates, from 5 s after the onset on, with the truth within twice their published standard deviation
  (95 % would be right);
- the time from the fault's end until the last of its alarms had cleared."""


if __name__ == "__main__":
    main()
