"""The H-infinity norm is enclosed to nine digits, whatever the scaling and however near the poles."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gains.analysis.hinf import gains_at, hinf_norm
from gains.plants.plant import FloatArray

System = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


def random_system(seed: int, decades: float) -> System:
    rng = np.random.default_rng(seed)
    n, m, p = rng.integers(1, 7), rng.integers(1, 4), rng.integers(1, 4)
    size = 10.0 ** rng.uniform(-decades, decades, n)
    A = size[:, None] * rng.normal(size=(n, n)) / size
    return A, size[:, None] * rng.normal(size=(n, m)), rng.normal(size=(p, n)) / size, rng.normal(size=(p, m))


def matrix(*rows: tuple[float, ...]) -> FloatArray:
    return np.array(rows)


@settings(deadline=None, derandomize=True)
@given(st.integers(0, 100_000), st.floats(0, 4), st.floats(-7, -0.05), st.booleans(), st.booleans())
def test_the_discrete_norm_encloses_the_grid(
    seed: int, decades: float, margin: float, feedthrough: bool, singular: bool
) -> None:
    A, B, C, D = random_system(seed, decades)
    if singular:
        A[:, 0] = 0.0
    A *= (1.0 - 10.0**margin) / max(float(np.max(np.abs(np.linalg.eigvals(A)))), 1e-3)
    D = D * feedthrough
    angles = np.concatenate([[0.0], np.geomspace(1e-6, math.pi, 400), np.abs(np.angle(np.linalg.eigvals(A)))])
    found, grid = hinf_norm(A, B, C, D, discrete=True), gains_at(A, B, C, D, angles, True)
    rounding = 1e-12 * 10.0**-margin
    assert grid.max() <= found.upper * (1.0 + rounding)
    assert found.upper <= found.lower * (1.0 + 2e-9)
    assert found.lower == pytest.approx(gains_at(A, B, C, D, np.array([found.omega]), True)[0], rel=1e-9 + rounding)


@settings(deadline=None, derandomize=True)
@given(st.integers(0, 100_000), st.floats(0, 4), st.floats(-6, 1), st.floats(-2, 3), st.booleans())
def test_the_continuous_norm_encloses_a_grid(
    seed: int, decades: float, margin: float, pace: float, feedthrough: bool
) -> None:
    A, B, C, D = random_system(seed, decades)
    A = 10.0**pace * (A - (np.max(np.linalg.eigvals(A).real) + 10.0**margin) * np.eye(len(A)))
    D = D * feedthrough
    poles = np.linalg.eigvals(A)
    near = [abs(pole.imag) + np.linspace(-3, 3, 31) * abs(pole.real) for pole in poles]
    grid = np.abs(np.concatenate([[0.0], np.geomspace(1e-7, 1e7, 800), *near]))
    found = hinf_norm(A, B, C, D, discrete=False)
    highest = float(gains_at(A, B, C, D, grid, False).max())
    assert highest <= found.upper * (1.0 + 1e-8)
    assert found.lower <= highest * 1.05
    assert found.upper <= found.lower * (1.0 + 2e-9)


@pytest.mark.parametrize(("radius", "angle"), [(0.9, 1.0), (0.999, 0.3), (0.99999, 2.0), (0.99, 0.001)])
def test_a_sharp_discrete_resonance_is_not_missed(radius: float, angle: float) -> None:
    pole = radius * np.exp(1j * angle)
    A = matrix((pole.real, pole.imag), (-pole.imag, pole.real))
    found = hinf_norm(A, np.eye(2), np.eye(2), np.zeros((2, 2)), discrete=True)
    assert found.lower == pytest.approx(1.0 / (1.0 - radius), rel=1e-6)


@pytest.mark.parametrize("damping", [0.5, 0.1, 1e-3, 1e-6])
def test_a_resonance_has_its_closed_form(damping: float) -> None:
    A, B, C = matrix((0.0, 1.0), (-4.0, -4.0 * damping)), matrix((0.0,), (4.0,)), matrix((1.0, 0.0))
    found = hinf_norm(A, B, C, np.zeros((1, 1)), discrete=False)
    assert found.lower == pytest.approx(1.0 / (2.0 * damping * math.sqrt(1.0 - damping**2)), rel=1e-8)
    assert found.omega == pytest.approx(2.0 * math.sqrt(1.0 - 2.0 * damping**2), rel=1e-4)


def test_the_norm_of_a_high_pass_is_at_infinity() -> None:
    found = hinf_norm(matrix((-1.0,)), matrix((1.0,)), matrix((-1.0,)), matrix((1.0,)), discrete=False)
    assert (found.lower, found.omega) == (1.0, math.inf)
    assert found.upper == pytest.approx(1.0, rel=1e-8)


def test_the_norm_of_an_all_pass_is_one_everywhere() -> None:
    found = hinf_norm(matrix((-3.0,)), matrix((6.0,)), matrix((-1.0,)), matrix((1.0,)), discrete=False)
    assert found.lower == pytest.approx(1.0, rel=1e-9)
    assert found.upper == pytest.approx(1.0, rel=1e-8)


@pytest.mark.parametrize(("discrete", "pole"), [(True, 1.0), (True, -1.2), (False, 0.0), (False, 2.0)])
def test_a_system_that_is_not_stable_has_no_norm(discrete: bool, pole: float) -> None:
    found = hinf_norm(matrix((pole,)), matrix((1.0,)), matrix((1.0,)), matrix((0.0,)), discrete)
    assert (found.lower, found.upper) == (math.inf, math.inf)


@pytest.mark.parametrize("discrete", [True, False])
def test_a_system_that_does_nothing_has_the_norm_zero(discrete: bool) -> None:
    found = hinf_norm(matrix((-0.5,)), np.zeros((1, 2)), matrix((1.0,)), np.zeros((1, 2)), discrete)
    assert (found.lower, found.upper) == (0.0, 0.0)
