"""Estimators: what they conclude does not depend on how samples are cut into batches, to the bit."""

from __future__ import annotations

import numpy as np
import pytest
from cuts import cuts, same_bits
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from adapters.sample import Given, Samples
from gains.analysis.estimability import restricted
from gains.plants.plant import Disturbance, Fault, Noise, Plant
from gains.synthesis.bank import Hypothesis, compile_bank
from gains.synthesis.convex import design_convex
from gains.synthesis.gains_file import Gains
from monitor.estimation.affine import AffineObserver
from monitor.estimation.estimator import Estimator, make_estimator
from monitor.estimation.isolation_rule import BankRule, IndependentRule
from monitor.estimation.observer import FaultSet, Observer, ObserverRun
from monitor.estimation.uncertainty import Uncertainty

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
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
        washouts = {"left": 0.4, "right": 0.2}
        rule = BankRule(0.03, 0.2, 3.0, 25.0, hypotheses, (1e-4 * np.eye(2),) * 4, edges, washouts, usual_score=1.0)
        return make_estimator(AffineObserver(gains), rule, NAMES, THRESHOLDS)
    return make_estimator(AffineObserver(gains[3:]), IndependentRule(0.05), ("left", "gyro"), {})


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
    return Samples(index, index, index, u, y, restart, complete, index, ~lost, np.tile(lost[:, None], 3))


@given(kind=st.sampled_from(["bank", "independent"]), seed=st.integers(0, 100_000), parts=cuts(500))
def test_cuts_do_not_change_a_bit(gains: tuple[Gains, ...], kind: str, seed: int, parts: list[slice]) -> None:
    samples = flight(np.random.default_rng(seed), 500)
    armed = np.arange(500) > 50
    whole, cut = estimator(gains, kind).run(Given(samples), armed), estimator(gains, kind)
    runs = [cut.run(Given(samples.part(part.start, part.stop)), armed[part]) for part in parts]
    for name, column, expected in zip(whole._fields, zip(*runs, strict=True), whole, strict=True):
        assert same_bits(np.concatenate(column), expected), name


class Difference:
    """An observer that is no affine map: it takes the sine of the first output for the state, the rest for faults."""

    rate_hz = 100.0
    hypotheses = (FaultSet(("left", "gyro"), (False, False)),)

    def __init__(self) -> None:
        self._last = np.zeros(2)

    def run(self, u: Array, y: Array, measured: Flags | None = None, restart: Flags | None = None) -> ObserverRun:
        fault = np.empty((len(u), 2))
        for k in range(len(u)):
            if measured is None or measured[k]:
                self._last = y[k] - np.sin(u[k, 0])
            fault[k] = self._last
        return ObserverRun(np.sin(u)[:, None], fault, np.zeros((len(u), 1, 2)))

    def error_systems(self, plant: Plant) -> None:
        """Return None: its errors are not known."""

    def settling_s(self) -> float:
        return 0.0


def test_an_observer_of_another_kind_is_used_like_compiled_gains() -> None:
    samples = flight(np.random.default_rng(3), 30)
    samples.measured[:], samples.restart[:], samples.y[:] = True, False, 0.3
    observer: Observer = Difference()
    joint = make_estimator(observer, IndependentRule(0.0), ("left", "gyro"), {}).run(Given(samples), samples.measured)
    assert joint.evidence == pytest.approx(np.tile(0.3 - np.sin(samples.u), (1, 2)))
    rule = BankRule(0.0, 0.2, 3.0, 25.0, (("left", "gyro"),), (np.eye(2),), (False,))
    bank = make_estimator(observer, rule, ("left", "gyro"), {}).run(Given(samples), samples.measured)
    assert bank.x == pytest.approx(np.sin(samples.u))
    assert bank.evidence == pytest.approx(joint.evidence)
    assert np.isnan(Uncertainty(observer, None, ("left", "gyro")).run(samples.measured, samples.restart)).all()


def test_without_measurements_the_evidence_stays(gains: tuple[Gains, ...]) -> None:
    for kind in ("bank", "independent"):
        samples = flight(np.random.default_rng(5), 60)
        samples.measured[40:], samples.restart[:] = False, False
        run = estimator(gains, kind).run(Given(samples), samples.measured)
        for column in (run.evidence, run.counted, run.smoothed, run.unexplained):
            assert np.array_equal(column[40:], np.broadcast_to(column[39], column[40:].shape), equal_nan=True)


def test_a_joint_estimate_counts_for_all_channels_and_leaves_nothing_unexplained(gains: tuple[Gains, ...]) -> None:
    run = estimator(gains, "independent").run(Given(flight(np.random.default_rng(1), 20)), np.ones(20, np.bool_))
    assert run.counted.all()
    assert not run.unexplained.any()
    assert run.smoothed is run.evidence
