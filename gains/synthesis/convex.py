"""Convex discrete-time synthesis: all gains at once from one linear matrix inequality.

The inequality, jointly linear in all unknowns, is that of :mod:`gains.synthesis.bounded_real`; it is solved in the
coordinates of :mod:`gains.synthesis.conditioning`.

Minimising mu alone leaves those gains free that do not influence it, and drives those to infinity that influence it a
little. So the objective is mu + rho trace(Z), Z >= [Kb; L_i]^T P [Kb; L_i] + L_p^T W_f^2 L_p: the energy that an
innovation of size one puts into the error.

The solver's time grows with the sixth power of the inequality's size and with the number of slope vertices. For a large
plant with many vertices one inequality with multipliers is tried first in place of them all, and it is the only one if
there are too many vertices to enumerate. Only a solution that passes :mod:`gains.synthesis.certificate` counts.
"""

import itertools
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from adapters.errors import InaccurateError, InfeasibleError, ModelError
from gains.analysis.augment import LARGEST_VERTEX_COUNT, Augmentation, ErrorModel, augment, error_model, varying_slopes
from gains.analysis.estimability import check_existence
from gains.analysis.hinf import hinf_norm
from gains.analysis.riccati import doubled
from gains.plants.discretise import discretise
from gains.plants.plant import FloatArray, Plant
from gains.synthesis.bounded_real import Demands, Inequality, Solution, inequality, solve_bounded_real, user_design
from gains.synthesis.certificate import certify
from gains.synthesis.conditioning import Coordinates, kalman_coordinates
from gains.synthesis.design import Design, ObserverMatrices, observer_matrices, split_direct

GAIN_WEIGHT = 1e-3
"""Price of the gains. Measured on the disturbed arm at 100 Hz: sqrt(mu) is .2 % above the least (.14034, .14009) with a
largest gain of 23; at 1e-2 .7 % and 12, at 1e-1 2 % and 6. On the quadrotor every price gives 26.0 within .5 %."""
_SLACKS = (1e-3, 1e-2, 5e-2)
"""Relative increases of mu, tried in turn until the certificate holds: a design loses no more than the last one. The
first is as small as the solver allows."""
_LARGEST_CONE = 5_000
"""Largest number of entries of all vertex inequalities together, above which multipliers are tried first. Up to it the
solver needs seconds; its time grows with the sixth power of the size."""
_CAUTION = (0.0, 1e-2, 1e-1, 1.0)
"""Noise that is added to the outputs to bound the gains, in units of the outputs that the errors that matter cause,
tried in turn. Measured with gains bounded by 5: without added noise none are found for the arm."""
_LOOSENESS = (4.0, 1.5, 0.7, 0.35)
"""Bounds of [Kb; L_i] relative to the bound of the gains, tried in turn, the loosest first: the condition is stricter
than the bound of the entries. Measured on the arm, bounds of 5 and 1: sqrt(mu) is .072 and .36 with these, .086 and .54
with 1 alone."""

_MARGINS = (1e-3, 1e-2, 1e-1)
"""Relative distances of the bound above the norm, tried in turn until the certificate holds: a design loses that
much."""
_INSIDE = 1e-2
"""eps, as a share of a margin and of the size of C^T C. Chosen: smaller leaves less room for rounding, larger moves the
bound by more than its margin.
"""


