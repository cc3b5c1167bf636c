"""The bound that no observer of a model can beat: disturbances that hide faults and states from every output.

At a frequency s = j omega the signals in the null space of

    [ A + G Delta H - s I   0     E_f   E_1   0   ]
    [ C                     D_f   0     0     D_1 ]        unknowns [x; f_s; f_a; w_1; w_2]

leave the outputs at zero, and so do the same signals with the opposite sign. An observer answers both with the same
estimate, so that for one of the two its error is at least [x; f_s; f_a]. This holds for every observer, linear or not,
causal or not. The largest |e-weighted [x; f_s; f_a]| over |scaled [w; s w; s f_a]| (discrete: z = exp(j omega), [w; z
w; (z - 1) f_a]) in that null space is therefore a floor of sqrt(mu); if noise counts once, without s w.

A certified sqrt(mu) holds for every g within its slopes, hence for the linear g of any constant slopes Delta there,
even if the observer knew them: the largest floor over some constant slopes is a floor of every certificate. For the
model's own g alone it is a floor if g attains these slopes, in small motions around that point.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gains.analysis.augment import sloped_dynamics, sloped_faults
from gains.analysis.hidden_modes import row_norms, step_matrix
from gains.plants.discretise import discretise
from gains.plants.plant import FloatArray, Plant

_GRID = 160
"""Number of grid points: twenty in each decade. The best is refined; a floor that is missed between two points makes
the answer smaller, never wrong."""
_DECADES = 8.0
"""Decades of the grid below the fastest pole, or half the rate: the slowest modes of plants monitored at 100 Hz take
hours at the most."""
_REFINEMENTS, _BETWEEN = 9, 15
"""Number of finer grids around the best, and of their points: each covers 2/16 of the one before, the last 7e-9 of a
step."""
_RANK_TOLERANCE = 1e-11
"""Singular value below which a direction is in the kernel, in units of the signals. Measured on the plants of the
tests: kernels have 2e-16 at most, all others 3e-6 and more."""
_TIE = 1e-9
"""Relative gain below which a floor counts as unchanged: rounding moves the frequency of a flat floor about."""


@dataclass(frozen=True, slots=True)
class Floor:
    """No observer has a smaller certified sqrt(mu) than ``value``; where it is, radians per second and constant slopes.

    It is zero if nothing is hidden, infinite if the faults cannot be estimated at all.
    """

    value: float
    omega: float
    slopes: tuple[float, ...] = ()


def floor_sqrt_mu(
    plant: Plant, rate_hz: float | None = None, integrator_order: int = 1, *, noise_once: bool = False
) -> Floor:
    """Return the floor of sqrt(mu) over frequency and over the mean of the slopes and their vertices.

    Every value in this search is a floor, so leaving out frequencies or vertices (a sample of them is enough) makes the
    result smaller but never wrong. A continuous model is taken as it is or sampled at a rate. With integrators of order
    2 the rate of an actuator fault bounds f_a'' instead of f_a': s^2 f_a replaces s f_a.
    """
    if rate_hz is not None:
        plant = discretise(plant, rate_hz)
    dynamics, slopes = sloped_dynamics(plant, sampled=True)
    best = Floor(0.0, 0.0)
    for A, slope in zip(dynamics, slopes, strict=True):
        at = partial(_floors, plant, A, sloped_faults(plant, slope), order=integrator_order, noise_once=noise_once)
        value, omega = _highest(plant, A, at)
        if value > best.value * (1.0 + _TIE):
            best = Floor(value, omega, tuple(slope.tolist()))
    return best


def _highest(plant: Plant, A: FloatArray, floors_at: Callable[[FloatArray], FloatArray]) -> tuple[float, float]:
    """Return the floor at the highest point of a frequency grid, refined until the floors around it are equal."""
    if plant.rate_hz is not None:
        grid = math.pi * plant.rate_hz * np.geomspace(10.0**-_DECADES, 1.0, _GRID)
    else:
        rates = np.abs(np.linalg.eigvals(A))
        fastest = max(float(rates.max(initial=0.0)), 1.0)
        grid = fastest * np.geomspace(10.0**-_DECADES, 1e3, _GRID)
    omega = np.concatenate([[0.0], grid])
    floors = floors_at(omega)
    top = int(np.argmax(floors >= np.max(floors) * (1.0 - _TIE)))
    best, where = float(floors[top]), float(omega[top])
    low, high = omega[max(top - 1, 0)], omega[min(top + 1, len(omega) - 1)]
    for _ in range(_REFINEMENTS if 0.0 < best < math.inf else 0):
        finer = np.linspace(low, high, _BETWEEN + 2)
        floors = floors_at(finer[1:-1])
        top = int(np.argmax(floors))
        if floors[top] > best * (1.0 + _TIE):
            best, where = float(floors[top]), float(finer[1 + top])
        if floors.min() >= best * (1.0 - _TIE):
            break
        low, high = finer[top], finer[top + 2]
    return best, where


def _floors(
    plant: Plant, A: FloatArray, E_f: FloatArray, omega: FloatArray, order: int, noise_once: bool
) -> FloatArray:
    """Return the floor at each frequency."""
    n, p = plant.C.shape[1], len(plant.C)
    a1, a2 = len(plant.actuator_faults), len(plant.sensor_faults)
    a, q = a1 + a2, len(plant.disturbances) + len(plant.noises)
    unit = np.concatenate([plant.errors, np.ones(q)])
    constant = np.zeros((n + p, n + a + q))
    constant[:n, :n], constant[n:, :n] = step_matrix(A, plant.domain), plant.C
    constant[n:, n : n + a2], constant[:n, n + a2 : n + a] = plant.D_f, E_f
    constant[:n, n + a :], constant[n:, n + a :] = plant.E, plant.D
    # exp(j omega h) - 1 without the cancellation that would lose the digits at low frequencies
    turn = 1j * omega if plant.rate_hz is None else np.expm1(1j * omega / plant.rate_hz)
    shift = 1j * omega if plant.rate_hz is None else 1.0 + turn
    rate = np.array([fault.rate / (plant.rate_hz or 1.0) ** order for fault in plant.actuator_faults])
    pencils = np.repeat(constant[None].astype(np.complex128), len(omega), axis=0)
    pencils[:, range(n), range(n)] -= turn[:, None]
    pencils *= unit
    pencils /= row_norms(pencils)[..., None]
    columns = row_norms(np.swapaxes(pencils, 1, 2))
    values = np.zeros(len(omega))
    for at, _, _, kernel in _by_rank(pencils / columns[:, None]):
        if not kernel.shape[2]:
            continue
        hidden = kernel / columns[at][..., None]
        w, f_a = hidden[:, n + a :], hidden[:, n + a2 : n + a] * (unit[n + a2 : n + a] / rate)[:, None]
        moved_w, moved_f = (factor[at, None, None] * f for factor, f in ((shift, w), (turn**order, f_a)))
        causes = np.concatenate([w, *([] if noise_once else [moved_w]), moved_f], axis=1)
        values[at] = _largest_ratios(hidden[:, : n + a], causes)
    return values


def _largest_ratios(effects: FloatArray, causes: FloatArray) -> FloatArray:
    """Return the largest |effect c| / |cause c| of each pair (N,); infinite if a cause of size zero has an effect."""
    scale = 1.0 / row_norms(np.swapaxes(np.concatenate([effects, causes], axis=1), 1, 2))[:, None]
    effects, causes = effects * scale, causes * scale
    ratios = np.zeros(len(effects))
    for at, singular, seen, unseen in _by_rank(causes):
        free = np.abs(effects[at] @ unseen) > math.sqrt(_RANK_TOLERANCE)
        if seen.shape[2]:
            ratios[at] = np.linalg.norm(effects[at] @ seen / singular[:, None], 2, axis=(1, 2))
        ratios[at] = np.where(free.any(axis=(1, 2)), math.inf, ratios[at])
    return ratios


def _by_rank(matrices: NDArray[Any]) -> Iterator[tuple[NDArray[np.bool_], FloatArray, FloatArray, FloatArray]]:
    """Yield which matrices (N, m, n) have a rank, and their singular values, row space and null space as columns."""
    _, singular, right = np.linalg.svd(matrices, full_matrices=matrices.shape[1] < matrices.shape[2])
    ranks = np.sum(singular > _RANK_TOLERANCE, axis=1)
    for rank in np.unique(ranks):
        at = ranks == rank
        basis = np.swapaxes(right[at], 1, 2).conj()
        yield at, singular[at, :rank], basis[..., :rank], basis[..., rank:]
