"""Measures on healthy recordings how well GPS, barometer, compass and gyro agree: scales and delays.

No vehicle parameter is identified: the kinematics are known (:mod:`monitor.vehicles.inertial.identify`). Flights have
to show the differences between healthy sensors, fast (noise) and slow (disturbance), and each sensor's delay.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import exp
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapters.errors import ModelError
from gains.identification.segment import Segment
from monitor.vehicles.inertial.strapdown import ACCELEROMETERS

Made = Callable[[NDArray[np.float64], float, float], NDArray[np.float64]]
"""Function of an input (N,), its rate and a time constant that returns the expected output (N,)."""
HORIZONTAL = ("north", "east")
BODY = ("x", "y", "z")

_LEAST_S = 20.0
"""Least healthy motion, seconds: less leaves fewer than five independent spans of ``_SLOW_S`` to measure a drift on."""
_SETTLE_S = 5.0
"""Beginning of each segment that is left out, seconds: the compared integrals begin at zero."""
BARE_SETTLE_S = 10.0
"""The same for positions that come without a velocity. Chosen: a speed error of 1 m/s at the start, as from two fixes
that are off by a tenth of a metre, has faded to .4 m (v t exp(-t / 3 s))."""
_FAST_S = 0.5
"""Span of the differences that show noise, seconds. Chosen: drifts are too slow to matter in that time."""
_SLOW_S = 4.0
"""Span of the differences that show drift, seconds; longer spans would be too few in short flights."""
_SHOWN = 1.05
"""Least ratio of the mean squares from which a delay is read. Chosen: a difference of less than 5 % may be chance in
minutes of flight."""
_EXCITED = 20.0
"""Least ratio of the motion to the remaining difference from which a scale is read: it is then known within 5 %."""
_LARGEST_SCALE_ERROR = 0.05
"""Largest error of a scale: the earth's ellipsoid against a sphere makes 0.7 % at most, so a larger one is no scale."""
_SMALLEST = 1e-4
"""Least noise and drift, in the unit of the output: they keep the design finite if a simulator has none."""


class Washouts(NamedTuple):
    """Time constants of the transform, seconds."""

    position: float  # for positions and angles
    velocity: float
    bare: float  # for positions that come without a velocity, applied twice


@dataclass(frozen=True, slots=True, eq=False)
class InertialData:
    """Healthy flight to compare sensors in; ``inputs`` and ``outputs`` name the columns of u and y."""

    segments: Sequence[Segment]  # unbroken, one period from sample to sample
    inputs: Sequence[str]
    outputs: Sequence[str]
    rate_hz: float
    washouts: Washouts

    def errors(self, source: str, output: str, tau: float, made: Made, settle_s: float) -> list[NDArray[np.float64]]:
        """Return an output minus the one that ``made`` computes from an input, without the beginning of segments."""
        i, j, settle = self.inputs.index(source), self.outputs.index(output), round(settle_s * self.rate_hz)
        return [(part.y[:, j] - made(part.u[:, i], self.rate_hz, tau))[settle:] for part in self.segments]

    def bare_errors(self, axis: str) -> list[NDArray[np.float64]]:
        """Return a position that comes without a velocity minus the one that its acceleration gives."""
        return self.errors(f"acceleration_{axis}", f"gps_{axis}", self.washouts.bare, twice_washed, BARE_SETTLE_S)

    def has(self, source: str, output: str) -> bool:
        """Return whether both signals exist."""
        return source in self.inputs and output in self.outputs


@dataclass(frozen=True, slots=True, eq=False)
class InertialFit:
    """How well the sensors agree in healthy flights."""

    rate_hz: float
    washouts: Washouts
    # names as the transform gives them
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    speed_scale: Mapping[str, float]  # s of position north and east; 1 if the flights did not show it
    noise: Mapping[str, float]  # noise of each output, in its unit
    disturbance: Mapping[str, float]  # random walk of each state within one period, in its unit
    seconds: float  # healthy flight used


