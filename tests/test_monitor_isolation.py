"""Isolation: one channel is held responsible, disturbances along healthy directions are not."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from monitor.estimation.isolation import IndependentChannels, SingleFaultIsolator

GUST = np.ones(4) / 2
COVARIANCE = 1e-6 * np.eye(4) + 1e-2 * np.outer(GUST, GUST)
LOSSES = np.ones(4, dtype=np.bool_)


def isolator(penalty: float = 25.0) -> SingleFaultIsolator:
    return SingleFaultIsolator(
        COVARIANCE, 0.0, 100.0, tolerance=0.2, score_floor=10.0, gain_penalty=penalty, losses=LOSSES
    )


@given(motor=st.integers(0, 3), size=st.floats(-0.3, -0.02), gust=st.floats(-0.3, 0.3))
def test_a_single_fault_is_found_with_its_size_under_a_gust(motor: int, size: float, gust: float) -> None:
    fault = gust * GUST
    fault[motor] += size
    result = isolator().update(fault)
    assert int(np.argmax(np.abs(result.evidence))) == motor
    assert result.evidence[motor] == pytest.approx(size, abs=0.002)
    others = np.delete(result.evidence, motor)
    assert np.abs(others).max() < 0.002


def test_two_large_faults_are_both_held_responsible() -> None:
    result = isolator().update(np.array([-0.2, 0.0, -0.15, 0.0]))
    assert result.evidence == pytest.approx([-0.2, 0.0, -0.15, 0.0], abs=0.01)


@given(gust=st.floats(-0.3, 0.3), noise=st.lists(st.floats(-2e-3, 2e-3), min_size=4, max_size=4))
def test_healthy_estimates_hold_nobody_responsible_for_more_than_their_noise(gust: float, noise: list[float]) -> None:
    evidence = isolator().update(gust * GUST + np.array(noise)).evidence
    assert np.abs(evidence).max() < 0.01


def test_where_the_data_cannot_tell_the_motor_that_lost_is_named() -> None:
    roll = np.array([1.0, -1.0, 0.0, 0.0]) / np.sqrt(2)
    blind = 1e-2 * np.eye(4) - (1e-2 - 1e-6) * np.outer(roll, roll)
    stage = SingleFaultIsolator(blind, 0.0, 100.0, tolerance=0.2, score_floor=10.0, gain_penalty=25.0, losses=LOSSES)
    result = stage.update(0.01 * roll)
    assert int(np.argmax(np.abs(result.evidence))) == 1
    assert result.evidence[1] < 0


def test_smoothing_follows_a_step_with_its_time_constant() -> None:
    stage = IndependentChannels(1, smoothing_s=0.1, rate_hz=100.0)
    values = [stage.update(np.ones(1)).evidence[0] for _ in range(10)]
    assert values[-1] == pytest.approx(1 - np.exp(-1))
    stage.restart()
    assert stage.update(np.zeros(1)).evidence[0] == 0.0


@given(seed=st.integers(0, 10_000), lengths=st.lists(st.integers(0, 30), min_size=1, max_size=8))
def test_a_stretch_gives_what_its_samples_give_one_by_one(seed: int, lengths: list[int]) -> None:
    rng = np.random.default_rng(seed)
    one, many = (SingleFaultIsolator(COVARIANCE, 0.05, 100.0, 0.2, 3.0, 25.0, LOSSES) for _ in range(2))
    alike, together = (IndependentChannels(4, 0.05, 100.0) for _ in range(2))
    for length in lengths:
        fault = rng.choice([0.001, 0.01, 0.3]) * rng.normal(size=(length, 4)) + rng.normal(size=4) * rng.choice([0, 1])
        expected = np.array([one.update(row).evidence for row in fault]).reshape(length, 4)
        assert many.run(fault).tobytes() == expected.tobytes()
        expected = np.array([alike.update(row).evidence for row in fault]).reshape(length, 4)
        assert together.run(fault).tobytes() == expected.tobytes()
        single = rng.normal(size=4)
        assert many.update(single).evidence.tobytes() == one.update(single).evidence.tobytes()
        assert together.update(single).evidence.tobytes() == alike.update(single).evidence.tobytes()
