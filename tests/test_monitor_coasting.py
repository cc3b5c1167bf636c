"""Coasting: without measurements the model goes on alone, and the first one after it is not taken for a fault."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gains.plants.model_file import builtin_model
from gains.plants.plant import Disturbance, Fault, Noise, Plant
from gains.synthesis.bank import compile_bank, design_bank
from gains.synthesis.certificate import certify
from gains.synthesis.compilation import compile_gains
from gains.synthesis.convex import design_convex
from gains.synthesis.gains_file import Gains
from monitor.estimation.coasting import coasting_maps
from monitor.estimation.observer import Observer
from monitor.estimation.observer_stack import ObserverStack


def plant() -> Plant:
    """Return two coupled states, both measured, with an actuator and a sensor that may fail."""
    identity = np.eye(2)
    return Plant(
        name="pair",
        domain="discrete",
        rate_hz=100.0,
        states=("a", "b"),
        inputs=("drive",),
        outputs=("a", "b"),
        A=np.array([[0.97, 0.02], [-0.03, 0.95]]),
        B=np.array([[0.1], [0.05]]),
        C=identity,
        faults=(
            Fault("motor", "actuator", np.array([0.1, 0.05]), rate=1.0),
            Fault("sensor", "sensor", np.array([0.0, 1.0]), rate=1.0),
        ),
        disturbances=tuple(Disturbance(f"w{i}", identity[:, i], 0.001) for i in range(2)),
        noises=tuple(Noise(f"n{i}", identity[:, i], 0.001) for i in range(2)),
    )


@pytest.fixture(scope="module")
def gains() -> Gains:
    whole = plant()
    design = design_convex(whole)
    return compile_gains(whole, design, certify(whole, design))


@given(lost=st.lists(st.booleans(), min_size=60, max_size=60), motor=st.floats(-1, 1), sensor=st.floats(-1, 1))
@settings(max_examples=10, deadline=None)
def test_a_model_without_error_is_followed_through_any_losses(
    gains: Gains, lost: list[bool], motor: float, sensor: float
) -> None:
    whole, observer, rng = plant(), Observer(gains), np.random.default_rng(0)
    x = np.array([0.3, -0.2])
    for k in range(1_060):
        u = rng.normal(size=1)
        y = x + np.array([0.0, sensor])
        if k == 0:
            observer.restart(u, y)
        if k >= 1_000 and lost[k - 1_000]:
            observer.coast(u)
        else:
            observer.step(u, y)
        if k >= 999:
            assert observer.fault == pytest.approx([motor, sensor], abs=1e-6)
            assert observer.x == pytest.approx(x, abs=1e-6)
            assert observer.residual == pytest.approx([0.0, 0.0], abs=1e-6)
        x = whole.A @ x + whole.B @ (u + motor)


def test_coasting_keeps_the_faults_and_says_that_nothing_is_left_unexplained(gains: Gains) -> None:
    observer = Observer(gains)
    observer.restart(np.zeros(1), np.zeros(2))
    for _ in range(300):
        observer.step(np.ones(1), np.array([0.5, 0.7]))
    sensor = observer.fault[1]
    for _ in range(10):
        observer.coast(np.ones(1))
        assert observer.fault[1] == pytest.approx(sensor, abs=1e-9)
        assert np.abs(observer.residual).max() < 1e-9


def test_the_drift_of_a_loss_is_not_taken_for_a_fault(gains: Gains) -> None:
    maps = coasting_maps(gains)
    observer, thrown = Observer(gains), Observer(gains)
    for one in (observer, thrown):
        one.restart(np.zeros(1), np.zeros(2))
        for _ in range(300):
            one.step(np.zeros(1), np.zeros(2))
        for _ in range(10):
            one.coast(np.zeros(1))
    thrown._coasted = False
    for one in (observer, thrown):
        one.step(np.zeros(1), np.array([0.1, 0.05]))
    assert np.abs(observer.fault).max() < 0.1 * np.abs(thrown.fault).max()
    assert not maps.coast.step[:, len(gains.initial_matrix) + 1 : len(gains.initial_matrix) + 3].any()


@pytest.fixture(scope="module")
def bank() -> tuple[Gains, ...]:
    arm = replace(builtin_model("arm-disturbed"), curves=((1.0, 0.1),))
    return compile_bank(arm, design_bank(arm, 100.0))


@given(seed=st.integers(0, 200))
@settings(max_examples=20, deadline=None)
def test_a_stack_coasts_and_resumes_each_observer_as_it_would_alone(bank: tuple[Gains, ...], seed: int) -> None:
    rng = np.random.default_rng(seed)
    stack, alone = ObserverStack(bank), [Observer(one) for one in bank]
    everyone: list[Observer | ObserverStack] = [stack, *alone]
    for one in everyone:
        one.restart(np.zeros(1), np.zeros(3))
    for _ in range(20):
        u, y, lost = rng.normal(size=1), rng.normal(size=3), rng.random() < 0.5
        for one in everyone:
            if lost:
                one.coast(u)
            else:
                one.step(u, y)
        for at, observer in enumerate(alone):
            assert stack.x[at] == pytest.approx(observer.x, rel=1e-9, abs=1e-9)
            assert stack.fault[stack.spans[at]] == pytest.approx(observer.fault, rel=1e-9, abs=1e-9)
            assert stack.residual[at] == pytest.approx(observer.residual, rel=1e-9, abs=1e-9)
