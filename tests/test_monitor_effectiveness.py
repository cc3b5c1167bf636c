"""Loss and offset read from a fault estimate: seen when they can be, silent when they cannot, gone when they end."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from monitor.core.effectiveness import EffectivenessEstimator
from monitor.estimation.effectiveness import EffectivenessRule, EffectivenessRun

RATE_HZ = 50.0
RULE = EffectivenessRule(noise=0.01, inflation=2.0, lag_s=0.0, loss_doubt=0.02, offset_doubt=0.002, certainty=5.0)
TURNS = 0.3 * np.sign(np.sin(np.arange(1500) / 40.0))
STRAIGHT = np.zeros(1500)
ONSET, END = 500, 1000


def read(
    fault: NDArray[np.float64],
    command: NDArray[np.float64],
    *,
    full: NDArray[np.float64] | float = 1.0,
    restart: int | None = None,
    armed: NDArray[np.bool_] | None = None,
    rule: EffectivenessRule = RULE,
    beyond: NDArray[np.float64] | float = 1.0,
) -> EffectivenessRun:
    """Return loss and offset after each sample of a run."""
    rows = np.arange(len(fault))
    always = np.ones(len(fault), np.bool_)
    flags = rows == restart, always if armed is None else armed
    columns = fault, command, full * always, beyond * always
    return EffectivenessRun(*EffectivenessEstimator(rule, RATE_HZ).run(rows * round(1e9 / RATE_HZ), *flags, *columns))


def faulty(
    command: NDArray[np.float64],
    *,
    loss: float = 0.0,
    offset: float = 0.0,
    seed: int = 0,
    rule: EffectivenessRule = RULE,
) -> EffectivenessRun:
    """Return loss and offset after each sample of a run with a fault from ONSET to END."""
    k = np.arange(len(command))
    acts = (k >= ONSET) & (k < END)
    noise = np.random.default_rng(seed).normal(scale=0.01, size=len(command))
    return read(np.where(acts, -loss * command + offset, 0.0) + noise, command, rule=rule)


def accused(run: EffectivenessRun) -> NDArray[np.intp]:
    """Return the samples with evidence of a fault."""
    return np.flatnonzero(~np.isnan(run.evidence) & (run.evidence != 0.0))


@settings(max_examples=15, deadline=None)
@given(loss=st.floats(0.4, 1.0), seed=st.integers(0, 1000))
def test_a_loss_is_seen_at_once_while_the_actuator_is_used_and_its_end_too(loss: float, seed: int) -> None:
    run = faulty(TURNS, loss=loss, seed=seed)
    seen = accused(run)
    assert ONSET <= seen[0] < ONSET + 40
    assert np.sum((seen >= ONSET + 40) & (seen < END)) >= 0.95 * (END - ONSET - 40)
    assert seen[-1] < END + 50
    assert run.share[END - 1] == pytest.approx(-loss, abs=0.05)
    assert run.evidence[END - 1] == pytest.approx(-loss * 0.3, abs=0.02)


@settings(max_examples=15, deadline=None)
@given(offset=st.floats(0.08, 0.5), sign=st.sampled_from([-1.0, 1.0]), seed=st.integers(0, 1000))
def test_an_offset_is_seen_without_any_command(offset: float, sign: float, seed: int) -> None:
    run = faulty(STRAIGHT, offset=sign * offset, seed=seed)
    seen = accused(run)
    assert ONSET <= seen[0] < ONSET + 25
    assert seen[-1] < END + 75
    assert run.evidence[END - 1] == pytest.approx(sign * offset, abs=0.02)
    assert np.isnan(run.share[END - 1])


WEATHER = replace(RULE, misfit=1.2)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 1000))
def test_gusts_that_no_fitted_flight_had_accuse_nobody(seed: int) -> None:
    noise = np.random.default_rng(seed).normal(scale=0.01, size=6000) * np.where(np.arange(6000) < 1000, 1.0, 10.0)
    command = np.resize(TURNS, 6000)
    assert np.sum(accused(read(noise, command)) >= 2500)
    assert not np.sum(accused(read(noise, command, rule=WEATHER)) >= 2500)


@settings(max_examples=15, deadline=None)
@given(loss=st.floats(0.4, 1.0), seed=st.integers(0, 1000))
def test_a_fault_is_not_taken_for_weather(loss: float, seed: int) -> None:
    run = faulty(TURNS, loss=loss, seed=seed, rule=WEATHER)
    seen = accused(run)
    assert ONSET <= seen[0] < ONSET + 40
    assert np.sum((seen >= ONSET + 40) & (seen < END)) >= 0.95 * (END - ONSET - 40)
    assert seen[-1] < END + 75


@pytest.mark.parametrize("column", ["fault", "beyond"])
def test_one_absurd_value_hides_no_fault(column: str) -> None:
    columns = {"fault": np.zeros(1500), "beyond": np.ones(1500)}
    columns["fault"][ONSET:END] = -0.5 * TURNS[ONSET:END]
    columns[column][ONSET - 25] = 9e5
    seen = accused(read(columns["fault"], TURNS, rule=WEATHER, beyond=columns["beyond"]))
    assert ONSET <= seen[seen >= ONSET][0] < ONSET + 125  # 2.5 s, from half a second after it on


def test_errors_of_the_model_grow_beyond_the_flights_that_were_fitted() -> None:
    stalled = np.where(np.arange(1500) >= ONSET, 0.3 * TURNS, 0.0)  # 30 % less than commanded
    assert len(accused(read(stalled, TURNS)))
    assert not len(accused(read(stalled, TURNS, beyond=4.0)))


def test_loss_and_offset_together_are_told_apart() -> None:
    run = faulty(TURNS, loss=0.2, offset=-0.2)
    assert run.evidence[END - 1] == run.offset[END - 1]
    assert run.offset[END - 1] == pytest.approx(-0.2, abs=0.06)
    assert run.share[END - 1] == pytest.approx(-0.2, abs=0.05)


@given(seed=st.integers(0, 1000))
@settings(max_examples=15, deadline=None)
def test_health_is_never_accused(seed: int) -> None:
    assert not len(accused(faulty(TURNS, seed=seed)))
    assert not len(accused(faulty(STRAIGHT, seed=seed)))


def test_a_loss_without_deflection_is_not_guessed_at() -> None:
    run = faulty(STRAIGHT, loss=0.9)
    assert not len(accused(run))
    assert run.loss_error[END - 1] > 1.0


def test_a_loss_shows_with_the_first_turn() -> None:
    command = np.where(np.arange(1500) < 700, 0.0, TURNS)
    seen = accused(faulty(command, loss=0.5))
    assert 700 <= seen[0] < 725


def test_an_accusation_that_nothing_can_confirm_is_held_and_then_dropped() -> None:
    command = np.where(np.arange(1500) < 800, TURNS, 0.0)
    run = faulty(command, loss=0.5, rule=replace(RULE, hold_s=3.0))
    assert (run.evidence[800:940] != 0.0).all()
    assert accused(run)[-1] < 1050


def test_a_restart_forgets() -> None:
    command = np.append(TURNS[:200], 0.0)
    run = read(-0.5 * command, command, restart=200)
    assert (run.loss[200], run.evidence[200]) == (0.0, 0.0)


def test_a_mistimed_command_is_no_fault() -> None:
    command = 0.3 * np.sin(np.arange(1500) / 5.0)
    fault = np.diff(command, prepend=0.0) + np.random.default_rng(1).normal(scale=0.01, size=1500)
    assert not len(accused(read(fault, command)))


def test_the_command_is_lagged_like_the_estimate() -> None:
    command = 0.3 * np.sign(np.sin(np.arange(1500) / 10.0))
    lagged = np.zeros(1500)
    keep = np.exp(-1.0 / (0.1 * RATE_HZ))
    for k in range(1, 1500):
        lagged[k] = keep * lagged[k - 1] + (1.0 - keep) * command[k]
    assert read(-0.4 * lagged, command, rule=replace(RULE, lag_s=0.1)).loss[-1] == pytest.approx(0.4, abs=0.01)


def test_the_full_deflections_effect_scales_the_offset() -> None:
    full = np.linspace(0.5, 2.0, 300)
    assert read(0.1 * full, np.zeros(300), full=full).evidence[-1] == pytest.approx(0.1, abs=1e-6)


def test_time_without_evidence_fades_what_is_known_and_ends_it_after_the_longest_memory() -> None:
    command, rows = np.append(TURNS[:212], np.zeros(60)), np.arange(272)
    run = read(-0.5 * command, command, armed=(rows < 200) | (rows == 211) | (rows == 271))
    assert np.isnan(run.evidence[200:211]).all()
    assert run.loss[211] == pytest.approx(0.5, abs=1e-6)
    assert run.loss_error[211] >= run.loss_error[199]
    assert run.size[211:262] == pytest.approx(run.evidence[211])
    assert not run.size[262:].any()
    assert run.loss[271] == 0.0
