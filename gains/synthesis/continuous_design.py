"""A continuous design: gains of the paper's structure, the matrix that proves them and the bound it proves."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from gains.analysis.augment import ErrorModel
from gains.plants.plant import FloatArray, Plant
from gains.synthesis.continuous_observer import ContinuousObserver, FauioGains, fauio_observer

FaultState = Literal["integral", "error"]


@dataclass(frozen=True, slots=True, eq=False)
class ContinuousDesign:
    """Gains of one continuous observer.

    Parameters
    ----------
    method : str
        ``"convex"``, ``"theorem1"`` or ``"theorem2"``.
    gains : FauioGains
        K, L_i, L_p and what follows from them.
    P : FloatArray
        Matrix of the bounded-real inequality (na, na).
    mu : float
        The bound: the integral of |e|^2 is at most mu times that of the scaled |[w; w'; f_a']|^2.
    fault_state : {"integral", "error"}
        Coordinates of P: [zeta~; z] with z = f_a - q of the convex synthesis, or [zeta~; fa~] of the paper.
    solve_s, total_s : float
        Time in the solver and in all, seconds.
    notes : tuple[str, ...]
        What a person should know about this design.
    """

    method: str
    gains: FauioGains
    P: FloatArray
    mu: float
    fault_state: FaultState = "integral"
    solve_s: float = 0.0
    total_s: float = 0.0
    notes: tuple[str, ...] = ()

    @property
    def sqrt_mu(self) -> float:
        """Bound of the H-infinity norm from the scaled disturbances to the scaled errors."""
        return math.sqrt(self.mu)

    def observer(self, plant: Plant) -> ContinuousObserver:
        """Return the observer that runs."""
        return fauio_observer(
            plant,
            self.gains.K,
            self.gains.L_i,
            self.gains.L_p,
            self.method,
            sqrt_mu=self.sqrt_mu,
            solve_s=self.solve_s,
            total_s=self.total_s,
            notes=self.notes,
        )


class ContinuousErrorSystem(NamedTuple):
    """The closed error system: A at each slope vertex (vertices, na, na), then B, C and D with the weights applied."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray


def closed_error_system(model: ErrorModel, gains: FauioGains, fault_state: FaultState) -> ContinuousErrorSystem:
    """Close the error system of a continuous plant.

    With Kb = K + L1 E_f L_p the state [zeta~; z] obeys

        [zeta~; z]' = (A_a + vertex - [Kb; L_i] Ca) [zeta~; z] + (B - [Kb; L_i] D) [w; w'; f_a']
        fa~ = z - L_p (Cb zeta~ + D w)

    and the paper's state [zeta~; fa~] its (4.14), which differentiates yt:

        fa~' = f_a' - L_i (Cb zeta~ + D w) - L_p (Cb zeta~' + D w')

    They are one system for signals whose derivative is w'. A norm takes w and w' as independent, so there each has
    its own.

    Parameters
    ----------
    model : ErrorModel
        Error model of the continuous plant.
    gains : FauioGains
        The gains.
    fault_state : {"integral", "error"}
        Which of the two.
    """
    nz = len(gains.K)
    if fault_state == "integral":
        L1_E_f = model.A[0, :nz, nz:]
        injection = np.vstack([gains.K + L1_E_f @ gains.L_p, gains.L_i])
        C_e, D_e = model.output(gains.L_p)
        return ContinuousErrorSystem(model.A - injection @ model.C, model.B - injection @ model.D, C_e, D_e)
    q = (model.B.shape[1] - model.a1) // 2
    D_rate = np.roll(model.D, q, axis=1)
    A, B = np.empty_like(model.A), np.empty_like(model.B)
    A[:, :nz] = model.A[:, :nz] - gains.K @ model.C
    B[:nz] = model.B[:nz] - gains.K @ model.D
    C_b = model.C[:, :nz]
    A[:, nz:] = -gains.L_i @ model.C - gains.L_p @ C_b @ A[:, :nz]
    B[nz:] = model.B[nz:] - gains.L_i @ model.D - gains.L_p @ (C_b @ B[:nz] + D_rate)
    return ContinuousErrorSystem(A, B, np.diag(model.weights), np.zeros_like(B))
