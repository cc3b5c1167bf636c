"""Which faults of a plant can be estimated together, and the smallest sets that cannot.

A set S of faults can be estimated when, at every slope vertex and at their mean (existence conditions of the theory),

    rank E_f(S), D_f(S)     the directions of its faults are independent
    (A, C)                  the plant without faults hides no mode that stays
    (L1 A_z, Cb)            no invariant zero of (A, 0; C, D_f(S)) with |z| >= 1 (Re s >= 0)
    condition II            no constant faults S with states that stand still and outputs that are zero: the matrix
                            [L1 A_z - I, L1 E_f; Cb, 0] (continuous: no I) has full column rank

An error system can be made stable exactly if its unobservable modes decay by themselves. A hidden mode without faults
is a mistake of the model. With Pi a basis of the combinations of outputs without sensor faults (Pi D_f = 0) the third
means that (A, Pi C) has no hidden mode that stays, and the fourth that ([A, E_f; 0, I], [Pi C, 0]) has none
(continuous: 0 for I). Every part of an estimable set is estimable, too: sets are built up one fault at a time, and a
set that is not estimable while all its parts are is a smallest reason.
"""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from adapters.errors import InfeasibleError, ModelError
from gains.analysis.augment import sloped_dynamics
from gains.analysis.hidden_modes import HiddenMode, hidden_modes, kernel, leading, row_norms, signal_scales, step_matrix
from gains.plants.plant import FloatArray, Plant, check_independence, first_dependent

Condition = Literal["hidden mode", "rank of E_f", "rank of D_f", "detectability of (L1 A_z, Cb)", "condition II"]

LARGEST_TEST_COUNT = 5000
"""Largest number of tests of a set at a slope (measured: 1 ms each for a quadrotor): the search ends within seconds."""
_MOST_GROWN = 20
"""Number of sets that are grown to largest ones if the search ended early: as many as a report can explain."""
_SEEN_TOLERANCE = 1e-6
"""Share of an effect below which it is not seen. Measured on the plants of the tests: unseen effects are exactly 0,
seen ones 4e-3 and more."""
_MOVING = 0.05
"""Share of a fault's unit, in motions that no output shows at once, below which the fault is only a side effect of the
others."""
_GENERIC_TOLERANCE = 1e-9
"""Smallest singular value of full rank, in units of the signals. Measured on the plants of the tests: a pencil without
full rank has 2e-16 at most, one with full rank 3e-4 and more."""
_GENERIC = (0.37 + 0.61j, 0.83 - 0.29j)
"""Two points that are zeros of a plant only by coincidence, in units of the size of A: a pencil that loses rank at both
loses it everywhere."""


@dataclass(frozen=True, slots=True)
class Problem:
    """A smallest set of faults that cannot be estimated together, and why."""

    faults: tuple[str, ...]  # the set; empty if the plant itself hides a mode
    condition: Condition  # the existence condition that fails
    mode: complex  # the hidden mode in the continuous sense, radians per second (0: constant)
    states: tuple[str, ...]  # states that move with the faults while every output is zero, the largest first
    at_every_frequency: bool  # whether other motions of the faults are hidden in the same way, besides this mode


@dataclass(frozen=True, slots=True)
class Estimability:
    """The sets of faults that can be estimated."""

    # the largest sets of faults that can be estimated together, each in the order of the model
    sets: tuple[tuple[str, ...], ...]
    problems: tuple[Problem, ...]  # the smallest sets that cannot
    # whether all sets were tested; otherwise the search stopped after ``LARGEST_TEST_COUNT`` tests of a set at a
    # combination of slopes, and there may be more of both
    complete: bool = True


def restricted(plant: Plant, faults: Iterable[str]) -> Plant:
    """Return the plant with these faults only; all else is unchanged."""
    kept = set(faults)
    return replace(plant, faults=tuple(fault for fault in plant.faults if fault.name in kept))


