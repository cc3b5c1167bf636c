"""Banks: the hypothesis that explains the data names the fault, and gives way when the fault has gone."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gains.plants.plant import Disturbance, Fault, Noise, Plant
from gains.synthesis.bank import compile_bank, design_bank
from gains.synthesis.gains_file import Gains
from monitor.estimation.bank import Bank
from monitor.estimation.isolation_rule import BankRule

DIRECTIONS = ((1.0, 0.0), (0.0, 1.0), (-0.7, 0.7))
NAMES = ("left", "right", "both")


def plant() -> Plant:
    """Return two leaky states, both measured, and three faults that depend on each other."""
    identity = np.eye(2)
    return Plant(
        name="three-in-two",
        domain="discrete",
        rate_hz=100.0,
        states=("a", "b"),
        inputs=("drive",),
        outputs=("a", "b"),
        A=0.95 * identity,
        B=np.array([[0.1], [0.1]]),
        C=identity,
        faults=tuple(
            Fault(name, "actuator", np.array(direction), rate=1.0)
            for name, direction in zip(NAMES, DIRECTIONS, strict=True)
        ),
        disturbances=tuple(Disturbance(f"w{i}", identity[:, i], 0.01) for i in range(2)),
        noises=tuple(Noise(f"n{i}", identity[:, i], 0.01) for i in range(2)),
    )


@pytest.fixture(scope="module")
def gains() -> tuple[Gains, ...]:
    whole = plant()
    return compile_bank(whole, design_bank(whole))


def bank_of(gains: tuple[Gains, ...]) -> Bank:
    rule = BankRule(0.05, 0.2, 4.0, 25.0, tuple(one.faults for one in gains), (1e-5 * np.eye(2),) * 3, (False,) * 3)
    return Bank(gains, rule, NAMES, {})


def run(bank: Bank, x: np.ndarray, fault: np.ndarray, seed: int) -> np.ndarray:
    """Step bank and plant from x for 1.5 s with a constant fault vector (2,) and return the last x."""
    rng = np.random.default_rng(seed)
    u = np.zeros(1)
    for _ in range(150):
        bank.step(u, x + rng.normal(0.0, 1e-3, 2))
        x = 0.95 * x + fault + rng.normal(0.0, 1e-3, 2)
    return x


@given(which=st.integers(0, 2), size=st.floats(0.2, 2.0), seed=st.integers(0, 99))
def test_the_right_fault_is_named_with_its_size_and_let_go(
    gains: tuple[Gains, ...], which: int, size: float, seed: int
) -> None:
    bank = bank_of(gains)
    x = run(bank, np.zeros(2), size * np.array(DIRECTIONS[which]), seed)
    assert (bank.believed, bank.unexplained) == (which, 0.0)
    assert bank.evidence[which] == pytest.approx(size, rel=0.05, abs=0.02)
    assert not np.delete(bank.evidence, which).any()
    run(bank, x, np.zeros(2), seed)
    assert np.abs(bank.evidence).max() < 0.05


def test_what_no_hypothesis_explains_holds_nobody_responsible(gains: tuple[Gains, ...]) -> None:
    bank = bank_of(gains)
    run(bank, np.zeros(2), np.array([1.0, 1.0]), 0)
    assert bank.unexplained > 4.0
    assert not bank.evidence.any()


def test_each_fault_is_estimated_under_its_own_hypothesis(gains: tuple[Gains, ...]) -> None:
    bank = bank_of(gains)
    run(bank, np.zeros(2), np.array([0.5, 0.0]), 1)
    assert bank.fault[0] == pytest.approx(0.5, abs=0.01)
    assert abs(bank.fault[1]) < 0.1


def test_a_restart_forgets_the_fault(gains: tuple[Gains, ...]) -> None:
    bank = bank_of(gains)
    run(bank, np.zeros(2), np.array([0.5, 0.0]), 1)
    bank.restart(np.zeros(1), np.zeros(2))
    bank.step(np.zeros(1), np.zeros(2))
    assert np.abs(bank.evidence).max() < 1e-6
    assert bank.J.max() < 1.0
