"""Isolation: one channel is held responsible, disturbances along healthy directions are not."""

import numpy as np
import pytest
from cuts import cuts
from hypothesis import given
from hypothesis import strategies as st

from monitor.estimation.estimator import independent_isolation, single_fault_isolation
from monitor.estimation.isolation_rule import SingleRule

GUST = np.ones(4) / 2
COVARIANCE = 1e-6 * np.eye(4) + 1e-2 * np.outer(GUST, GUST)
LOSSES = np.ones(4, dtype=np.bool_)


def isolated(fault: np.ndarray, penalty: float = 25.0, covariance: np.ndarray = COVARIANCE) -> np.ndarray:
    """Return the evidence after one joint estimate that is not smoothed."""
    rule = SingleRule(0.0, tolerance=0.2, score_floor=10.0, gain_penalty=penalty, covariance=covariance)
    one = np.ones(1, np.uint8)
    return single_fault_isolation(rule, 100.0, LOSSES).run(fault[None], one, one)[0]


@given(motor=st.integers(0, 3), size=st.floats(-0.3, -0.02), gust=st.floats(-0.3, 0.3))
def test_a_single_fault_is_found_with_its_size_under_a_gust(motor: int, size: float, gust: float) -> None:
    fault = gust * GUST
    fault[motor] += size
    evidence = isolated(fault)
    assert int(np.argmax(np.abs(evidence))) == motor
    assert evidence[motor] == pytest.approx(size, abs=0.002)
    others = np.delete(evidence, motor)
    assert np.abs(others).max() < 0.002


def test_two_large_faults_are_both_held_responsible() -> None:
    evidence = isolated(np.array([-0.2, 0.0, -0.15, 0.0]))
    assert evidence == pytest.approx([-0.2, 0.0, -0.15, 0.0], abs=0.01)


@given(gust=st.floats(-0.3, 0.3), noise=st.lists(st.floats(-2e-3, 2e-3), min_size=4, max_size=4))
def test_healthy_estimates_hold_nobody_responsible_for_more_than_their_noise(gust: float, noise: list[float]) -> None:
    evidence = isolated(gust * GUST + np.array(noise))
    assert np.abs(evidence).max() < 0.01


def test_where_the_data_cannot_tell_the_motor_that_lost_is_named() -> None:
    roll = np.array([1.0, -1.0, 0.0, 0.0]) / np.sqrt(2)
    blind = 1e-2 * np.eye(4) - (1e-2 - 1e-6) * np.outer(roll, roll)
    evidence = isolated(0.01 * roll, covariance=blind)
    assert int(np.argmax(np.abs(evidence))) == 1
    assert evidence[1] < 0


def test_suspects_are_fitted_together_by_least_squares() -> None:
    rng = np.random.default_rng(0)
    mixed = rng.normal(size=(4, 4))
    covariance = 1e-6 * (mixed @ mixed.T + np.eye(4))
    information = np.linalg.inv(covariance)
    for seed in range(20):
        fault = np.random.default_rng(seed).normal(size=4)
        evidence = isolated(fault, penalty=0.0, covariance=covariance)
        suspects = np.flatnonzero(evidence)
        fitted = np.linalg.solve(information[np.ix_(suspects, suspects)], (information @ fault)[suspects])
        assert evidence[suspects] == pytest.approx(fitted, rel=1e-9)
        score = (information @ fault) ** 2 / np.diag(information)
        assert evidence[np.argmax(score)] != 0.0


def test_smoothing_follows_a_step_with_its_time_constant_and_a_restart_forgets() -> None:
    restart = (np.arange(11) == 10).astype(np.uint8)
    fault = np.append(np.ones(10), 0.0)[:, None]
    evidence = independent_isolation(1, smoothing_s=0.1, rate_hz=100.0).run(fault, np.ones(11, np.uint8), restart)
    assert evidence[9] == pytest.approx(1 - np.exp(-1))
    assert evidence[10] == 0.0


@given(seed=st.integers(0, 10_000), parts=cuts(100), single=st.booleans())
def test_cuts_do_not_change_a_bit(seed: int, parts: list[slice], single: bool) -> None:
    rng = np.random.default_rng(seed)
    fault = rng.choice([0.001, 0.01, 0.3]) * rng.normal(size=(100, 4)) + rng.normal(size=4) * rng.choice([0, 1])
    measured, restart = (rng.random(100) > 0.1).astype(np.uint8), (rng.random(100) > 0.98).astype(np.uint8)
    rule = SingleRule(0.05, 0.2, 3.0, 25.0, COVARIANCE)
    one, other = (
        single_fault_isolation(rule, 100.0, LOSSES) if single else independent_isolation(4, 0.05, 100.0)
        for _ in range(2)
    )
    cut = [other.run(fault[part], measured[part], restart[part]) for part in parts]
    assert np.concatenate(cut).tobytes() == one.run(fault, measured, restart).tobytes()
