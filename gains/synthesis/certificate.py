"""Independent proof of a design, from its actual gains and NumPy's eigenvalues alone.

With the closed error system A_e = A_a + vertex - [Kb; L_i] [Cb 0], B_e = B - [Kb; L_i] D of the final gains,
the bounded-real inequality of the theory

    [ P   P A_e   P B_e   0     ]
    [ *   P       0       C_e^T ]  >= 0      at every slope vertex
    [ *   *       mu I    D_e^T ]
    [ *   *       *       I     ]

implies sum |e|^2 <= mu sum |[w; w+; df_a]|^2 (+ x~' P x~ at the start) for every g within its slopes, or of [w; df_a]
if noise counts once. Without any vertex the same follows from one inequality with the multipliers Lambda = diag(lambda)
of a design

    [ P   P A_e             P B_e   P Gs     0     ]
    [ *   P - Hs^T Lambda Hs  0       0        C_e^T ]
    [ *   *                 mu I    0        D_e^T ]  >= 0      A_e at the mean slopes
    [ *   *                 *       Lambda   0     ]
    [ *   *                 *       *        I     ]

because w = delta Hs x~, |delta_i| <= 1, adds sum lambda_i ((Hs x~)_i^2 - w_i^2) >= 0: the slopes may even move. Its
first two rows and the fourth, with r^2 P for P, bound the poles by r in the same way.

In continuous time P > 0 and, at every slope vertex,

    [ P A_e + A_e^T P   P B_e    C_e^T ]
    [ *                 -mu I    D_e^T ]  <= 0
    [ *                 *        -I    ]

imply the same for the integrals, with w' and f_a' for w+ and df_a. Without P > 0 the inequality implies nothing about
stability.
"""

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from gains.analysis.augment import ErrorModel, augment, error_model, varying_slopes
from gains.analysis.hinf import StateSpace, hinf_norm
from gains.plants.discretise import discretise
from gains.plants.plant import FloatArray, Plant
from gains.synthesis.design import Design, FaultState, ObserverMatrices, design_figures, observer_matrices
from gains.synthesis.peak import peak_bounds

CONSISTENCY = 1e-9
"""Relative tolerance: the norm is enclosed to 2e-9, and N and J follow from K within rounding."""
_UNIT_ROUNDOFF = np.finfo(np.float64).eps / 2.0


@dataclass(frozen=True, slots=True)
class Certificate:
    """The result of verifying a design."""

    # the inequality holds with a margin, the error system is stable, its norm is within the bound, and poles and gains
    # are within theirs
    holds: bool
    # whether the inequality was verified at every slope vertex, or that with multipliers for all slopes at once
    proof: Literal["vertices", "multipliers"]
    # number of combinations of slopes at which the norm and the poles were computed: every vertex, or with multipliers
    # the mean and at most ``SAMPLE_COUNT`` vertices
    slopes: int
    # smallest eigenvalue, over the vertices, of the inequality (and of P in continuous time) scaled to unit diagonal,
    # less a bound on the rounding errors of forming and decomposing it
    margin: float
    # H-infinity norm of the scaled error system, at the worst of those slopes: a gain of that system, exact to nine
    # digits; infinite if it is unstable
    norm: float
    norm_hz: float  # frequency of that peak; infinite if the direct path of a continuous design has the peak
    # largest and smallest pole of the error system over those slopes: by size, or in continuous time by its real part,
    # rad/s
    poles_max: float
    poles_min: float
    # bound of the H2 norm of the scaled discrete error system at all slopes, sqrt(trace(B_e^T P B_e + D_e^T D_e)); it
    # is proven if the certificate holds, because P - A_e^T P A_e - C_e^T C_e >= 0 then
    h2: float | None = None


