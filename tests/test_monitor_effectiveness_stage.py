"""Which samples the effectiveness estimators hear, and what is known in between."""

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from stretches import bits, partitions

from adapters.sample import Sample, Samples
from monitor.effectiveness_stage import EffectivenessStage
from monitor.estimation.effectiveness import Effectiveness, EffectivenessRule
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
STEERING = 2
STEP_NS = 20_000_000


class Clocked:
    """A stage and the time of its next sample."""

    def __init__(self) -> None:
        self.stage = EffectivenessStage({"steering": RULE}, FAULTS, ("steering", "throttle", "speed"), 50.0)
        self.now_ns = 0

    @property
    def sizes(self) -> dict[int, float]:
        return self.stage.sizes


def feed(
    one: Clocked,
    count: int,
    *,
    command: float = 0.3,
    loss: float = 0.0,
    speed: float = 1.0,
    armed: bool = True,
    restart: bool = False,
) -> Effectiveness | None:
    """Feed samples, the first marked ``restart``; return what is known of the steering after the last."""
    found: dict[int, Effectiveness] = {}
    for k in range(count):
        u = np.array([command, 0.5, speed])
        sample = Sample(k, one.now_ns, one.now_ns, u, np.zeros(1), restart and k == 0, True)
        one.now_ns += STEP_NS
        found = one.stage.judge(sample, np.array([9.0, 9.0, -loss * command]), armed)
        assert set(found) <= {STEERING}
    return found.get(STEERING)


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


def test_a_bridged_sample_is_not_heard_but_costs_nothing_that_was_learned() -> None:
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
    assert all(size != 0.0 for evidence, size in held if evidence is None)


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
    "steering": replace(RULE, lag_s=0.05, loss_doubt=0.02, offset_doubt=0.004, inflation=2.0),
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
    samples = Samples(k, time_ns, time_ns, u, np.zeros((LONG, 1)), k == 0, k >= 0, time_ns, np.ones(LONG, np.bool_))
    return samples, fault, rng.random(LONG) < 0.97


@settings(max_examples=60, deadline=None)
@given(
    parts=partitions(LONG),
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
def test_stretches_and_single_samples_mix_to_the_bit(
    parts: list[tuple[int, int, bool]],
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
    one, other = (EffectivenessStage(MANY, FAULTS, ("steering", "throttle", "speed"), 50.0) for _ in range(2))
    expected = singly(one, samples, fault, armed)
    found = []
    for start, stop, by_one in parts:
        part = samples.part(start, stop), fault[start:stop], armed[start:stop]
        found += singly(other, *part) if by_one else at_once(other, *part)
    different = [row for row, (a, b) in enumerate(zip(found, expected, strict=True)) if a != b]
    assert not different[:1]
    assert one.sizes == other.sizes


def singly(stage: EffectivenessStage, samples: Samples, fault: Array, armed: NDArray[np.bool_]) -> list[bytes]:
    """Return evidence, share and size of each fault after each sample, one by one."""
    rows = []
    for row in range(len(samples)):
        found = stage.judge(samples.one(row), fault[row], bool(armed[row]))
        said = [(v.evidence, v.share) if (v := found.get(index)) else (None, None) for index in stage.sizes]
        rows.append(bits([x for pair, size in zip(said, stage.sizes.values(), strict=True) for x in (*pair, size)]))
    return rows


def at_once(stage: EffectivenessStage, samples: Samples, fault: Array, armed: NDArray[np.bool_]) -> list[bytes]:
    found = stage.run(samples, fault, armed)
    assert list(found) == list(stage.sizes)
    columns = [column for one in found.values() for column in (one.evidence, one.share, one.size)]
    return [bits(row) for row in np.column_stack(columns)]


def test_the_samples_of_that_comparison_accuse_contradict_and_hold() -> None:
    seen = {"accused": 0, "unknown": 0, "dropped": 0}
    for seed in range(8):
        samples, fault, armed = driven(seed)
        stage = EffectivenessStage(MANY, FAULTS, ("steering", "throttle", "speed"), 50.0)
        for one in stage.run(samples, fault, armed).values():
            accused = ~np.isnan(one.evidence) & (one.evidence != 0.0)
            seen["accused"] += int(np.sum(accused))
            seen["unknown"] += int(np.sum(np.isnan(one.evidence[armed])))
            seen["dropped"] += int(np.sum(accused[:-1] & (one.evidence[1:] == 0.0)))
    assert min(seen.values()) > 5