def design_convex(
    plant: Plant,
    rate_hz: float | None = None,
    *,
    pole_radius: float = 1.0,
    gain_weight: float = GAIN_WEIGHT,
    gain_bound: float | None = None,
    integrator_order: int = 1,
    h2: float = 0.0,
    vertices: bool | None = None,
    P: FloatArray | None = None,
    inverse: ObserverMatrices | None = None,
    free_inverse: bool = True,
    noise_once: bool = False,
) -> Design:
    """Design an observer for a plant and prove it: its certificate holds.

    Parameters
    ----------
    plant : Plant
        Continuous model (sampled at ``rate_hz``) or discrete model.
    rate_hz : float | None
        Samples per second; None takes the rate of a discrete model.
    pole_radius : float
        Upper bound of the size of every pole of the error system at every slope vertex, in (0, 1].
    gain_weight : float
        rho, the price of the energy that an innovation puts into the error, against mu; positive. With a lower price
        the estimates follow noise that is small by its scale more closely.
    gain_bound : float | None
        Bound of every entry of K, L_i and L_p by size, in the user's units; positive. It is enforced by a sufficient
        convex condition (:mod:`gains.synthesis.bounded_real`), the loosest that leads to it: other gains within the
        bound may have a smaller mu. With P given the condition is exact.
    integrator_order : int
        1 for actuator faults that move at no more than their rate; 2 for actuator faults that ramp: their rate then is
        the rate of change of their rate, per second squared, and a steady ramp is followed without lag.
    h2 : float
        alpha in [0, 1]: 0 minimises the bound of the largest energy of the error, 1 that of its energy under white
        noise in every input (the squared H2 norm), and a value in between (1 - alpha) mu + alpha trace(W).
    vertices : bool | None
        One inequality per slope vertex (the least bound), or one with multipliers for all, which holds for slopes that
        move too; None takes multipliers if the vertices would take long or are too many, and the vertices if
        multipliers fail.
    P : FloatArray | None
        Lyapunov matrix (na, na) of an earlier design for the same error system, in the user's units. Designs with one P
        may be exchanged for each other while they run, at any time: x~' P x~ then proves the largest of their bounds.
    inverse : ObserverMatrices | None
        An observer of this plant whose left inverse [L1 F; L_q F_q] is kept: that of the design of P, because designs
        that may be exchanged need the same error. None keeps the pseudo-inverse if P is given.
    free_inverse : bool
        Whether the left inverse is found with the gains. Otherwise it is the pseudo-inverse, as published, and also if
        P or a bound of the gains is given: F would take the place of bounded gains (on the arm at 100 Hz with a largest
        gain of .01: sqrt(mu) = .144).
    noise_once : bool
        Bound the error against [w; df_a] instead of [w; w+; df_a], which counts noise twice: choose it to compare the
        bound with errors caused by noise. F then moves the sensor faults' estimates alone and is not free; what is
        published is zeta^ + L_z yt, because zeta^ does not contain the output of its own sample.

    Raises
    ------
    ModelError
        The model cannot be sampled at that rate, has no faults or a hidden mode, or an option is out of range.
    InfeasibleError
        An existence condition fails (named in the message), the inequality has no solution, or no gains within their
        bound were found.
    InaccurateError
        The solver stopped short and nothing it found passes the certificate.
    """
    import cvxpy  # noqa: F401 - the first import takes seconds that do not belong to the design's time

    started = time.perf_counter()
    rate_hz = plant.rate_hz if rate_hz is None else rate_hz
    if rate_hz is None:
        raise ModelError(f"{plant.name}: a continuous model needs a rate in samples per second (--rate)")
    if wrong := _wrong_option(pole_radius, gain_weight, gain_bound, integrator_order, h2):
        raise ModelError(f"{plant.name}: {wrong}")
    discrete = discretise(plant, rate_hz)
    augmentation = augment(discrete, integrator_order, noise_once=noise_once)
    size = len(augmentation.L1) + len(augmentation.L_q)
    if P is not None and P.shape != (size, size):
        raise ModelError(f"{plant.name}: the Lyapunov matrix is {P.shape}, not {(size, size)}: is it of this model?")
    if inverse is not None:
        augmentation = inverse.inverse(augmentation)
    too_many = 1 << varying_slopes(plant) > LARGEST_VERTEX_COUNT
    sampled = vertices is False or (vertices is None and too_many)
    # A chain of integrators hides the same modes as one: a design exists for order 2 if it exists for order 1.
    notes = check_existence(discrete, sampled=sampled)
    model = error_model(discrete, augmentation, integrator_order, sampled=sampled)
    free = free_inverse and P is None and inverse is None and gain_bound is None
    asked = Demands(gain_weight, pole_radius, h2, P, free=free)
    search = _Search(discrete, augmentation, model, vertices, too_many)
    design = _bounded(search, asked) if gain_bound is None else _within(search, asked, gain_bound)
    return replace(design, total_s=time.perf_counter() - started, notes=(*notes, *design.notes))