def certify(plant: Plant, design: Design) -> Certificate:
    """Verify a design against the model it was made for, continuous or discrete.

    Raises
    ------
    ModelError, InfeasibleError
        The plant cannot be sampled at the design's rate, or has too many vertices and the design no multipliers.
    """
    discrete, rate_hz = design.rate_hz is not None, design.rate_hz or 1.0
    if discrete:
        plant = discretise(plant, rate_hz)
    gains = design.gains
    augmentation = gains.inverse(augment(plant, design.integrator_order, noise_once=design.noise_once))
    free = design.multipliers is not None
    model = error_model(plant, augmentation, design.integrator_order, sampled=free)
    system = closed_error_system(model, gains, design.fault_state, with_mean=free)
    margin = _discrete_margin(model, design) if discrete else _continuous_margin(system, design.P, design.mu)
    eigenvalues = np.linalg.eigvals(system.A)
    poles = np.abs(eigenvalues) if discrete else eigenvalues.real
    poles_max = float(np.max(poles))
    norms = [hinf_norm(A_e, system.B, system.C, system.D, discrete=discrete) for A_e in system.A]
    worst = max(norms, key=lambda norm: norm.lower)
    energy = float(np.sum(system.B * (design.P @ system.B)) + np.sum(system.D**2)) if discrete else None
    return Certificate(
        holds=margin > 0.0
        and (poles_max < 1.0 and poles_max <= design.pole_radius if discrete else poles_max < 0.0)
        and gains.gain_max_abs <= design.gain_bound
        and max(norm.upper for norm in norms) <= design.sqrt_mu * (1.0 + CONSISTENCY)
        and _consistent(plant, gains, observer_matrices(augmentation, gains.K, gains.L_i, gains.L_p, gains.L_z)),
        proof="multipliers" if free else "vertices",
        slopes=len(system.A),
        margin=margin,
        norm=worst.lower,
        norm_hz=worst.omega * rate_hz / (2.0 * math.pi),
        poles_max=poles_max,
        poles_min=float(np.min(poles)),
        h2=None if energy is None else math.sqrt(max(energy, 0.0)) * (1.0 + CONSISTENCY),
    )


def closed_error_system(
    model: ErrorModel, gains: ObserverMatrices, fault_state: FaultState = "integral", *, with_mean: bool = False
) -> StateSpace:
    """Close the error system of a plant at its vertices, or at the mean slopes and after them the vertices.

    A is that of each combination of slopes (k, na, na); C and D have the weights applied.

    With Kb = K + L1 E_f L_p the state [zeta~; z] ("integral") obeys

        [zeta~; z]+ = (A_a + vertex - [Kb; L_i] Ca) [zeta~; z] + (B - [Kb; L_i] D) [w; w+; df_a]
        fa~ = z - L_p (Cb zeta~ + D w),   with an L_z likewise of zeta~

    and the paper's state [zeta~; fa~] ("error"), in continuous time, its (4.14), which differentiates yt:

        fa~' = f_a' - L_i (Cb zeta~ + D w) - L_p (Cb zeta~' + D w')

    Both describe the same system for signals whose derivative is w'. A norm takes w and w' as independent, so that the
    two have different norms.
    """
    vertices = np.concatenate([model.mean[None], model.A]) if with_mean else model.A
    if fault_state == "integral":
        injection = model.injection(gains.K, gains.L_i, gains.L_p)
        return StateSpace(vertices - injection @ model.C, model.B - injection @ model.D, *model.output(gains.L_e))
    nz, q = len(gains.K), (model.B.shape[1] - model.a1) // 2
    D_rate = np.roll(model.D, q, axis=1)
    A, B = np.empty_like(vertices), np.empty_like(model.B)
    A[:, :nz] = vertices[:, :nz] - gains.K @ model.C
    B[:nz] = model.B[:nz] - gains.K @ model.D
    C_b = model.C[:, :nz]
    A[:, nz:] = -gains.L_i @ model.C - gains.L_p @ C_b @ A[:, :nz]
    B[nz:] = model.B[nz:] - gains.L_i @ model.D - gains.L_p @ (C_b @ B[:nz] + D_rate)
    return StateSpace(A, B, np.diag(model.weights), np.zeros_like(B))


