"""Riccati's and Lyapunov's equations by doubling, without SciPy, which a running monitor does not import."""

import numpy as np

from gains.plants.plant import FloatArray

_DOUBLINGS = 60
"""Largest number of doublings. Convergence is quadratic; measured, six to ten suffice. Sixty reach a filter that needs
2 ^ 60 samples to forget."""


def doubled(X: FloatArray, G: FloatArray, H: FloatArray) -> FloatArray:
    """Return the limit of H in the structured doubling algorithm: a Riccati equation's stabilising solution.

    SciPy's solvers order a generalised Schur form, which fails on the continuous arm without noise.
    """
    riccati = bool(G.any())  # without G it is Lyapunov's equation
    for _ in range(_DOUBLINGS):
        left, right = X.T @ H, X
        if riccati:
            W = np.linalg.inv(np.eye(len(X)) + G @ H)
            left, right = left @ W, right @ W
            G = G + right @ G @ X.T
            G = 0.5 * (G + G.T)
        step = left @ X
        H, X = H + step, right @ X
        H = 0.5 * (H + H.T)
        if not np.all(np.isfinite(H)):
            raise np.linalg.LinAlgError
        if np.max(np.abs(step)) <= 1e-10 * np.max(np.abs(H)):
            break
    return H
