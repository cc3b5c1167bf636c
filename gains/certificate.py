"""Independent proof of a design, from its actual gains and NumPy's eigenvalues alone.

With the closed error system A_e = A_a + vertex - [Kb; L_i] [Cb 0], B_e = B - [Kb; L_i] D of the final gains,
the bounded-real inequality of the theory

    [ P   P A_e   P B_e   0     ]
    [ *   P       0       C_e^T ]  >= 0      at every slope vertex
    [ *   *       mu I    D_e^T ]
    [ *   *       *       I     ]

implies sum |e|^2 <= mu sum |[w; w+; df_a]|^2 (+ x~' P x~ at the start) for every g within its slopes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from gains.augment import Augmentation, ErrorModel, augment, error_model
from gains.design import Design
from gains.discretise import discretise
from gains.hinf import hinf_norm as level_set_norm
from gains.plant import FloatArray, Plant

_GRID = 240
_SLOWEST = 1e-6
_REFINEMENTS = 40
_FLAT = 1e-9
_CONSISTENCY = 1e-9
_UNIT_ROUNDOFF = np.finfo(np.float64).eps / 2.0


@dataclass(frozen=True, slots=True)
class Certificate:
    """What could be verified about a design.

    Parameters
    ----------
    holds : bool
        The inequality holds with a margin, the error system is stable and its norm is within the bound.
    margin : float
        Smallest eigenvalue, over the vertices, of the inequality scaled to unit diagonal, less a bound on the
        rounding errors of forming and decomposing it.
    norm : float
        H-infinity norm of the scaled error system, worst slope vertex: a gain that it has, exact to nine digits;
        infinite where it is unstable.
    norm_hz : float
        Frequency of that peak.
    norm_slopes : tuple[float, ...]
        Slopes of that vertex.
    poles_max_abs : float
        Largest pole of the error system over the vertices.
    h2 : float
        Bound of the H2 norm of the scaled error system at every vertex, sqrt(trace(B_e^T P B_e + D_e^T D_e)); it is
        proven where the certificate holds, because P - A_e^T P A_e - C_e^T C_e >= 0 then.
    """

    holds: bool
    margin: float
    norm: float
    norm_hz: float
    norm_slopes: tuple[float, ...]
    poles_max_abs: float
    h2: float


class Peak(NamedTuple):
    """A gain of a system and the angle in [0, pi] on the unit circle where it has it."""

    value: float
    angle: float


def certify(plant: Plant, design: Design) -> Certificate:
    """Verify a design against its plant.

    Parameters
    ----------
    plant : Plant
        The model the design was made for, continuous or discrete.
    design : Design
        Gains, P and mu.

    Raises
    ------
    ModelError, InfeasibleError
        The plant cannot be sampled at the design's rate, or has too many vertices.
    """
    discrete = discretise(plant, design.rate_hz)
    augmentation = augment(discrete)
    model = error_model(discrete, augmentation, design.integrator_order)
    injection = np.vstack([design.K + augmentation.L1 @ discrete.E_f @ design.L_p, design.L_i])
    C_e, D_e = model.output(design.L_p)
    B_e = model.B - injection @ model.D
    closed = model.A - injection @ model.C
    margin = min(_margin(model, vertex, injection, design) for vertex in range(len(closed)))
    poles = float(np.max(np.abs(np.linalg.eigvals(closed))))
    norms = [level_set_norm(A_e, B_e, C_e, D_e, discrete=True) for A_e in closed]
    worst = max(range(len(norms)), key=lambda vertex: norms[vertex].lower)
    upper = max(norm.upper for norm in norms)
    return Certificate(
        holds=margin > 0.0
        and poles < 1.0
        and upper <= design.sqrt_mu * (1.0 + _CONSISTENCY)
        and _consistent(design, augmentation),
        margin=margin,
        norm=norms[worst].lower,
        norm_hz=norms[worst].omega * design.rate_hz / (2.0 * math.pi),
        norm_slopes=tuple(model.slopes[worst].tolist()),
        poles_max_abs=poles,
        h2=math.sqrt(max(float(np.sum(B_e * (design.P @ B_e)) + np.sum(D_e**2)), 0.0)) * (1.0 + _CONSISTENCY),
    )


def report(plant: Plant, design: Design, certificate: Certificate) -> dict[str, Any]:
    """Return what a design is worth as the JSON object of the command line and the gains file."""
    return {
        "model": plant.name,
        "method": design.method,
        "domain": "discrete",
        "rate_hz": design.rate_hz,
        "integrator_order": design.integrator_order,
        "status": design.status,
        "sqrt_mu": design.sqrt_mu,
        "norm": certificate.norm,
        "norm_hz": certificate.norm_hz,
        "h2": certificate.h2,
        "poles_max_abs": certificate.poles_max_abs,
        "gain_max_abs": design.gain_max_abs,
        "certificate": {"holds": certificate.holds, "margin": certificate.margin},
        "fault_rate": {fault.name: fault.rate for fault in plant.actuator_faults},
        "solve_s": design.solve_s,
        "total_s": design.total_s,
        "notes": list(design.notes),
    }


def hinf_norm(A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray) -> Peak:
    """Return the largest singular value of C (zI - A)^-1 B + D over the unit circle.

    A grid that is logarithmic towards angle 0, with the angles of the poles, is refined around its highest
    point by golden section: a lower bound of the norm that is exact to many digits for smooth peaks.
    """
    poles = np.abs(np.angle(np.linalg.eigvals(A)))
    fine, even = np.geomspace(_SLOWEST, math.pi, _GRID), np.linspace(0.0, math.pi, _GRID // 4)
    angles = np.unique(np.concatenate([fine, even, poles]))
    gains = _gains(A, B, C, D, angles)
    top = int(np.argmax(gains))
    best = Peak(float(gains[top]), float(angles[top]))
    low, high = float(angles[max(top - 1, 0)]), float(angles[min(top + 1, len(angles) - 1)])
    ratio = (math.sqrt(5.0) - 1.0) / 2.0
    for _ in range(_REFINEMENTS):
        inner = np.array([high - ratio * (high - low), low + ratio * (high - low)])
        found = _gains(A, B, C, D, inner)
        better = int(np.argmax(found))
        if found[better] > best.value * (1.0 + _FLAT):
            best = Peak(float(found[better]), float(inner[better]))
        low, high = (low, float(inner[1])) if better == 0 else (float(inner[0]), high)
    return best


def _gains(A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray, angles: FloatArray) -> FloatArray:
    """Return the largest singular value at each angle; infinite at a pole on the circle."""
    pencil = np.exp(1j * angles)[:, None, None] * np.eye(len(A)) - A
    try:
        response = C @ np.linalg.solve(pencil, np.broadcast_to(B, (len(angles), *B.shape))) + D
    except np.linalg.LinAlgError:
        return np.full(len(angles), math.inf)
    norms: FloatArray = np.linalg.norm(response, ord=2, axis=(1, 2))
    return norms


def _margin(model: ErrorModel, vertex: int, injection: FloatArray, design: Design) -> float:
    """Return the smallest eigenvalue of the scaled inequality less the bound on its rounding error."""
    A, B, P = model.A[vertex], model.B, design.P
    PA, PB = P @ (A - injection @ model.C), P @ (B - injection @ model.D)
    C_e, D_e = model.output(design.L_p)
    (na, nw), ne = PB.shape, len(C_e)
    inequality = _layout(P, PA, PB, C_e, D_e) + np.diag(np.repeat([0.0, design.mu, 1.0], [2 * na, nw, ne]))
    diagonal = np.diag(inequality)
    if np.any(diagonal <= 0.0):
        return -math.inf
    gain = np.abs(injection)
    direct = model.weights[:, None] * np.vstack([np.zeros_like(design.K), np.abs(design.L_p)])
    rounding = _layout(
        np.zeros_like(P),
        np.abs(P) @ (np.abs(A) + gain @ np.abs(model.C)),
        np.abs(P) @ (np.abs(B) + gain @ np.abs(model.D)),
        direct @ np.abs(model.C) + model.weights[:, None] * np.eye(ne, na),
        direct @ np.abs(model.D),
    )
    scale = 1.0 / np.sqrt(diagonal)
    eigenvalues = np.linalg.eigvalsh(inequality * scale * scale[:, None])
    formed = (2 * na + len(model.C) + 4) * np.linalg.norm(rounding * scale * scale[:, None], np.inf)
    decomposed = 10 * len(scale) * eigenvalues[-1]
    return float(eigenvalues[0] - _UNIT_ROUNDOFF * (formed + decomposed))


def _layout(P: FloatArray, PA: FloatArray, PB: FloatArray, C_e: FloatArray, D_e: FloatArray) -> FloatArray:
    """Return the blocks of the inequality but for mu I and I on its diagonal."""
    (na, nw), ne = PB.shape, len(C_e)
    zero = np.zeros
    return np.block(
        [
            [P, PA, PB, zero((na, ne))],
            [PA.T, P, zero((na, nw)), C_e.T],
            [PB.T, zero((nw, na)), zero((nw, nw)), D_e.T],
            [zero((ne, na)), C_e, D_e, zero((ne, ne))],
        ]
    )


def _consistent(design: Design, augmentation: Augmentation) -> bool:
    """Return whether N and J, which run, belong to K, which is certified."""
    N = augmentation.L1 @ augmentation.A_z - design.K @ augmentation.C_b
    pairs = (
        (design.N, N),
        (design.J, N @ augmentation.F + design.K),
        (design.L1, augmentation.L1),
        (design.F, augmentation.F),
    )
    return all(
        bool(np.max(np.abs(found - expected)) <= _CONSISTENCY * max(1.0, np.max(np.abs(expected))))
        for found, expected in pairs
    )
