"""Motors' speeds and currents minus those expected from their commands and speeds.

With u a motor's command, w its speed, i its current, and v the relative deviation of the battery's voltage (mean over
all controllers) from that of the fitted flights:

    expected speed    c0 + c1 x + c2 x^2 + c3 u v,  x = u (1 + v)      after delay and lag
    expected current  d0 + (d1 w + d2 w^2 + d3 w^3) / (1 + v)

in shares of those in hover. A speed controller without a governor applies a share x of the battery's voltage, one with
a governor compensates the voltage (c3 = -c1). The power of a propeller depends on its speed alone, nearly on the cube.

Measurements come a few times a second, so each is paired with the value expected at its own time, and both are averaged
over a tick. The plant compares the expectation of a tick with the measurement of the same tick, which the transform
therefore gives one tick later. A current below the expected one counts as equal to it: a failing motor draws more; less
current means a damaged propeller, which shows in the thrust.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from adapters.errors import TelemetryError
from adapters.sample import Given, Samples
from monitor.core.lagged import LaggedMeans
from monitor.sampling.scaled import check_parameters, raw_per_sample

Array = NDArray[np.float64]

TERMS = 4
"""Coefficients of a motor's curve."""
_KNOWN = 0.99
"""Share of an expectation that has to come from commands within the flown range: the rest is below the smallest
deviation worth an alarm."""


class HeldMeans:
    """Means over ticks of what held when speeds were measured last; some of it after a delay and lag.

    ``timing`` is delay and lag of each of the first inputs, seconds; a tick has ``size`` raw samples; ``inputs`` and
    ``outputs`` are the widths of u and y.
    """

    def __init__(
        self, timing: Sequence[tuple[float, float]], signal_rate_hz: float, size: int, inputs: int, outputs: int
    ) -> None:
        self._lagged = LaggedMeans(timing, signal_rate_hz, 1, inputs, outputs)
        self._means = LaggedMeans((), signal_rate_hz, size, inputs, outputs)
        self._speed: Array | None = None
        self._held = np.zeros((1, inputs + outputs))

    def run(self, samples: Samples, columns: Sequence[Array], speed: Array) -> Given:
        """Process raw samples: return the means, each at the end of its tick.

        ``columns`` are u followed by y, one each (n,); speeds (s, n) count as measured when one of them changes.
        """
        everywhere = np.ones(len(samples), np.bool_)
        if not len(samples):
            return self._means.run(samples, columns, everywhere)
        lagged = self._lagged.run(samples, columns, everywhere).samples
        before = speed[:, :1] if self._speed is None else self._speed
        news = samples.restart | (np.diff(speed, prepend=before) != 0.0).any(axis=0)
        values = np.vstack([self._held, np.hstack([lagged.u, lagged.y])])
        held = values[np.maximum.accumulate(np.where(news, np.arange(1, len(news) + 1), 0))]
        self._speed, self._held = speed[:, -1:], held[-1:]
        return self._means.run(samples, list(held.T), everywhere)


class OneTickLater:
    """Delays measurements by one tick, for a plant that delays expectations by one tick.

    In columns of ``at_least``, a measurement below the expectation is no fault, and counts as the expectation.
    """

    def __init__(self, at_least: slice) -> None:
        self._at_least = at_least
        self._before: Samples | None = None

    def run(self, samples: Samples) -> Samples:
        """Return the samples with the measurements of the tick before, or of the same tick at a restart."""
        if not len(samples):
            return samples
        before = samples.part(0, 1) if self._before is None else self._before
        self._before = samples.part(len(samples) - 1, len(samples))
        fresh = samples.restart
        measured, complete = (
            np.append(getattr(before, name), getattr(samples, name)[:-1]) for name in ("measured", "complete")
        )
        lost = np.vstack([before.lost, samples.lost[:-1]])
        u, y = (
            np.where(fresh[:, None], now, np.vstack([then, now[:-1]]))
            for then, now in ((before.u, samples.u), (before.y, samples.y))
        )
        y[:, self._at_least] = np.maximum(y[:, self._at_least], u[:, self._at_least])
        return replace(
            samples,
            y=y,
            lost=samples.lost | (lost & ~fresh[:, None]),
            measured=samples.measured & (measured | fresh),
            complete=samples.complete & (complete | fresh),
        )


def motor_outputs(parameters: Mapping[str, float]) -> dict[str, int]:
    """Return the motors' output numbers from the parameters ``output1``, ``output2``, up to the first missing one."""
    outputs: dict[str, int] = {}
    while (key := f"output{len(outputs) + 1}") in parameters:
        outputs[key] = int(parameters[key])
    return outputs


