"""Which samples are evidence for the effectiveness estimators, and what is known in between."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from cuts import cuts, same_bits
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from adapters.sample import Samples
from monitor.chain import EffectivenessStage
from monitor.estimation.effectiveness import EffectivenessRule
from monitor.profile import FaultChannel

Array = NDArray[np.float64]
RULE = EffectivenessRule(
    noise=0.01, inflation=1.0, lag_s=0.0, loss_doubt=0.0, offset_doubt=0.0, certainty=5.0, full="speed"
)
FAULTS = (
    FaultChannel("gyro", "sensor", "rad/s", None),
    FaultChannel("throttle", "actuator", "", 1),
    FaultChannel("steering", "actuator", "", 0),
)
INPUTS, OUTPUTS = ("steering", "throttle", "speed"), ("yaw_rate",)
REACHED = {"throttle": 0.41, "yaw_rate": 1.0}
STEERING = 2
STEP_NS = 20_000_000


class Clocked:
    """A stage and the time of its next sample."""

    def __init__(self) -> None:
        self.stage = EffectivenessStage({"steering": RULE}, FAULTS, INPUTS, OUTPUTS, 50.0)
        self.now_ns = 0

        self.sizes: dict[int, float] = {}


class Verdict(NamedTuple):
    """Loss and evidence after a sample."""

    loss: float
    evidence: float


def feed(
    one: Clocked,
    count: int,
    *,
    command: float = 0.3,
    loss: float = 0.0,
    speed: float = 1.0,
    armed: bool = True,
    restart: bool = False,
) -> Verdict | None:
    """Feed samples, the first marked ``restart``; return the steering's verdict after the last, None where none."""
    rows = np.arange(count)
    times_ns = one.now_ns + STEP_NS * rows
    one.now_ns += STEP_NS * count
    flags = np.ones(count, np.bool_)
    u, fault = np.tile([command, 0.5, speed], (count, 1)), np.tile([9.0, 9.0, -loss * command], (count, 1))
    y, none = np.zeros((count, 1)), np.zeros((count, 4), np.bool_)
    samples = Samples(rows, times_ns, times_ns, u, y, restart & (rows == 0), flags, times_ns, flags, none)
    runs = one.stage.run(samples, fault, armed & flags)
    assert set(runs) == {STEERING}
    run = runs[STEERING]
    one.sizes = {STEERING: float(run.size[-1])}
    return None if np.isnan(run.loss[-1]) else Verdict(float(run.loss[-1]), float(run.evidence[-1]))


def test_only_faults_with_a_rule_are_judged() -> None:
    one = Clocked()
    assert feed(one, 50, loss=0.5) is not None
    assert set(one.sizes) == {STEERING}
    assert one.sizes[STEERING] < -0.05


def test_the_effect_of_a_full_deflection_is_an_input() -> None:
    slow, fast = Clocked(), Clocked()
    feed(slow, 50, loss=0.5)
    feed(fast, 50, loss=0.5, speed=2.0)
    assert np.isclose(slow.sizes[STEERING], 2.0 * fast.sizes[STEERING])


def test_a_bridged_sample_is_no_evidence_but_costs_nothing_that_was_learned() -> None:
    one = Clocked()
    feed(one, 50, loss=0.5)
    assert feed(one, 2, loss=-9.0, armed=False) is None
    after = feed(one, 1, loss=0.5)
    assert after is not None
    assert np.isclose(after.loss, 0.5)
    assert after.evidence


def test_after_a_long_time_without_evidence_all_begins_anew() -> None:
    one = Clocked()
    feed(one, 50, loss=0.5)
    feed(one, 60, loss=0.5, armed=False)
    assert one.sizes[STEERING] == 0.0
    after = feed(one, 1)
    assert after is not None
    assert after.loss == 0.0


def test_a_restart_forgets() -> None:
    one = Clocked()
    feed(one, 50, loss=0.5)
    after = feed(one, 1, restart=True)
    assert after is not None
    assert after.loss == 0.0


def test_an_accusation_that_cannot_be_confirmed_keeps_its_size() -> None:
    one = Clocked()
    feed(one, 50, loss=0.5)
    held = []
    for _ in range(150):
        verdict = feed(one, 1, command=0.0)
        assert verdict is not None
        held.append((verdict.evidence, one.sizes[STEERING]))
    assert all(size != 0.0 for evidence, size in held if np.isnan(evidence))


@pytest.mark.parametrize(("command", "yaw_rate", "seen"), [(0.3, 1.0, True), (3.0, 0.0, False), (0.3, 3.0, False)])
def test_beyond_what_the_fitted_flights_reached_errors_of_the_model_are_larger(
    command: float, yaw_rate: float, seen: bool
) -> None:
    rule = replace(RULE, loss_doubt=0.02)
    stage = EffectivenessStage({"steering": rule}, FAULTS, INPUTS, OUTPUTS, 50.0, {"steering": 0.5, "yaw_rate": 1.0})
    samples, fault, armed = driven(0)
    samples.u[:] = command, 0.5, 1.0
    samples.y[:], fault[:] = yaw_rate, -0.2 * command
    assert bool(stage.run(samples, fault, armed)[STEERING].size[-1]) is seen


