"""The battery observer: the battery's resistance against that of healthy flights.

With V and I the battery's voltage and current minus their recent means (a low-pass of :data:`_BASE_S`), and moments
over a memory of some seconds,

    resistance = (lambda R - w cov(V, I)) / (lambda + w var(I))

where R is the resistance in healthy flights, lambda the variance of the current from which the data outweigh R, and w,
from 0 to 1, the part of the memory that is filled: while the current hardly changes the result is the usual resistance.
The open-circuit voltage, which depends on charge and age, is no evidence. A faulty cell, a corroded connector and an
old battery have a larger resistance before they fail under load.

The memory is the shortest of :data:`_MEMORIES_S` in which healthy flights determine the resistance well enough, which
depends on how much their current changes compared with the voltage's noise. A calm hover tells very little.

The plant compares the resistance with the usual one. The current, and the time for which the charge lasts at it, are
inputs for the alarm's sentence.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from adapters.errors import TelemetryError
from adapters.sample import Given, Samples
from monitor.alarms.alarm import RESISTANCE
from monitor.core.lagged import LaggedMeans
from monitor.fitting.expectation import Expectation, check_length, fit_expectations
from monitor.fitting.fitted import FitRequest, Fitted
from monitor.fitting.flights import Flight, raw_flights, transformed
from monitor.fitting.thresholds import Times, plain_only
from monitor.sampling.gate import GateRule
from monitor.sampling.scaled import check_parameters
from monitor.sampling.transform import SampleSource, TransformRule
from monitor.vehicles.multirotor.signals import battery_channels, multirotor_channels

Array = NDArray[np.float64]

OBSERVER = "battery"

_SLOWEST_HZ, _FASTEST_HZ = 0.5, 10.0
"""Bounds of the observer's rate, hertz. Chosen: slower reports miss the manoeuvres that change the current; faster ones
add nothing, since autopilots filter both signals."""
_BASE_S, _MEMORIES_S = 5.0, (5.0, 10.0, 20.0)
"""Time constants of the low-pass and of the moments, seconds. Chosen: a manoeuvre lasts some seconds, charge moves the
open voltage in minutes; if a resistance doubles at once, half of it is seen after 0.7 of a memory."""
_SURE = 0.08
"""Largest relative standard deviation of the resistance in healthy flights for which a memory is long enough: a fifth
of the smallest alarm, a distance that no Gaussian error reaches in a million samples."""
_LARGEST_ERROR = 0.25
"""Largest relative standard error of the resistance for which the flights determine it; the same as for the motors'
effects."""
_DOUBT = 1.0
"""Share by which the resistance may differ before this flight has shown it: lithium batteries are taken out of service
at about twice the resistance of a new one."""
_SMALLEST, _CRITICAL = 0.4, 1.5
"""Relative increases of the resistance that are worth an alarm, and critical. Chosen: from full to a fifth of the
charge, and from 30 to 10 degrees, it rises by a third, which is no fault; the end of service is an increase by one."""
_RAISE, _SLOW = 0.25, 1.0
"""Shares of the memory for which evidence has to last. Chosen: the evidence of one manoeuvre is not enough."""
_FAULT_RATE = 0.1
"""Rate at which the relative resistance may grow, 1/s. Chosen: a contact fails within ten seconds."""
_LEAST_LEFT = 0.01
"""Least relative deviation of the resistance: no battery is steadier, since its temperature changes."""
_LEAST_USED = 0.03
"""Share of the charge that a flight has to use to determine the battery's charge: it is reported in whole per cent."""
_LEAST_FILLED = 1e-9
"""Share of the memory below which it counts as empty: only a restart leaves less."""
_MOST_CELLS = 10
"""Number of cells in a BATTERY_STATUS."""
_LEAST_AMPS = 0.05
"""Smallest current for which a remaining time is given, amperes: a fifth of what an autopilot draws."""


