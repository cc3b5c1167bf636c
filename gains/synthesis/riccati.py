"""A design without a solver: the gains of a Kalman filter, and a Riccati equation's solution that proves them.

Where numbers lie far apart the solver of matrix inequalities can stop short although gains exist. A filter exists
whenever the plant is detectable, and its coordinates (:mod:`gains.synthesis.conditioning`) are those in which its own
error is of size one. In them the least storage function for a bound gamma above the norm of the closed error system
solves

    P = A^T P A + C^T C + eps I + (A^T P B + C^T D) (gamma^2 I - D^T D - B^T P B)^-1 (A^T P B + C^T D)^T

and eps > 0 puts it inside the inequality of :mod:`gains.synthesis.certificate`, which decides. The bound is that of
these gains, not the least there is: for linear plants, as the last resort.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gains.analysis.augment import ErrorModel
from gains.analysis.hinf import hinf_norm
from gains.plants.plant import FloatArray
from gains.synthesis.conditioning import Coordinates, doubled

_MARGINS = (1e-3, 1e-2, 1e-1)
"""By how much the bound lies above the norm, tried in turn until the certificate holds: what a design loses by it."""
_INSIDE = 1e-2
"""eps, as a share of a margin and of the size of C^T C. Chosen: smaller leaves less room for rounding, larger moves the
bound by more than its margin.
"""


def riccati_proofs(
    model: ErrorModel, coordinates: Coordinates
) -> Iterator[tuple[FloatArray, FloatArray, FloatArray, float]]:
    """Yield [Kb; L_i], L_p, P and mu in users' units for a linear discrete error system, the least mu first."""
    S, a1 = coordinates.S, model.a1
    inverse = np.linalg.inv(S)
    injection, L_p = coordinates.gain, coordinates.direct[len(model.weights) - a1 : len(model.weights)]
    C, D = model.output(L_p)
    A, B, C = inverse @ (model.mean - injection @ model.C) @ S, inverse @ (model.B - injection @ model.D), C @ S
    norm = hinf_norm(A, B, C, D, discrete=True).upper
    if not 0.0 < norm < np.inf:
        return
    C, D = C / norm, D / norm
    for margin in _MARGINS:
        Q = C.T @ C + _INSIDE * margin * np.linalg.norm(C, 2) ** 2 * np.eye(len(A))
        R, cross = D.T @ D - (1.0 + margin) ** 2 * np.eye(B.shape[1]), C.T @ D
        try:
            solved = np.linalg.solve(R, np.hstack([cross.T, B.T]))
            left, right = solved[:, : len(A)], solved[:, len(A) :]
            P = doubled(A - B @ left, B @ right, Q - cross @ left)
        except np.linalg.LinAlgError:
            continue
        P = norm**2 * inverse.T @ P @ inverse
        yield injection, L_p, 0.5 * (P + P.T), (norm * (1.0 + margin) * (1.0 + 1e-6)) ** 2
