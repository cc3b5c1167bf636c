"""Scales of process disturbance and measurement noise, by maximum likelihood of the innovations.

With Q = sum q_i^2 E_i E_i^T and R = sum r_j^2 D_j D_j^T the Riccati equation gives the Kalman gain K and the covariance
S of the innovations e; the scales minimise N log det S + sum e^T S^-1 e (Ljung 1999, section 7.4). A disturbance is
held over each sample: its scale is its standard deviation, as in a plant's disturbances. White signals are assumed;
others are represented by the white signals that are nearest to them.
"""

from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from gains.analysis.riccati import doubled
from gains.plants.plant import FloatArray

_SPAN = (1e-4, 20.0)
"""Smallest and largest scale, as shares of the scale at which a signal alone would explain the residuals: from nearly
nothing to clearly too much."""
_ITERATIONS = 40
"""Largest number of iterations. Measured on the turret of the tests: 10 give the scales of 40 in all digits."""
_MOST = 60
"""Largest number of windows on which the likelihood is computed, spread evenly: its cost grows with them. 60 of 100
samples determine a scale to 1 / sqrt(12,000), which is .9 %; measured on the turret of the tests, 15 move a scale by up
to 4 %, 30 and 150 do not move it."""
_EPSILON = 1e-4
"""Step of the logarithm of a scale for differences of the likelihood. Measured on the turret of the tests: 1e-6 gives
the same scales, 1e-2 half a percent less."""
_FLOOR = 1e-5
"""Least noise, as a share of each residual's size: it keeps the covariance of outputs without noise invertible.
Measured on the turret of the tests: 1e-7 and 1e-3 give the same scales."""
_STARTS = (1.0, 0.3, 0.1, 0.03, 0.01, 0.001)
"""Shares of disturbance and of noise at the starts, in all combinations, because the likelihood has several maxima.
Measured on the turret of the tests: one start finds the same scales, except for a disturbance too small to be
distinguished from noise."""


@dataclass(frozen=True, slots=True, eq=False)
class NoiseScales:
    """The most likely scales and the Kalman filter that belongs to them."""

    # q (number of disturbances,) and r (number of noises,); nearly zero if the data do not need it
    disturbances: FloatArray
    noises: FloatArray
    K: FloatArray  # filter gain (n, p): x^ + K e is the state after the measurement
    S: FloatArray  # covariance of the innovations (p, p)


def fit_noise_scales(A: FloatArray, C: FloatArray, E: FloatArray, D: FloatArray, residuals: FloatArray) -> NoiseScales:
    """Return the scales that make the residuals of a simulation most likely.

    A (n, n) is the transition of a sample, linearised if the plant is not linear, C (p, n) the outputs; E (n, q) and D
    (p, r) are the columns of disturbances and noises, not scaled; ``residuals`` are y - y^ of simulations over windows,
    each from its own initial state (W, T, p).
    """
    from scipy.optimize import minimize

    size = np.maximum(np.sqrt((residuals**2).mean(axis=(0, 1))), 1e-12)
    noise_one = 1.0 / np.maximum(np.sqrt(np.mean((D / size[:, None]) ** 2, axis=0)), 1e-100)
    reference = np.concatenate([_effect_one(A, C, E, size, residuals.shape[1]), noise_one])
    floor = np.diag((_FLOOR * size) ** 2)
    q = E.shape[1]

    def filters_at(logs: FloatArray) -> tuple[FloatArray, FloatArray]:
        scales = reference * np.exp(logs)
        Q = np.einsum("iq,mq,jq->mij", E, scales[:, :q] ** 2, E)
        R = np.einsum("ir,mr,jr->mij", D, scales[:, q:] ** 2, D) + floor
        return _kalman(A, C, Q, R, size)

    def objective(logs: FloatArray) -> tuple[float, FloatArray]:
        values = _likelihoods(A, C, *filters_at(logs + np.vstack([0.0 * logs, _EPSILON * np.eye(len(logs))])), shown)
        return float(values[0]), (values[1:] - values[0]) / _EPSILON

    shown = residuals[np.linspace(0, len(residuals) - 1, min(len(residuals), _MOST)).round().astype(int)]
    bounds = [(np.log(_SPAN[0]), np.log(_SPAN[1]))] * len(reference)
    # the likelihood has several maxima: start at the best of a few shares of disturbance and noise
    steps = np.log(_STARTS)
    grid = np.array([[a] * q + [b] * (len(reference) - q) for a in steps for b in steps])
    start = grid[int(np.argmin(_likelihoods(A, C, *filters_at(grid), shown)))]
    options = {"maxiter": _ITERATIONS, "ftol": 1e-6}
    best = minimize(objective, start, method="L-BFGS-B", jac=True, bounds=bounds, options=options)
    K, S = filters_at(best.x[None])
    scales = reference * np.exp(best.x)
    return NoiseScales(scales[:q], scales[q:], K[0], S[0])