class BatteryInputs:
    """Samples of a battery: its resistance as a share of the usual one, its current and the time that its charge lasts.

    Parameters are ``ohm``: usual resistance; ``doubt``: lambda, A^2; ``charge``: charge of a full battery, As, 0 if it
    is not known; ``memory_s``: time constant of the moments, 20 if it is left out; ``cells``: number of parts in which
    the voltage is reported, 1 if it is left out. The rates of raw samples and of samples are equal; TelemetryError is
    raised if a parameter is missing, unknown or out of range.
    """

    inputs, outputs = ("battery", "ohm", "current", "left_s"), ("resistance",)

    def __init__(self, parameters: Mapping[str, float], signal_rate_hz: float, rate_hz: float) -> None:
        check_parameters("battery", parameters, ("ohm", "doubt", "charge"), optional=("memory_s", "cells"))
        if not (0.0 < parameters["ohm"] < 1e3 and parameters["doubt"] > 0.0 and 0.0 <= parameters["charge"] < 1e9):
            raise TelemetryError("transform 'battery': 'ohm' or 'doubt' is not above 0, or 'charge' negative")
        memory_s = parameters.get("memory_s", _MEMORIES_S[-1])
        if not 1.0 <= memory_s <= 1e3:
            raise TelemetryError(f"transform 'battery': 'memory_s' is {memory_s:g}; from 1 to 1000")
        cells = parameters.get("cells", 1.0)
        if cells not in range(1, _MOST_CELLS + 1):
            raise TelemetryError(f"transform 'battery': 'cells' is {cells:g}; a whole number up to {_MOST_CELLS}")
        # roll_rate is there for its time stamps: the messages of batteries have none
        self.signals = ("volts", "amps", "left", "roll_rate", *(f"volts{at}" for at in range(2, int(cells) + 1)))
        if signal_rate_hz != rate_hz:
            raise TelemetryError(f"transform 'battery': signals at {signal_rate_hz:g} Hz, samples at {rate_hz:g} Hz")
        self._ohm, self._doubt, self._charge = (parameters[name] for name in ("ohm", "doubt", "charge"))
        self._moments = Moments(rate_hz, memory_s)
        self._given = LaggedMeans((), rate_hz, 1, len(self.inputs), len(self.outputs))

    def run(self, samples: Samples) -> Given:
        """Return the observer's samples that raw samples complete; one marked ``restart`` forgets all moments."""
        with np.errstate(all="ignore"):  # absurd values may overflow; they are no evidence
            covariance, variance, amps = self._moments.run(samples)
            ohm = (self._doubt * self._ohm - covariance) / (self._doubt + variance)
            left_s = np.where(amps > _LEAST_AMPS, self._charge * samples.u[:, 2] / np.maximum(amps, _LEAST_AMPS), 0.0)
            # a resistance below the usual one is no fault
            share = np.where(ohm < self._ohm, 1.0, ohm / self._ohm)
        columns = [np.ones(len(samples)), ohm, amps, left_s, share]
        return self._given.run(samples, columns, np.ones(len(samples), np.bool_))


class Moments:
    """Moments of voltage and current, both minus their recent mean."""

    def __init__(self, rate_hz: float, memory_s: float) -> None:
        self._base = LaggedMeans([(0.0, _BASE_S)] * 2, rate_hz, 1, 2, 2)
        self._means = LaggedMeans([(0.0, memory_s)] * 5, rate_hz, 1, 5, 1)

    def run(self, samples: Samples) -> tuple[Array, Array, Array]:
        """Return w cov(V, I), w var(I) and the recent mean of the current of raw samples (n,)."""
        if not len(samples):
            return np.empty(0), np.empty(0), np.empty(0)
        everywhere = np.ones(len(samples), np.bool_)
        volts, amps = _voltage(samples), samples.u[:, 1]
        base = self._base.run(samples, [volts, amps, volts, amps], everywhere).samples.u
        v, i = volts - base[:, 0], amps - base[:, 1]
        # all begin at zero, so that the last one shows how much of the memory is filled
        columns = [v, i, v * i, i * i, np.where(samples.restart, 0.0, 1.0), i]
        *mean, weight = self._means.run(samples, columns, everywhere).samples.u.T
        filled = np.maximum(weight, _LEAST_FILLED)
        return mean[2] - mean[0] * mean[1] / filled, mean[3] - mean[1] * mean[1] / filled, base[:, 1]


def _voltage(samples: Samples) -> Array:
    """Return the battery's voltage (n,): the sum of the voltages of its cells if they are reported."""
    return np.asarray(samples.u[:, 0] + samples.u[:, 4:].sum(axis=1))