def _wrong_option(
    pole_radius: float, gain_weight: float, gain_bound: float | None, integrator_order: int, h2: float
) -> str | None:
    """Return the first option that is out of range, and its range; None if all are within theirs."""
    if not 0.0 < pole_radius <= 1.0:
        return f"a pole radius of {pole_radius} does not lie in (0, 1]"
    if not 0.0 < gain_weight < np.inf:
        return f"a gain weight of {gain_weight} is not positive"
    if gain_bound is not None and not gain_bound > 0.0:
        return f"a gain bound of {gain_bound} is not positive"
    if integrator_order not in (1, 2):
        return f"an integrator order of {integrator_order} is neither 1 nor 2"
    if not 0.0 <= h2 <= 1.0:
        return f"an H2 share of {h2} does not lie in [0, 1]"
    return None


class _Search(NamedTuple):
    """Data of all attempts at a design: the sampled plant, its error system, and the treatment of its slopes."""

    plant: Plant
    augmentation: Augmentation
    model: ErrorModel
    vertices: bool | None  # as for :func:`design_convex`
    too_many: bool  # whether there are too many vertices to enumerate


def _bounded(search: _Search, asked: Demands, caution: float = 0.0) -> Design:
    """Return the first certified design, with ``caution`` noise added to the outputs."""
    coordinates = kalman_coordinates(search.model, asked.pole_radius, caution)
    if asked.free:
        # the pseudo-inverse has fewer unknowns, so that the solver may succeed with it if it stops short here
        with suppress(InaccurateError):
            return _searched(search, _problems(search, coordinates, asked))
        asked = replace(asked, free=False)
    try:
        return _searched(search, _problems(search, coordinates, asked))
    except InaccurateError:
        linear = asked.P is None and len(search.model.A) == 1
        design = _by_riccati(search, asked) if linear else None
        if design is None:
            raise
        return design


def _problems(search: _Search, coordinates: Coordinates, asked: Demands) -> tuple[Inequality, ...]:
    """Return the inequalities to try in turn: with multipliers if requested or for a large size, then with vertices."""
    model = search.model
    plain, at_once = (replace(asked, multipliers=multipliers) for multipliers in (False, True))
    if len(model.A) > 1 and (search.vertices is False or search.too_many):
        return (inequality(model, coordinates, at_once),)
    problem = inequality(model, coordinates, plain)
    size = 2 * len(problem.B) + problem.B.shape[1] + problem.a1
    if len(model.A) == 1 or search.vertices or len(model.A) * size * (size + 1) // 2 <= _LARGEST_CONE:
        return (problem,)
    return inequality(model, coordinates, at_once), problem


def _within(search: _Search, asked: Demands, bound: float) -> Design:
    """Return the first design whose gains are within their bound: without a condition, then with stricter ones."""
    design = _bounded(search, asked)
    smallest, solve_s = design.gains.gain_max_abs, design.solve_s
    for caution, looseness in itertools.product(_CAUTION, _LOOSENESS) if asked.P is None else [(0.0, 1.0)]:
        if design.gains.gain_max_abs <= bound:
            break
        try:
            design = _bounded(search, replace(asked, gain_bound=bound, looseness=looseness), caution)
        except InfeasibleError:
            continue
        smallest, solve_s = min(smallest, design.gains.gain_max_abs), solve_s + design.solve_s
    if design.gains.gain_max_abs <= bound:
        return replace(design, gain_bound=bound, solve_s=solve_s)
    raise InfeasibleError(
        f"{search.model.name}: no gains within {bound:g} were found; the smallest that were are {smallest:.3g}: allow "
        "these, narrow the slopes, or let faults move slower or poles be larger"
    )


def _searched(search: _Search, problems: Sequence[Inequality]) -> Design:
    """Return the first certified design."""
    for problem in problems:
        try:
            for solution, solve_s in _solutions(problem):
                design = _design(search, problem, solution)
                if certify(search.plant, design).holds:
                    return replace(design, solve_s=solve_s)
        except InfeasibleError:  # multipliers are stricter than the vertices: their failure proves nothing
            if problem is problems[-1]:
                raise
    raise InaccurateError(
        f"{search.plant.name}: the solver stopped short and no gains it found could be certified; "
        "check units and scales, or relax the fault rates or the pole radius"
    )