_LEAST_WALK = 0.005
"""Least random walk of a magnetic heading, rad per root of a second. Measured: in 4 s the headings of six healthy
flights of three simulated vehicles turn 0.0025 to 0.011 rad more or less than the gyros; in other flights noise
hides it."""


@dataclass(frozen=True, slots=True)
class Chain:
    """One state that integrates one input and is measured by one output."""

    state: str
    source: str
    output: str
    tau: float


def identify_inertial(data: InertialData) -> InertialFit:
    """Measure how well the sensors agree in healthy flight.

    Noise is the change of the difference between an output and the integral of its input within half a second,
    disturbance its further change within four seconds.

    Raises
    ------
    ModelError
        Less than 20 s of flight, or nothing to compare.
    """
    rate_hz = data.rate_hz
    usable = [part for part in data.segments if len(part.u) > (_SETTLE_S + 2.0 * _SLOW_S) * rate_hz]
    seconds = sum(len(part.u) for part in usable) / rate_hz
    if seconds < _LEAST_S:
        raise ModelError(f"only {seconds:.0f} s of healthy recording; at least {_LEAST_S:.0f} s in motion are needed")
    data = replace(data, segments=usable)
    fit = InertialFit(rate_hz, data.washouts, tuple(data.inputs), tuple(data.outputs), {}, {}, {}, seconds)
    return _with_vertical(_with_bare_positions(_with_chains(fit, data), data), data)


def _with_chains(fit: InertialFit, data: InertialData) -> InertialFit:
    """Measure the sensors with one state."""
    scale: dict[str, float] = {}
    noise: dict[str, float] = {}
    disturbance: dict[str, float] = {}
    settle = round(_SETTLE_S * fit.rate_hz)
    for chain in chains_of(data.inputs, data.outputs, data.washouts):
        i, j = data.inputs.index(chain.source), data.outputs.index(chain.output)
        x = [washed(part.u[:, i], fit.rate_hz, chain.tau)[settle:] for part in data.segments]
        y = [part.y[settle:, j] for part in data.segments]
        if chain.source.startswith("speed_"):
            scale[chain.state] = _scale(x, y)
            x = [scale[chain.state] * series for series in x]
        errors = [a - b for a, b in zip(y, x, strict=True)]
        fast, slow = _spread(errors, 1), _spread(errors, round(_SLOW_S * fit.rate_hz))
        noise[chain.output] = max(fast / np.sqrt(2.0), _SMALLEST)
        growth = np.sqrt(max(slow * slow - fast * fast, 0.0) / (_SLOW_S * fit.rate_hz))
        disturbance[chain.state] = max(float(growth), _SMALLEST)
    for name in (output for output in data.outputs if output in ACCELEROMETERS):
        noise[name] = disturbance[f"judged_{name}"] = _SMALLEST
    return replace(fit, speed_scale=scale, noise=noise, disturbance=disturbance)


def _with_bare_positions(fit: InertialFit, data: InertialData) -> InertialFit:
    """Measure positions that come without a velocity."""
    noise, disturbance, rate_hz = dict(fit.noise), dict(fit.disturbance), fit.rate_hz
    for axis in bare_positions(data.inputs, data.outputs):
        errors = data.bare_errors(axis)
        fast, lag = _spread(errors, 1), round(data.washouts.bare * rate_hz)
        noise[f"gps_{axis}"] = max(fast / np.sqrt(2.0), _SMALLEST)
        # a random walk of the speed makes steps^3 / 3 of its variance per step of the position's
        growth = np.sqrt(3.0 * max(_spread(errors, lag) ** 2 - fast**2, 0.0) / lag**3) * rate_hz
        disturbance[f"speed_{axis}"] = max(float(growth), _SMALLEST)
        disturbance[f"position_{axis}"] = max(0.5 * float(growth) / rate_hz, _SMALLEST)
    return replace(fit, noise=noise, disturbance=disturbance)


