"""Alarms become findings with size, certainty and rivals; every channel of a profile is accounted for."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic_run import event, trace

from monitor.estimation.effectiveness import EffectivenessRule
from monitor.event import AlarmEvent
from monitor.profile import Profile
from monitor.trace import Trace
from replay.reports.findings import FIT_FILE, effects, findings, watched_channels
from replay.reports.verdict import alarm_summary

EFFECT = EffectivenessRule(noise=0.01, inflation=1.0, lag_s=0.0, loss_doubt=0.0, offset_doubt=0.0, certainty=5.0)
EVENTS = [
    event(1020, "raised", estimate=-0.03, peak=-0.03, message="begins"),
    event(1100, "updated", estimate=-0.07, peak=-0.07, severity="critical", relative=-0.1, message="largest"),
    event(1200, "updated", estimate=-0.02, peak=-0.07, message="less"),
    event(1300, "cleared", estimate=0.0, peak=-0.07, message="over"),
]


@pytest.fixture
def profile(arm_profile: Profile) -> Profile:
    """Return a profile whose one observer is named as the made-up run's, with an alarm for two of its motors."""
    [observer] = arm_profile.observers
    first, second = observer.alarms
    alarms = (
        replace(first, observer="motors", channel="motor1", unit="N", threshold=0.015),
        replace(second, observer="motors", channel="motor2", unit="N", threshold=0.5),
    )
    return replace(arm_profile, observers=(replace(observer, name="motors", alarms=alarms),))


def run() -> Trace:
    found = trace()
    found.isolated[:] = 0.0
    found.isolated[1020:1200, 0], found.isolated[1100, 1] = -0.05, 0.25
    return found


def test_an_alarm_has_one_size_the_median_while_it_was_active(profile: Profile) -> None:
    [found] = findings(profile, EVENTS, [run()])
    assert (found.largest.message, found.alarm.severity) == ("largest", "critical")
    assert (found.alarm.start_vehicle_ns, found.alarm.end_vehicle_ns) == (10_200_000_000, 13_000_000_000)
    assert (found.size, found.grew) == (pytest.approx(-0.05), False)
    assert found.deviation == pytest.approx(0.002)
    assert found.rival == ("motor2", pytest.approx(0.5))


def test_time_in_which_no_channel_was_responsible_does_not_count_for_the_size(profile: Profile) -> None:
    seldom = run()
    seldom.isolated[1040:, 0] = 1e-15
    [found] = findings(profile, EVENTS, [seldom])
    assert (found.size, found.grew) == (pytest.approx(-0.05), False)


def test_an_alarm_that_grew_has_the_size_that_it_came_to(profile: Profile) -> None:
    growing = run()
    growing.isolated[:, 0] = -0.08 * np.clip((growing.vehicle_ns / 1e9 - 10.2) / 2.8, 0.0, 1.0)
    with_share = [replace(one, relative=(one.estimate or 0.0) / 0.5) for one in EVENTS]
    [found] = findings(profile, with_share, [growing])
    assert (found.size, found.grew) == (pytest.approx(-0.075, abs=0.001), True)
    assert found.relative == pytest.approx(2.0 * (found.size or 0.0))
    assert found.message == "motor1 delivers 15 % less than commanded"


def test_an_alarm_that_stands_at_the_end_has_none(profile: Profile) -> None:
    [found] = findings(profile, EVENTS[:2], [run()])
    assert (found.alarm.end_ns, found.alarm.end_vehicle_ns) == (None, None)


@pytest.mark.parametrize("events", [[event(5, "cleared")], [event(5, "raised", estimate=None, peak=None)]])
def test_an_alarm_without_sizes_or_estimates_is_a_finding_too(profile: Profile, events: list[AlarmEvent]) -> None:
    [found] = findings(profile, events, [])
    assert (found.size, found.deviation, found.rival) == (None, None, None)
    assert found.message == found.largest.message


def test_what_answers_for_an_effect_has_no_standard_deviation(profile: Profile) -> None:
    [observer] = profile.observers
    judged = replace(profile, observers=(replace(observer, effectiveness={"motor1": EFFECT}),))
    assert effects(judged) == {("motors", "motor1"): EFFECT}
    [found] = findings(judged, EVENTS, [run()])
    assert (found.deviation, found.effect) == (None, EFFECT)


def test_a_lost_effect_is_said_as_its_events_say_it_and_its_peak_as_an_estimate(profile: Profile) -> None:
    [observer] = profile.observers
    judged = replace(profile, observers=(replace(observer, effectiveness={"motor1": EFFECT}),))
    shares = [replace(one, relative=share) for one, share in zip(EVENTS, (-0.5, -0.48, -0.52, None), strict=True)]
    [found] = findings(judged, shares, [run()])
    assert found.relative == pytest.approx(-0.5)
    assert found.message == "motor1 delivers 50 % less than commanded"
    assert alarm_summary(found).endswith("(peak -7 % of full thrust)")


def test_every_channel_says_how_quiet_it_was_and_what_its_threshold_rests_on(profile: Profile, tmp_path: Path) -> None:
    said = {"threshold": 0.015, "level": 0.01, "level_low": 0.005, "level_high": 0.02, "healthy_hours": 0.5}
    alarms = {"motor1": said, "motor2": said}
    (tmp_path / FIT_FILE).write_text(json.dumps({"observers": {"motors": {"alarms": alarms}}}))
    found = findings(profile, EVENTS, [run()])
    first, second = watched_channels(profile, tmp_path, [run()], {"motors": 12.0}, found)
    assert (first.alarms, first.watched_s, first.peak) == (1, 12.0, pytest.approx(-0.05))
    assert first.calibration is not None
    assert (first.calibration.level, first.calibration.high, first.calibration.hours) == (0.01, 0.02, 0.5)
    assert [first.size_text(size) for size in (-0.05, 1e-5)] == ["-0.05 N", "0 N"]
    # its threshold is not what the fit had found
    assert (second.alarms, second.calibration) == (0, None)


@pytest.mark.parametrize(
    "content", ["", "[]", '{"observers": {"motors": []}}', '{"observers": {"motors": {"alarms": 1}}}']
)
def test_a_fit_that_cannot_be_read_is_no_calibration(profile: Profile, tmp_path: Path, content: str) -> None:
    (tmp_path / FIT_FILE).write_text(content)
    assert all(one.calibration is None for one in watched_channels(profile, tmp_path, [], {}, []))


def test_what_is_no_number_is_no_peak(profile: Profile, tmp_path: Path) -> None:
    empty = run()
    empty.isolated[:] = np.nan
    assert [one.peak for one in watched_channels(profile, tmp_path, [empty], {}, [])] == [None, None]