def _by_riccati(search: _Search, asked: Demands) -> Design | None:
    """Return a certified filter for a linear plant on which the solver stopped short; None if it proves nothing."""
    plant, augmentation, model = search.plant, search.augmentation, search.model
    nz = len(augmentation.L1)
    for injection, L_e, P, mu in _riccati_proofs(model, kalman_coordinates(model, asked.pole_radius)):
        L_p, L_z = split_direct(L_e, model.a1)
        gains = injection - model.into @ L_p
        design = Design(
            method="convex",
            rate_hz=plant.rate_hz,
            gains=observer_matrices(augmentation, gains[:nz], gains[nz:], L_p, L_z),
            P=P,
            mu=mu,
            pole_radius=asked.pole_radius,
            noise_once=augmentation.noise_once,
            notes=("the solver stopped short; these are the gains of a filter, whose bound need not be the least",),
        )
        if design.gains.gain_max_abs <= asked.gain_bound and certify(plant, design).holds:
            return design
    return None


def _riccati_proofs(
    model: ErrorModel, coordinates: Coordinates
) -> Iterator[tuple[FloatArray, FloatArray, FloatArray, float]]:
    """Yield [Kb; L_i], L_e, P and mu in users' units for a linear discrete error system, the least mu first.

    If numbers differ by many orders, the solver of matrix inequalities can stop short although gains exist. A Kalman
    filter exists whenever the plant is detectable, and in its coordinates its own error has size one. There the least
    storage function for a bound gamma above the norm of the closed error system solves

        P = A^T P A + C^T C + eps I + (A^T P B + C^T D) (gamma^2 I - D^T D - B^T P B)^-1 (A^T P B + C^T D)^T

    and eps > 0 puts it inside the inequality of the certificate, which decides. The bound holds for these gains; others
    may have a smaller one.
    """
    S = coordinates.S
    inverse = np.linalg.inv(S)
    injection, L_e = coordinates.gain, coordinates.direct[model.fixed : len(model.weights)]
    C, D = model.output(L_e)
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
        yield injection, L_e, 0.5 * (P + P.T), (norm * (1.0 + margin) * (1.0 + 1e-6)) ** 2


def _solutions(problem: Inequality) -> Iterator[tuple[Solution, float]]:
    """Yield the optimum, then points farther inside at slightly larger mu, with the solver's time so far.

    An optimum lies on the boundary of the inequality, where rounding decides. If it fails the certificate, a
    point inside, a little above the least mu, can still pass.
    """
    best, solve_s = solve_bounded_real(problem)
    if best is None:
        return
    yield best, solve_s
    # With bounded gains the next condition helps more than more slack.
    for slack in _SLACKS if problem.asked.gain_bound == np.inf else _SLACKS[:1]:
        solution, seconds = solve_bounded_real(problem, (best.mu * (1.0 + slack), best.noise_energy * (1.0 + slack)))
        solve_s += seconds
        if solution is not None:
            yield solution, solve_s


def _design(search: _Search, problem: Inequality, solution: Solution) -> Design:
    """Return a solution as gains in the user's units, with mu raised by the smallest slack."""
    mu, asked = problem.coordinates.mu, problem.asked
    inverse = np.linalg.inv(problem.coordinates.S)
    P = mu * inverse.T @ solution.P @ inverse
    return Design(
        method="convex",
        rate_hz=search.plant.rate_hz,
        gains=user_design(problem, solution, search.augmentation),
        P=0.5 * (P + P.T) if asked.P is None else asked.P,
        mu=mu * solution.mu * (1.0 + _SLACKS[0]),
        multipliers=mu * solution.multipliers / problem.balance if asked.multipliers else None,
        pole_radius=asked.pole_radius,
        gain_weight=asked.gain_weight,
        noise_once=search.augmentation.noise_once,
    )