def fit_battery(request: FitRequest, gate: GateRule) -> Fitted | None:
    """Learn the battery's resistance on healthy recordings, design the observer, calibrate its alarm.

    Return None if voltage and current are not reported, or the flights do not determine the resistance.

    Raises
    ------
    ModelError
        Too little healthy flight.
    """
    reported, reported_hz = battery_channels(request.surveys)
    if reported_hz < _SLOWEST_HZ:
        return None
    _, outputs = multirotor_channels(request.surveys)
    channels = (*reported[:3], outputs[0], *reported[3:])
    rate_hz = float(f"{min(reported_hz, _FASTEST_HZ):.3g}")
    raw = raw_flights(request.logs, channels, rate_hz, gate)
    parameters = _learned(raw, rate_hz)
    if parameters is None:
        return None
    memory_s = parameters["memory_s"]
    source = SampleSource(transform=TransformRule(OBSERVER, rate_hz, parameters), signals=channels)
    shares = [flight.samples.y[flight.armed, 0] for flight in _transformed(raw, parameters, rate_hz)]
    left = max(float(np.concatenate(shares).std()), _LEAST_LEFT)
    expected = Expectation("resistance", left, OBSERVER, RESISTANCE, _SMALLEST, _CRITICAL, _FAULT_RATE, OBSERVER)
    raise_s = max(_RAISE * memory_s, 3.0 / rate_hz)
    times = Times(fast_s=raise_s, raise_s=raise_s, slow_s=_SLOW * memory_s, clear_s=raise_s)
    # the first input is the usual resistance; the others are for the alarm's sentence
    fitted = fit_expectations(request.name, source, rate_hz, raw, gate, [expected], times, B=np.eye(1, 4))
    # a resistance is a mean itself: the path of means would raise an alarm from half of the smallest size that matters
    alarm = plain_only(*fitted.alarms)
    charge = "" if not parameters["charge"] else f", {parameters['charge'] / 3600.0:.1f} Ah when full"
    return replace(
        fitted,
        alarms=(alarm,),
        findings={"rate_hz": rate_hz, "ohm": parameters["ohm"], "charge_as": parameters["charge"]},
        lines=(
            f"{1000.0 * parameters['ohm']:.1f} milliohms{charge}; "
            f"known over {memory_s:g} s; "
            f"alarm from {100.0 * alarm.rule.threshold:.0f} % more resistance on",
        ),
    )


def _learned(raw: Sequence[Flight], rate_hz: float) -> dict[str, float] | None:
    """Return the transform's parameters, or None if the flights do not determine the resistance."""
    products, charge, rows = np.zeros((2, 2)), [], 0
    for flight in raw:
        amps, left = flight.samples.u[flight.armed, 1:3].T
        rows += len(amps)
        if not len(amps) or not np.isfinite(flight.samples.u[flight.armed]).all() or not np.median(amps) > _LEAST_AMPS:
            return None
        base = LaggedMeans([(0.0, _BASE_S)] * 2, rate_hz, 1, 2, 2)
        both = np.column_stack([_voltage(flight.samples), flight.samples.u[:, 1]])
        slow = base.run(flight.samples, [*both.T, *both.T], np.ones(len(flight), np.bool_)).samples.u
        fast = (both - slow)[flight.armed]
        fast -= fast.mean(axis=0)
        products += fast.T @ fast
        if left[0] - left[-1] >= _LEAST_USED:
            charge.append(float(amps.sum()) / rate_hz / float(left[0] - left[-1]))
    check_length(rows, rate_hz, "the battery's current")
    if not products[1, 1] > 0.0:
        return None
    ohm = -products[0, 1] / products[1, 1]
    noise = max(products[0, 0] - ohm * ohm * products[1, 1], 0.0) / rows
    # errors within a second are correlated
    error = math.sqrt(noise / (products[1, 1] / rate_hz))
    if not ohm > 0.0 or error > _LARGEST_ERROR * ohm:
        return None
    parameters: dict[str, float] = {}
    for memory_s in _MEMORIES_S:
        doubt = max(noise / (memory_s * (_DOUBT * ohm) ** 2), 1e-6 * products[1, 1] / rows)
        full = float(np.median(charge)) if charge else 0.0
        values = {"ohm": ohm, "doubt": doubt, "charge": full, "memory_s": memory_s}
        if (cells := raw[0].samples.u.shape[1] - 3) > 1:
            values["cells"] = cells
        parameters = {name: float(f"{value:.6g}") for name, value in values.items()}
        known = np.concatenate([flight.samples.u[flight.armed, 1] for flight in _transformed(raw, parameters, rate_hz)])
        if known.std() <= _SURE * ohm:
            break
    return parameters


def _transformed(raw: Sequence[Flight], parameters: Mapping[str, float], rate_hz: float) -> list[Flight]:
    return [transformed(flight, BatteryInputs(parameters, rate_hz, rate_hz)) for flight in raw]
