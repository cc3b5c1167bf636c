"""Invariant zeros of a plant with its faults: motions of states and faults that leave every output at zero.

The zeros of (A, 0; C, D_f) are modes of the error that no gain moves: with Re s < 0 the estimates settle at that rate
at best. The zeros of the whole, [A - sI, 0, E_f; C, D_f, 0], are motions of the faults that are hidden at that s alone;
at 0 no observer exists, elsewhere they limit how well an observer follows fast faults.
"""

import math
from dataclasses import dataclass

import numpy as np

from gains.analysis.augment import sloped_dynamics
from gains.analysis.estimability import (
    continuous_mode,
    fault_pencil,
    hides_at_every_frequency,
    moving_states,
    smallest_singular_value,
    unattacked_outputs,
)
from gains.analysis.hidden_modes import hidden_modes, leading, signal_scales
from gains.plants.plant import FloatArray, Plant

_LARGEST = 1e4
"""Largest size of a finite zero, in units of the size of A. The square pencil has infinite zeros too, which rounding
makes large but finite."""
_ZERO_TOLERANCE = 1e-8
"""Smallest singular value of full rank, in units of the signals. Measured on the plants of the tests: zeros of the
whole pencil have 1e-15 at most, those of its random square part alone 1.5e-3 and more."""


@dataclass(frozen=True, slots=True)
class Zero:
    """An invariant zero, rad/s, and the faults and states that move in it, the largest first.

    Of a conjugate pair it is the one above the real axis. It is a zero of the ``"sensor faults"``, with the actuator
    faults held at zero, or of ``"all faults"``.
    """

    s: complex
    faults: tuple[str, ...]
    states: tuple[str, ...]
    of: str


def invariant_zeros(plant: Plant) -> tuple[Zero, ...]:
    """Return the zeros with the sensor faults and those with all faults, at the mean slopes.

    The latter only if the faults can be distinguished at all: otherwise every s is a zero.
    """
    A = sloped_dynamics(plant)[0][0]
    zeros = _sensor_zeros(plant, A) if plant.sensor_faults else []
    if plant.actuator_faults and not hides_at_every_frequency(plant, A):
        zeros += _fault_zeros(plant, A)
    return tuple(sorted(zeros, key=lambda zero: (-zero.s.real, zero.s.imag)))


def mode_text(s: complex) -> str:
    """Return a mode's motion in words."""
    if math.isinf(s.real):
        return "gone after one sample"
    if abs(s) < 1e-9:
        return "constant"
    settles = "" if abs(s.real) < 1e-9 * abs(s) else f" with time constant {1.0 / abs(s.real):.3g} s"
    if abs(s.imag) < 1e-9 * abs(s):
        return f"{'decays' if s.real < 0.0 else 'grows'}{settles}"
    pace = "undamped" if not settles else ("decaying" if s.real < 0.0 else "growing") + settles
    return f"oscillates at {abs(s.imag) / (2.0 * math.pi):.3g} Hz, {pace}"


def _sensor_zeros(plant: Plant, A: FloatArray) -> list[Zero]:
    n = len(plant.states)
    modes = hidden_modes(A, unattacked_outputs(plant), signal_scales(plant)[:n], plant.domain)
    into = np.linalg.pinv(plant.D_f)
    zeros = []
    for mode in modes:
        if mode.eigenvalue.imag >= 0.0:
            # The direction has sizes only; the share of each fault in C x shows which faults answer.
            sizes = np.abs(into) @ (np.abs(plant.C) @ mode.direction)
            faults = leading([fault.name for fault in plant.sensor_faults], sizes)
            zeros.append(
                Zero(continuous_mode(mode.eigenvalue, plant), faults, moving_states(plant, mode), "sensor faults")
            )
    return zeros


def _fault_zeros(plant: Plant, A: FloatArray) -> list[Zero]:
    """Return the zeros of the tall pencil: those of a random square part of it at which it loses rank itself."""
    from scipy.linalg import eigvals

    n, a = len(plant.states), len(plant.faults)
    pencil, size, scales = fault_pencil(plant, A)
    mix, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(len(plant.outputs), a)))
    square = np.vstack([pencil[:n], mix.T @ pencil[n:]])
    alpha, beta = eigvals(square, np.diag(np.repeat([1.0, 0.0], [n, a])), homogeneous_eigvals=True)
    finite = np.abs(alpha) < _LARGEST * size * np.abs(beta)
    zeros: list[Zero] = []
    names = [fault.name for fault in (*plant.sensor_faults, *plant.actuator_faults)]
    for eigenvalue in alpha[finite] / beta[finite]:
        distance, right = smallest_singular_value(pencil, n, complex(eigenvalue))
        if distance > _ZERO_TOLERANCE or eigenvalue.imag < -1e-12 * size:
            continue
        direction = right * scales
        s = continuous_mode(complex(eigenvalue) + (1.0 if plant.domain == "discrete" else 0.0), plant)
        faults = leading(names, direction[n:])
        states = leading(plant.states, direction[:n] / plant.state_errors)
        zeros.append(Zero(0j if abs(s) < 1e-9 * size else s, faults, states, "all faults"))
    return zeros
