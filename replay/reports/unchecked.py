"""Everything that a run could not check, and why: without it, no alarm would look like no fault."""

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

from adapters.logs.damage import Damage
from monitor.estimation.isolation_rule import BankRule
from monitor.profile import ObserverProfile, Profile
from monitor.sampling.slow_telemetry import spanned, unfitted
from replay.player import Replay, Watch
from replay.reports.findings import Finding
from replay.reports.recording_facts import RecordingFacts

_FOREIGN = "other systems or components sent them; one vehicle is watched"
_MOST_GAPS_NAMED = 5
"""Gaps that are named. Chosen: they fit in a sentence."""


class Unchecked(NamedTuple):
    """Something that was not checked, and why."""

    what: str
    why: str


def unchecked(
    profile: Profile,
    replay: Replay,
    facts: RecordingFacts,
    found: Sequence[Finding],
    damage: Sequence[Damage] = (),
) -> list[Unchecked]:
    """Return what a run could not check, the gravest first, from the recording (facts, damage) and the results."""
    return [
        *([Unchecked("all results", replay.mismatch)] if replay.mismatch else []),
        *(Unchecked(f"{seconds:.0f} s in flight", why) for why, seconds in replay.unwatched(facts.last_ns or 0)),
        *(Unchecked(f"{name}: {seconds:.0f} s", far) for name, (seconds, far) in replay.outside.items()),
        *(Unchecked(f"the unreadable part of {part.file}", "; ".join(part.found)) for part in damage),
        *(gap for observer in profile.observers for gap in _observer(profile, observer, replay, facts)),
        *(gap for observer in profile.observers for gap in _bridged(observer, replay.watches[observer.name])),
        *(gap for observer in profile.observers for gap in _interpolated(observer, facts)),
        *_gaps(facts),
        *(gap for observer in profile.observers for gap in _without_alarm(observer)),
        *(gap for observer in profile.observers for gap in _together(observer)),
        *_excused(profile, found),
        *([Unchecked(f"{replay.foreign} messages", _FOREIGN)] if replay.foreign else []),
        Unchecked(
            "faults of any other kind, and smaller ones",
            "only the channels of the profile are watched, each from its threshold on",
        ),
    ]


def _observer(
    profile: Profile, observer: ObserverProfile, replay: Replay, facts: RecordingFacts
) -> Iterator[Unchecked]:
    """Report an observer that watched nothing, or only part of the time."""
    watch, channels = replay.watches[observer.name], _and([rule.channel for rule in observer.alarms])
    if lacks := replay.lacking.get(observer.name):
        yield Unchecked(f"{observer.name} ({channels})", f"the recording has no {_and(lacks)}")
    elif not watch.samples:
        statistics = watch.sampling
        reasons = [f"{statistics.messages} messages came"]
        if statistics.invalid:
            reasons.append(f"{statistics.invalid} values in them are missing or no numbers")
        if statistics.untimed:
            reasons.append(f"{statistics.untimed} have no usable time stamp")
        yield Unchecked(f"{observer.name} ({channels})", f"no sample could be made of them: {'; '.join(reasons)}")
    elif found := unfitted(observer.source, observer.rate_hz, facts.rates):
        yield Unchecked(f"{observer.name} ({channels})", f"messages come too seldom for this profile: {found}")
    elif not watch.evidence:
        yield Unchecked(
            f"{observer.name} ({channels})", f"the vehicle was never seen {_phase(profile)} for long enough"
        )
    else:
        rest_s = (watch.samples - watch.evidence) / watch.rate_hz
        if rest_s >= 1.0:
            yield Unchecked(
                f"{observer.name}: {rest_s:.0f} s of {watch.samples / watch.rate_hz:.0f} s",
                f"the vehicle was not {_phase(profile)}, the observer settled, or measurements were lost",
            )


def _phase(profile: Profile) -> str:
    wanted = ["armed"] * profile.gate.require_armed + ["in the air"] * profile.gate.require_airborne
    return _and(wanted) or "sampled"


