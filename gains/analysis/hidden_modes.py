"""Unobservable modes, found independently of units."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gains.plants.plant import Domain, FloatArray, Plant

_RANK_TOLERANCE = 1e-10
"""Singular value below which a direction is in the kernel, in units of the signals. Measured on the plants of the
tests: kernels have 1e-13 at most, all others 4e-6 and more."""
_STABILITY_TOLERANCE = 1e-8
"""Decay below which a mode stays, in units of the size of A. Measured on the plants of the tests: modes that stay have
1e-13 at most, modes that decay 4e-4 and more; a slower one decays for days."""

_SHARE = 0.05
"""Share of the largest motion, in units of the errors that matter, below which a signal is left out of texts. Chosen:
less than a twentieth tells a reader nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class HiddenMode:
    """The eigenvalue (z in discrete time, otherwise s) of an unobservable mode, and how each signal moves in it.

    ``decay`` is 1 - |z|, or -Re s over the size of A.
    """

    eigenvalue: complex
    motion: NDArray[np.complex128]
    decay: float

    @property
    def direction(self) -> FloatArray:
        """Size of each signal's motion in the mode."""
        return np.abs(self.motion)

    @property
    def stays(self) -> bool:
        """Whether the mode does not decay by itself."""
        return self.decay <= _STABILITY_TOLERANCE


def hidden_modes(A: FloatArray, C: FloatArray, scales: FloatArray, domain: Domain) -> list[HiddenMode]:
    """Return the modes of A (n, n) in the unobservable subspace of (A, C), C (p, n), those that decay least first.

    The subspace is the largest one inside the kernel of C that A maps into itself; it is found from A - I,
    which has the same invariant subspaces and stays well scaled at high rates. Rank decisions are made in units of the
    signals' sizes ``scales`` (n,).
    """
    step = step_matrix(A, domain) / scales[:, None] * scales
    size = float(np.linalg.norm(step, 2)) or 1.0
    step = step / size
    outputs = C * scales
    basis = kernel(outputs / row_norms(outputs)[:, None])
    while basis.shape[1]:
        image = step @ basis
        inside = kernel(image - basis @ (basis.T @ image))
        if inside.shape[1] == basis.shape[1]:
            break
        basis = basis @ inside
    if not basis.shape[1]:
        return []
    values, vectors = np.linalg.eig(basis.T @ (A / scales[:, None] * scales) @ basis)
    decay = 1.0 - np.abs(values) if domain == "discrete" else -values.real / size
    return [
        HiddenMode(complex(values[i]), scales * (basis @ vectors[:, i]), float(decay[i]))
        for i in np.argsort(decay, kind="stable")
    ]


def leading(names: Sequence[str], sizes: FloatArray) -> tuple[str, ...]:
    """Return the names of the signals that move, the largest first: those with ``_SHARE`` of the largest or more."""
    order = np.argsort(-sizes, kind="stable")
    return tuple(names[i] for i in order if sizes[i] >= _SHARE * np.max(sizes) > 0.0)


def signal_scales(plant: Plant) -> FloatArray:
    """Return sizes of [x; f_s; f_a] that make rank decisions independent of units."""
    from scipy.linalg import matrix_balance

    step = step_matrix(plant.A, plant.domain)
    _, (states, _) = matrix_balance(step, permute=False, separate=True)
    size = np.linalg.norm(step / states[:, None] * states, 2) or 1.0
    rows = row_norms(plant.C * states)
    sensor = 1.0 / np.linalg.norm(plant.D_f / rows[:, None], axis=0)
    actuator = size / np.linalg.norm(plant.E_f / states[:, None], axis=0)
    return np.concatenate([states, sensor, actuator])


def step_matrix(A: FloatArray, domain: Domain) -> FloatArray:
    """Return the change that A gives a state: A - I in discrete time, A itself in continuous time."""
    return A - np.eye(len(A)) if domain == "discrete" else A


def kernel(matrix: FloatArray) -> FloatArray:
    """Return an orthonormal basis of the kernel as columns."""
    _, singular, right = np.linalg.svd(matrix)
    return right[int(np.sum(singular > _RANK_TOLERANCE)) :].T


def row_norms(matrices: NDArray[Any]) -> FloatArray:
    """Return the length of each row of a matrix or of several, one for a row of zeros."""
    norms = np.linalg.norm(matrices, axis=-1)
    return np.where(norms > 0.0, norms, 1.0)
