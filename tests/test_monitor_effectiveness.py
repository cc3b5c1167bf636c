"""Loss and offset read from a fault estimate: seen when they can be, silent when they cannot, gone when they end."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from monitor.estimation.effectiveness import Effectiveness, EffectivenessEstimator, EffectivenessRule

RATE_HZ = 50.0
RULE = EffectivenessRule(noise=0.01, inflation=2.0, lag_s=0.0, loss_doubt=0.02, offset_doubt=0.002, certainty=5.0)
TURNS = 0.3 * np.sign(np.sin(np.arange(1500) / 40.0))
STRAIGHT = np.zeros(1500)
ONSET, END = 500, 1000


def told(
    command: NDArray[np.float64],
    *,
    loss: float = 0.0,
    offset: float = 0.0,
    seed: int = 0,
    rule: EffectivenessRule = RULE,
) -> list[Effectiveness]:
    """Return what is said over a run with a fault from ONSET to END."""
    k = np.arange(len(command))
    acts = (k >= ONSET) & (k < END)
    noise = np.random.default_rng(seed).normal(scale=0.01, size=len(command))
    fault = np.where(acts, -loss * command + offset, 0.0) + noise
    estimator = EffectivenessEstimator(rule, RATE_HZ)
    return [estimator.update(f, u) for f, u in zip(fault.tolist(), command.tolist(), strict=True)]


def accused(said: list[Effectiveness]) -> list[int]:
    return [k for k, verdict in enumerate(said) if verdict.evidence]


@settings(max_examples=15, deadline=None)
@given(loss=st.floats(0.4, 1.0), seed=st.integers(0, 1000))
def test_a_loss_is_seen_at_once_while_the_actuator_is_used_and_its_end_too(loss: float, seed: int) -> None:
    said = told(TURNS, loss=loss, seed=seed)
    seen = accused(said)
    assert ONSET <= seen[0] < ONSET + 40
    assert len([k for k in seen if ONSET + 40 <= k < END]) >= 0.95 * (END - ONSET - 40)
    assert seen[-1] < END + 50
    assert said[END - 1].relative == pytest.approx(-loss, abs=0.05)
    assert said[END - 1].evidence == pytest.approx(-loss * 0.3, abs=0.02)


@settings(max_examples=15, deadline=None)
@given(offset=st.floats(0.08, 0.5), sign=st.sampled_from([-1.0, 1.0]), seed=st.integers(0, 1000))
def test_an_offset_is_seen_without_any_command(offset: float, sign: float, seed: int) -> None:
    said = told(STRAIGHT, offset=sign * offset, seed=seed)
    seen = accused(said)
    assert ONSET <= seen[0] < ONSET + 25
    assert seen[-1] < END + 75
    assert said[END - 1].evidence == pytest.approx(sign * offset, abs=0.02)
    assert said[END - 1].relative is None


def test_loss_and_offset_together_are_told_apart() -> None:
    last = told(TURNS, loss=0.2, offset=-0.2)[END - 1]
    assert not last.is_loss
    assert last.offset == pytest.approx(-0.2, abs=0.06)
    assert last.relative == pytest.approx(-0.2, abs=0.05)


@given(seed=st.integers(0, 1000))
@settings(max_examples=15, deadline=None)
def test_health_is_never_accused(seed: int) -> None:
    assert not accused(told(TURNS, seed=seed))
    assert not accused(told(STRAIGHT, seed=seed))


def test_a_loss_without_deflection_is_not_guessed_at() -> None:
    said = told(STRAIGHT, loss=0.9)
    assert not accused(said)
    assert said[END - 1].loss_error > 1.0


def test_a_loss_shows_with_the_first_turn() -> None:
    command = np.where(np.arange(1500) < 700, 0.0, TURNS)
    seen = accused(told(command, loss=0.5))
    assert 700 <= seen[0] < 725


def test_an_accusation_that_nothing_can_confirm_is_held_and_then_dropped() -> None:
    command = np.where(np.arange(1500) < 800, TURNS, 0.0)
    said = told(command, loss=0.5, rule=replace(RULE, hold_s=3.0))
    assert all(verdict.evidence != 0.0 for verdict in said[800:940])
    assert not accused(said[1050:])


def test_a_restart_forgets() -> None:
    estimator = EffectivenessEstimator(RULE, RATE_HZ)
    for u in TURNS[:200].tolist():
        estimator.update(-0.5 * u, u)
    estimator.restart()
    first = estimator.update(0.0, 0.0)
    assert (first.loss, first.evidence) == (0.0, 0.0)


def test_a_mistimed_command_is_no_fault() -> None:
    command = 0.3 * np.sin(np.arange(1500) / 5.0)
    fault = np.diff(command, prepend=0.0) + np.random.default_rng(1).normal(scale=0.01, size=1500)
    estimator = EffectivenessEstimator(RULE, RATE_HZ)
    assert not accused([estimator.update(f, u) for f, u in zip(fault.tolist(), command.tolist(), strict=True)])


def test_the_command_is_lagged_like_the_estimate() -> None:
    command = 0.3 * np.sign(np.sin(np.arange(1500) / 10.0))
    lagged = np.zeros(1500)
    keep = np.exp(-1.0 / (0.1 * RATE_HZ))
    for k in range(1, 1500):
        lagged[k] = keep * lagged[k - 1] + (1.0 - keep) * command[k]
    estimator = EffectivenessEstimator(replace(RULE, lag_s=0.1), RATE_HZ)
    for f, u in zip((-0.4 * lagged).tolist(), command.tolist(), strict=True):
        last = estimator.update(f, u)
    assert last.loss == pytest.approx(0.4, abs=0.01)


def test_the_full_deflections_effect_scales_the_offset() -> None:
    estimator = EffectivenessEstimator(RULE, RATE_HZ)
    for full in np.linspace(0.5, 2.0, 300).tolist():
        last = estimator.update(0.1 * full, 0.0, full)
    assert last.evidence == pytest.approx(0.1, abs=1e-6)


def test_skipped_time_fades_what_is_known_and_ends_what_nothing_confirms() -> None:
    estimator = EffectivenessEstimator(RULE, RATE_HZ)
    for u in TURNS[:200].tolist():
        before = estimator.update(-0.5 * u, u)
    for _ in range(10):
        estimator.skip()
    after = estimator.update(-0.5 * TURNS[200], float(TURNS[200]))
    assert after.loss == pytest.approx(0.5, abs=1e-6)
    assert after.loss_error >= before.loss_error
    for _ in range(300):
        estimator.skip()
    assert not estimator.update(0.0, 0.0).evidence
