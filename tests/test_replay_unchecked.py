"""What a run could not check is said with its reason, and nothing else is."""

from __future__ import annotations

from dataclasses import replace

import pytest
from synthetic_run import event

from adapters.logs.damage import Damage
from adapters.simulation.arm import SCENARIOS, simulate_arm
from adapters.simulation.arm_source import arm_messages
from adapters.source import MAVLINK, ZENOH
from monitor.alarms.excuse import ExcuseRule
from monitor.profile import Profile
from replay.player import Replay, play
from replay.reports.findings import findings
from replay.reports.recording_facts import Gap, RecordingFacts, StreamFacts
from replay.reports.unchecked import _exclusive, unchecked

NOTHING = RecordingFacts(None, None, ())


@pytest.fixture(scope="module")
def replay(arm_profile: Profile) -> Replay:
    return play(arm_profile, arm_messages(simulate_arm(SCENARIOS["healthy"], 12.4, 100.0, "zero"), 10**18))


def told(
    profile: Profile, replay: Replay, facts: RecordingFacts = NOTHING, damage: tuple[Damage, ...] = ()
) -> dict[str, str]:
    return dict(unchecked(profile, replay, facts, findings(profile, replay.events, ()), damage))


def test_what_could_not_be_read_comes_first(arm_profile: Profile, replay: Replay) -> None:
    damage = (Damage("flight.tlog", ("1 damaged place, 9 bytes unreadable", "breaks off at its end")),)
    first = next(iter(told(arm_profile, replay, damage=damage).items()))
    assert first == (
        "the unreadable part of flight.tlog",
        "1 damaged place, 9 bytes unreadable; breaks off at its end",
    )


def changed(replay: Replay, **changes: object) -> Replay:
    """Return a run whose one observer fared otherwise."""
    [(name, watch)] = replay.watches.items()
    return replace(replay, watches={name: replace(watch, **changes)})


def test_a_clean_run_leaves_out_only_what_no_run_checks(arm_profile: Profile, replay: Replay) -> None:
    [(_, watch)] = replay.watches.items()
    clean = replace(changed(replay, evidence=watch.samples), foreign=0)
    assert list(told(arm_profile, clean)) == ["faults of any other kind, and smaller ones"]


def test_time_that_was_not_watched_is_told(arm_profile: Profile, replay: Replay) -> None:
    assert any(what.endswith(" s of 12 s") for what in told(arm_profile, replay))


def test_an_observer_that_saw_nothing_says_why(arm_profile: Profile, replay: Replay) -> None:
    [observer] = arm_profile.observers
    [(_, watch)] = replay.watches.items()
    key = f"{observer.name} ({' and '.join(rule.channel for rule in observer.alarms)})"
    lacking = replace(replay, lacking={observer.name: ("ATTITUDE", "VFR_HUD")})
    assert told(arm_profile, lacking)[key] == "the recording has no ATTITUDE and VFR_HUD"
    sampling = replace(watch.sampling, messages=7, invalid=3, untimed=2)
    blind = changed(replay, samples=0, evidence=0, sampling=sampling)
    assert told(arm_profile, blind)[key] == (
        "no sample could be made of them: 7 messages came; 3 values in them are missing or no numbers; "
        "2 have no usable time stamp"
    )
    grounded = changed(replay, evidence=0)
    flying = replace(arm_profile, gate=replace(arm_profile.gate, require_armed=True, require_airborne=True))
    assert told(flying, grounded)[key] == "the vehicle was never seen armed and in the air for long enough"


def test_messages_that_come_much_more_seldom_than_samples_are_told(arm_profile: Profile, replay: Replay) -> None:
    [observer] = arm_profile.observers
    [name] = {channel.message for channel in observer.source.channels}

    def said(rate_hz: float) -> dict[str, str]:
        return told(arm_profile, replay, RecordingFacts(0, 1, (StreamFacts(ZENOH, name, 0, 0, 9, rate_hz, ()),)))

    assert said(4.0)[f"{observer.name}: what happened between messages"] == (
        f"{name} 4 times a second came for 100 samples a second: samples are interpolated over up to 25 periods, "
        "and faults show later, weaker or not at all"
    )
    assert not any("between messages" in what for what in said(50.0))


def test_lost_measurements_gaps_and_jumps_of_the_clock_are_told(arm_profile: Profile, replay: Replay) -> None:
    [(name, watch)] = replay.watches.items()
    sampling = replace(watch.sampling, skipped=250, restarts=3, clock_restarts=1)
    stream = StreamFacts(MAVLINK, "ATTITUDE", 1, 1, 9, 10.0, tuple(Gap(0, 1.0 + k) for k in range(7)))
    said = told(arm_profile, changed(replay, coasted=50, sampling=sampling), RecordingFacts(0, 1, (stream,)))
    assert f"{name}: 2.5 s inside gaps" in said
    assert any(what.startswith(f"{name}: 0.5 s (") for what in said)
    assert any("1 jumps" in what for what in said)
    assert said["what happened inside gaps of the recording"] == (
        "nothing came: ATTITUDE 7.0 s, ATTITUDE 6.0 s, ATTITUDE 5.0 s, ATTITUDE 4.0 s and ATTITUDE 3.0 s, "
        "and 2 shorter ones"
    )


def test_channels_without_an_alarm_and_excused_ones_and_foreign_messages_are_told(
    arm_profile: Profile, replay: Replay
) -> None:
    [observer] = arm_profile.observers
    first, second = (rule.channel for rule in observer.alarms)
    silent = replace(arm_profile, observers=(replace(observer, alarms=observer.alarms[:1]),))
    assert f"{observer.name}: {second}" in told(silent, replay)
    excusing = replace(arm_profile, excuses=(ExcuseRule((second,), (first,), 5.0),))
    raised = replace(replay, events=(event(10, "raised", observer=observer.name, channel=first),), foreign=4)
    said = told(excusing, raised)
    assert f"{second} while {first} had an alarm, and 5 s after" in said
    assert "4 messages" in said
    assert not any("while" in what for what in told(excusing, replay))


def test_faults_that_no_hypothesis_names_together_form_groups() -> None:
    names = ["a", "b", "c", "d"]
    assert _exclusive(names, [{"a"}, {"b"}, {"c"}, {"d"}]) == [names]
    assert _exclusive(names, [{"a", "b", "c"}, {"a", "b", "d"}]) == [["c", "d"]]
    assert _exclusive(names, [set(names)]) == []
