"""The imbalance observer of a multirotor: how much each propeller shakes the vehicle once per turn (order tracking).

An unbalanced propeller pulls at its arm with a force that rotates with it. The angle phi_j of each motor is the
integral of its measured speed, and over a tick of :data:`_TICK_S` each axis of the raw accelerometer is

    a = b + sum over motors j of (p_j cos phi_j + q_j sin phi_j) + everything else,

solved by least squares for all motors together, which separates motors that turn at different speeds. The squared
amplitude of a motor's line is the sum of its p^2 + q^2 over the axes, averaged over :data:`_MEMORY_S` with a weight:
how well the speeds of a tick separate that motor from the others. Motors that turn at equal speeds for so long get
equal shares, so an imbalance raises the alarms of all of them: it is one of that set.

The logarithm of the line's amplitude is compared with ``c0 + c1 ln(w)``, w being the speed as a share of that in hover,
identified for each motor from healthy flights: an imbalance pulls with the square of the speed, and arms and mounts
differ in their response. Throttle adds nothing to the known speed.

The angle has to be known between two measurements of a speed. Where speeds come too seldom for that, only the level of
vibration is used.

Rotations faster than half the accelerometer's rate are aliased onto frequencies with other lines, and autopilots
average over the time between samples: above the share :data:`_HIGHEST` of the rate lines are not used.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from adapters.channels import Channel
from adapters.errors import ModelError, TelemetryError
from adapters.sample import Given, Samples
from monitor.alarms.alarm import LOG_TIMES
from monitor.alarms.excuse import ExcuseRule
from monitor.core.lagged import LaggedMeans, cosines, sines
from monitor.fitting.expectation import Expectation, check_length, fit_expectations
from monitor.fitting.fitted import FitRequest, Fitted
from monitor.fitting.flights import Flight, raw_flights
from monitor.fitting.survey import IMUS, least_hz
from monitor.fitting.thresholds import Times
from monitor.sampling.gate import GateRule
from monitor.sampling.scaled import check_parameters, raw_per_sample
from monitor.sampling.transform import SampleSource, TransformRule
from monitor.vehicles.multirotor.signals import multirotor_channels
from monitor.vehicles.multirotor.speeds import motor_speeds
from monitor.vehicles.multirotor.transform import OneTickLater, motor_outputs
from monitor.vehicles.multirotor.vibration import OBSERVER as SHAKING

Array = NDArray[np.float64]

OBSERVER = "imbalance"

_AXES = ("xacc", "yacc", "zacc")
_IMUS = ("HIGHRES_IMU", "RAW_IMU", "SCALED_IMU")
"""Messages of raw accelerations; among those of the same rate, the preferred ones first."""
_TICK_S = 0.5
"""Length of a tick, seconds. Chosen: lines 2 Hz apart are told apart, a fiftieth of the frequency of rotors; over a
longer tick the speeds' errors would add up to more in the angle."""
_LARGEST_DRIFT = 0.5
"""Largest error of the angle (standard deviation, turns) on a straight line over two intervals of the speeds'
telemetry. Measured on a simulated quadrotor in gusts, with an imbalance of each propeller in turn: at 0.01, 0.07 and
0.39 (50, 20 and 10 Hz) each is named alone, at 1.6 and 2.7 (5 and 3 Hz) others are named in five of eight."""
_MEMORY_S = 2.0
"""Time over which lines are averaged, seconds. Chosen: four ticks; the speeds of motors separate within seconds of any
manoeuvre."""
_HIGHEST = 0.45
"""Largest frequency of a line, as a share of the accelerometer's rate: a twentieth below half of it, the width that
jitter of stamps and the steps of speeds between their measurements take."""
_RIDGE = 0.01
"""Term added to the diagonal of the normal equations, as a share of it. Chosen: lines that cannot be separated are
shared out, lines that can are off by a hundredth."""
_LEAST_LEVEL = 0.3
"""Smallest amplitude that counts, m/s^2; a smaller one counts as this. Chosen: a tenth of the level of a good vehicle
(that of the vibration observer), for one line of many."""
_LEAST_LEFT = 0.05
"""Least remaining deviation of logarithms. Chosen: that of the vibration observer."""
_SQUARE = 2.0
"""Exponent of the speed in an imbalance's force."""
_WIDTH = 1.0
"""Expected deviation of the exponent. Chosen: near their resonance, arms and mounts answer in proportion to the speed
or to its cube; it decides if flights show less."""
_SMALLEST, _CRITICAL = math.log(2.5), math.log(6.25)
"""Ratios to the usual imbalance that are worth an alarm, and critical, as logarithms: one and two grades of balance
(ISO 21940-11, whose grades are a factor of 2.5 apart)."""
_EXCUSED_S = 5.0
"""Time after a propeller's alarm has cleared in which it explains the vehicle's level of vibration, seconds: both
levels have a memory of seconds."""
_FAULT_RATE = 0.5
"""Rate at which an imbalance may grow, logarithms per second. Chosen: a chip doubles it at once, seen over two
seconds."""
_TIMES = Times(fast_s=1.0, raise_s=2.0, slow_s=10.0, clear_s=2.0)
"""Times of the alarms. Chosen: those of the vibration observer, since an imbalance is a part of the vibration."""


