"""Inequalities in unknown matrices: expressions have the values that NumPy gives, and known optima are found."""

from __future__ import annotations

import numpy as np
import pytest

from gains.synthesis.affine_matrix import Unknowns, block, trace, within, zero
from gains.synthesis.solver import DEFAULT, minimise


def test_expressions_have_the_values_that_numpy_gives() -> None:
    random = np.random.default_rng(1)
    unknowns = Unknowns()
    P, R, D, number = unknowns.symmetric(3), unknowns.matrix(3, 2), unknowns.diagonal(2), unknowns.matrix()
    unknowns.values = random.normal(size=unknowns.count)
    M, N, K = random.normal(size=(4, 3)), random.normal(size=(3, 2)), random.normal(size=(4, 4))
    p, r, d, x = (y.value for y in (P, R, D, number))
    assert np.array_equal(p, p.T)
    assert np.array_equal(d, np.diag(np.diag(d)))
    assert np.allclose((M @ P @ N - 2.0 * (M @ R) / 3.0 + 1.0).value, M @ p @ N - 2.0 * (M @ r) / 3.0 + 1.0)
    assert np.allclose((K - number * np.eye(4))[1:3].value, (K - x * np.eye(4))[1:3])
    assert np.allclose(block([[P, R], [R.T, D]]).value, np.block([[p, r], [r.T, d]]))
    assert np.isclose(trace(P - number * np.eye(3)).number, np.trace(p) - 3.0 * x[0, 0])


def test_the_least_multiple_of_the_identity_above_a_matrix_is_its_largest_eigenvalue() -> None:
    matrix = np.array([[2.0, 1.0, 0.0], [1.0, -1.0, 0.5], [0.0, 0.5, 0.3]])
    size = Unknowns().matrix()
    assert minimise(size, [size * np.eye(3) >> matrix], DEFAULT).status == "optimal"
    assert size.number == pytest.approx(np.linalg.eigvalsh(matrix)[-1], rel=1e-6)


def test_equations_and_bounds_hold_and_what_contradicts_itself_is_infeasible() -> None:
    x = Unknowns().matrix(2, 2)
    kept = [zero(x[:1] - np.array([[1.0, -2.0]])), *within(x, 3.0)]
    assert minimise(trace(x), kept, DEFAULT).status == "optimal"
    assert x.value == pytest.approx(np.array([[1.0, -2.0], [x.value[1, 0], -3.0]]), abs=1e-6)
    assert minimise(trace(x), [*kept, x >= 0.0], DEFAULT).status == "infeasible"
    assert np.isnan(x.value).all()