def design_report(
    plant: Plant, design: Design, certificate: Certificate, rate_hz: float | None = None
) -> dict[str, Any]:
    """Return the figures of a design as the JSON object of the command line and the gains file.

    ``rate_hz`` is the rate for which a continuous design is compiled, if any.
    """
    figures: dict[str, Any] = {"holds": certificate.holds, "margin": certificate.margin}
    if design.domain == "discrete":
        rate_hz = design.rate_hz
        figures |= {"proof": certificate.proof, "slopes": certificate.slopes}
        own = {
            "integrator_order": design.integrator_order,
            "h2": certificate.h2,
            "poles_max_abs": certificate.poles_max,
            "gain_weight": design.gain_weight,
            "error_bounds": peak_bounds(discretise(plant, design.rate_hz or 1.0), design),
        }
    else:
        own = {"poles_max_re": certificate.poles_max, "poles_min_re": certificate.poles_min}
    return design_figures(
        plant.name,
        design.method,
        design.domain,
        rate_hz,
        sqrt_mu=design.sqrt_mu,
        norm=certificate.norm,
        norm_hz=certificate.norm_hz if math.isfinite(certificate.norm_hz) else None,  # JSON has no infinity
        gain_max_abs=design.gains.gain_max_abs,
        certificate=figures,
        solve_s=design.solve_s,
        total_s=design.total_s,
        notes=[*design.notes, *_sample_note(plant, certificate)],
        noise_once=design.noise_once,
        fault_rate={fault.name: fault.rate for fault in plant.actuator_faults},
        faults=list(plant.fault_names),
        **own,
    )


def _sample_note(plant: Plant, certificate: Certificate) -> tuple[str, ...]:
    varying = varying_slopes(plant)
    if certificate.slopes >= 1 << varying:
        return ()
    return (
        f"norm and poles are those of the mean slopes and {certificate.slopes - 1} of their 2^{varying} vertices; "
        "the bound is proven at all",
    )


def _discrete_margin(model: ErrorModel, design: Design) -> float:
    """Return the smallest margin of the inequalities that prove a discrete design."""
    if design.multipliers is None:
        return min(_inequality_margin(model, A, design, np.zeros(0)) for A in model.A)
    bound, decay = design.multipliers
    margin = _inequality_margin(model, model.mean, design, bound)
    if design.pole_radius < 1.0:
        margin = min(margin, _inequality_margin(model, model.mean, design, decay, decaying=True))
    return margin


def _inequality_margin(
    model: ErrorModel, A: FloatArray, design: Design, multipliers: FloatArray, *, decaying: bool = False
) -> float:
    """Return the margin of one inequality: without multipliers at one vertex; ``decaying``: of the poles."""
    gains = design.gains
    injection = model.injection(gains.K, gains.L_i, gains.L_p)
    used = slice(0) if decaying else slice(None)
    P, (na, k), ne = design.P, (len(design.P), len(multipliers)), len(model.weights[used])
    B, D, G, H = model.B[:, used], model.D[:, used], model.G[:, :k], model.H[:k]
    C_e, D_e = model.output(gains.L_e)
    C_e, D_e = C_e[used], np.hstack([D_e[used, used], np.zeros((ne, k))])
    radius = design.pole_radius if decaying else 1.0
    PA, PB = P @ (A - injection @ model.C), np.hstack([P @ (B - injection @ D), P @ G])
    inequality = _layout(P, radius**2 * P - (H.T * multipliers) @ H, PA, PB, C_e, D_e)
    inequality += np.diag(np.concatenate([np.zeros(2 * na), np.full(B.shape[1], design.mu), multipliers, np.ones(ne)]))
    gain, size = np.abs(injection), np.abs(P)
    direct = model.weights[:, None] * np.pad(np.abs(gains.L_e), ((len(model.weights) - len(gains.L_e), 0), (0, 0)))
    own = model.weights[:, None] * np.eye(len(direct), na)
    at_once = model.weights[:, None] * np.pad(np.abs(model.direct), ((0, model.a1), (0, 0)))
    rounding = _layout(
        np.zeros_like(P),
        size + (np.abs(H).T * multipliers) @ np.abs(H) if k else np.zeros_like(P),
        size @ (np.abs(A) + gain @ np.abs(model.C)),
        np.hstack([size @ (np.abs(B) + gain @ np.abs(D)), size @ np.abs(G)]),
        (direct @ np.abs(model.C) + own)[used],
        np.hstack([(direct @ np.abs(model.D) + at_once)[used, used], np.zeros((ne, k))]),
    )
    return _scaled_margin(inequality, rounding, 2 * na + len(model.C) + k + 4)


