"""Edges: a jump that stays is held with its size, a ramp or a loud hypothesis is not, the opposite jump cancels it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from monitor.estimation.edge import EdgeDetector

RATE_HZ = 100.0


def run(values: np.ndarray, J: np.ndarray | None = None, smallest: float | None = 0.05) -> np.ndarray:
    detector = EdgeDetector(RATE_HZ, limit=14.0, smallest=smallest)
    scores = np.ones(len(values)) if J is None else J
    return np.array([detector.update(float(value), float(score)) for value, score in zip(values, scores, strict=True)])


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


def test_a_jump_that_the_sensor_alone_does_not_explain_is_no_edge() -> None:
    assert not run(step(0.5), J=np.full(300, 20.0)).any()


def test_the_opposite_jump_cancels_what_is_held() -> None:
    values = np.concatenate([np.zeros(100), np.full(200, 0.1), np.zeros(200)])
    held = run(values)
    assert held[250] == pytest.approx(0.1)
    assert held[-1] == 0.0


def test_an_edge_is_forgotten_after_ten_seconds() -> None:
    held = run(step(0.1, count=1300))
    assert held[1000] == pytest.approx(0.1, abs=0.01)
    assert held[-1] == 0.0


def test_without_a_smallest_size_each_edge_shows_and_none_is_held() -> None:
    edges = run(step(0.02), smallest=None)
    assert edges.max() == pytest.approx(0.02, abs=0.01)
    assert np.count_nonzero(edges) < 10


def test_no_edge_is_found_among_samples_that_were_bridged_across_losses() -> None:
    def held(bridged_every: int) -> float:
        detector = EdgeDetector(100.0, 10.0, 0.05)
        for index in range(200):
            complete = index % bridged_every != 0 if bridged_every else True
            detector.update(0.08 if index >= 100 else 0.0, 0.0, complete)
        return detector.held

    assert held(0) == pytest.approx(0.08)
    assert held(4) == pytest.approx(0.08)
    assert held(1) == 0.0


@given(
    seed=st.integers(0, 10_000),
    smallest=st.sampled_from([None, 0.05, 0.4]),
    lengths=st.lists(st.integers(0, 120), min_size=1, max_size=12),
)
def test_a_stretch_gives_what_its_samples_give_one_by_one(
    seed: int, smallest: float | None, lengths: list[int]
) -> None:
    rng = np.random.default_rng(seed)
    count = sum(max(1, length) for length in lengths)
    jumps = rng.choice([0.0, -0.3, 0.06, 0.3], p=[0.97, 0.01, 0.01, 0.01], size=count)
    values = np.cumsum(jumps) + rng.choice([0.0, 0.002]) * rng.normal(size=count)
    values[rng.random(count) < 0.002] = rng.choice([np.nan, np.inf, 1e308])
    J = np.where(rng.random(count) < 0.005, 20.0, 1.0)
    complete = rng.random(count) > 0.1
    one, many = (EdgeDetector(RATE_HZ, 14.0, smallest, hold_s=0.5) for _ in range(2))
    at = 0
    for length in lengths:
        rows = slice(at, at + max(1, length))
        given_back, held = many.run(values[rows], J[rows], complete[rows])
        for k in range(rows.start, rows.stop):
            expected = one.update(float(values[k]), float(J[k]), bool(complete[k]))
            assert (given_back[k - at], held[k - at]) == (expected, one.held)
        assert many.edge == one.edge
        if length == 0:
            assert [len(part) for part in many.run(values[:0], J[:0], complete[:0])] == [0, 0]
            for detector in (one, many):
                detector.update(0.0, 1.0)
        at = rows.stop