class ImbalanceInputs:
    """Samples of a multirotor's propellers: expected and measured logarithm of each one's line in the vibration.

    Parameters are ``output1`` and so on: numbers of the motors' outputs; for each motor n ``rpmN`` (that of hovering),
    ``cN_0`` and ``cN_1``; ``least``: the smallest amplitude that counts, m/s^2. Rates and errors are those of
    :class:`monitor.sampling.scaled.ScaledInputs`.
    """

    def __init__(self, parameters: Mapping[str, float], signal_rate_hz: float, rate_hz: float) -> None:
        outputs = motor_outputs(parameters)
        numbers = list(outputs.values())
        learned = (name for n in numbers for name in (f"rpm{n}", f"c{n}_0", f"c{n}_1"))
        check_parameters("imbalance", parameters, {"least", *outputs, *learned})
        if not numbers or min(parameters["least"], *(parameters[f"rpm{n}"] for n in numbers)) <= 0.0:
            raise TelemetryError("transform 'imbalance': no motors, or 'least' or a speed of hovering is not above 0")
        self.signals = (*_AXES, *(f"rpm{n}" for n in numbers))
        self.inputs = tuple(f"prop{n}_imbalance" for n in numbers)
        self.outputs = tuple(f"line{n}" for n in numbers)
        self._hover = np.array([parameters[f"rpm{n}"] for n in numbers])
        self._c = np.array([[parameters[f"c{n}_{term}"] for n in numbers] for term in (0, 1)])
        self._least = parameters["least"]
        self._lines = Lines(len(numbers), signal_rate_hz, raw_per_sample("imbalance", signal_rate_hz, rate_hz))
        self._later = OneTickLater(slice(None))

    def run(self, samples: Samples) -> Given:
        """Return the observer's samples that raw samples complete; one marked ``restart`` forgets the lines."""
        given = self._lines.run(samples)
        found = given.samples
        with np.errstate(all="ignore"):  # absurd values may overflow; they are no evidence
            expected = self._c[0] + self._c[1] * np.log(found.u / self._hover)
            measured = np.log(np.maximum(found.y, self._least))
            expected = np.maximum(expected, math.log(self._least))
        wrong = ~(np.isfinite(expected) & np.isfinite(measured)).all(axis=1, keepdims=True)
        expected, measured = np.where(wrong, 0.0, expected), np.where(wrong, 0.0, measured)
        later = self._later.run(replace(found, u=expected, y=measured, lost=found.lost | wrong))
        return Given(later, given.rows)


