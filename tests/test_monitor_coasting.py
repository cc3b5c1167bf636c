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
from monitor.estimation.affine import AffineObserver
from monitor.estimation.coasting import coasting_maps


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
    whole, rng, x = plant(), np.random.default_rng(0), np.array([0.3, -0.2])
    u, states = rng.normal(size=(1_060, 1)), np.empty((1_060, 2))
    for k in range(1_060):
        states[k] = x
        x = whole.A @ x + whole.B @ (u[k] + motor)
    measured = np.array([True] * 1_000 + [not one for one in lost])
    run = AffineObserver([gains]).run(u, states + np.array([0.0, sensor]), measured)
    assert run.fault[999:] == pytest.approx(np.tile([motor, sensor], (61, 1)), abs=1e-6)
    assert run.x[999:, 0] == pytest.approx(states[999:], abs=1e-6)
    assert np.abs(run.residual[999:]).max() < 1e-6


def test_coasting_keeps_the_faults_and_leaves_nothing_unexplained(gains: Gains) -> None:
    measured = np.arange(310) < 300
    run = AffineObserver([gains]).run(np.ones((310, 1)), np.tile([0.5, 0.7], (310, 1)), measured)
    assert run.fault[300:, 1] == pytest.approx(run.fault[299, 1], abs=1e-9)
    assert np.abs(run.residual[300:]).max() < 1e-9


def test_the_drift_of_a_loss_is_not_taken_for_a_fault(gains: Gains) -> None:
    u, y, measured = np.zeros((311, 1)), np.zeros((311, 2)), np.arange(311) != 305
    y[-1] = 0.1, 0.05
    measured[300:310] = False
    resumed = AffineObserver([gains]).run(u, y, measured).fault[-1]
    # the same jump without the loss: an observer that did not resume would see it as this
    thrown = AffineObserver([gains]).run(u, y).fault[-1]
    assert np.abs(resumed).max() < 0.1 * np.abs(thrown).max()
    size = len(gains.initial_matrix)
    assert not coasting_maps(gains).coast.step[:, size + 1 : size + 3].any()


@pytest.fixture(scope="module")
def bank() -> tuple[Gains, ...]:
    arm = replace(builtin_model("arm-disturbed"), curves=((1.0, 0.1),))
    return compile_bank(arm, design_bank(arm, 100.0))


@given(seed=st.integers(0, 200))
@settings(max_examples=20, deadline=None)
def test_a_stack_coasts_and_resumes_each_observer_as_it_would_alone(bank: tuple[Gains, ...], seed: int) -> None:
    rng = np.random.default_rng(seed)
    u, y, measured = rng.normal(size=(20, 1)), rng.normal(size=(20, 3)), rng.random(20) < 0.5
    stack, at = AffineObserver(bank).run(u, y, measured), 0
    for k, gains in enumerate(bank):
        alone = AffineObserver([gains]).run(u, y, measured)
        assert stack.x[:, k] == pytest.approx(alone.x[:, 0], rel=1e-9, abs=1e-9)
        assert stack.fault[:, at : at + len(gains.faults)] == pytest.approx(alone.fault, rel=1e-9, abs=1e-9)
        assert stack.residual[:, k] == pytest.approx(alone.residual[:, 0], rel=1e-9, abs=1e-9)
        at += len(gains.faults)