def _layout(
    P: FloatArray, remainder: FloatArray, PA: FloatArray, PB: FloatArray, C_e: FloatArray, D_e: FloatArray
) -> FloatArray:
    """Return the blocks of the inequality except mu I, Lambda and I on its diagonal."""
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


def _continuous_margin(system: StateSpace, P: FloatArray, mu: float) -> float:
    """Return the smallest margin of P and of the negated inequalities of a continuous design."""
    na, nw = len(P), system.B.shape[1]
    margin = _scaled_margin(P, np.zeros_like(P), 0)
    PB, C, D = P @ system.B, system.C, system.D
    for A in system.A:
        PA, size = P @ A, np.abs(P) @ np.abs(A)
        inequality = np.block([[-PA - PA.T, -PB, -C.T], [-PB.T, mu * np.eye(nw), -D.T], [-C, -D, np.eye(na)]])
        size_B = np.abs(P) @ np.abs(system.B)
        rounding = np.block(
            [
                [size + size.T, size_B, np.abs(C).T],
                [size_B.T, np.zeros((nw, nw)), np.abs(D).T],
                [np.abs(C), np.abs(D), np.zeros((na, na))],
            ]
        )
        margin = min(margin, _scaled_margin(inequality, rounding, 3 * len(rounding) + 4))
    return margin


def _scaled_margin(matrix: FloatArray, rounding: FloatArray, operations: int) -> float:
    """Return the smallest eigenvalue of a matrix scaled to unit diagonal, minus a bound on rounding errors.

    ``rounding`` is, for each entry, the sum of the sizes of its terms; each was formed in at most that many operations.
    """
    diagonal = np.diag(matrix)
    if not (np.all(np.isfinite(matrix)) and np.all(diagonal > 0.0)):
        return -math.inf
    scale = 1.0 / np.sqrt(diagonal)
    eigenvalues = np.linalg.eigvalsh(matrix * scale * scale[:, None])
    formed = operations * np.linalg.norm(rounding * scale * scale[:, None], np.inf)
    decomposed = 10 * len(scale) * eigenvalues[-1]
    return float(eigenvalues[0] - _UNIT_ROUNDOFF * (formed + decomposed))


def _consistent(plant: Plant, gains: ObserverMatrices, expected: ObserverMatrices) -> bool:
    """Return whether the N and J that run belong to the certified K, and [L1 F; L_q F_q] inverts [T; Cb]."""
    pairs = ((getattr(gains, name), getattr(expected, name)) for name in ("N", "J"))
    return inverse_error(plant, gains) <= CONSISTENCY and all(
        bool(np.max(np.abs(a - b), initial=0.0) <= CONSISTENCY * max(1.0, np.max(np.abs(b), initial=0.0)))
        for a, b in pairs
    )


def inverse_error(plant: Plant, gains: ObserverMatrices) -> float:
    """Return by how much [L1 F; L_q F_q] [T; Cb] is off [I; 0], in units of the errors and of its sizes."""
    n, nz = len(plant.states), len(gains.L1)
    C_b, T, unit = np.hstack([plant.C, plant.D_f]), np.eye(n, nz), plant.errors
    L, F, rows = gains.L1, gains.F, unit[:nz]
    if gains.L_q.size:
        rates = np.resize(unit[nz:], len(gains.L_q))
        L, F, rows = np.vstack([L, gains.L_q]), np.vstack([F, gains.F_q]), np.concatenate([rows, rates])
    scale = unit[:nz] / rows[:, None]
    off = np.abs(L @ T + F @ C_b - np.eye(len(L), nz)) * scale
    return float(np.max(off) / max(1.0, np.max(np.abs(F) @ np.abs(C_b) * scale)))