class Lines:
    """Amplitudes of the lines of motors in raw accelerations.

    A tick has ``size`` raw samples.
    """

    def __init__(self, motors: int, signal_rate_hz: float, size: int) -> None:
        self._motors, self._rate_hz = motors, signal_rate_hz
        width = 1 + 2 * motors
        self._rows, self._columns = np.triu_indices(width)
        self._products = LaggedMeans((), signal_rate_hz, size, motors, len(self._rows) + len(_AXES) * width)
        timing = [(0.0, _MEMORY_S)] * (3 * motors)
        self._memory = LaggedMeans(timing, signal_rate_hz / size, 1, 3 * motors, 1)
        self._angle = np.zeros((1, motors))

    def run(self, samples: Samples) -> Given:
        """Return speeds as ``u`` (n, motors), rpm, and amplitudes as ``y`` (n, motors), m/s^2, of ticks that end."""
        acceleration, rpm = samples.u[:, : len(_AXES)], samples.u[:, len(_AXES) :]
        with np.errstate(all="ignore"):
            # a speed of more than half a turn from sample to sample is of no use, and would spoil the angle's precision
            steps = np.clip(math.tau / 60.0 / self._rate_hz * rpm, 0.0, math.pi)
            # never wrapped, so that it does not depend on where the samples are cut: good to 1e-7 after a day
            angles = np.cumsum(np.vstack([self._angle, steps]), axis=0)
            self._angle = angles[-1:]
            waves = [wave(angle) for angle in angles[1:].T for wave in (cosines, sines)]
            X = np.column_stack([np.ones(len(samples)), *waves])
            products = np.hstack([X[:, self._rows] * X[:, self._columns], *(X * a[:, None] for a in acceleration.T)])
        given = self._products.run(samples, [*rpm.T, *products.T], np.ones(len(samples), np.bool_))
        means = given.samples
        weight, square = self._solved(means.y)
        too_fast = (means.u > 60.0 * _HIGHEST * self._rate_hz).any(axis=1, keepdims=True)
        columns = [*(weight * square).T, *weight.T, *means.u.T, np.zeros(len(means))]
        smooth = self._memory.run(means, columns, np.ones(len(means), np.bool_)).samples.u
        power, weights, speed = np.split(smooth, 3, axis=1)
        amplitude = np.sqrt(np.where(weights > 0.0, power / np.where(weights > 0.0, weights, 1.0), 0.0))
        lost = np.repeat(means.lost[:, :1] | too_fast, 2 * self._motors, axis=1)
        return Given(replace(means, u=speed, y=amplitude, lost=lost), given.rows)

    def _solved(self, means: Array) -> tuple[Array, Array]:
        """Return from means over ticks how well each motor's line is told from others, and its square (n, motors)."""
        width = 1 + 2 * self._motors
        normal = np.zeros((len(means), width, width))
        normal[:, self._rows, self._columns] = means[:, : len(self._rows)]
        normal[:, self._columns, self._rows] = means[:, : len(self._rows)]
        right = means[:, len(self._rows) :].reshape(len(means), len(_AXES), width).transpose(0, 2, 1)
        good = np.asarray(np.isfinite(means).all(axis=1))[:, None]
        ridge = 0.5 * _RIDGE * np.diag([0.0, *np.ones(width - 1)])
        inverse = np.linalg.inv(np.where(good[:, :, None], normal, np.eye(width)) + ridge)
        found = (inverse @ np.where(good[:, :, None], right, 0.0))[:, 1:]
        pairs = (len(means), self._motors, 2)
        square = (found**2).sum(axis=2).reshape(pairs).sum(axis=2)
        # for a single line, cosine and sine have a variance of two over the number of samples
        alike = np.diagonal(inverse, axis1=1, axis2=2)[:, 1:].reshape(pairs).sum(axis=2)
        return np.where(good, 4.0 / alike, 0.0), square


