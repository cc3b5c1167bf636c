"""A recording played through a profile: how long it was watched, and thresholds that tell observers apart."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import fauio
from adapters.logs.mcap_log import MessageLogWriter
from adapters.simulation.arm import SCENARIOS, simulate_arm
from adapters.simulation.arm_source import arm_messages
from monitor.profile import Profile
from replay.player import play

DURATION_S = 12.4


@pytest.fixture
def two_observers(arm_profile: Profile) -> Profile:
    """Return the arm's profile with its observer a second time, under another name and with other thresholds."""
    [observer] = arm_profile.observers
    rules = tuple(replace(rule, observer="second", threshold=2.0 * rule.threshold) for rule in observer.alarms)
    return replace(arm_profile, observers=(observer, replace(observer, name="second", alarms=rules)))


def test_observers_of_one_flight_watch_it_once(arm_profile: Profile, two_observers: Profile) -> None:
    run = simulate_arm(SCENARIOS["healthy"], DURATION_S, 100.0, "zero")
    one, both = (play(profile, arm_messages(run, 10**18)) for profile in (arm_profile, two_observers))
    assert both.evidence == 2 * one.evidence
    assert both.watched_s == one.watched_s == one.evidence / arm_profile.observers[0].rate_hz


def test_channels_of_one_name_keep_the_threshold_of_their_observer(two_observers: Profile) -> None:
    first, second = two_observers.observers
    thresholds = play(two_observers, []).thresholds
    assert len(thresholds) == 2 * len(first.alarms)
    for rule in first.alarms:
        assert thresholds["second", rule.channel] == 2.0 * thresholds[first.name, rule.channel] == 2.0 * rule.threshold
    assert second.alarms


def test_a_replay_says_so_where_nothing_was_raised(
    arm_profile: Profile, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, log = tmp_path / "arm", tmp_path / "arm.mcap"
    folder.mkdir()
    for name, content in arm_profile.files.items():
        (folder / name).write_bytes(content)
    with MessageLogWriter(log) as writer:
        for message in arm_messages(simulate_arm(SCENARIOS["healthy"], DURATION_S, 100.0, "zero"), 10**18):
            writer.write(message)
    assert fauio.main(["replay", str(folder), str(log), "--plot", str(tmp_path / "arm.png")]) == 0
    assert "arm.mcap: no alarm in 5 s of watched flight" in capsys.readouterr().out
    assert (tmp_path / "arm.png").stat().st_size > 0
