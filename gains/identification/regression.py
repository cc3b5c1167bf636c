"""One output of a vehicle from its inputs: coefficients without noise bias, actuator timing, noise, excitation.

For an output y, its actuator's effect u and other inputs z_j, all on one grid (k counts samples):

    y(k+1) = a y(k) + b v(k) + sum_j b_j z_j(k) + c,       v = u after transport delay and first-order lag

Plain least squares puts measurement noise of y on both sides, which biases ``a`` towards zero and all other
coefficients with it. Here the instrument for y(k) is the model's own simulation from the inputs alone, which contains
no such noise (refined instrumental variables; Young, Recursive Estimation and Time-Series Analysis, 2011, ch. 7). The
first autocovariance of the residual e(k) = w(k) + n(k+1) - a n(k) separates disturbance w from noise n.

Generalised least squares, which filters both sides until e is white, would be consistent under feedback as well. It was
measured and not taken: it weighs what changes within samples, where the model is least exact (a simulated plane's
throttle has two fifths of its effect, a recorded rover's error of one step grows from .014 to .030 rad/s).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from adapters.errors import ModelError
from gains.identification.lag import followed
from gains.identification.segment import Segment
from gains.plants.plant import FloatArray

_LAGS_S = (0.0, 0.02, 0.04, 0.06, 0.08, 0.1, 0.15, 0.2, 0.3)
"""Lags tried, s: those of motors and servos, so far apart that the fit can just distinguish them."""
_DELAYS_S = (0.0, 0.01, 0.02, 0.03, 0.04, 0.06, 0.08, 0.1)
"""Delays tried, s, as far apart as the grid of usual telemetry."""
_SETTLE_S = 1.0
"""Time left out after each start, s, because the actuators' model begins at rest there: a lag of .3 s has 4 % left
after it. Measured on recorded rovers: with .25 s steering changes by 2 % and its error grows by a quarter, with 2 s and
4 s by less than 1.2 %."""
_LEAST_S = 20.0
"""Shortest data, s: twenty times the memory below, so that standard errors are meaningful."""
_SWEEPS = 4
"""Number of estimates of instruments and coefficients in turn. Measured on recorded planes and rovers: three give the
coefficients of sixteen within .01 %."""
_MEMORY_S = 1.0
"""Time over which residuals correlate, s. Measured on recorded rovers: half of it understates standard errors by 8 to
18 %, twice as much changes them only on an axis without dynamics (by 7 and 20 %)."""
_MIDDLE = 0.5
"""Value of ``a`` from which an unstable estimate restarts. Measured on recorded planes and rovers: .2 and .9 end at the
same coefficients."""
_SLOWEST_S = 10.0
"""Longest memory of an output, s. Chosen: a surface or a wheel that acts for so long moves the vehicle, not a rate."""
_AS_GOOD = 10.0
"""Twice the logarithm of the likelihood ratio within which timings fit equally well: it includes the true lag and delay
with a probability of 99.3 % (chi-squared with two degrees of freedom)."""
_SMALLEST = 1e-12
"""Least variance of a denominator: it keeps a division by zero variance finite."""


@dataclass(frozen=True, slots=True)
class AxisModel:
    """The axis to identify: one output, the actuator that moves it, and its other inputs."""

    # names of y and u
    output: str
    actuator: str
    others: tuple[str, ...]  # names of the z_j
    # other actuators whose effect on y cannot be ruled out: no part of the model, but the standard error of b is that
    # with them in it. The effect of an actuator that moves in step with a rival cannot be identified.
    rivals: tuple[str, ...] = ()
    dynamic: bool = True  # whether y has a memory; otherwise a = 0, as for a specific force
    offset: bool = True  # whether there is a constant c


@dataclass(frozen=True, slots=True)
class AxisFit:
    """The result of identifying one output from recordings."""

    model: AxisModel  # the axis that was identified
    # coefficients per step; b is the actuator's
    a: float
    b: float
    c: float
    effects: FloatArray  # b_j of ``model.others``
    # standard error of b, with the colour of the residuals, rivals that may act, and timings that fit equally well
    b_error: float
    # the actuator's timing
    lag_s: float
    delay_s: float
    residual_std: float  # one-step prediction error, in units of y
    # its two parts, in units of y: w per step, n
    disturbance_std: float
    noise_std: float
    # share of the variance of y(k+1), without the parts of ``a`` and the others, that the actuator explains
    explained: float
    whiteness: float  # correlation of the residual with that one step before; near zero for a complete model
    moved: float  # standard deviation of the actuator's effect
    samples: int  # number of one-step equations

    @property
    def t_value(self) -> float:
        """Excitation of the axis: b over its standard error."""
        return abs(self.b) / max(self.b_error, _SMALLEST)


def fit_axis(
    segments: Sequence[Segment], rate_hz: float, inputs: Sequence[str], outputs: Sequence[str], model: AxisModel
) -> AxisFit:
    """Identify one output.

    ``segments`` are uninterrupted healthy operation, the actuators' effects without delay and lag.

    Raises
    ------
    ModelError
        Less than 20 s of samples.
    """
    settle = round(_SETTLE_S * rate_hz)
    usable = [segment for segment in segments if len(segment.u) > 2 * settle]
    count = sum(len(segment.u) - settle - 1 for segment in usable)
    if count < _LEAST_S * rate_hz:
        raise ModelError(
            f"only {count / rate_hz:.0f} s of healthy driving or flight in unbroken stretches; "
            f"at least {_LEAST_S:.0f} s are needed"
        )
    places = [inputs.index(name) for name in model.others]
    rivals = [inputs.index(name) for name in model.rivals]
    actuator, output = inputs.index(model.actuator), outputs.index(model.output)
    data = _Data(
        u=[segment.u[:, actuator] for segment in usable],
        z=[segment.u[:, places] for segment in usable],
        y=[segment.y[:, output] for segment in usable],
        rivals=[segment.u[:, rivals] for segment in usable],
        rate_hz=rate_hz,
        settle=settle,
        model=model,
    )
    trials = sorted((*data.trial(*timing), *timing) for timing in _timings(rate_hz))
    _, _, lag_s, delay_s = trials[0]
    return data.refined(lag_s, delay_s, trials)


def lagged(effect: FloatArray, delay_s: float, lag_s: float, rate_hz: float) -> FloatArray:
    """Return an effect (N,) after transport delay and first-order lag, at rest before its start."""
    steps = np.arange(len(effect)) - delay_s * rate_hz
    delayed: FloatArray = np.interp(steps, np.arange(len(effect)), effect)
    if lag_s <= 0.0:
        return delayed
    keep = float(np.exp(-1.0 / (lag_s * rate_hz)))
    return followed((1.0 - keep) * delayed[1:], keep, delayed[0])


def coloured_inflation(residual: Sequence[FloatArray], rate_hz: float) -> float:
    """Return the factor by which correlation in time inflates the variance of a residual's mean: 1 for white."""
    centred = [part - part.mean() for part in residual]
    variance = sum(float(part @ part) for part in centred)
    total = 1.0
    for shift in range(1, round(_MEMORY_S * rate_hz)):
        shared = sum(float(part[shift:] @ part[:-shift]) for part in centred if len(part) > shift)
        if shared <= 0.0:
            break
        total += 2.0 * shared / max(variance, _SMALLEST)
    return total