def fit_imbalance(request: FitRequest, gate: GateRule) -> Fitted | None:
    """Learn on healthy recordings how much each propeller shakes, design the observer, calibrate its alarms.

    None where raw accelerations or speeds of motors are not reported.

    Raises
    ------
    ModelError
        Too little healthy flight, or accelerations that come too seldom for rotors as fast as these.
    """
    commands, _ = multirotor_channels(request.surveys)
    signals = motor_speeds(request, gate, commands)
    message = max(_IMUS, key=partial(least_hz, request.surveys))
    reported_hz = least_hz(request.surveys, message)
    if signals is None or not signals.measured or not reported_hz:
        return None
    rate_hz = 1.0 / _TICK_S
    signal_hz = rate_hz * max(1, round(reported_hz / rate_hz))
    turns = max(signals.hover) / 60.0
    if turns > _HIGHEST * signal_hz:
        raise ModelError(
            f"no imbalance of a propeller can be told: rotors turn {turns:.0f} times a second, accelerations come at "
            f"{signal_hz:.0f} Hz, on which that is folded onto other frequencies; log them at "
            f"{turns / _HIGHEST:.0f} Hz or more"
        )
    axes = (Channel(axis, message, (axis,), scale=IMUS[message], interpolation="previous") for axis in _AXES)
    channels = (*axes, *(replace(channel, interpolation="linear") for channel in signals.speed))
    raw = raw_flights(request.logs, channels, signal_hz, gate)
    drift = _drift([flight.samples.u[flight.armed, len(_AXES) :] for flight in raw], signal_hz, signals.rate_hz)
    if drift > _LARGEST_DRIFT:
        raise ModelError(
            f"the unbalanced propeller cannot be identified: speeds come at {signals.rate_hz:.3g} Hz, and within "
            f"two intervals a rotor gets {drift:.2g} turns away from a straight line; record them more often"
        )
    numbers = [int(channel.name.removeprefix("rpm")) for channel in signals.speed]
    parameters, left = _learned(raw, numbers, signals.hover, signal_hz, rate_hz)
    source = SampleSource(transform=TransformRule(OBSERVER, signal_hz, parameters), signals=channels)
    faults = [f"prop{n}_imbalance" for n in numbers]
    expectations = [
        Expectation(f"line{n}", left, fault, LOG_TIMES, _SMALLEST, _CRITICAL, _FAULT_RATE)
        for n, fault in zip(numbers, faults, strict=True)
    ]
    fitted = fit_expectations(request.name, source, rate_hz, raw, gate, expectations, _TIMES)
    usual = ", ".join(f"prop{n} {math.exp(parameters[f'c{n}_0']):.2g} m/s^2" for n in numbers)
    return replace(
        fitted,
        excuses=(ExcuseRule((SHAKING,), tuple(faults), _EXCUSED_S, same_cause=True),),
        findings={"rate_hz": rate_hz, "left": left, "signal_hz": signal_hz},
        lines=(
            f"once per turn, by {message} at {signal_hz:g} Hz, in hover: {usual}; within a factor of "
            f"{math.exp(left):.2f}; alarms from {math.exp(fitted.alarms[0].rule.threshold):.1f} times on",
        ),
    )


def _drift(speeds: Sequence[Array], signal_hz: float, rate_hz: float) -> float:
    """Return the error (standard deviation, turns) of a straight line between two measurements of a speed.

    Every second measurement is left out and compared with the line through its neighbours, which is twice as long.
    """
    every = max(1, round(signal_hz / rate_hz))
    taken = [speed[::every] for speed in speeds]
    missed = np.concatenate([series[1:-1] - 0.5 * (series[:-2] + series[2:]) for series in taken])
    return float(missed.std()) / 60.0 / rate_hz if len(missed) else math.inf


def _learned(
    raw: Sequence[Flight], numbers: Sequence[int], hover: Sequence[float], signal_hz: float, rate_hz: float
) -> tuple[dict[str, float], float]:
    """Return the transform's parameters, and the remaining standard deviation of the logarithms."""
    speeds, amplitudes = [], []
    for flight in raw:
        given = Lines(len(numbers), signal_hz, round(signal_hz / rate_hz)).run(flight.samples)
        found = given.samples
        kept = flight.armed[given.rows] & ~found.lost.any(axis=1) & (found.u > 0.0).all(axis=1)
        speeds.append(np.log(found.u[kept] / hover))
        amplitudes.append(np.log(np.maximum(found.y[kept], _LEAST_LEVEL)))
    x, y = np.concatenate(speeds), np.concatenate(amplitudes)
    check_length(len(x), rate_hz, "speeds and accelerations")
    parameters = {f"output{at}": float(n) for at, n in enumerate(numbers, start=1)} | {"least": _LEAST_LEVEL}
    left = []
    for at, n in enumerate(numbers):
        # ticks within the memory are correlated
        weight = max(float(y[:, at].std()), _LEAST_LEFT) * math.sqrt(_MEMORY_S * rate_hz) / _WIDTH
        A = np.vstack([np.column_stack([np.ones(len(x)), x[:, at]]), [0.0, weight]])
        c = np.linalg.lstsq(A, np.append(y[:, at], weight * _SQUARE), rcond=None)[0]
        left.append(float((y[:, at] - A[:-1] @ c).std()))
        values = {f"rpm{n}": hover[at], f"c{n}_0": float(c[0]), f"c{n}_1": float(c[1])}
        parameters |= {name: float(f"{value:.6g}") for name, value in values.items()}
    return parameters, max(float(np.sqrt(np.mean(np.square(left)))), _LEAST_LEFT)
