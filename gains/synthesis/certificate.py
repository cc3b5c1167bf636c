"""Independent proof of a design, from its actual gains and NumPy's eigenvalues alone.

With the closed error system A_e = A_a + vertex - [Kb; L_i] [Cb 0], B_e = B - [Kb; L_i] D of the final gains,
the bounded-real inequality of the theory

    [ P   P A_e   P B_e   0     ]
    [ *   P       0       C_e^T ]  >= 0      at every slope vertex
    [ *   *       mu I    D_e^T ]
    [ *   *       *       I     ]

implies sum |e|^2 <= mu sum |[w; w+; df_a]|^2 (+ x~' P x~ at the start) for every g within its slopes. So does, without
any vertex, the one inequality with the multipliers Lambda = diag(lambda) of a design

    [ P   P A_e             P B_e   P Gs     0     ]
    [ *   P - Hs^T Lambda Hs  0       0        C_e^T ]
    [ *   *                 mu I    0        D_e^T ]  >= 0      A_e at the mean slopes
    [ *   *                 *       Lambda   0     ]
    [ *   *                 *       *        I     ]

for w = delta Hs x~, |delta_i| <= 1, adds sum lambda_i ((Hs x~)_i^2 - w_i^2) >= 0: the slopes may even move. Its first
two rows and the fourth, with r^2 P for P, bound the poles by r in the same way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from gains.analysis.augment import Augmentation, ErrorModel, augment, error_model, varying_slopes
from gains.analysis.hinf import hinf_norm
from gains.plants.discretise import discretise
from gains.plants.plant import FloatArray, Plant
from gains.synthesis.design import Design

_CONSISTENCY = 1e-9
"""Relative. The norm is enclosed to 2e-9, and N and J follow from K to rounding."""
_UNIT_ROUNDOFF = np.finfo(np.float64).eps / 2.0


@dataclass(frozen=True, slots=True)
class Certificate:
    """What could be verified about a design.

    Parameters
    ----------
    holds : bool
        The inequality holds with a margin, the error system is stable, its norm is within the bound, and poles and
        gains are within theirs.
    proof : {"vertices", "multipliers"}
        Whether the inequality was looked at for every slope vertex, or that with multipliers for all slopes at once.
    slopes : int
        At how many combinations of slopes the norm and the poles were computed: every vertex, or with multipliers
        the mean and at most ``SAMPLE_COUNT`` vertices.
    margin : float
        Smallest eigenvalue, over the vertices, of the inequality scaled to unit diagonal, less a bound on the
        rounding errors of forming and decomposing it.
    norm : float
        H-infinity norm of the scaled error system, worst of those slopes: a gain that it has, exact to nine digits;
        infinite where it is unstable.
    norm_hz : float
        Frequency of that peak.
    poles_max_abs : float
        Largest pole of the error system over those slopes.
    h2 : float
        Bound of the H2 norm of the scaled error system at all slopes, sqrt(trace(B_e^T P B_e + D_e^T D_e)); it is
        proven where the certificate holds, because P - A_e^T P A_e - C_e^T C_e >= 0 then.
    """

    holds: bool
    proof: Literal["vertices", "multipliers"]
    slopes: int
    margin: float
    norm: float
    norm_hz: float
    poles_max_abs: float
    h2: float


def certify(plant: Plant, design: Design) -> Certificate:
    """Verify a design against its plant.

    Parameters
    ----------
    plant : Plant
        The model the design was made for, continuous or discrete.
    design : Design
        Gains, P and mu, and multipliers where it has them.

    Raises
    ------
    ModelError, InfeasibleError
        The plant cannot be sampled at the design's rate, or has too many vertices and the design no multipliers.
    """
    discrete = discretise(plant, design.rate_hz)
    augmentation = augment(discrete)
    free = design.multipliers is not None
    model = error_model(discrete, augmentation, design.integrator_order, sampled=free)
    injection = np.vstack([design.K + augmentation.L1 @ discrete.E_f @ design.L_p, design.L_i])
    C_e, D_e = model.output(design.L_p)
    B_e = model.B - injection @ model.D
    dynamics = np.concatenate([model.mean[None], model.A]) if free else model.A
    closed = dynamics - injection @ model.C
    margin = _margin(model, injection, design)
    poles = float(np.max(np.abs(np.linalg.eigvals(closed))))
    norms = [hinf_norm(A_e, B_e, C_e, D_e, discrete=True) for A_e in closed]
    worst = max(range(len(norms)), key=lambda vertex: norms[vertex].lower)
    upper = max(norm.upper for norm in norms)
    return Certificate(
        holds=margin > 0.0
        and poles < 1.0
        and poles <= design.pole_radius
        and design.gain_max_abs <= design.gain_bound
        and upper <= design.sqrt_mu * (1.0 + _CONSISTENCY)
        and _consistent(design, augmentation),
        proof="multipliers" if free else "vertices",
        slopes=len(closed),
        margin=margin,
        norm=norms[worst].lower,
        norm_hz=norms[worst].omega * design.rate_hz / (2.0 * math.pi),
        poles_max_abs=poles,
        h2=math.sqrt(max(float(np.sum(B_e * (design.P @ B_e)) + np.sum(D_e**2)), 0.0)) * (1.0 + _CONSISTENCY),
    )


def design_report(plant: Plant, design: Design, certificate: Certificate) -> dict[str, Any]:
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
        "gain_weight": design.gain_weight,
        "certificate": {
            "holds": certificate.holds,
            "margin": certificate.margin,
            "proof": certificate.proof,
            "slopes": certificate.slopes,
        },
        "fault_rate": {fault.name: fault.rate for fault in plant.actuator_faults},
        "solve_s": design.solve_s,
        "total_s": design.total_s,
        "notes": [*design.notes, *_sample_note(plant, certificate)],
    }


def _sample_note(plant: Plant, certificate: Certificate) -> tuple[str, ...]:
    varying = varying_slopes(plant)
    if certificate.slopes >= 1 << varying:
        return ()
    return (
        f"norm and poles are those of the mean slopes and {certificate.slopes - 1} of their 2^{varying} vertices; "
        "the bound is proven at all",
    )


def _margin(model: ErrorModel, injection: FloatArray, design: Design) -> float:
    """Return the smallest margin of the inequalities that prove a design."""
    if design.multipliers is None:
        return min(_inequality_margin(model, A, injection, design, np.zeros(0)) for A in model.A)
    bound, decay = design.multipliers
    margin = _inequality_margin(model, model.mean, injection, design, bound)
    if design.pole_radius < 1.0:
        margin = min(margin, _inequality_margin(model, model.mean, injection, design, decay, decaying=True))
    return margin


def _inequality_margin(
    model: ErrorModel,
    A: FloatArray,
    injection: FloatArray,
    design: Design,
    multipliers: FloatArray,
    *,
    decaying: bool = False,
) -> float:
    """Return the smallest eigenvalue of the scaled inequality less the bound on its rounding error.

    Without multipliers it is that of one vertex. ``decaying`` takes the inequality of the poles.
    """
    used = slice(0) if decaying else slice(None)
    P, (na, k), ne = design.P, (len(design.P), len(multipliers)), len(model.weights[used])
    B, D, G, H = model.B[:, used], model.D[:, used], model.G[:, :k], model.H[:k]
    C_e, D_e = model.output(design.L_p)
    C_e, D_e = C_e[used], np.hstack([D_e[used, used], np.zeros((ne, k))])
    radius = design.pole_radius if decaying else 1.0
    PA, PB = P @ (A - injection @ model.C), np.hstack([P @ (B - injection @ D), P @ G])
    inequality = _layout(P, radius**2 * P - (H.T * multipliers) @ H, PA, PB, C_e, D_e)
    inequality += np.diag(np.concatenate([np.zeros(2 * na), np.full(B.shape[1], design.mu), multipliers, np.ones(ne)]))
    diagonal = np.diag(inequality)
    if np.any(diagonal <= 0.0):
        return -math.inf
    gain, size = np.abs(injection), np.abs(P)
    direct = model.weights[:, None] * np.vstack([np.zeros_like(design.K), np.abs(design.L_p)])
    own = model.weights[:, None] * np.eye(len(direct), na)
    rounding = _layout(
        np.zeros_like(P),
        size + (np.abs(H).T * multipliers) @ np.abs(H) if k else np.zeros_like(P),
        size @ (np.abs(A) + gain @ np.abs(model.C)),
        np.hstack([size @ (np.abs(B) + gain @ np.abs(D)), size @ np.abs(G)]),
        (direct @ np.abs(model.C) + own)[used],
        np.hstack([(direct @ np.abs(model.D))[used, used], np.zeros((ne, k))]),
    )
    scale = 1.0 / np.sqrt(diagonal)
    eigenvalues = np.linalg.eigvalsh(inequality * scale * scale[:, None])
    formed = (2 * na + len(model.C) + k + 4) * np.linalg.norm(rounding * scale * scale[:, None], np.inf)
    decomposed = 10 * len(scale) * eigenvalues[-1]
    return float(eigenvalues[0] - _UNIT_ROUNDOFF * (formed + decomposed))


def _layout(
    P: FloatArray, remainder: FloatArray, PA: FloatArray, PB: FloatArray, C_e: FloatArray, D_e: FloatArray
) -> FloatArray:
    """Return the blocks of the inequality but for mu I, Lambda and I on its diagonal."""
    (na, nw), ne = PB.shape, len(C_e)
    zero = np.zeros
    return np.block(
        [
            [P, PA, PB, zero((na, ne))],
            [PA.T, remainder, zero((na, nw)), C_e.T],
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
        bool(np.max(np.abs(actual - expected)) <= _CONSISTENCY * max(1.0, np.max(np.abs(expected))))
        for actual, expected in pairs
    )