def estimability(plant: Plant) -> Estimability:
    """Return which of the declared faults can be estimated together, and why not all."""
    names = tuple(fault.name for fault in plant.faults)
    if problem_of(plant, names) is None:
        return Estimability((names,), ())
    problem = problem_of(plant, ())
    if problem is not None:
        return Estimability((), (problem,))
    problems: list[Problem] = []
    sets: list[tuple[str, ...]] = []
    level: list[tuple[str, ...]] = [()]
    slopes, tests = len(sloped_dynamics(plant)[0]), 0
    while level:
        known, larger = set(level), []
        for smaller, name in itertools.product(level, names):
            if tests >= LARGEST_TEST_COUNT or (smaller and names.index(name) <= names.index(smaller[-1])):
                continue
            faults = (*smaller, name)
            if not all(part in known for part in itertools.combinations(faults, len(smaller))):
                continue
            tests += slopes
            problem = problem_of(plant, faults)
            if problem is None:
                larger.append(faults)
            else:
                problems.append(problem)
        covered = {part for faults in larger for part in itertools.combinations(faults, len(faults) - 1)}
        sets += [faults for faults in level if faults and faults not in covered]
        level = larger
    if tests >= LARGEST_TEST_COUNT:
        sets = list(dict.fromkeys(_grown(plant, faults, names) for faults in sets[:_MOST_GROWN]))
        problems = problems or [_smallest_problem(plant, names)]
    sets.sort(key=lambda faults: (-len(faults), [names.index(name) for name in faults]))
    return Estimability(tuple(sets), tuple(problems), tests < LARGEST_TEST_COUNT)


def _grown(plant: Plant, faults: tuple[str, ...], names: tuple[str, ...]) -> tuple[str, ...]:
    """Return an estimable set with every fault added that keeps it estimable."""
    for name in names:
        if name not in faults and problem_of(plant, (*faults, name)) is None:
            faults = (*faults, name)
    return tuple(name for name in names if name in faults)


def _smallest_problem(plant: Plant, faults: tuple[str, ...]) -> Problem:
    """Return the problem of a set that cannot be estimated, without the faults that do not matter for it."""
    for name in faults:
        fewer = tuple(other for other in faults if other != name)
        if problem_of(plant, fewer) is not None:
            faults = fewer
    problem = problem_of(plant, faults)
    assert problem is not None  # noqa: S101 - for mypy: the loop keeps only sets with a problem
    return problem


def problem_of(plant: Plant, faults: Iterable[str]) -> Problem | None:
    """Return why these faults cannot be estimated together, or None if they can.

    The problem names all of them; if the set is not a smallest one, it gives the first reason found.
    """
    part = restricted(plant, faults)
    names = tuple(fault.name for fault in part.faults)
    if first_dependent(part.E_f / part.state_errors[:, None]) is not None:
        return Problem(names, "rank of E_f", 0j, (), at_every_frequency=True)
    if first_dependent(part.D_f) is not None:
        return Problem(names, "rank of D_f", 0j, (), at_every_frequency=True)
    for condition, mode, A, _ in _failures(part):
        return Problem(
            faults=names,
            condition=condition,
            mode=continuous_mode(mode.eigenvalue, plant),
            states=moving_states(plant, mode),
            at_every_frequency=hides_at_every_frequency(part, A),
        )
    return None


def _failures(plant: Plant, *, sampled: bool = False) -> Iterator[tuple[Condition, HiddenMode, FloatArray, FloatArray]]:
    """Yield each existence condition that fails, the mode that stays, and A and the slopes at which it does."""
    for A, slopes in zip(*sloped_dynamics(plant, sampled=sampled), strict=True):
        for condition, modes in conditions(plant, A):
            if modes and modes[0].stays:
                yield condition, modes[0], A, slopes


