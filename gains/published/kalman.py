"""Baseline: augmented-state (extended) Kalman filter with random-walk faults, the usual alternative.

xa = [x; f_s; f_a] in discrete time, faults as random walks and all scales as standard deviations per sample:

    x+   = A x + B v + c + G g(H x) + E_f f_a + E_1 w_1        f+ = f + rate / rate_hz * white noise
    y    = C x + D_f f_s + D_1 w_2

The walk of f_s is an ASSUMPTION that the filter needs and FAUIO does not: with too small a rate the filter follows a
sensor fault late, with too large a rate it ignores the sensor. Noise and states get a floor (``FLOOR`` of what the
outputs show of the one-sample uncertainty), because an output without noise would count as exact.

:func:`design_ekf` is the steady-state filter at the middle of the slopes, with the true g in its prediction; it
compiles to the same gains as every observer, in the current form x^(k|k).
"""

from dataclasses import dataclass

import numpy as np

from adapters.errors import InfeasibleError, ModelError
from gains.analysis.augment import slope_matrix
from gains.plants.discretise import discretise
from gains.plants.plant import FloatArray, Plant
from gains.synthesis.compilation import common_fields, recursion, selection
from gains.synthesis.design import ObserverMatrices, design_figures
from gains.synthesis.gains_file import Gains

FLOOR = 1e-2
"""Floor of noise and states, as a share of the uncertainty of one sample: as for our own designs
(gains.synthesis.conditioning), so that both have the same information."""
_STABILITY_TOLERANCE = 1e-7
"""Smallest distance of a stable pole from the unit circle: the Riccati solver returns poles on the circle within the
square root of rounding."""


@dataclass(frozen=True, slots=True, eq=False)
class FilterModel:
    """The augmented discrete model of a discrete plant: xa = [x; f_s; f_a].

    A (na, na) is without the nonlinearity; C is (p, na), G (na, m), H (arguments, na). Q (na, na) and R (p, p) are
    covariances per sample.
    """

    plant: Plant
    A: FloatArray
    C: FloatArray
    G: FloatArray
    H: FloatArray
    Q: FloatArray
    R: FloatArray


def filter_model(plant: Plant, rate_hz: float | None = None) -> FilterModel:
    """Return the augmented model of a plant at a rate, which a continuous one needs."""
    rate_hz = plant.rate_hz if rate_hz is None else rate_hz
    if rate_hz is None:
        raise ModelError(f"{plant.name}: a continuous model needs a rate in samples per second")
    discrete = discretise(plant, rate_hz)
    n, p, m = len(plant.states), len(plant.outputs), len(plant.nonlinearities)
    faults = (*discrete.sensor_faults, *discrete.actuator_faults)
    nz, na = n + len(discrete.sensor_faults), n + len(faults)
    A, C, G = np.eye(na), np.zeros((p, na)), np.zeros((na, m))
    A[:n, :n], A[:n, nz:], G[:n] = discrete.A, discrete.E_f, discrete.G
    C[:, :n], C[:, n:nz] = discrete.C, discrete.D_f
    Q, R = np.zeros((na, na)), discrete.D @ discrete.D.T
    Q[:n, :n] = discrete.E @ discrete.E.T
    Q[n:, n:] = np.diag([(fault.rate / rate_hz) ** 2 for fault in faults])
    spread = C @ (Q + A @ Q @ A.T) @ C.T + R
    size = np.diag(spread)
    floor = np.where(size > 0.0, size, np.max(size, initial=0.0) or 1.0)
    Q[:n, :n] += FLOOR**2 * np.diag(np.diag((A @ Q @ A.T)[:n, :n]))
    return FilterModel(
        plant=discrete,
        A=A,
        C=C,
        G=G,
        H=np.hstack([discrete.H, np.zeros((len(plant.H), nz - n)), discrete.H_f]),
        Q=Q,
        R=R + FLOOR**2 * np.diag(floor),
    )


def design_ekf(plant: Plant, rate_hz: float | None = None) -> Gains:
    """Return the compiled steady-state filter of a continuous model, sampled at a rate, or of a discrete one.

    The residual of its recursion is the innovation y - Cb xa^(k|k-1). It has no bound.

    Raises
    ------
    ModelError
        The model cannot be sampled at that rate.
    InfeasibleError
        The Riccati equation has no stabilising solution: a fault with a random walk has no effect on any output.
    """
    from scipy.linalg import solve_discrete_are

    model = filter_model(plant, rate_hz)
    discrete, C = model.plant, model.C
    middle = np.concatenate([np.zeros(0), *(g.slopes.mean(axis=1) for g in discrete.nonlinearities)])
    A = model.A + model.G @ slope_matrix(discrete, middle) @ model.H
    failed = InfeasibleError(
        f"{plant.name}: the Kalman filter has no steady state: some fault or state shows in no output"
    )
    try:
        Sigma = solve_discrete_are(A.T, C.T, model.Q, model.R)
    except np.linalg.LinAlgError as error:
        raise failed from error
    # K = Sigma C' (C Sigma C' + R)^-1 with the stationary covariance of the prediction
    K = np.linalg.solve(C @ Sigma @ C.T + model.R, C @ Sigma).T
    if np.max(np.abs(np.linalg.eigvals(A - A @ K @ C))) >= 1.0 - _STABILITY_TOLERANCE:
        raise failed
    return _compiled(plant, model, np.asarray(K, dtype=np.float64))


def _compiled(plant: Plant, model: FilterModel, K: FloatArray) -> Gains:
    """Return the recursion s = [xa^(k|k-1); v(k-1); ...] with xa^ = s + K (y - Cb s)."""
    discrete, na, n = model.plant, len(K), len(plant.states)
    nz, rate_hz = na - len(plant.actuator_faults), float(discrete.rate_hz or 0.0)
    z = selection(discrete, na)
    innovation = z.y - model.C @ z.own
    estimate = z.own + K @ innovation
    moved = model.A @ estimate + np.eye(na, n) @ z.drive(discrete)
    closed = model.A @ (np.eye(na) - K @ model.C)
    matrices = ObserverMatrices(
        K=K[:nz], L_i=K[nz:], L_p=K[nz:], L1=np.eye(nz, n), F=K[:nz], N=closed[:nz, :nz], J=(model.A @ K)[:nz]
    )
    start = np.eye(na, n) @ np.linalg.pinv(plant.C)
    note = "f_s is assumed to be a random walk of its rate; no bound is claimed"
    return Gains(
        **common_fields(plant, matrices),
        **recursion(
            discrete,
            z,
            moved,
            np.vstack([estimate, innovation]),
            start,
            estimate[: len(discrete.states)],
            estimate[nz:],
        ),
        method="ekf",
        domain="discrete",
        rate_hz=rate_hz,
        report=design_figures(plant.name, "ekf", "discrete", rate_hz, notes=[note]),
    )
