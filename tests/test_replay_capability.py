"""What will be detected: delays measured on healthy flights beforehand are those of real faults later."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from adapters.logs.recordings import packed, read_batches
from adapters.simulation.arm import SCENARIOS, TORQUES, simulate_arm
from adapters.simulation.arm_source import arm_messages
from monitor.fitting.capability import Capability, Detection, capability_text
from monitor.fitting.fitted import BatchSource
from monitor.profile import Profile
from replay.player import play_batches
from replay.sensitivity.capability import measure_capability, step_sizes

LONG = pytest.mark.long

ONSET_S = 112.704
MOTORS = ("motor2", "motor3")


@given(st.floats(1e-6, 1e6))
def test_sizes_to_try_are_round_and_start_about_half_the_threshold(threshold: float) -> None:
    sizes = step_sizes(threshold)
    assert len(sizes) == 12
    assert sizes == tuple(sorted(set(sizes)))
    assert 0.25 * threshold < sizes[0] <= 0.5 * threshold * (1.0 + 1e-6)
    assert sizes[-1] > 20.0 * threshold
    assert all(float(f"{size:.2g}") == size for size in sizes)


def found(
    smallest: tuple[tuple[float, float | None], ...], unit: str = "", detections: tuple[Detection, ...] = ()
) -> Capability:
    tried = detections or (Detection(0.5, None, None, only=True),)
    return Capability("motor1", unit, not unit, smallest, 0.5, tried)


def test_the_text_names_each_size_once_with_its_shortest_delay() -> None:
    assert (
        capability_text(found(((2.0, 0.04), (1.0, 0.04), (0.25, 0.1)))) == "motor1: 4 % within 1 s, 10 % within 0.25 s"
    )
    assert capability_text(found(((2.0, 0.07), (1.0, None), (0.25, None)))) == "motor1: 7 % within 2 s"
    assert (
        capability_text(found(((2.0, 0.3), (0.25, 1.5)), "m/s")) == "motor1: 0.3 m/s within 2 s, 1.5 m/s within 0.25 s"
    )
    none = capability_text(found(((2.0, None), (0.25, None))))
    assert none == "motor1: nothing up to 50 % reliably within 2 s by this observer alone"
    unmeasured = replace(found(((2.0, None),)), detections=())
    assert (
        capability_text(unmeasured) == "motor1: not measured, no healthy stretch in the logs is long and quiet enough"
    )


def measured(profile: Profile, logs: Sequence[BatchSource], channels: Collection[str] = ()) -> dict[str, Capability]:
    observer = profile.observers[0]
    rules = tuple(rule for rule in observer.alarms if not channels or rule.channel in channels)
    alone = replace(profile, observers=(replace(observer, alarms=rules),), excuses=())
    return {one.channel: one for one in measure_capability(alone, logs)}


@pytest.fixture(scope="module")
def logs(data: Path) -> list[BatchSource]:
    return [partial(read_batches, data / f"copter_healthy_{name}.tlog.xz") for name in ("square", "vel_gusty")]


@pytest.fixture(scope="module")
def of_motor(quad_profile: Profile, logs: list[BatchSource]) -> Callable[[str], Capability]:
    """Return what measures a motor of the quadrotor, once."""
    return cache(lambda motor: measured(quad_profile, logs, [motor])[motor])


@pytest.mark.long
def test_small_losses_of_each_motor_are_detected_and_larger_ones_sooner(of_motor: Callable[[str], Capability]) -> None:
    for one in map(of_motor, MOTORS):
        sizes = dict(one.smallest)
        assert list(sizes) == [2.0, 1.0, 0.25]
        assert sizes[2.0] <= sizes[1.0] <= sizes[0.25] <= 0.10
        assert sizes[1.0] <= 0.05
        worst = [d.worst_s for d in one.detections if d.worst_s is not None]
        assert all(later <= sooner + 0.05 for sooner, later in pairwise(worst))
        assert all(d.median_s <= d.worst_s for d in one.detections if d.median_s is not None)
        assert all(d.only for d in one.detections)


@pytest.mark.parametrize(
    ("name", "motor", "loss"),
    [pytest.param("copter_motor3_090", "motor3", 0.10, marks=LONG), ("copter_motor2_080", "motor2", 0.20)],
)
def test_a_real_loss_is_detected_as_soon_as_measured_beforehand(
    name: str, motor: str, loss: float, of_motor: Callable[[str], Capability], quad_profile: Profile, data: Path
) -> None:
    events = play_batches(quad_profile, read_batches(data / f"{name}.tlog.xz")).events
    actual = next(event.vehicle_time_ms / 1000 - ONSET_S for event in events if event.channel == motor)
    smaller = [d.worst_s for d in of_motor(motor).detections if d.worst_s is not None and d.size < loss]
    assert actual == pytest.approx(min(smaller), abs=0.1)


def test_a_flight_too_short_for_an_onset_says_so(quad_profile: Profile, data: Path) -> None:
    found = measured(quad_profile, [partial(read_batches, data / "copter_5s.tlog.xz")])
    assert len(found) == 7
    assert all("not measured" in capability_text(one) for one in found.values())


@pytest.mark.long
def test_faults_that_scale_no_command_worth_losing_are_steps_in_their_own_units(arm_profile: Profile) -> None:
    runs = [simulate_arm(SCENARIOS["healthy"], 30.0, arm_profile.observers[0].rate_hz, torque) for torque in TORQUES]
    found = measured(arm_profile, [lambda run=run: packed(arm_messages(run, 10**18)) for run in runs])
    assert [(one.channel, one.unit, one.loss) for one in found.values()] == [
        ("motor", "N m", False),
        ("encoder", "rad", False),
    ]
    thresholds = {rule.channel: rule.threshold for rule in arm_profile.observers[0].alarms}
    for one in found.values():
        within_a_second = dict(one.smallest)[1.0]
        assert within_a_second is not None
        assert 0.5 * thresholds[one.channel] < within_a_second < 3.0 * thresholds[one.channel]
