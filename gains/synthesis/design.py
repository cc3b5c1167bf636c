"""A designed observer: gains in the user's units, the matrix that proves them and the bound it proves."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from gains.plants.plant import FloatArray

Method = Literal["convex"]


@dataclass(frozen=True, slots=True, eq=False)
class Design:
    """Gains of one observer, symbols as in :mod:`gains.analysis.augment`.

    Parameters
    ----------
    method : {"convex"}
        The synthesis.
    rate_hz : float
        Samples per second.
    K, L_i, L_p : FloatArray
        (nz, p), (a1, p) and (a1, p); integrators of order 2 have L_i = [L_i1; L_i2] (2 a1, p).
    L1, F, N, J : FloatArray
        (nz, n), (nz, p), (nz, nz) and (nz, p).
    P : FloatArray
        Matrix of the bounded-real inequality (na, na), na = nz + a1 times the order of the integrators.
    mu : float
        The bound: |e|^2 summed over time is at most mu times that of the scaled [w; w+; df_a].
    multipliers : FloatArray | None
        Multipliers of the slopes that vary (2, k) where they prove the bound, and the pole radius, in place of the
        vertices.
    pole_radius, gain_bound : float
        What was asked for: the largest size of a pole, and of an entry of the gains.
    gain_weight : float
        The price of the gains that the design was found with.
    status : {"optimal"}
        A design exists only where its certificate holds; failures are errors.
    solve_s, total_s : float
        Time in the solver and in all, seconds.
    notes : tuple[str, ...]
        What a person should know about the faults of this model.
    """

    method: Method
    rate_hz: float
    K: FloatArray
    L_i: FloatArray
    L_p: FloatArray
    L1: FloatArray
    F: FloatArray
    N: FloatArray
    J: FloatArray
    P: FloatArray
    mu: float
    multipliers: FloatArray | None = None
    pole_radius: float = 1.0
    gain_bound: float = math.inf
    gain_weight: float = 0.0
    status: Literal["optimal"] = "optimal"
    solve_s: float = 0.0
    total_s: float = 0.0
    notes: tuple[str, ...] = ()

    @property
    def sqrt_mu(self) -> float:
        """Bound of the H-infinity norm from the scaled disturbances to the scaled errors."""
        return math.sqrt(self.mu)

    @property
    def integrator_order(self) -> int:
        """1 where q integrates the actuator faults, 2 where it integrates them and their rates."""
        return len(self.L_i) // len(self.L_p) if len(self.L_p) else 1

    @property
    def gain_max_abs(self) -> float:
        """Largest entry of K, L_i and L_p by size."""
        return float(max(np.max(np.abs(gain), initial=0.0) for gain in (self.K, self.L_i, self.L_p)))
