"""The esc observer of a multirotor: whether motors turn as commanded and draw the current of their speed.

Curves, delay and lag (:mod:`monitor.vehicles.multirotor.transform`) are identified from healthy flights by least
squares. Where a flight does not determine them, prior knowledge about motors does, with a width by which motors differ:

- The curve of speed over command lies between a straight line and a square root. Speed depends on the voltage as on the
  command, since a speed controller without a governor applies the product of both.
- The power of a propeller is proportional to the cube of its speed; the current is that power over the voltage.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from adapters.channels import Channel
from adapters.errors import ModelError
from gains.plants.plant import FloatArray
from monitor.alarms.alarm import CURRENT, SPEED
from monitor.alarms.excuse import ExcuseRule
from monitor.fitting.expectation import Expectation, check_length, fit_expectations
from monitor.fitting.fitted import FitRequest, Fitted
from monitor.fitting.flights import Flight, raw_flights
from monitor.fitting.survey import fitted_rates
from monitor.fitting.thresholds import Calibrated, Times
from monitor.sampling.gate import GateRule
from monitor.sampling.transform import SampleSource, TransformRule
from monitor.vehicles.multirotor.signals import multirotor_channels
from monitor.vehicles.multirotor.speeds import EscSignals, motor_speeds, rounded
from monitor.vehicles.multirotor.transform import TERMS, HeldMeans, deviation, terms

OBSERVER = "esc"

_SIGNAL_HZ = 100.0
"""Rate of the grid for delay and lag of commands, hertz: a fifth of the usual lag of a motor."""
_FASTEST_HZ = 50.0
"""Fastest rate of the observer, hertz: speeds follow with a lag of 50 ms."""
_SLOWEST_HZ = 2.0
"""Least rate of speeds that are judged, hertz. Measured over radios at 1 Hz: what commands did between two messages
raised alarms of two controllers in 8 minutes of healthy flight, and left others without evidence for 5 s and more;
neither happened at 10 Hz of a log. Chosen: between the two."""
_DELAYS_S, _LAGS_S = (
    (0.0, 0.02, 0.04, 0.07, 0.1, 0.15),
    (0.0, 0.01, 0.02, 0.03, 0.04, 0.05, 0.065, 0.08, 0.1, 0.13, 0.17),
)
"""Delays and lags that are tried, seconds. Chosen: from nothing to the slowest motor and link that fly; neighbours
differ by a third or two samples of the grid, which changes no expectation by more than the noise of motors."""
_SMALLEST_SPEED, _SMALLEST_CURRENT = 0.02, 0.08
"""Smallest deviations of speed and current worth an alarm, as shares of those in hover. The first is the residual of a
real vehicle's speeds over commands (2.3 %, PX4 at 3 Hz). A current goes with the cube of a speed, and controllers
measure it within 5 %: chosen, one and a half times that."""
_CRITICAL_SPEED, _CRITICAL_CURRENT = 0.25, 1.0
"""Critical deviations of speed and current. Chosen: a quarter of the speed is nearly half of the thrust; twice the
usual current burns a motor."""
_EXCUSED_S = 2.0
"""Time after the alarm of a motor's controller or propeller has cleared in which it explains that motor's loss,
seconds: after it, the mean over which losses are seen has forgotten the fault. A chipped propeller takes less
current and has less thrust at its command; a motor that turns slower, too."""
_LEAST_SHARE = 1e-3
"""Share of the flown commands below the least one that is judged, and of their steps above the largest one. Chosen: a
flight of minutes has some."""
_OTHERWISE = 0.5
"""Share of the usual current by which each term may differ from a propeller's power alone. Chosen: without load, motors
draw a tenth of their current in hover or less; flights that show the term decide."""
_LEAST_LEFT = 1e-4
"""Least remaining deviation: the rounding of a speed of 10,000 rpm."""
_FAULT_RATE = 1.0
"""Rate at which a fault may grow, shares per second. Chosen: a controller fails within a second."""


class _Curves(NamedTuple):
    """Curves of quantities over their causes: coefficients (m, terms), and the remaining deviation (m,)."""

    coefficients: FloatArray
    left: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Identified:
    """Motors' speeds, and currents if they are measured, as identified from the flights."""

    numbers: tuple[int, ...]  # numbers of the outputs that drive the motors
    volts: float  # usual voltage, 0 if it is not measured
    delay_s: float
    lag_s: float
    hover: FloatArray  # speeds, then currents, in hover (m,), rpm and A
    curves: _Curves
    least: float  # smallest command that was flown, without the lowest thousandth
    most: float  # largest command that was flown, without the highest thousandth
    fastest: float  # fastest change of a command that was flown, per second, without the highest thousandth
    command: float  # command in hover

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the measured quantities."""
        kinds = ("rpm", "amps")[: len(self.hover) // len(self.numbers)]
        return tuple(f"{kind}{n}" for kind in kinds for n in self.numbers)

    def speeds_only(self) -> _Identified:
        """Return a copy without currents."""
        s = len(self.numbers)
        return replace(self, hover=self.hover[:s], curves=_Curves(*(part[:s] for part in self.curves)))

    @property
    def doubt(self) -> float:
        """Return the relative growth of errors per squared command beyond the flown ones.

        The error is twice the deviation with which the bend is filled in (:func:`_regressed`), for a speed that is
        about in proportion to its command.
        """
        return 2.0 / (4.0 * self.command * self.command) / _SMALLEST_SPEED

    def parameters(self) -> dict[str, float]:
        """Return the parameters of the transform."""
        return {
            **{f"output{at}": float(n) for at, n in enumerate(self.numbers, start=1)},
            "curves": 2.0,
            "least": rounded(self.least),
            "most": rounded(self.most),
            "doubt": rounded(self.doubt),
            "fastest": rounded(self.fastest),
            "volts": self.volts,
            "delay_s": self.delay_s,
            "lag_s": self.lag_s,
            **{name: rounded(value) for name, value in zip(self.names, self.hover, strict=True)},
            **{
                f"{name}_c{term}": rounded(value)
                for name, row in zip(self.names, self.curves.coefficients, strict=True)
                for term, value in enumerate(row)
            },
        }


def fit_esc(request: FitRequest, gate: GateRule) -> Fitted | None:
    """Identify speeds and currents on healthy recordings, design the observer, calibrate its alarms.

    Return None if no speed controller reports its speed, or too seldom. Currents that follow speeds too loosely to show
    twice the usual current are left out.

    Raises
    ------
    ModelError
        Too little healthy flight, or speeds do not follow commands.
    """
    commands, _ = multirotor_channels(request.surveys)
    signals = motor_speeds(request, gate, commands)
    if signals is None or signals.rate_hz < _SLOWEST_HZ:
        return None
    rate_hz = float(f"{min(signals.rate_hz, _FASTEST_HZ):.3g}")
    signal_hz = rate_hz * max(1, round(_SIGNAL_HZ / rate_hz))
    channels = (*commands, *signals.speed, *signals.current, *signals.voltage)
    raw = raw_flights(request.logs, channels, signal_hz, gate)
    found = _identified(raw, commands, signal_hz, rate_hz)
    source = SampleSource(signals=channels, fitted_hz=fitted_rates(request.surveys, commands))
    fitted = _designed(request.name, gate, raw, source, found, signals, signal_hz, rate_hz)
    rules = [alarm.rule for alarm in fitted.alarms]
    worst = {
        kind: max((rule.threshold for rule in rules if rule.channel.startswith(kind)), default=0.0)
        for kind in ("esc", "motor")
    }
    if worst["esc"] >= 1.0:
        raise ModelError(
            "speeds of motors do not follow their commands: only losses above "
            f"{100 * worst['esc']:.0f} % would stand out"
        )
    if worst["motor"] >= _CRITICAL_CURRENT:
        left = 100.0 * float(found.curves.left[len(commands) :].mean())
        fitted = _designed(request.name, gate, raw, source, found.speeds_only(), signals, signal_hz, rate_hz)
        unsteady = f"currents are not watched: they follow speeds within {left:.0f} % only"
        fitted = replace(fitted, lines=(*fitted.lines, unsteady))
    return fitted


def _designed(
    name: str,
    gate: GateRule,
    raw: Sequence[Flight],
    source: SampleSource,
    found: _Identified,
    signals: EscSignals,
    signal_hz: float,
    rate_hz: float,
) -> Fitted:
    """Return the designed observer with its alarms; ``source`` has the channels of the raw flights."""
    s = len(found.numbers)
    kept = [*range(2 * s), *(range(2 * s, 3 * s) if len(found.names) > s else ())]
    kept += range(3 * s, 4 * s) if found.volts else ()
    rule = TransformRule(OBSERVER, signal_hz, found.parameters())
    source = replace(source, transform=rule, signals=tuple(source.signals[at] for at in kept))
    chosen = [_chosen(flight, kept) for flight in raw]
    speed, current = (SPEED, _SMALLEST_SPEED, _CRITICAL_SPEED), (CURRENT, _SMALLEST_CURRENT, _CRITICAL_CURRENT)
    faults = [(f"esc{n}", *speed) for n in found.numbers] + [(f"motor{n}", *current) for n in found.numbers]
    expectations = [
        Expectation(measured, left, *fault, _FAULT_RATE, fault[0])
        for measured, left, fault in zip(found.names, found.curves.left.tolist(), faults, strict=False)
    ]
    fitted = fit_expectations(name, source, rate_hz, chosen, gate, expectations, _times(rate_hz))
    return replace(
        fitted,
        findings={
            "rate_hz": rate_hz,
            "delay_s": found.delay_s,
            "lag_s": found.lag_s,
            "controllers": {channel.name: _place(channel) for channel in signals.speed},
            "left": dict(zip(found.names, found.curves.left.tolist(), strict=True)),
        },
        lines=_lines(found, signals, fitted.alarms, rate_hz),
        excuses=tuple(
            ExcuseRule((f"motor{n}",), (f"{part}{n}",), _EXCUSED_S, same_cause=True)
            for n in found.numbers
            for part in ("esc", "prop")
        ),
    )


def _identified(raw: Sequence[Flight], commands: Sequence[Channel], signal_hz: float, rate_hz: float) -> _Identified:
    """Identify on raw flights whose signals are commands, then speeds, currents and voltages of the same motors."""
    s = len(commands)
    u, speed, current, voltage = np.split(np.concatenate([flight.samples.u[flight.armed] for flight in raw]), 4, axis=1)
    check_length(len(u), signal_hz, "speeds of motors")
    hover = np.median(speed, axis=0)
    if not (hover > 0.0).all():
        raise ModelError("a motor in flight reports no speed: does every speed controller belong to a motor?")
    volts = float(np.median(voltage.mean(axis=1)))
    volts = float(f"{volts:.4g}") if volts > 0.0 and (voltage.mean(axis=0) > 0.0).all() else 0.0
    amps = np.median(current, axis=0)
    # a value that never changes is no measurement: ArduPilot's simulator reports 0.8 A for each motor at any speed
    measured = np.append(hover, amps) if (amps > 0.0).all() and np.ptp(current, axis=0).all() else hover
    prior_u = np.median(u, axis=0)
    candidates = []
    for timing in product(_DELAYS_S, _LAGS_S):
        X, y = _means(raw, s, volts, timing, signal_hz, rate_hz)
        curves = _regressed(X, y / hover, rate_hz, prior_u)
        candidates.append((float(np.log(curves.left).sum()), timing, curves))
    _, (delay_s, lag_s), curves = min(candidates, key=itemgetter(0))
    if len(measured) > s:
        X, y = _means(raw, s, volts, None, signal_hz, rate_hz, hover)
        drawn = _regressed(X, y / amps, rate_hz)
        curves = _Curves(*(np.concatenate(both) for both in zip(curves, drawn, strict=True)))
    numbers = tuple(int(channel.name.removeprefix("motor")) for channel in commands)
    least, most = max(float(np.quantile(u, _LEAST_SHARE)), 0.0), float(np.quantile(u, 1.0 - _LEAST_SHARE))
    steps = [np.abs(np.diff(flight.samples.u[flight.armed, :s], axis=0)).ravel() for flight in raw]
    fastest = float(np.quantile(np.concatenate(steps), 1.0 - _LEAST_SHARE)) * signal_hz
    return _Identified(numbers, volts, delay_s, lag_s, measured, curves, least, most, fastest, float(prior_u.mean()))


def _means(
    flights: Sequence[Flight],
    s: int,
    volts: float,
    timing: tuple[float, float] | None,
    signal_hz: float,
    rate_hz: float,
    hover: FloatArray | float = 1.0,
) -> tuple[FloatArray, FloatArray]:
    """Return the factors of the coefficients in the curves of speeds (N, terms, s), and speeds (N, s), of all flights.

    Commands are delayed and lag by ``timing``; without ``timing``, the same for currents over speeds as shares of
    ``hover``.
    """
    half = slice(0, s) if timing is not None else slice(s, 2 * s)
    every = []
    for flight in flights:
        u, speed, current, voltage = np.split(flight.samples.u.T, 4)
        v = deviation(voltage, volts) if volts else np.zeros(len(flight))
        columns = np.concatenate([part[half] for part in terms(u, (speed.T / hover).T, v)])
        lagged = [] if timing is None else [timing] * len(columns)
        means = HeldMeans(lagged, signal_hz, round(signal_hz / rate_hz), len(columns), s)
        given = means.run(flight.samples, [*columns, *(current if timing is None else speed)], speed)
        kept = flight.armed[given.rows] & ~given.samples.lost.any(axis=1)
        every.append((given.samples.u[kept].reshape(kept.sum(), TERMS, s), given.samples.y[kept]))
    X, y = (np.concatenate(part) for part in zip(*every, strict=True))
    return X, y


def _regressed(X: FloatArray, y: FloatArray, rate_hz: float, commands: FloatArray | None = None) -> _Curves:
    """Return the curves of y (N, s), one at hover, over X (N, terms, s).

    These are the curves of speeds if the ``commands`` in hover (s,) are given, otherwise of currents.
    """
    rows, left = [], []
    for at in range(y.shape[1]):
        A, b = X[:, :, at], y[:, at]
        usual = 1.0 if commands is None else float(commands[at])
        line = np.polyfit(A[:, 1], b, 1) if A[:, 1].std() > 0.0 else np.array([1.0 / usual, 0.0])
        slope = max(float(line[0]), 0.5 / usual)
        # the residual of a straight line, counted once a second: errors within a second are correlated
        noise = max(float((b - np.polyval(line, A[:, 1])).std()), 1e-6) * np.sqrt(rate_hz)
        if commands is None:
            weights, expected = noise / np.full(TERMS, _OTHERWISE), np.array([0.0, 0.0, 0.0, 1.0])
        else:
            weights, expected = noise * np.array([0.0, 0.0, 4.0 * usual, 1.0]) / slope, np.zeros(TERMS)
        row = np.linalg.lstsq(np.vstack([A, np.diag(weights)]), np.append(b, weights * expected), rcond=None)[0]
        rows.append(row)
        left.append(max(float((b - A @ row).std()), _LEAST_LEFT))
    return _Curves(np.array(rows), np.array(left))


def _times(rate_hz: float) -> Times:
    """Return how long evidence has to last: the usual times, or the number of ticks that slow grids need.

    That number is that of the motors' trim (:func:`monitor.vehicles.multirotor.trim.slow_times`), whose errors are as
    coloured: both compare means of commands with motion.
    """
    usual, tick_s = Times(), 1.0 / rate_hz
    return Times(
        fast_s=max(usual.fast_s, 2 * tick_s),
        raise_s=max(usual.raise_s, 4 * tick_s),
        slow_s=max(usual.slow_s, 10 * tick_s),
        clear_s=max(usual.clear_s, 3 * tick_s),
    )


def _lines(found: _Identified, signals: EscSignals, alarms: Sequence[Calibrated], rate_hz: float) -> tuple[str, ...]:
    """Return the report of a fit for people: how well the curves hold, where speeds come from, and the thresholds."""
    s = len(found.numbers)
    left = 100.0 * found.curves.left
    order = ", ".join(f"motor{n} {_place(channel)}" for n, channel in zip(found.numbers, signals.speed, strict=True))
    current = "" if len(left) == s else f", currents follow speeds within {left[s:].mean():.1f} %"
    sizes = ", ".join(f"{alarm.rule.channel} {100 * alarm.rule.threshold:.1f} %" for alarm in alarms)
    return (
        f"at {rate_hz:g} Hz, {1000 * (found.delay_s + found.lag_s):.0f} ms late: speeds follow commands within "
        f"{left[:s].mean():.1f} %{current} (standard deviation)",
        f"speed controllers: {order}" + ("" if found.volts else "; no voltage"),
        f"alarms from: {sizes}",
    )


def _place(channel: Channel) -> str:
    """Return the source of a channel, for people."""
    first = next((int(value) for name, value in channel.where if name == "index"), 0)
    return f"{channel.message}[{first + int(channel.path[-1])}]"


def _chosen(flight: Flight, columns: Sequence[int]) -> Flight:
    samples = flight.samples
    return Flight(replace(samples, u=samples.u[:, columns], lost=samples.lost[:, columns]), flight.armed)
