"""Edges: a jump that stays is held with its size, a ramp or a loud hypothesis is not, the opposite jump cancels it."""

import numpy as np
import pytest
from cuts import cuts, same_bits
from hypothesis import given
from hypothesis import strategies as st

from monitor.estimation.bank import edge_detector

RATE_HZ = 100.0


def run(
    values: np.ndarray,
    J: np.ndarray | None = None,
    smallest: float | None = 0.05,
    complete: np.ndarray | None = None,
) -> np.ndarray:
    scores = np.ones(len(values)) if J is None else J
    flags = np.ones(len(values), np.uint8) if complete is None else complete.astype(np.uint8)
    return edge_detector(RATE_HZ, 14.0, smallest).run(values, scores, flags)


def step(size: float, count: int = 300, seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0.0, 0.002, count)
    return np.where(np.arange(count) >= 100, size, 0.0) + noise


@given(size=st.floats(0.06, 2.0), sign=st.sampled_from([-1.0, 1.0]), seed=st.integers(0, 50))
def test_a_jump_is_held_with_its_size_within_a_fifth_of_a_second(size: float, sign: float, seed: int) -> None:
    held = run(step(sign * size, seed=seed))
    assert not held[:100].any()
    assert held[120] == pytest.approx(sign * size, abs=0.01)
    assert held[-1] == held[120]


@given(slope=st.floats(0.05, 50.0))
def test_a_ramp_is_no_edge(slope: float) -> None:
    values = np.concatenate([np.zeros(100), slope * np.arange(200) / RATE_HZ])
    assert not run(values)[:100].any()
    assert not run(values, smallest=0.2)[130:].any()


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize(("left", "is_edge"), [(0.3, False), (0.6, True), (0.9, True), (1.2, True), (1.5, False)])
def test_a_jump_of_which_attitudes_take_up_less_than_half_is_an_edge(left: float, is_edge: bool, sign: float) -> None:
    faded = np.interp(np.arange(300), [106, 113, 300], [1.0, left, left])
    held = run(np.where(np.arange(300) >= 100, sign * faded, 0.0))
    assert (held[125] != 0.0) == is_edge


def test_a_jump_that_the_sensor_alone_does_not_explain_is_no_edge() -> None:
    assert not run(step(0.5), J=np.full(300, 20.0)).any()


def test_the_opposite_jump_cancels_what_is_held() -> None:
    values = np.concatenate([np.zeros(100), np.full(200, 0.1), np.zeros(200)])
    held = run(values)
    assert held[250] == pytest.approx(0.1)
    assert held[-1] == 0.0


def test_a_jump_back_to_nothing_is_the_end_of_what_came_slowly() -> None:
    values = np.concatenate([np.zeros(100), np.linspace(0.0, 1.0, 3000), np.zeros(200)])
    assert not run(values, smallest=0.2).any()


def test_an_edge_is_forgotten_after_ten_seconds() -> None:
    held = run(step(0.1, count=1300))
    assert held[1000] == pytest.approx(0.1, abs=0.01)
    assert held[-1] == 0.0


def test_the_end_of_a_jump_that_was_forgotten_is_no_jump_of_its_own() -> None:
    values = np.concatenate([np.zeros(100), np.full(1300, 0.1), np.zeros(200), np.full(200, -0.1)])
    held = run(values)
    assert not held[1200:1600].any()
    assert held[-1] == pytest.approx(-0.1, abs=0.01)


@pytest.mark.parametrize("lasts", [300, 1300])
def test_a_jump_to_the_other_side_counts_from_where_the_sensor_was_and_its_end_is_known(lasts: int) -> None:
    values = np.concatenate([np.zeros(100), np.full(lasts, 0.1), np.full(lasts, -0.1), np.zeros(200)])
    held = run(values)
    assert held[2 * lasts] == pytest.approx(-0.1 if lasts < 1000 else 0.0, abs=0.01)
    assert held[lasts + 150] == pytest.approx(-0.1, abs=0.01)
    assert not held[2 * lasts + 150 :].any()


def test_without_a_smallest_size_each_edge_shows_and_none_is_held() -> None:
    edges = run(step(0.02), smallest=None)
    assert edges.max() == pytest.approx(0.02, abs=0.01)
    assert np.count_nonzero(edges) < 10


@pytest.mark.parametrize(
    ("bridged", "believed"), [(range(0), 1), (range(0, 95), 1), (range(99, 100), 0), (range(101, 200), 0)]
)
def test_no_edge_is_believed_whose_jump_was_bridged_across_losses(bridged: range, believed: int) -> None:
    complete = np.array([k not in bridged for k in range(200)])
    held = run(np.where(np.arange(200) >= 100, 0.08, 0.0), np.zeros(200), complete=complete)[-1]
    assert held == pytest.approx(0.08 * believed)


@given(seed=st.integers(0, 10_000), smallest=st.sampled_from([None, 0.05, 0.4]), parts=cuts(600))
def test_cuts_do_not_change_a_bit(seed: int, smallest: float | None, parts: list[slice]) -> None:
    rng = np.random.default_rng(seed)
    jumps = rng.choice([0.0, -0.3, 0.06, 0.3], p=[0.97, 0.01, 0.01, 0.01], size=600)
    values = np.cumsum(jumps) + rng.choice([0.0, 0.002]) * rng.normal(size=600)
    values[rng.random(600) < 0.002] = rng.choice([np.nan, np.inf, 1e308])
    J = np.where(rng.random(600) < 0.005, 20.0, 1.0)
    complete = (rng.random(600) > 0.1).astype(np.uint8)
    one, other = (edge_detector(RATE_HZ, 14.0, smallest, hold_s=0.5) for _ in range(2))
    whole = one.run(values, J, complete)
    assert same_bits(np.concatenate([other.run(values[part], J[part], complete[part]) for part in parts]), whole)