def test_absurd_numbers_from_a_network_are_no_evidence() -> None:
    one = Clocked()
    feed(one, 50, loss=0.5)
    for absurd in (1e200, float("inf"), float("nan"), -1e7):
        assert feed(one, 1, command=absurd) is None
        assert feed(one, 1, speed=absurd) is None
    assert feed(one, 50, loss=0.5) is not None
    assert one.sizes[STEERING] < -0.05


LONG = 420
MANY = {
    "steering": replace(RULE, lag_s=0.05, loss_doubt=0.02, offset_doubt=0.004, inflation=2.0, misfit=1.2),
    "throttle": EffectivenessRule(0.02, 1.5, 0.0, 0.05, 0.0, 4.0, memories_s=(0.2, 0.8, 3.0), hold_s=1.0),
}


def driven(seed: int) -> tuple[Samples, Array, NDArray[np.bool_]]:
    """Return samples with commands that come and go, estimates of losses and offsets likewise, and what is evidence."""
    rng, k = np.random.default_rng(seed), np.arange(LONG)
    phases = rng.integers(0, 3, 12)[k * 12 // LONG]
    command = np.where(phases[:, None] > 0, 0.4 * np.sign(np.sin(k[:, None] / rng.uniform(5.0, 60.0, 2))), 0.0)
    u = np.column_stack([command, 1.0 + 0.2 * np.sin(k / 30.0)])
    u[:, :2] += rng.normal(scale=0.01, size=(LONG, 2))
    faulty = rng.integers(0, 2, 6)[k * 6 // LONG]
    lost, offset = rng.uniform(0.0, 1.0, 2), rng.choice([0.0, 0.1, -0.3], 2)
    fault = np.zeros((LONG, 3))
    fault[:, [2, 1]] = faulty[:, None] * (-lost * u[:, :2] + offset) + rng.normal(scale=0.01, size=(LONG, 2))
    time_ns = k * STEP_NS + 10**9
    none = np.zeros((LONG, 4), np.bool_)
    samples = Samples(k, time_ns, time_ns, u, np.zeros((LONG, 1)), k == 0, k >= 0, time_ns, k >= 0, none)
    return samples, fault, rng.random(LONG) < 0.97


@given(
    parts=cuts(LONG),
    seed=st.integers(0, 10**6),
    restarts=st.lists(st.integers(0, LONG - 1), max_size=2),
    disarmed=st.lists(st.tuples(st.integers(0, LONG - 1), st.integers(1, 120)), max_size=2),
    jump=st.tuples(st.integers(0, LONG), st.sampled_from([0, 10**8, 10**10, -(10**8)])),
    odd=st.lists(
        st.tuples(
            st.integers(0, LONG - 1),
            st.integers(0, 2),
            st.sampled_from([0.0, -0.0, np.nan, np.inf, 1e7, 9e5, 1e-300]),
        ),
        max_size=4,
    ),
)
def test_cuts_do_not_change_a_bit(
    parts: list[slice],
    seed: int,
    restarts: list[int],
    disarmed: list[tuple[int, int]],
    jump: tuple[int, int],
    odd: list[tuple[int, int, float]],
) -> None:
    samples, fault, armed = driven(seed)
    samples.restart[restarts] = True
    for start, length in disarmed:
        armed[start : start + length] = False
    samples.vehicle_time_ns[jump[0] :] += jump[1]
    for row, column, value in odd:
        (samples.u if seed % 2 else fault)[row, column] = value
    one, other = (EffectivenessStage(MANY, FAULTS, INPUTS, OUTPUTS, 50.0, REACHED) for _ in range(2))
    whole = one.run(samples, fault, armed)
    runs = [other.run(samples.part(part.start, part.stop), fault[part], armed[part]) for part in parts]
    for index, expected in whole.items():
        cut = np.hstack([np.stack(run[index]) for run in runs])
        assert same_bits(cut, np.stack(expected))


def test_the_samples_of_that_comparison_accuse_contradict_and_hold() -> None:
    seen = {"accused": 0, "unknown": 0, "dropped": 0}
    for seed in range(8):
        samples, fault, armed = driven(seed)
        stage = EffectivenessStage(MANY, FAULTS, INPUTS, OUTPUTS, 50.0, REACHED)
        for one in stage.run(samples, fault, armed).values():
            accused = ~np.isnan(one.evidence) & (one.evidence != 0.0)
            seen["accused"] += int(np.sum(accused))
            seen["unknown"] += int(np.sum(np.isnan(one.evidence[armed])))
            seen["dropped"] += int(np.sum(accused[:-1] & (one.evidence[1:] == 0.0)))
    assert min(seen.values()) > 5