def _effect_one(A: FloatArray, C: FloatArray, E: FloatArray, size: FloatArray, steps: int) -> FloatArray:
    """Return the scale at which each disturbance alone would explain the size of the residuals."""
    response, energy = E.copy(), np.zeros(E.shape[1])
    for _ in range(steps):
        energy += np.mean(((C @ response) / size[:, None]) ** 2, axis=0)
        response = A @ response
        if not np.isfinite(energy).all() or energy.max(initial=0.0) > 1e200:
            break
    return np.asarray(1.0 / np.sqrt(np.maximum(np.nan_to_num(energy, posinf=1e200), 1e-200)))


def _kalman(
    A: FloatArray, C: FloatArray, Q: FloatArray, R: FloatArray, size: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return filter gains (M, n, p) and innovation covariances (M, p, p) for M pairs of Q and R.

    Riccati's equation is solved in units in which the residual of each output is one. If it has no solution, the gain
    is zero and the covariance so large that the likelihood is never the best.
    """
    C_1, R_1 = C / size[:, None], R / np.outer(size, size)
    P = np.full_like(Q, np.nan)
    with np.errstate(all="ignore"):
        for m in range(len(Q)):
            with suppress(np.linalg.LinAlgError):
                P[m] = doubled(A.T, C_1.T @ np.linalg.solve(R_1[m], C_1), Q[m])
        S = C_1 @ P @ C_1.T + R_1
        bad = ~np.isfinite(S).all(axis=(1, 2)) | ~(np.linalg.eigvalsh(np.nan_to_num(S)).min(axis=1) > 0.0)
        P[bad], S[bad] = 0.0, 1e12 * np.eye(len(C))
        K = np.swapaxes(np.linalg.solve(S, C_1 @ P), 1, 2)
    return K / size, S * np.outer(size, size)


def _likelihoods(A: FloatArray, C: FloatArray, K: FloatArray, S: FloatArray, residuals: FloatArray) -> FloatArray:
    """Return minus twice the logarithm of the likelihood for each of M filters, up to a constant.

    Initial states are free. Filter and simulation differ by d: d(k+1) = A (d + K e), e = r - C d, linear in d(0).
    """
    (W, T, p), (M, n, _) = residuals.shape, K.shape
    root = np.linalg.cholesky(S)
    whiten = np.swapaxes(np.linalg.inv(root), 1, 2)
    innovations, sensitivity = np.empty((T, M, W, p)), np.empty((T, M, n, p))
    d, effect, C_T = np.zeros((M, W, n)), np.tile(np.eye(n), (M, 1, 1)), C.T
    closed, injection = np.swapaxes(A - A @ K @ C, 1, 2), np.swapaxes(A @ K, 1, 2)
    rows = np.moveaxis(residuals, 1, 0)
    with np.errstate(all="ignore"):
        for k in range(T):
            innovations[k] = rows[k] - d @ C_T
            sensitivity[k] = effect @ C_T
            d = d @ closed + rows[k] @ injection
            effect = effect @ closed
        e = np.moveaxis(innovations @ whiten, (1, 2), (0, 1)).reshape(M, W, T * p)
        slopes = np.moveaxis(sensitivity @ whiten, 0, 2).reshape(M, n, T * p)
    bad = ~(np.isfinite(e).all(axis=(1, 2)) & np.isfinite(slopes).all(axis=(1, 2)))
    e[bad], slopes[bad] = 1e6, 0.0
    basis, upper = np.linalg.qr(np.swapaxes(slopes, 1, 2))
    sizes = np.abs(np.diagonal(upper, axis1=1, axis2=2))
    basis *= (sizes > 1e-9 * np.maximum(sizes.max(axis=1, keepdims=True), 1e-300))[:, None, :]
    left = np.sum(e**2, axis=(1, 2)) - np.sum((e @ basis) ** 2, axis=(1, 2))
    log_det = 2.0 * np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
    return np.asarray(W * (T - n / p) * log_det + left)
