"""Lost measurements: short losses are coasted, long ones stop the observer, and neither raises a false alarm."""

import random
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from adapters.logs.recordings import packed, read_recording
from adapters.message import Message
from adapters.simulation.arm import SCENARIOS, simulate_arm
from adapters.simulation.arm_source import arm_messages
from monitor.estimate import Estimates
from monitor.event import AlarmEvent
from monitor.pipeline import Pipeline
from monitor.profile import Profile
from replay.player import play

ONSET_MS = 112_704
"""Onset of the motors' losses of the excerpts."""
TELEMETRY = ("ATTITUDE", "HIGHRES_IMU", "SERVO_OUTPUT_RAW")


def without(messages: Iterable[Message], start_s: float, length_s: float) -> list[Message]:
    """Return messages without those of a stretch, seconds after the first."""
    kept = list(messages)
    start = kept[0].received_ns + round(start_s * 1e9)
    return [m for m in kept if not start <= m.received_ns < start + round(length_s * 1e9)]


def with_bursts_lost(messages: Iterable[Message], length_s: float, seed: int) -> list[Message]:
    """Return messages without bursts, about one and a half a second."""
    rng, kept = random.Random(seed), []
    until = following = 0
    for message in messages:
        following = following or message.received_ns
        if message.received_ns >= following:
            until = message.received_ns + round(length_s * 1e9)
            following = until + round((0.2 + rng.expovariate(2.0)) * 1e9)
        if message.received_ns >= until or message.name not in TELEMETRY:
            kept.append(message)
    return kept


def alarms(profile: Profile, messages: list[Message]) -> list[AlarmEvent]:
    """Return the alarms of a run, but for those that say what is not watched: that is true of gaps."""
    return [event for event in play(profile, messages).events if event.kind not in ("stale", "blind")]


@pytest.mark.parametrize("first", [0, *(pytest.param(k, marks=pytest.mark.long) for k in range(1, 8))])
def test_a_gap_anywhere_in_the_arms_motion_raises_no_alarm(arm_profile: Profile, first: int) -> None:
    run = simulate_arm(SCENARIOS["healthy"], 28.0, 100.0, "tracking")
    messages = list(arm_messages(run, 10**18))
    for k in range(first, 21, 8):
        cut = without(messages, 2.0 + 0.7 * k, 0.3 + 0.4 * (k % 6))
        assert alarms(arm_profile, cut) == [], k


def test_a_fault_that_comes_after_the_arm_is_armed_again_is_found(arm_profile: Profile) -> None:
    run = simulate_arm(SCENARIOS["case2"], 25.0, 100.0)
    found = alarms(arm_profile, without(arm_messages(run, 10**18), 0.5, 0.5))
    assert (found[0].channel, found[0].state) == ("motor", "raised")
    assert 10_000 <= found[0].vehicle_time_ms < 10_500


@pytest.fixture(scope="module")
def gusty(data: Path) -> list[Message]:
    messages = [m for m in read_recording(data / "copter_healthy_vel_gusty.tlog.xz") if m.system == 1]
    return [m for m in messages if m.received_ns < messages[0].received_ns + 25_000_000_000]


def estimates(profile: Profile, messages: list[Message]) -> list[Estimates]:
    pipeline = Pipeline(profile)
    outputs = [output for batch in packed(messages) for output in pipeline.run(batch)]
    return [output for output in outputs if isinstance(output, Estimates) and output.observer == "motors"]


@pytest.mark.parametrize("seed", [0, 1])
def test_bursts_on_a_healthy_flight_are_coasted_closer_than_a_straight_line_and_raise_nothing(
    quad_profile: Profile, gusty: list[Message], seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = play(quad_profile, gusty, keep_traces=True).traces[0]
    errors = []
    for first in (3, 1_000_000):
        monkeypatch.setattr("monitor.core.sampling.LINE_PERIODS", first)
        found = play(quad_profile, with_bursts_lost(gusty, 0.08, seed), keep_traces=True)
        if first == 3:
            assert found.events == ()
        trace = found.traces[0]
        _, i, j = np.intersect1d(whole.vehicle_ns, trace.vehicle_ns, return_indices=True)
        i, j = i[whole.armed[i]], j[whole.armed[i]]
        errors.append(np.sqrt(np.mean((trace.fault[j] - whole.fault[i])[:, :4] ** 2)))
    assert errors[0] < 0.6 * errors[1]


@pytest.mark.parametrize(("name", "motor"), [("copter_motor3_090", "motor3"), ("copter_motor2_080", "motor2")])
def test_a_failing_motor_is_named_through_bursts_within_a_third_of_a_second(
    quad_profile: Profile, data: Path, name: str, motor: str
) -> None:
    messages = [m for m in read_recording(data / f"{name}.tlog.xz") if m.system == 1]
    first, *_ = alarms(quad_profile, with_bursts_lost(messages, 0.08, 1))
    assert first.channel == motor
    assert ONSET_MS <= first.vehicle_time_ms <= ONSET_MS + 333


def test_what_is_shown_while_coasting_says_so(quad_profile: Profile, gusty: list[Message]) -> None:
    parts, whole = (estimates(quad_profile, messages) for messages in (without(gusty, 12.0, 0.08), gusty))
    sd, coasted_s = (np.concatenate([getattr(part, name) for part in parts]) for name in ("sd", "coasted_s"))
    armed = np.concatenate([part.armed for part in parts])
    coasted = np.flatnonzero(~np.concatenate([part.samples.measured for part in parts]))
    assert 5 <= len(coasted) <= 10
    assert coasted.tolist() == list(range(coasted[0], coasted[-1] + 1))
    before, after = coasted[0] - 1, coasted[-1] + 400
    assert coasted_s[before] == coasted_s[after] == 0.0
    assert coasted_s[coasted] == pytest.approx(0.01 * np.arange(1, len(coasted) + 1))
    assert not armed[coasted].any()
    assert np.all(np.diff(sd[coasted], axis=0) > 0.0)
    assert np.all(sd[coasted[-1]] > 2.0 * sd[before])
    # the flight's own errors go on without a trace of the gap
    assert sd[after] == pytest.approx(np.concatenate([part.sd for part in whole])[after], rel=0.1)