def _with_vertical(fit: InertialFit, data: InertialData) -> InertialFit:
    """Measure noise of the altitudes and error of the vertical accelerometer by second differences."""
    noise, rate_hz, drift = dict(fit.noise), fit.rate_hz, []
    for output in ("gps_down", "baro_down"):
        if data.has("acceleration_down", output):
            errors = data.errors("acceleration_down", output, data.washouts.position, _washed_speed, _SETTLE_S)
            noise[output] = max(_spread(errors, round(_FAST_S * rate_hz), 2) / np.sqrt(6.0), _SMALLEST)
            drift.append(_spread(errors, round(_SLOW_S * rate_hz), 2) / _SLOW_S**2)
    if not drift:
        return fit
    down = {
        "velocity_down": max(min(drift) / rate_hz, _SMALLEST),
        "down": max(0.5 * min(drift) / rate_hz**2, _SMALLEST),
    }
    return replace(fit, noise=noise, disturbance={**fit.disturbance, **down})


def delay_costs(data: InertialData) -> dict[str, float]:
    """Return how badly GPS, barometer and compass fit the inertial sensors, for samples of a transform.

    Run the transform with all its delays at 0, 0.02, ... 0.3 s: each sensor's delay is that of its least cost.

    Returns
    -------
    dict[str, float]
        Under ``gps_delay_s`` (velocity, or positions that come without, against the accelerometers), ``baro_delay_s``
        (against the vertical one) and ``compass_delay_s`` (against the gyro), of the sensors that are there, the
        standard deviation of their difference over a second (for the barometer of second order over two: accelerometers
        integrate to speed first).
    """
    tau, costs, lag = data.washouts, {}, round(data.rate_hz)
    gps = [(f"acceleration_{axis}", f"gps_velocity_{axis}") for axis in HORIZONTAL]
    errors = [e for pair in gps if data.has(*pair) for e in data.errors(*pair, tau.velocity, washed, _SETTLE_S)]
    errors = errors or [e for axis in bare_positions(data.inputs, data.outputs) for e in data.bare_errors(axis)]
    if errors:
        costs["gps_delay_s"] = _spread(errors, lag)
    if data.has(*(baro := ("acceleration_down", "baro_down"))):
        errors = data.errors(*baro, tau.position, _washed_speed, _SETTLE_S)
        costs["baro_delay_s"] = _spread(errors, 2 * lag, 2)
    if data.has(*(compass := ("heading_rate", "heading"))):
        costs["compass_delay_s"] = _spread(data.errors(*compass, tau.position, washed, _SETTLE_S), lag)
    return costs


def field_noise(data: InertialData, over_s: float) -> dict[str, float]:
    """Return noise and random walk of the magnetic heading against the gyros, from differences over two times."""
    errors = data.errors("heading_rate", "heading", data.washouts.position, washed, _SETTLE_S)
    fast, slow = (_spread(errors, round(times * over_s * data.rate_hz)) for times in (1, 10))
    walk = np.sqrt(max(slow * slow - fast * fast, 0.0) / (9.0 * over_s))
    return {"field_noise": max(fast / np.sqrt(2.0), _SMALLEST), "field_walk": max(float(walk), _LEAST_WALK)}


def best_delays(trials: Mapping[float, Mapping[str, float]]) -> dict[str, float]:
    """Return each sensor's delay from the costs at each trial delay: the minimum of a parabola through the best three.

    Zero if the flights do not determine it: the costs hardly differ, or are least at the end of the range.
    """
    delays = sorted(trials)
    found = {}
    for key in trials[delays[0]]:
        costs = np.array([trials[delay][key] ** 2 for delay in delays])
        best = int(np.argmin(costs))
        if not 0 < best < len(delays) - 1 or costs[0] < _SHOWN * costs[best]:
            found[key] = 0.0
            continue
        left, middle, right = costs[best - 1 : best + 2]
        shift = 0.5 * (left - right) / (left - 2.0 * middle + right)
        found[key] = round(float(delays[best] + shift * (delays[best + 1] - delays[best])), 3)
    return found