class EscInputs:
    """Samples of a multirotor's speed controllers: expected and measured speed, and current where it is measured.

    Parameters are ``output1`` and so on: numbers of the motors' outputs; ``volts``: usual voltage, 0 where it is not
    measured; ``delay_s``, ``lag_s`` of speed behind command; for each motor n ``rpmN`` (that of hovering) and
    ``rpmN_c0`` to ``rpmN_c3``; the same of ``ampsN`` for all or none; ``curves``: 2;
    ``least``: smallest command that was flown, 0 where it is left out. Below it the curves were never seen: no
    evidence. ``fastest``: fastest change of a command that was flown, per second, left out for any. Beyond it what a
    command did between two messages is not known well enough: no evidence either. ``most``: largest command that was
    flown, left out for any; beyond it sizes are ``doubt`` times the square of the excess larger, as the curve's bend is
    not known there. Rates and errors are those of :class:`monitor.sampling.scaled.ScaledInputs`.
    """

    def __init__(self, parameters: Mapping[str, float], signal_rate_hz: float, rate_hz: float) -> None:
        outputs = motor_outputs(parameters)
        numbers = list(outputs.values())
        currents = any(key.startswith("amps") for key in parameters)
        kinds = ("rpm", "amps") if currents else ("rpm",)
        curves = [f"{kind}{n}" for kind in kinds for n in numbers]
        terms_of = (f"{name}_c{term}" for name in curves for term in range(TERMS))
        needed = {"delay_s", "lag_s", "volts", "curves", *outputs, *curves, *terms_of}
        check_parameters("esc", parameters, needed, optional=("least", "fastest", "most", "doubt"))
        if parameters["curves"] != 2.0:
            raise TelemetryError(f"transform 'esc': 'curves' is {parameters['curves']:g}; it has to be 2")
        for key, most in (("delay_s", 2.0), ("lag_s", 2.0), ("volts", 1e4), ("least", 1.0)):
            if not 0.0 <= parameters.get(key, 0.0) <= most:
                raise TelemetryError(f"transform 'esc': '{key}' is {parameters[key]:g}; from 0 to {most:g}")
        if bad := next((name for name in curves if not 0.0 < parameters[name] < 1e9), None):
            raise TelemetryError(f"transform 'esc': '{bad}' is {parameters[bad]:g}; that of hover must be above 0")
        self._least = parameters.get("least", 0.0)
        self._most, self._doubt = parameters.get("most", math.inf), parameters.get("doubt", 0.0)
        self._largest_step = parameters.get("fastest", math.inf) / signal_rate_hz
        self._command: Array | None = None
        size = raw_per_sample("esc", signal_rate_hz, rate_hz)
        volts = parameters["volts"] > 0.0
        raw = ("motor", "rpm", *(["amps"] if currents else []), *(["volts"] if volts else []))
        self.signals = tuple(f"{kind}{n}" for kind in raw for n in numbers)
        self.inputs = tuple(f"{kind}{n}" for kind in (("esc", "motor") if currents else ("esc",)) for n in numbers)
        self.outputs = tuple(curves)
        self._units = np.array([parameters[name] for name in curves])
        self._curves = np.array([[parameters[f"{name}_c{term}"] for term in range(TERMS)] for name in curves])
        self._volts, self._motors, self._raw = parameters["volts"], len(numbers), len(raw)
        timing = [(parameters["delay_s"], parameters["lag_s"])] * (2 + len(numbers))
        self._means = HeldMeans(timing, signal_rate_hz, size, 2 + len(curves), len(curves))
        self._later = OneTickLater(slice(len(numbers), None))
        self._beyond = np.ones(1)

    def run(self, samples: Samples) -> Given:
        """Return the observer's samples that raw samples complete; one marked ``restart`` forgets lag and tick."""
        with np.errstate(all="ignore"):  # absurd values may overflow; they are no evidence
            command, speed, *more = np.split(samples.u.T, self._raw)
            v = deviation(more.pop(), self._volts) if self._volts else np.zeros(len(samples))
            measured = np.vstack([speed, *more]) / self._units[:, None]
            parts = terms(command, measured[: self._motors], v)
            expected = sum(c[:, None] * part[: len(c)] for c, part in zip(self._curves.T, parts, strict=True))
        # the effect on speeds of commands outside the flown range fades as slowly as that of the commands themselves
        before = command[:, :1] if self._command is None else self._command
        steps = np.abs(np.diff(command, prepend=before)).max(axis=0)
        flown = (command >= self._least).all(axis=0) & (samples.restart | (steps <= self._largest_step))
        self._command = command[:, -1:] if len(samples) else self._command
        known = np.asarray(flown, np.float64)
        beyond = 1.0 + self._doubt * np.maximum(0.0, command.max(axis=0, initial=0.0) - self._most) ** 2
        given = self._means.run(samples, [known, beyond, *expected, *measured], speed)
        means = given.samples
        lost = means.lost[:, 2:] | (means.u[:, :1] < _KNOWN)
        later = self._later.run(replace(means, u=means.u[:, 2:], lost=lost))
        # a sample compares with the expectation of the tick before
        beyond = np.append(self._beyond, means.u[:, 1])
        self._beyond = beyond[-1:]
        unflown = np.asarray(later.lost.all(axis=1) & ~means.lost[:, 2:].any(axis=1))
        return Given(later, given.rows, unflown=unflown, beyond=np.maximum(beyond[1:], beyond[:-1]))


def deviation(volts: Array, usual: float) -> Array:
    """Return the relative deviation (n,) of the mean of all controllers' voltages (s, n) from the usual voltage."""
    # added one after the other, so that the sum does not depend on the number of rows
    return np.asarray(sum(volts) / len(volts) / usual - 1.0)


def terms(command: Array, speed: Array, v: Array) -> tuple[Array, ...]:
    """Return the factors of the curves' coefficients, :data:`TERMS` arrays (2 s, n): of speeds, then of currents.

    Commands, and speeds as shares of those in hover, are (s, n).
    """
    applied, power = command * (1.0 + v), speed / (1.0 + v)
    of_speed = np.ones_like(command), applied, applied * applied, command * v
    of_current = np.ones_like(speed), power, power * speed, power * speed * speed
    return tuple(np.vstack(both) for both in zip(of_speed, of_current, strict=True))
