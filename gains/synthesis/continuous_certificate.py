"""Independent proof of a continuous design, from its actual gains and NumPy's eigenvalues alone.

With the closed error system (A_e, B_e, C_e, D_e) of :mod:`gains.synthesis.continuous_design` at every slope vertex, P
> 0 and

    [ P A_e + A_e^T P   P B_e    C_e^T ]
    [ *                 -mu I    D_e^T ]  <= 0
    [ *                 *        -I    ]

imply that the integral of |e|^2 is at most mu times that of |[w; w'; f_a']|^2 (+ the start's x~' P x~) for every g
within its slopes. Without P > 0 the same inequality says nothing about stability.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from gains.analysis.augment import augment, error_model
from gains.analysis.hinf import hinf_norm
from gains.plants.plant import FloatArray, Plant
from gains.synthesis.continuous_design import ContinuousDesign, ContinuousErrorSystem, closed_error_system
from gains.synthesis.continuous_observer import fauio_gains

_CONSISTENCY = 1e-9
"""Relative. The norm is enclosed to 2e-9, and N and J follow from K to rounding."""
_UNIT_ROUNDOFF = np.finfo(np.float64).eps / 2.0


@dataclass(frozen=True, slots=True)
class ContinuousCertificate:
    """What could be verified about a continuous design.

    Parameters
    ----------
    holds : bool
        P > 0 and the inequality hold with a margin, the error system is stable and its norm is within the bound.
    margin : float
        Smallest eigenvalue, over P and the vertices, of the matrices scaled to unit diagonal, less a bound on the
        rounding errors of forming and decomposing them.
    norm : float
        H-infinity norm of the scaled error system, worst slope vertex: a gain that it has, exact to nine digits;
        infinite where it is unstable.
    norm_hz : float
        Frequency of that peak; infinite where the direct path has it.
    poles_max_re : float
        Largest real part of a pole of the error system over the vertices, rad/s.
    poles_min_re : float
        Smallest one: how fast the fastest pole is.
    """

    holds: bool
    margin: float
    norm: float
    norm_hz: float
    poles_max_re: float
    poles_min_re: float


def certify_continuous(plant: Plant, design: ContinuousDesign) -> ContinuousCertificate:
    """Verify a continuous design against its plant.

    Parameters
    ----------
    plant : Plant
        The continuous model the design was made for.
    design : ContinuousDesign
        Gains, P and mu.

    Raises
    ------
    InfeasibleError
        The plant has too many vertices.
    """
    model = error_model(plant, augment(plant))
    system = closed_error_system(model, design.gains, design.fault_state)
    margin = inequality_margin(system, design.P, design.mu)
    poles = np.linalg.eigvals(system.A).real
    norms = [hinf_norm(A_e, system.B, system.C, system.D, discrete=False) for A_e in system.A]
    worst = max(range(len(norms)), key=lambda vertex: norms[vertex].lower)
    return ContinuousCertificate(
        holds=margin > 0.0
        and bool(np.max(poles) < 0.0)
        and max(norm.upper for norm in norms) <= design.sqrt_mu * (1.0 + _CONSISTENCY)
        and _consistent(plant, design),
        margin=margin,
        norm=norms[worst].lower,
        norm_hz=norms[worst].omega / (2.0 * math.pi),
        poles_max_re=float(np.max(poles)),
        poles_min_re=float(np.min(poles)),
    )


def continuous_report(
    plant: Plant, design: ContinuousDesign, certificate: ContinuousCertificate, rate_hz: float | None = None
) -> dict[str, Any]:
    """Return what a design is worth as the JSON object of the command line and the gains file."""
    return {
        "model": plant.name,
        "method": design.method,
        "domain": "continuous",
        "rate_hz": rate_hz,
        "status": "optimal",
        "sqrt_mu": design.sqrt_mu,
        "norm": certificate.norm,
        "norm_hz": certificate.norm_hz if math.isfinite(certificate.norm_hz) else None,  # JSON has no infinity
        "poles_max_re": certificate.poles_max_re,
        "poles_min_re": certificate.poles_min_re,
        "gain_max_abs": design.gains.gain_max_abs,
        "certificate": {"holds": certificate.holds, "margin": certificate.margin},
        "fault_rate": {fault.name: fault.rate for fault in plant.actuator_faults},
        "solve_s": design.solve_s,
        "total_s": design.total_s,
        "notes": list(design.notes),
    }


def inequality_margin(system: ContinuousErrorSystem, P: FloatArray, mu: float) -> float:
    """Return the smallest eigenvalue of P and of the negated inequality, scaled, less their rounding errors."""
    na, nw = len(P), system.B.shape[1]
    margin = _scaled_margin(P, np.zeros_like(P))
    PB = P @ system.B
    for A in system.A:
        PA = P @ A
        matrix = np.block(
            [
                [-PA - PA.T, -PB, -system.C.T],
                [-PB.T, mu * np.eye(nw), -system.D.T],
                [-system.C, -system.D, np.eye(na)],
            ]
        )
        size = np.abs(P) @ np.abs(A)
        rounding = np.block(
            [
                [size + size.T, np.abs(P) @ np.abs(system.B), np.abs(system.C).T],
                [(np.abs(P) @ np.abs(system.B)).T, np.zeros((nw, nw)), np.abs(system.D).T],
                [np.abs(system.C), np.abs(system.D), np.zeros((na, na))],
            ]
        )
        margin = min(margin, _scaled_margin(matrix, rounding))
    return margin


def _scaled_margin(matrix: FloatArray, rounding: FloatArray) -> float:
    """Return the smallest eigenvalue of a matrix scaled to unit diagonal, less what rounding can hide."""
    diagonal = np.diag(matrix)
    if not (np.all(np.isfinite(matrix)) and np.all(diagonal > 0.0)):
        return -math.inf
    scale = 1.0 / np.sqrt(diagonal)
    eigenvalues = np.linalg.eigvalsh(matrix * scale * scale[:, None])
    size = len(scale)
    formed = (3 * size + 4) * np.linalg.norm(rounding * scale * scale[:, None], np.inf)
    return float(eigenvalues[0] - _UNIT_ROUNDOFF * (formed + 10 * size * eigenvalues[-1]))


def _consistent(plant: Plant, design: ContinuousDesign) -> bool:
    """Return whether N and J, which run, belong to K, which is certified."""
    gains = design.gains
    expected = fauio_gains(plant, gains.K, gains.L_i, gains.L_p)
    pairs = ((gains.N, expected.N), (gains.J, expected.J), (gains.L1, expected.L1), (gains.F, expected.F))
    return all(
        bool(np.max(np.abs(a - b), initial=0.0) <= _CONSISTENCY * max(1.0, np.max(np.abs(b), initial=0.0)))
        for a, b in pairs
    )
