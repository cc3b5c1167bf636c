"""Coordinates in which the synthesis is well scaled: the errors of a Kalman filter have size one.

For the error system of :mod:`gains.analysis.augment` at its mean slopes, driven by white noise of the size of its
weights, the stationary covariance of the one-step errors is S S', that of the innovations Y Y'. In the coordinates S^-1
[zeta~; z] and Y^-1 yt every error and every innovation is of size one, whatever the units. The norm of that filter
predicts the size of mu.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from adapters.errors import InfeasibleError
from gains.analysis.augment import ErrorModel
from gains.analysis.hinf import hinf_norm
from gains.analysis.riccati import doubled
from gains.plants.plant import FloatArray

FLOOR = 1e-2
"""Share of fictitious noise in an error or innovation. Measured on the arm: below 1e-3 the gains of the case without
noise grow a hundredfold (3e4 at 1e-4), at 3e-2 the bounds are .6 % looser and at 1e-1 up to six times; from 1e-3 to
1e-2 they are the same within .1 %."""
_SMALLEST_SHARE = 1e-6
"""Smallest scale of a state, as a share of the error that matters. Measured on the arm: from 1e-9 to 1e-3 the same
bounds."""
_FLOOR_SWEEPS = 6
"""Number of iterations for the floor of noise, which depends on the error that it influences. Measured: one fails on
the arm, two give the result of twelve."""


@dataclass(frozen=True, slots=True, eq=False)
class Coordinates:
    """Triangular S (na, na) and Y (p, p), and the filter they come from: its squared norm and its gains.

    ``gain`` (na, p) acts on the next error, ``direct`` (na, p) on this one; in continuous time both are empty.
    """

    S: FloatArray
    Y: FloatArray
    mu: float
    gain: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    direct: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))


def kalman_coordinates(model: ErrorModel, pole_radius: float = 1.0, caution: float = 0.0) -> Coordinates:
    """Return the coordinates of a model.

    With a pole radius below one they are the coordinates of the filter whose poles lie within it: the Kalman filter of
    the model with A divided by the radius (prescribed degree of stability).

    With caution the filter has smaller gains, because it assumes that much more noise in the outputs, in units of the
    outputs that the errors that matter cause.

    States and outputs get a floor of fictitious noise, ``FLOOR`` of their own stationary error, because a
    direction without any noise would be known exactly and have no scale.

    Raises
    ------
    InfeasibleError
        The Riccati equation has no solution that numbers can represent.
    """
    A, C = model.mean / pole_radius, model.C
    Q, S, R = model.B @ model.B.T, model.B @ model.D.T, model.D @ model.D.T
    R = R + caution**2 * np.diag(np.max(np.abs(C) * model.sizes, axis=1) ** 2)
    smallest = (_SMALLEST_SHARE * model.sizes) ** 2
    variance = np.maximum(np.diag(Q), smallest)
    try:
        for _ in range(_FLOOR_SWEEPS):
            floor = FLOOR**2 * (np.diag(C @ np.diag(variance) @ C.T) + np.diag(R))
            inverse = np.linalg.inv(R + np.diag(floor))
            remainder = Q + FLOOR**2 * np.diag(variance) - S @ inverse @ S.T
            Sigma = doubled((A - S @ inverse @ C).T, C.T @ inverse @ C, remainder)
            previous, variance = variance, np.maximum(np.diag(Sigma), smallest)
            if np.allclose(variance, previous, rtol=0.2, atol=0.0):
                break
        # Kalman's gain (A Sigma C' + S) (C Sigma C' + R)^-1 for the next error, Sigma C' (...)^-1 for L_e of this one
        innovation = C @ Sigma @ C.T + R + np.diag(floor)
        gain = np.linalg.solve(innovation, (A @ Sigma @ C.T + S).T).T
        direct = np.asarray(np.linalg.solve(innovation, C @ Sigma).T, dtype=np.float64)
        S_factor = np.asarray(np.linalg.cholesky(Sigma), dtype=np.float64)
        Y_factor = np.asarray(np.linalg.cholesky(innovation), dtype=np.float64)
    except np.linalg.LinAlgError as error:
        raise InfeasibleError(
            f"{model.name}: its numbers are too far apart: check units, scales of disturbance and noise"
        ) from error
    floored = with_floor(model, S_factor, Y_factor)
    C_e, D_e = floored.output(direct[model.fixed : len(model.weights)])
    norm = hinf_norm(A - gain @ C, floored.B - gain @ floored.D, C_e, D_e, discrete=True)
    if not np.isfinite(norm.lower):
        raise InfeasibleError(
            f"{model.name}: its numbers are too far apart: check units, scales of disturbance and noise"
        )
    return Coordinates(S_factor, Y_factor, norm.lower**2, np.asarray(pole_radius * gain, dtype=np.float64), direct)


def with_floor(model: ErrorModel, S: FloatArray, Y: FloatArray) -> ErrorModel:
    """Return the model with fictitious noise of ``FLOOR`` on every error and every innovation."""
    na, p = len(S), len(Y)
    return replace(
        model,
        B=np.hstack([model.B, FLOOR * S, np.zeros((na, p))]),
        D=np.hstack([model.D, np.zeros((p, na)), FLOOR * Y]),
        direct=np.pad(model.direct, ((0, 0), (0, na + p))),
        free=replace(model.free, B=np.pad(model.free.B, ((0, 0), (0, na + p)))),
    )