def check_existence(plant: Plant, *, sampled: bool = False) -> tuple[str, ...]:
    """Test the existence conditions of a plant, at every slope vertex or at a sample; return what is possible but slow.

    Raises
    ------
    ModelError
        The plant itself has a mode that does not decay and that no output shows, it has no faults, or directions of
        its faults depend on each other.
    InfeasibleError
        A condition fails; the message names it and the signals that cannot be distinguished. Or too many slopes vary.
    """
    faults = len(plant.faults)
    if not faults:
        raise ModelError(f"{plant.name}: 'fault' is empty; there is nothing to estimate")
    if faults > len(plant.outputs):
        raise InfeasibleError(
            f"{plant.name}: {faults} faults cannot be told apart with {len(plant.outputs)} outputs "
            "(condition II needs at least as many outputs as faults)"
        )
    check_independence(plant)
    for condition, mode, _, slopes in _failures(plant, sampled=sampled):
        moving = _moving(plant, mode, condition != "hidden mode")
        variable = "z" if plant.domain == "discrete" else "s"
        at = f" at slopes {', '.join(f'{slope:g}' for slope in slopes)}" if len(slopes) else ""
        value = mode.eigenvalue
        shown = f"{value.real:.4g}" if abs(value.imag) < 1e-9 else f"{value.real:.4g}{value.imag:+.4g}j"
        where = f"mode at {variable} = {shown}{at}"
        if condition == "hidden mode":
            raise ModelError(f"{plant.name}: hidden mode: {moving} shows in no output ({where})")
        raise InfeasibleError(
            f"{plant.name}: {condition} fails: {moving} shows in no output ({where}); "
            "add a sensor, a leak or leave a fault out"
        )
    if late := late_faults(plant):
        names = " and ".join(f"'{name}'" for name in late)
        return (
            f"Cb L1 E_f lacks rank: {names} cannot be seen in the first sample after acting; the estimate takes longer",
        )
    return ()


def _moving(plant: Plant, mode: HiddenMode, faulty: bool) -> str:
    """Return the signals that take part in a mode, the faults before the states, each group the largest first.

    The sensor faults cancel the effect of the states on the outputs: D_f f_s = -C x.
    """
    x, f_a = np.split(mode.motion, [len(plant.states)])
    moving = _largest(plant.states, np.abs(x) / plant.state_errors)
    if not faulty:
        return moving
    faults = (*plant.sensor_faults, *plant.actuator_faults)[: len(plant.sensor_faults) + len(f_a)]
    motion = np.concatenate([np.linalg.pinv(plant.D_f) @ (plant.C @ x), f_a])
    sizes = np.abs(motion) / [fault.error for fault in faults]
    return " moving with ".join(filter(None, (_largest([fault.name for fault in faults], sizes), moving)))


def _largest(names: Sequence[str], sizes: FloatArray) -> str:
    return " and ".join(f"'{name}'" for name in leading(names, sizes))


def moving_states(plant: Plant, mode: HiddenMode) -> tuple[str, ...]:
    """Return the states that move in a mode, the largest first in units of the errors that matter."""
    return leading(plant.states, mode.direction[: len(plant.states)] / plant.state_errors)


def continuous_mode(eigenvalue: complex, plant: Plant) -> complex:
    """Return an eigenvalue as s in radians per second; minus infinity for a mode that ends within one sample."""
    if plant.rate_hz is None:
        return eigenvalue
    if abs(eigenvalue) < 1e-12:
        return complex(-np.inf)
    s = plant.rate_hz * complex(np.log1p(eigenvalue - 1.0))
    return 0j if abs(s) < 1e-7 * plant.rate_hz else s


