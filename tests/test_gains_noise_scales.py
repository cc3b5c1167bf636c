"""Disturbance and noise told apart in simulated data."""

import numpy as np
import pytest

from gains.identification.noise_scales import fit_noise_scales

A = np.array([[1.0, 0.02], [-0.5, 0.97]])
C = np.array([[1.0, 0.0]])
E = np.array([[0.0], [1.0]])


def residuals(q: float, r: float) -> np.ndarray:
    rng = np.random.default_rng(7)
    x, found = np.zeros((40, 2)), np.empty((40, 150, 1))
    for k in range(150):
        found[:, k] = x @ C.T + r * rng.normal(size=(40, 1))
        x = x @ A.T + q * rng.normal(size=(40, 1)) @ E.T
    return found


@pytest.mark.parametrize(("q", "r"), [(0.05, 0.02), (0.05, 0.05), (0.5, 0.01)])
def test_both_scales_are_found(q: float, r: float) -> None:
    found = fit_noise_scales(A, C, E, np.eye(1), residuals(q, r))
    assert found.disturbances[0] == pytest.approx(q, rel=0.12)
    assert found.noises[0] == pytest.approx(r, rel=0.12)
    assert np.abs(np.linalg.eigvals(A - A @ found.K @ C)).max() < 1.0


def test_noise_that_nothing_calls_for_is_next_to_nothing() -> None:
    found = fit_noise_scales(A, C, E, np.eye(1), residuals(0.0, 0.1))
    assert found.disturbances[0] < 1e-3
    assert found.noises[0] == pytest.approx(0.1, rel=0.05)


def test_an_unstable_plant_gets_a_filter_that_holds_it() -> None:
    unstable = np.array([[1.02]])
    noise = np.random.default_rng(1).normal(size=(20, 60, 1))
    found = fit_noise_scales(unstable, np.eye(1), np.eye(1), np.eye(1), noise)
    assert abs(1.02 * (1.0 - found.K[0, 0])) < 1.0