@dataclass(frozen=True, slots=True)
class _Data:
    """The segments' columns of one axis."""

    u: list[FloatArray]
    z: list[FloatArray]
    y: list[FloatArray]
    rivals: list[FloatArray]
    rate_hz: float
    settle: int
    model: AxisModel

    def trial(self, lag_s: float, delay_s: float) -> tuple[float, float]:
        """Return the mean square of the residual of the simulation from the inputs alone, and the actuator's gain."""
        X, target = self._equations(lag_s, delay_s)
        theta, Z = self._solve(X, target, lag_s, delay_s)
        if not self.model.dynamic:
            return float(np.mean((target - X @ theta) ** 2)), float(theta[0])
        simulated = X.copy()
        simulated[:, 0] = Z[:, 0]
        return float(np.mean((target - simulated @ theta) ** 2)), float(theta[1] / (1.0 - theta[0]))

    def _solve(self, X: FloatArray, target: FloatArray, lag_s: float, delay_s: float) -> tuple[FloatArray, FloatArray]:
        """Return the coefficients and their instruments.

        At a rate that is slow for the vehicle, an output has no memory left, and feedback or noise may even show a
        negative one: ``a`` is then zero.
        """
        theta: FloatArray = np.asarray(np.linalg.lstsq(X, target, rcond=None)[0], dtype=np.float64)
        Z = X
        for _ in range(_SWEEPS if self.model.dynamic else 0):
            if not 0.0 <= theta[0] < 1.0:
                theta = _with(_MIDDLE, X, target)
            Z = X.copy()
            Z[:, 0] = np.concatenate(list(self._simulated(theta, lag_s, delay_s)))
            theta = np.asarray(np.linalg.lstsq(Z.T @ X, Z.T @ target, rcond=None)[0], dtype=np.float64)
        if self.model.dynamic and theta[0] < 0.0:
            return _with(0.0, X, target), X
        if self.model.dynamic and theta[0] >= 1.0:
            theta = _with(float(np.exp(-1.0 / (_SLOWEST_S * self.rate_hz))), X, target)
            Z = X.copy()
            Z[:, 0] = np.concatenate(list(self._simulated(theta, lag_s, delay_s)))
        return theta, Z

    def refined(self, lag_s: float, delay_s: float, trials: Sequence[tuple[float, float, float, float]]) -> AxisFit:
        X, target = self._equations(lag_s, delay_s)
        theta, Z = self._solve(X, target, lag_s, delay_s)
        e = target - X @ theta
        parts = np.split(e, np.cumsum([len(y) - self.settle - 1 for y in self.y])[:-1])
        inflation = coloured_inflation(parts, self.rate_hz)
        own = 1 if self.model.dynamic else 0
        rivals = self._rivals(lag_s, delay_s)
        inverse = np.linalg.pinv(Z.T @ X)
        spread = float((inverse @ (Z.T @ Z) @ inverse.T)[own, own]) * inflation * _shadowing(X, own, rivals)
        as_good = trials[0][0] * (1.0 + _AS_GOOD * inflation / len(e))
        gains = [gain for misfit, gain, *_ in trials if misfit <= as_good]
        timing = (max(gains) - min(gains)) / (2.0 * max(abs(trials[0][1]), _SMALLEST))
        variance = float(e.var())
        shared = sum(float(part[1:] @ part[:-1]) for part in parts) / len(e)
        a = float(theta[0]) if self.model.dynamic else 0.0
        noise = min(max(-shared / a, 0.0), variance / (1.0 + a * a)) if a > 0.0 else 0.5 * variance
        without = float((e + X[:, own] * theta[own] - np.mean(X[:, own] * theta[own])).var())
        return AxisFit(
            model=self.model,
            a=a,
            b=float(theta[own]),
            c=float(theta[-1]) if self.model.offset else 0.0,
            effects=theta[own + 1 : own + 1 + len(self.model.others)],
            b_error=float(np.hypot(np.sqrt(spread * variance), timing * theta[own])),
            lag_s=lag_s,
            delay_s=delay_s,
            residual_std=float(np.sqrt(variance)),
            disturbance_std=float(np.sqrt(variance - (1.0 + a * a) * noise)) if a > 0.0 else float(np.sqrt(noise)),
            noise_std=float(np.sqrt(noise)),
            explained=1.0 - variance / max(without, _SMALLEST),
            whiteness=shared / max(variance, _SMALLEST),
            moved=float(X[:, own].std()),
            samples=len(e),
        )

    def _equations(self, lag_s: float, delay_s: float) -> tuple[FloatArray, FloatArray]:
        keep = slice(self.settle, -1)
        rows = []
        for u, z, y in zip(self.u, self.z, self.y, strict=True):
            columns = [lagged(u, delay_s, lag_s, self.rate_hz)[keep, None], z[keep]]
            if self.model.dynamic:
                columns.insert(0, y[keep, None])
            if self.model.offset:
                columns.append(np.ones((len(y) - self.settle - 1, 1)))
            rows.append(np.hstack(columns))
        return np.vstack(rows), np.concatenate([y[self.settle + 1 :] for y in self.y])

    def _rivals(self, lag_s: float, delay_s: float) -> FloatArray:
        keep = slice(self.settle, -1)
        return np.vstack(
            [
                np.column_stack([lagged(column, delay_s, lag_s, self.rate_hz)[keep] for column in block.T])
                if block.shape[1]
                else block[keep]
                for block in self.rivals
            ]
        )

    def _simulated(self, theta: FloatArray, lag_s: float, delay_s: float) -> Iterator[FloatArray]:
        c = theta[-1] if self.model.offset else 0.0
        for u, z, y in zip(self.u, self.z, self.y, strict=True):
            drive = theta[1] * lagged(u, delay_s, lag_s, self.rate_hz) + z @ theta[2 : 2 + z.shape[1]] + c
            yield followed(drive[:-1], theta[0], y[0])[self.settle : -1]


def _with(a: float, X: FloatArray, target: FloatArray) -> FloatArray:
    """Return the coefficients with a given first one."""
    return np.append(a, np.linalg.lstsq(X[:, 1:], target - a * X[:, 0], rcond=None)[0])


def _shadowing(X: FloatArray, own: int, rivals: FloatArray) -> float:
    """Return by how much the rivals inflate the variance of one column's coefficient."""
    column, others = X[:, own], np.delete(X, own, axis=1)
    alone, among = (
        float(np.sum((column - block @ np.linalg.lstsq(block, column, rcond=None)[0]) ** 2))
        for block in (others, np.hstack([others, rivals]))
    )
    return float(alone / max(among, _SMALLEST * alone, _SMALLEST))


def _timings(rate_hz: float) -> Iterator[tuple[float, float]]:
    """Yield the lags and delays that this grid resolves."""
    step = 0.5 / rate_hz
    delays = [delay for i, delay in enumerate(_DELAYS_S) if i == 0 or delay - _DELAYS_S[i - 1] >= step]
    return product(_LAGS_S, delays)
