"""A designed observer: gains in the user's units, the matrix that proves their bound, and that bound."""

import math
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from gains.analysis.augment import Augmentation
from gains.plants.plant import Domain, FloatArray

FaultState = Literal["integral", "error"]


@dataclass(frozen=True, slots=True, eq=False)
class ObserverMatrices:
    """Matrices of the observer, symbols as in :mod:`gains.analysis.augment` (x' for x+ in continuous time)."""

    # (nz, p), (a1, p) and (a1, p); integrators of order 2 have L_i = [L_i1; L_i2] (2 a1, p)
    K: FloatArray
    L_i: FloatArray
    L_p: FloatArray
    # (nz, n), (nz, p), (nz, nz) and (nz, p)
    L1: FloatArray
    F: FloatArray
    N: FloatArray
    J: FloatArray
    # (nq, n) and (nq, p); (0, 0) if innovations alone move q
    L_q: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    F_q: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    L_z: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))  # (nz, p); (0, 0) if zeta^ is published as it is

    def inverse(self, augmentation: Augmentation) -> Augmentation:
        """Return the augmentation of the same plant with the left inverse of this observer."""
        nq, none = len(self.L_i), not self.L_q.size
        L_q, F_q = (np.zeros((nq, M.shape[1])) if none else own for M, own in ((self.L1, self.L_q), (self.F, self.F_q)))
        return replace(augmentation, L1=self.L1, F=self.F, L_q=L_q, F_q=F_q)

    @property
    def L_e(self) -> FloatArray:
        """Direct gains [L_z; L_p] of the errors that have one (nz + a1, p), or L_p alone (a1, p)."""
        return np.vstack([self.L_z, self.L_p]) if self.L_z.size else self.L_p

    @property
    def gain_max_abs(self) -> float:
        """Largest entry of K, L_i, L_p and L_z by size."""
        return float(max(np.max(np.abs(gain), initial=0.0) for gain in (self.K, self.L_i, self.L_p, self.L_z)))


def split_direct(L_e: FloatArray, a1: int) -> tuple[FloatArray, FloatArray | None]:
    """Return L_p, the last a1 rows of the direct gains, and L_z, the rows before; None if there are none."""
    first = len(L_e) - a1
    return L_e[first:], L_e[:first] if first else None


def observer_matrices(
    augmentation: Augmentation, K: FloatArray, L_i: FloatArray, L_p: FloatArray, L_z: FloatArray | None = None
) -> ObserverMatrices:
    """Return all matrices of the observer for its gains: N = L1 A_z - K Cb, J = N F + K."""
    L1, F = augmentation.L1, augmentation.F
    N = L1 @ augmentation.A_z - K @ augmentation.C_b
    L_z = np.zeros((0, 0)) if L_z is None else L_z
    return ObserverMatrices(K, L_i, L_p, L1, F, N, N @ F + K, augmentation.L_q, augmentation.F_q, L_z)


@dataclass(frozen=True, slots=True, eq=False)
class Design:
    """Gains of one observer, discrete or continuous, and their proof."""

    method: str  # ``"convex"``, ``"theorem1"`` or ``"theorem2"``
    rate_hz: float | None  # samples per second; None in continuous time
    gains: ObserverMatrices  # K, L_i, L_p and the matrices that follow from them
    P: FloatArray  # matrix of the bounded-real inequality (na, na), na = nz + a1 times the order of the integrators
    # the bound: |e|^2 summed (or integrated) over time is at most mu times that of the scaled [w; w+; df_a], or of [w;
    # df_a] if noise counts once
    mu: float
    # multipliers of the slopes that vary (2, k) where they prove the bound, and the pole radius, in place of the
    # vertices
    multipliers: FloatArray | None = None
    # required of a discrete design: the largest size of a pole, and of an entry of the gains
    pole_radius: float = 1.0
    gain_bound: float = math.inf
    gain_weight: float = 0.0  # the price of the gains in the synthesis
    # coordinates of P: [zeta~; z] with z = f_a - q of the convex synthesis, or [zeta~; fa~] of the paper
    fault_state: FaultState = "integral"
    noise_once: bool = False  # whether the bound is against [w; df_a]: F then moves the sensor faults' estimates alone
    # time in the solver and in total, seconds
    solve_s: float = 0.0
    total_s: float = 0.0
    notes: tuple[str, ...] = ()  # remarks about the faults of this model for people

    @property
    def domain(self) -> Domain:
        """Whether x' or x+ stands on the left."""
        return "continuous" if self.rate_hz is None else "discrete"

    @property
    def sqrt_mu(self) -> float:
        """Bound of the H-infinity norm from the scaled disturbances to the scaled errors."""
        return math.sqrt(self.mu)

    @property
    def integrator_order(self) -> int:
        """1 where q integrates the actuator faults, 2 where it integrates them and their rates."""
        return len(self.gains.L_i) // len(self.gains.L_p) if len(self.gains.L_p) else 1


def design_figures(model: str, method: str, domain: str, rate_hz: float | None, **known: Any) -> dict[str, Any]:
    """Return the figures of a design as the JSON object of the command line and the gains file.

    The figures that every design reports are None if they are not known.
    """
    return {
        "model": model,
        "method": method,
        "domain": domain,
        "rate_hz": rate_hz,
        "status": "optimal",
        "sqrt_mu": None,
        "norm": None,
        "norm_hz": None,
        "gain_max_abs": None,
        "certificate": {"holds": False, "margin": None},
        "solve_s": None,
        "total_s": None,
        "notes": [],
    } | known