def _bridged(observer: ObserverProfile, watch: Watch) -> Iterator[Unchecked]:
    """Report where measurements were lost."""
    if watch.coasted:
        share = 100.0 * watch.coasted / watch.samples
        yield Unchecked(
            f"{observer.name}: {watch.coasted / watch.rate_hz:.1f} s ({share:.2f} % of its samples)",
            "measurements were lost; the observer coasted on its model and raised nothing",
        )
    if watch.sampling.skipped:
        yield Unchecked(
            f"{observer.name}: {watch.sampling.skipped / watch.rate_hz:.1f} s inside gaps",
            f"too long to bridge: the observer restarted {watch.sampling.restarts} times, its first start included",
        )
    if watch.sampling.clock_restarts:
        yield Unchecked(
            f"{observer.name}: around {watch.sampling.clock_restarts} jumps of the vehicle's clock",
            "the vehicle rebooted or changed its clock; earlier estimates were dropped",
        )


def _interpolated(observer: ObserverProfile, facts: RecordingFacts) -> Iterator[Unchecked]:
    """Report messages that come much more rarely than the observer samples."""
    rates = facts.rates
    spans = spanned(observer.source, observer.rate_hz, rates)
    if spans and not unfitted(observer.source, observer.rate_hz, rates):
        seldom = _and([f"{name} {rates[name]:.3g} times a second" for name in spans])
        most = max(spans.values())
        yield Unchecked(
            f"{observer.name}: what happened between messages",
            f"{seldom} came for {observer.rate_hz:g} samples a second: samples are interpolated over up to {most:.0f} "
            "periods, and faults show later, weaker or not at all",
        )


def _gaps(facts: RecordingFacts) -> Iterator[Unchecked]:
    """Report the gaps of messages, the longest first."""
    gaps = [(gap.seconds, stream.name) for stream in facts.streams for gap in stream.gaps]
    gaps.sort(reverse=True)
    if gaps:
        longest = _and([f"{name} {seconds:.1f} s" for seconds, name in gaps[:_MOST_GAPS_NAMED]])
        more = f", and {len(gaps) - _MOST_GAPS_NAMED} shorter ones" if len(gaps) > _MOST_GAPS_NAMED else ""
        yield Unchecked("what happened inside gaps of the recording", f"nothing came: {longest}{more}")


def _without_alarm(observer: ObserverProfile) -> Iterator[Unchecked]:
    watched = {rule.channel for rule in observer.alarms}
    silent = [fault.name for fault in observer.faults if fault.name not in watched]
    if silent:
        yield Unchecked(f"{observer.name}: {_and(silent)}", "estimated, but the profile has no alarm for them")


def _together(observer: ObserverProfile) -> Iterator[Unchecked]:
    """Report the faults that can be isolated only one at a time."""
    names = [fault.name for fault in observer.faults]
    rule = observer.isolation
    for group in _exclusive(names, rule.hypotheses) if isinstance(rule, BankRule) else ():
        yield Unchecked(
            f"{observer.name}: several at once of {_and(group)}",
            "these measurements tell them apart only one at a time; several at once are put down to the one that "
            "explains most, or to none",
        )


def _exclusive(names: Sequence[str], hypotheses: Sequence[Sequence[str]]) -> list[list[str]]:
    """Return groups of faults, linked by pairs that no hypothesis contains."""
    groups: list[set[str]] = []
    for pair in combinations(names, 2):
        if any(set(pair).issubset(hypothesis) for hypothesis in hypotheses):
            continue
        touched = [group for group in groups if group & set(pair)]
        groups = [group for group in groups if group not in touched] + [set(pair).union(*touched)]
    return [[name for name in names if name in group] for group in groups]


def _excused(profile: Profile, found: Sequence[Finding]) -> Iterator[Unchecked]:
    """Report the channels whose evidence was excused by another alarm."""
    raised = {finding.alarm.channel for finding in found}
    for rule in profile.excuses:
        causes = [name for name in rule.by if name in raised]
        if causes:
            yield Unchecked(
                f"{_and(rule.channels)} while {_and(causes)} had an alarm, and {rule.for_s:g} s after",
                "the profile assigns their evidence to that alarm meanwhile",
            )


def _and(names: Sequence[str]) -> str:
    names = list(names)
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}" if names else ""
