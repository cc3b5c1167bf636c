"""Prediction errors over windows with free initial states: multiple shooting, with or without an innovation gain.

A window's predictor, from its own initial state x(0) (theory's symbols; K the gain of a Kalman filter, 0: simulation):

    e(k) = y(k) - C x(k),   x(k+1) = step(x(k) + K e(k), u(k), u(k+1))

The initial states are least-squares estimates for given parameters and drop out of the fit (variable projection, Golub
and Pereyra 1973): the remaining errors and their sensitivities are orthogonal to the sensitivities to the initial
state.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from adapters.errors import ModelError
from gains.identification.segment import Segment
from gains.identification.simulation import Dynamics, Hold, Stepper
from gains.plants.plant import FloatArray

_STEP = 1e-6
"""Step of forward differences: the root of rounding, 1.5e-8, times the growth of rounding in a simulation over 200
samples."""
_SWEEPS = 3
"""Gauss-Newton steps of the initial states for given parameters: one suffices if the plant is linear."""
_RANK = 1e-7
"""Relative singular value of full rank: ten times below the accuracy of the differences in the matrix."""


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """Windows of equal length: ``u`` (W, T, s), delayed already, and ``y`` (W, T, p)."""

    u: FloatArray
    y: FloatArray


class Sensitivities(NamedTuple):
    """Prediction errors (W, T, p), their sensitivities to parameters (W, T, p, k) and initial states (W, T, p, n)."""

    errors: FloatArray
    parameters: FloatArray
    states: FloatArray


def split_segments(logs: Sequence[Sequence[Segment]]) -> tuple[list[Segment], list[Segment]]:
    """Return training and validation segments: of three or more logs the last is kept back, or the last quarter."""
    filled = [segments for segments in logs if segments]
    if len(filled) >= 3:
        return [segment for segments in filled[:-1] for segment in segments], list(filled[-1])
    left = sum(len(segment.u) for segments in filled for segment in segments) * 3 // 4
    training, validation = [], []
    for segment in (segment for segments in filled for segment in segments):
        cut = min(max(left, 0), len(segment.u))
        left -= len(segment.u)
        if cut:
            training.append(segment.part(0, cut))
        if cut < len(segment.u):
            validation.append(segment.part(cut, len(segment.u)))
    return training, validation


def cut_windows(segments: Sequence[Segment], length: int, delay: int, longest_delay: int, most: int) -> Windows:
    """Return at most ``most`` windows of ``length`` samples, spread evenly over the segments.

    Inputs act ``delay`` samples later than they are recorded; windows are the same for all delays up to the longest.

    Raises
    ------
    ModelError
        No segment is long enough.
    """
    places = [
        (i, start)
        for i, segment in enumerate(segments)
        for start in range(longest_delay, len(segment.u) - length + 1, length)
    ]
    if not places:
        raise ModelError(f"no stretch of healthy samples is as long as {length + longest_delay} samples")
    if len(places) > most:
        places = [places[i] for i in np.linspace(0, len(places) - 1, most).round().astype(int)]
    u = np.stack([segments[i].u[start - delay : start - delay + length] for i, start in places])
    y = np.stack([segments[i].y[start : start + length] for i, start in places])
    return Windows(u, y)


def predict(stepper: Stepper, windows: Windows, x: FloatArray, K: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return prediction errors (P, W, T, p) and predicted states (P, W, T, n) from initial states x (P, W, n)."""
    P, W, n = x.shape
    T = windows.y.shape[1]
    errors, states = np.empty((P, W, T, windows.y.shape[2])), np.empty((P, W, T, n))
    y, gain = np.moveaxis(windows.y, 1, 0), K.T
    corrects = bool(K.any())
    with np.errstate(all="ignore"):
        drives = stepper.drives(windows.u)
        for k in range(T):
            states[:, :, k] = x
            e = y[k] - x @ stepper.C_T
            errors[:, :, k] = e
            if k + 1 < T:
                x = stepper.step(x + e @ gain if corrects else x, drives[k])
    return errors, states