def washed(rate: NDArray[np.float64], rate_hz: float, tau: float) -> NDArray[np.float64]:
    """Return x (N,) of x+ = phi x + tau (1 - phi) rate from x = 0."""
    keep, gain = washout(tau, rate_hz)
    x = np.zeros(len(rate))
    for k in range(len(rate) - 1):
        x[k + 1] = keep * x[k] + gain * rate[k]
    return x


def twice_washed(acceleration: NDArray[np.float64], rate_hz: float, tau: float) -> NDArray[np.float64]:
    """Return the position (N,) that follows from an acceleration, with speed and position washed out."""
    speed = washed(acceleration, rate_hz, tau)
    keep, gain = washout(tau, rate_hz)
    # the mean speed of a period: half the sum of the speeds at its ends
    return washed(0.5 * ((1.0 + keep) * speed + gain * acceleration), rate_hz, tau)


def bare_positions(inputs: Sequence[str], outputs: Sequence[str]) -> list[str]:
    """Return the horizontal axes whose position comes without a velocity."""
    return [axis for axis in HORIZONTAL if f"gps_{axis}" in outputs and f"speed_{axis}" not in inputs]


def chains_of(inputs: Sequence[str], outputs: Sequence[str], washouts: Washouts) -> list[Chain]:
    """Return the blocks with one state whose signals exist."""
    slow, fast = washouts.position, washouts.velocity
    found = [
        *(Chain(f"position_{axis}", f"speed_{axis}", f"gps_{axis}", slow) for axis in HORIZONTAL),
        *(Chain(f"velocity_{axis}", f"acceleration_{axis}", f"gps_velocity_{axis}", fast) for axis in HORIZONTAL),
        *(Chain(f"rotation_{axis}", f"rate_{axis}", f"rotation_{axis}", slow) for axis in BODY),
        Chain("heading", "heading_rate", "heading", slow),
    ]
    chains = [chain for chain in found if chain.source in inputs and chain.output in outputs]
    if not chains:
        raise ModelError("no sensor to compare with another: attitude and gyro are needed, GPS and compass help")
    return chains


def _scale(x: Sequence[NDArray[np.float64]], y: Sequence[NDArray[np.float64]]) -> float:
    """Return the ratio of y to x, or 1 if they moved too little to show it."""
    flat, measured = np.concatenate(x), np.concatenate(y)
    energy = float(flat @ flat)
    if energy <= 0.0:
        return 1.0
    ratio = float(flat @ measured) / energy
    error = float(np.std(measured - ratio * flat))
    excited = float(np.sqrt(energy / len(flat))) > _EXCITED * error
    return ratio if excited and abs(ratio - 1.0) < _LARGEST_SCALE_ERROR else 1.0


def _spread(errors: Sequence[NDArray[np.float64]], lag: int, order: int = 1) -> float:
    """Return the standard deviation of differences of the given order over a lag, one sample at least."""
    lag = max(lag, 1)
    differences = []
    for error in errors:
        difference = error
        for _ in range(order):
            difference = difference[lag:] - difference[:-lag]
        differences.append(difference)
    return float(np.concatenate(differences).std())


def _speed(acceleration: NDArray[np.float64], rate_hz: float) -> NDArray[np.float64]:
    """Return the mean speed of each period, from rest."""
    before = np.concatenate([[0.0], np.cumsum(acceleration)[:-1]])
    return np.asarray((before + 0.5 * acceleration) / rate_hz, dtype=np.float64)


def _washed_speed(acceleration: NDArray[np.float64], rate_hz: float, tau: float) -> NDArray[np.float64]:
    return washed(_speed(acceleration, rate_hz), rate_hz, tau)


def washout(tau: float, rate_hz: float) -> tuple[float, float]:
    """Return phi = exp(-T/tau) and tau (1 - phi)."""
    keep = exp(-1.0 / (tau * rate_hz))
    return keep, tau * (1.0 - keep)
