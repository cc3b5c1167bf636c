"""Estimators over stretches: every bit and all memory as if the samples had come one by one."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adapters.sample import Samples
from gains.analysis.estimability import restricted
from gains.plants.plant import Disturbance, Fault, Noise, Plant
from gains.synthesis.bank import Hypothesis, compile_bank
from gains.synthesis.convex import design_convex
from gains.synthesis.gains_file import Gains
from monitor.estimation.bank import Bank
from monitor.estimation.estimator import Estimator, JointEstimator, make_estimator
from monitor.estimation.estimator_run import EstimatorRun, pieces
from monitor.estimation.isolation_rule import BankRule, IndependentRule, SingleRule

NAMES = ("left", "right", "gyro")
THRESHOLDS = dict.fromkeys(NAMES, 0.05)


@pytest.fixture(scope="module")
def gains() -> tuple[Gains, ...]:
    """Return observers for three faults, each alone, and two of them together; inputs act after a delay."""
    identity = np.eye(2)
    plant = Plant(
        name="three-in-two",
        domain="discrete",
        rate_hz=100.0,
        states=("a", "b"),
        inputs=("drive",),
        outputs=("a", "b"),
        A=0.9 * identity,
        B=np.array([[0.1], [0.1]]),
        C=identity,
        taps=(0.0, 0.6, 0.4),
        faults=(
            Fault("left", "actuator", np.array([1.0, 0.0]), rate=1.0),
            Fault("right", "actuator", np.array([0.1, 0.1]), rate=1.0, input="drive"),
            Fault("gyro", "sensor", np.array([0.0, 1.0]), rate=1.0),
        ),
        disturbances=tuple(Disturbance(f"w{i}", identity[:, i], 0.01) for i in range(2)),
        noises=tuple(Noise(f"n{i}", identity[:, i], 0.01) for i in range(2)),
    )
    parts = [(found, restricted(plant, found)) for found in (*((name,) for name in NAMES), ("left", "gyro"))]
    return compile_bank(plant, [Hypothesis(found, part, design_convex(part)) for found, part in parts])


def estimator(gains: tuple[Gains, ...], kind: str) -> Estimator:
    if kind == "bank":
        hypotheses, edges = tuple(one.faults for one in gains), (False, False, True, False)
        rule = BankRule(0.03, 0.2, 3.0, 25.0, hypotheses, (1e-4 * np.eye(2),) * 4, edges, {"left": 0.4, "right": 0.2})
        return make_estimator(gains, rule, NAMES, THRESHOLDS)
    if kind == "single":
        return make_estimator(gains[3:], SingleRule(0.05, 0.2, 3.0, 5.0, 1e-4 * np.eye(2)), ("left", "gyro"), {})
    return make_estimator(gains[3:], IndependentRule(0.05), ("left", "gyro"), {})


def flight(rng: np.random.Generator, count: int) -> Samples:
    """Return samples with faults that come and go, of the plant and of its sensors, losses, restarts and nonsense."""
    noise, level, rare = rng.choice([0.002, 0.02]), rng.choice([0.0, 0.2, 1.0]), rng.choice([0.0, 0.01, 0.2])
    u, y = noise * rng.normal(size=(count, 1)), noise * rng.normal(size=(count, 2))
    fault = np.zeros(2)
    for k in range(count):
        if rng.random() < 0.03:
            fault = level * rng.normal(size=2) * rng.integers(0, 2, 2)
        y[k] += fault
    y[rng.random(y.shape) < 0.001] = rng.choice([np.nan, np.inf, 1e200, 0.0])
    index = np.arange(count, dtype=np.int64)
    lost = rng.random(count) < rare
    complete, restart = ~lost & (rng.random(count) > rare), rng.random(count) < 0.01 * (rare > 0.0)
    return Samples(index, index, index, u, y, restart, complete, index, ~lost)


def one_by_one(given: Estimator, samples: Samples) -> list[list[bytes]]:
    """Take samples as the chain does; return the bits of the attributes after each."""
    found = []
    for k in range(len(samples)):
        sample = samples.one(k)
        if sample.restart:
            given.restart(sample.u, sample.y)
        if sample.measured or sample.restart:
            given.step(sample.u, sample.y, sample.complete)
        else:
            given.coast(sample.u)
        found.append([np.asarray(getattr(given, field.name)).tobytes() for field in fields(EstimatorRun)])
    return found


@given(
    kind=st.sampled_from(["bank", "bank", "single", "independent"]),
    seed=st.integers(0, 100_000),
    lengths=st.lists(st.integers(0, 150), min_size=1, max_size=8),
)
def test_stretches_and_single_samples_give_the_same_bits_in_any_order(
    gains: tuple[Gains, ...], kind: str, seed: int, lengths: list[int]
) -> None:
    samples = flight(np.random.default_rng(seed), sum(lengths) + len(lengths))
    one, many = estimator(gains, kind), estimator(gains, kind)
    at = 0
    with np.errstate(all="ignore"):
        for length in lengths:
            stretch, single = samples.part(at, at + length), samples.part(at + length, at + length + 1)
            run = many.run(stretch)
            for row, expected in enumerate(one_by_one(one, stretch)):
                assert [getattr(run, field.name)[row].tobytes() for field in fields(EstimatorRun)] == expected
            assert len(run.x) == length
            assert one_by_one(many, single) == one_by_one(one, single)
            assert many.smoothed.tobytes() == one.smoothed.tobytes()
            at += length + 1


@given(seed=st.integers(0, 100_000), count=st.integers(1, 60))
def test_scores_of_any_size_are_judged_alike(gains: tuple[Gains, ...], seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    J = np.exp(rng.normal(2.0, 2.0, (count, 4)))
    J[rng.random(J.shape) < 0.2] = rng.choice([np.nan, np.inf, 0.0, 9.0, 1e308])
    faults, sizes = rng.normal(size=(count, 5)), [rng.choice([0.0, 0.1, 0.0], count) for _ in range(2)]
    one, many = estimator(gains, "bank"), estimator(gains, "bank")
    assert isinstance(one, Bank)
    assert isinstance(many, Bank)
    with np.errstate(all="ignore"):
        believed, unexplained = many._choices(J, faults, sizes)
        for k in range(count):
            one.J, one._faults = J[k], faults[k]
            one._choose()
            one._standing = {place for place, size in zip((0, 1), sizes, strict=True) if abs(size[k]) > 0.05}
            assert (believed[k], repr(unexplained[k])) == (one.believed, repr(np.float64(one.unexplained)))
    assert many._standing == one._standing


def test_a_stretch_is_cut_where_it_restarts_and_where_measurements_are_lost(gains: tuple[Gains, ...]) -> None:
    samples = flight(np.random.default_rng(0), 7)
    samples.restart[:] = [False, False, True, False, False, True, False]
    samples.measured[:] = [True, True, False, True, False, False, False]
    assert list(pieces(samples)) == [
        (0, 2, False, True),
        (2, 4, True, True),
        (4, 5, False, False),
        (5, 6, True, True),
        (6, 7, False, False),
    ]
    assert list(pieces(samples.part(0, 0))) == []
    assert [piece[:2] for piece in pieces(samples.part(0, 2), longest=1)] == [(0, 1), (1, 2)]


def test_a_joint_estimate_speaks_for_all_channels_and_leaves_nothing_unexplained(gains: tuple[Gains, ...]) -> None:
    joint = estimator(gains, "independent")
    assert isinstance(joint, JointEstimator)
    run = joint.run(flight(np.random.default_rng(1), 20))
    assert run.speaks.all()
    assert not run.unexplained.any()