class Shooting:
    """Prediction errors as a function of the parameters alone.

    ``dynamics`` are the plant's equations at parameter values (k,), whose orders of magnitude are ``sizes``. The
    innovation gain K (n, p) is zero for a simulation. Errors count as e @ L, L (p, p) the ``weight``: with L L' the
    inverse of their covariance they have size one. ``x`` is a first guess of the initial states (W, n), None: the
    smallest that explains the first output.
    """

    def __init__(
        self,
        dynamics: Callable[[FloatArray], Dynamics],
        sizes: FloatArray,
        windows: Windows,
        rate_hz: float,
        hold: Hold,
        K: FloatArray,
        weight: FloatArray,
        x: FloatArray | None = None,
    ) -> None:
        self._dynamics, self._sizes, self._windows = dynamics, sizes, windows
        self._rate_hz, self._hold, self._K, self._weight = rate_hz, hold, K, weight
        self._at: FloatArray | None = None
        self._best = np.inf
        self._found: Sensitivities
        self.x = x

    def residual(self, theta: FloatArray) -> FloatArray:
        """Return the weighted errors with the best initial states (W T p,); not finite if the plant diverges."""
        return np.asarray(self._whitened(self._evaluate(theta).errors).ravel())

    def jacobian(self, theta: FloatArray) -> FloatArray:
        """Return their sensitivities to the parameters (W T p, k), with the initial states adapted (Kaufman)."""
        sensitivities = self._evaluate(theta)
        W, T, p, k = sensitivities.parameters.shape
        J, J_0 = self._weighted(sensitivities.parameters), self._weighted(sensitivities.states)
        base = _range(J_0)
        return np.asarray((J - base @ (np.swapaxes(base, 1, 2) @ J)).reshape(W * T * p, k))

    def errors(self, theta: FloatArray) -> FloatArray:
        """Return the errors in their own units (W, T, p)."""
        return self._evaluate(theta).errors

    def states(self, theta: FloatArray) -> FloatArray:
        """Return the predicted states (W, T, n)."""
        self._evaluate(theta)
        start = np.zeros((len(self._windows.y), len(self._K))) if self.x is None else self.x
        stepper = Stepper([self._dynamics(theta)], self._rate_hz, self._hold)
        _, states = predict(stepper, self._windows, start[None], self._K)
        return np.asarray(states[0])

    def _evaluate(self, theta: FloatArray) -> Sensitivities:
        if self._at is not None and np.array_equal(theta, self._at):
            return self._found
        stepper = self._stepper(theta)
        x = self._windows.y[:, 0] @ np.linalg.pinv(stepper.C_T[0]) if self.x is None else self.x
        current = self._linearised(stepper, theta, x)
        for _ in range(_SWEEPS):
            if not np.isfinite(current.states).all():
                break
            J_0, e = self._weighted(current.states), self._whitened(current.errors).reshape(len(x), -1, 1)
            step = (np.linalg.pinv(J_0, rcond=_RANK) @ e)[..., 0]
            moved = self._linearised(stepper, theta, x - step)
            if not self._cost(moved) < self._cost(current):
                break
            gained = self._cost(current) - self._cost(moved)
            x, current = x - step, moved
            if gained < 1e-6 * self._cost(current):
                break
        if np.isfinite(current.errors).all() and self._cost(current) <= self._best:
            self._best, self.x = self._cost(current), x
        self._at, self._found = theta.copy(), current
        return current

    def _stepper(self, theta: FloatArray) -> Stepper:
        n, k = len(self._K), len(theta)
        self._steps = _STEP * np.maximum(np.abs(theta), self._sizes)
        base = self._dynamics(theta)
        moved = [self._dynamics(theta + step) for step in np.diag(self._steps)] if k else []
        return Stepper([base, *moved, *[base] * n], self._rate_hz, self._hold)

    def _linearised(self, stepper: Stepper, theta: FloatArray, x: FloatArray) -> Sensitivities:
        k, n = len(theta), x.shape[1]
        steps = _STEP * (1.0 + np.abs(x).max(axis=0))
        starts = np.concatenate([np.repeat(x[None], k + 1, axis=0), x + np.diag(steps)[:, None, :]])
        e, _ = predict(stepper, self._windows, starts, self._K)
        with np.errstate(all="ignore"):
            slopes = np.moveaxis(e[1:] - e[0], 0, -1) / np.concatenate([self._steps, steps])
        return Sensitivities(e[0], slopes[..., :k], slopes[..., k : k + n])

    def _cost(self, sensitivities: Sensitivities) -> float:
        with np.errstate(all="ignore"):
            cost = float(np.sum(self._whitened(sensitivities.errors) ** 2))
        return cost if np.isfinite(cost) else np.inf

    def _whitened(self, errors: FloatArray) -> FloatArray:
        with np.errstate(all="ignore"):
            return np.asarray(errors @ self._weight)

    def _weighted(self, slopes: FloatArray) -> FloatArray:
        """Return weighted sensitivities, one matrix per window (W, T p, .)."""
        W, T, p, k = slopes.shape
        return np.asarray(np.einsum("wtpk,pq->wtqk", slopes, self._weight).reshape(W, T * p, k))


def _range(matrices: FloatArray) -> FloatArray:
    """Return orthonormal bases of the columns of each matrix; dependent columns become zero."""
    left, singular, _ = np.linalg.svd(matrices, full_matrices=False)
    return np.asarray(left * (singular > _RANK * singular[:, :1])[:, None, :])