def conditions(plant: Plant, A: FloatArray) -> Iterator[tuple[Condition, list[HiddenMode]]]:
    """Yield the hidden modes that each existence condition forbids, at given slopes: of x, or of [x; f_a]."""
    n, a1, a2 = len(plant.states), len(plant.actuator_faults), len(plant.sensor_faults)
    scales = signal_scales(plant)
    yield "hidden mode", hidden_modes(A, plant.C, scales[:n], plant.domain)
    outputs = unattacked_outputs(plant)
    if a2:
        yield "detectability of (L1 A_z, Cb)", hidden_modes(A, outputs, scales[:n], plant.domain)
    if a1:
        held = np.eye(n + a1) if plant.domain == "discrete" else np.zeros((n + a1, n + a1))
        held[:n, :n], held[:n, n:] = A, plant.E_f
        outputs = np.hstack([outputs, np.zeros((len(outputs), a1))])
        yield "condition II", hidden_modes(held, outputs, np.concatenate([scales[:n], scales[n + a2 :]]), plant.domain)


def unattacked_outputs(plant: Plant) -> FloatArray:
    """Return Pi C: combinations of outputs, each in units of its own row, that no sensor fault enters.

    A combination on which the states have almost no effect has rounding errors only, and becomes zero.
    """
    states = signal_scales(plant)[: len(plant.states)]
    rows = row_norms(plant.C * states)
    directions = plant.D_f / rows[:, None]
    directions = directions / np.linalg.norm(directions, axis=0)
    combined = np.asarray(kernel(directions.T).T @ (plant.C / rows[:, None]), dtype=np.float64)
    combined[np.linalg.norm(combined * states, axis=1) < _GENERIC_TOLERANCE] = 0.0
    return combined


def late_faults(plant: Plant) -> tuple[str, ...]:
    """Return the actuator faults that move while Cb L1 E_f f_a is zero: no output that is not attacked jumps.

    Cb L1 E_f has the kernel of Pi C E_f, where Pi D_f = 0.
    """
    if not plant.actuator_faults:
        return ()
    size = plant.state_errors
    through, into = unattacked_outputs(plant) * size, plant.E_f / size[:, None]
    seen = through @ into / row_norms(through)[:, None] / np.linalg.norm(into, axis=0)
    _, singular, right = np.linalg.svd(seen)
    unseen = right[int(np.sum(singular > _SEEN_TOLERANCE)) :]
    moving = np.max(np.abs(unseen), axis=0, initial=0.0) > _MOVING
    return tuple(fault.name for fault, late in zip(plant.actuator_faults, moving, strict=True) if late)


def hides_at_every_frequency(plant: Plant, A: FloatArray) -> bool:
    """Return whether the pencil of the faults loses rank at every tested point."""
    if len(plant.faults) > len(plant.outputs):
        return True
    pencil, size, _ = fault_pencil(plant, A)
    n = len(plant.states)
    return all(smallest_singular_value(pencil, n, point * size)[0] < _GENERIC_TOLERANCE for point in _GENERIC)


def fault_pencil(plant: Plant, A: FloatArray) -> tuple[FloatArray, float, FloatArray]:
    """Return [A, 0, E_f; C, D_f, 0] (discrete: A - I) in units of the signals, the size of A, and those units."""
    n, a2, scales = len(plant.states), len(plant.sensor_faults), signal_scales(plant)
    pencil = np.zeros((n + len(plant.outputs), len(scales)))
    pencil[:n, :n], pencil[n:, :n] = step_matrix(A, plant.domain), plant.C
    pencil[n:, n : n + a2], pencil[:n, n + a2 :] = plant.D_f, plant.E_f
    pencil *= scales
    pencil[:n] /= scales[:n, None]
    pencil[n:] /= row_norms(pencil[n:, :n])[:, None]
    return pencil, float(np.linalg.norm(pencil[:n, :n], 2)) or 1.0, scales


def smallest_singular_value(pencil: FloatArray, n: int, s: complex) -> tuple[float, FloatArray]:
    """Return how far a pencil is from losing rank at s, with rows and columns scaled to one size, and the direction."""
    shifted = pencil.astype(np.complex128)
    shifted[range(n), range(n)] -= s
    shifted = shifted / row_norms(np.abs(shifted))[:, None]
    columns = row_norms(np.abs(shifted).T)
    _, singular, right = np.linalg.svd(shifted / columns)
    return float(singular[-1]), np.abs(right[-1]) / columns
