"""Deflections of a plane and of a rover as the effects they have at the present speed.

A control surface acts with the dynamic pressure and a damping moment with the speed; a steered wheel turns the
vehicle in proportion to how fast it rolls. With s = speed / reference,

    plane   effect = deflection s^2,   damping of a body rate ~ rate s        s = airspeed / reference
    rover   effect = (steering + kappa steering^3) s                          s = forward speed / reference, signed

so that the plant behind it has constant coefficients. Effects go through the actuator's transport delay and
first-order lag here, because the accelerations and rates beside them, which are inputs as well, do not.

Below ``minimum_speed`` a deflection has hardly any effect and division by it would only amplify noise: such samples
are given out with ``complete=False``, so an observer runs on through them, but they are no evidence.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from functools import partial
from math import cos, exp, sin
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from adapters.errors import TelemetryError
from adapters.sample import Sample, Samples
from monitor.sampling.stretch import Given, first_order, in_parts, joined, mapped, one_by_one
from monitor.vehicles.inertial.kinematics import Real

_SMALLEST_SCALE = 0.2

Array = NDArray[np.float64]


class SurfaceInputs:
    """Samples of a plane: surfaces scaled by dynamic pressure, and what else turns the airframe.

    Inputs are, after the four actuators, ``pressure`` s^2 (trims), the damping (s - 1) rate beyond that at the
    reference speed, the rates s that couple roll and yaw, lateral and vertical specific force (they stand for
    sideslip and angle of attack, and with these for the gusts), the share of gravity that curves the path, and
    ``lift_drag`` = vertical force squared over s^2.

    Parameters
    ----------
    parameters : Mapping[str, float]
        ``reference_speed`` and ``minimum_speed`` (m/s); for each actuator optionally ``<name>_delay_s`` and
        ``<name>_lag_s``.
    signal_rate_hz, rate_hz : float
        Raw samples and given samples per second; the first is a whole multiple of the second.

    Raises
    ------
    TelemetryError
        A parameter is missing, unknown or out of range, or the rates do not fit.
    """

    kind: ClassVar[str] = "surfaces"
    actuators: ClassVar[tuple[str, ...]] = ("aileron", "elevator", "rudder", "throttle")
    signals: ClassVar[tuple[str, ...]] = (
        *actuators,
        "airspeed",
        "roll",
        "pitch",
        "roll_rate",
        "pitch_rate",
        "yaw_rate",
        "forward_acceleration",
        "lateral_acceleration",
        "vertical_acceleration",
    )
    inputs: ClassVar[tuple[str, ...]] = (
        *actuators,
        "pressure",
        "roll_damping",
        "pitch_damping",
        "yaw_damping",
        "roll_coupling",
        "yaw_coupling",
        "side_force",
        "normal_force",
        "side_gravity",
        "normal_gravity",
        "lift_drag",
    )
    outputs: ClassVar[tuple[str, ...]] = ("roll_rate", "pitch_rate", "yaw_rate", "forward_acceleration")

    def __init__(self, parameters: Mapping[str, float], signal_rate_hz: float, rate_hz: float) -> None:
        _check_parameters(self.kind, parameters, _parameter_names(self.actuators))
        self._reference, self._minimum = parameters["reference_speed"], parameters["minimum_speed"]
        self._lags = _lags(parameters, self.actuators, signal_rate_hz)
        self._groups = _Groups(self.kind, signal_rate_hz, rate_hz)

    def feed(self, sample: Sample) -> Sample | None:
        """Take one raw sample; return the sample it completes, None where the group is not full yet."""
        values = sample.u.tolist()
        (*deflections, throttle, airspeed, roll, pitch), rest = values[:7], values[7:]
        s = airspeed / self._reference
        turns = sin(roll), cos(roll), cos(pitch)
        commands = _lagged(self._lags, _surface_commands(s, deflections, throttle), sample.restart)
        u = [*commands, *_airframe(s, max(s, _SMALLEST_SCALE), turns, rest)]
        return self._groups.feed(sample, np.array(u), np.array(rest[:4]), airspeed >= self._minimum)

    def run(self, samples: Samples) -> Given:
        """Take a stretch as :meth:`feed` takes samples one by one, to the same bits: a test holds them together."""
        with np.errstate(all="ignore"):
            return in_parts(samples, self._run, self.feed, (len(self.inputs), len(self.outputs)))

    def _run(self, samples: Samples) -> Given:
        signals = np.ascontiguousarray(samples.u.T)
        (*deflections, throttle, airspeed, roll, pitch), rest = signals[:7], tuple(signals[7:])
        s = airspeed / self._reference
        turns = mapped(sin, roll), mapped(cos, roll), mapped(cos, pitch)
        commands = _lagged_all(self._lags, _surface_commands(s, deflections, throttle), bool(samples.restart[0]))
        u = np.column_stack([*commands, *_airframe(s, np.maximum(s, _SMALLEST_SCALE), turns, rest)])
        return self._groups.run(samples, u, np.column_stack(rest[:4]), airspeed >= self._minimum)


class DriveInputs:
    """Samples of a rover: steering scaled by the speed along its own axis.

    Speed is the horizontal velocity projected on the heading: signed, so reverse driving turns the effect of
    the steering around, and on the vehicle's clock, which VFR_HUD is not.

    Parameters
    ----------
    parameters : Mapping[str, float]
        ``reference_speed`` and ``minimum_speed`` (m/s); optionally ``steering_cubic`` (kappa) and for each actuator
        ``<name>_delay_s`` and ``<name>_lag_s``.
    signal_rate_hz, rate_hz : float
        As for :class:`SurfaceInputs`.

    Raises
    ------
    TelemetryError
        A parameter is missing, unknown or out of range, or the rates do not fit.
    """

    kind: ClassVar[str] = "drive"
    actuators: ClassVar[tuple[str, ...]] = ("steering", "throttle")
    signals: ClassVar[tuple[str, ...]] = (
        *actuators,
        "velocity_north",
        "velocity_east",
        "yaw",
        "yaw_rate",
        "forward_acceleration",
    )
    inputs: ClassVar[tuple[str, ...]] = (*actuators, "speed")
    outputs: ClassVar[tuple[str, ...]] = ("yaw_rate", "forward_acceleration")

    def __init__(self, parameters: Mapping[str, float], signal_rate_hz: float, rate_hz: float) -> None:
        _check_parameters(self.kind, parameters, _parameter_names(self.actuators) | {"steering_cubic"})
        self._reference, self._minimum = parameters["reference_speed"], parameters["minimum_speed"]
        self._cubic = parameters.get("steering_cubic", 0.0)
        self._lags = _lags(parameters, self.actuators, signal_rate_hz)
        self._groups = _Groups(self.kind, signal_rate_hz, rate_hz)

    def feed(self, sample: Sample) -> Sample | None:
        """Take one raw sample; return the sample it completes, None where the group is not full yet."""
        steering, throttle, north, east, yaw, *y = sample.u.tolist()
        speed = _speed_ahead(north, east, cos(yaw), sin(yaw))
        s = speed / self._reference
        commands = [_steering_effect(steering, s, self._cubic), throttle]
        u = [*_lagged(self._lags, commands, sample.restart), s]
        return self._groups.feed(sample, np.array(u), np.array(y), abs(speed) >= self._minimum)

    def run(self, samples: Samples) -> Given:
        """Take a stretch as :meth:`feed` takes samples one by one, to the same bits: a test holds them together."""
        with np.errstate(all="ignore"):
            return in_parts(samples, self._run, self.feed, (len(self.inputs), len(self.outputs)))

    def _run(self, samples: Samples) -> Given:
        steering, throttle, north, east, yaw, *y = np.ascontiguousarray(samples.u.T)
        speed = _speed_ahead(north, east, mapped(cos, yaw), mapped(sin, yaw))
        s = speed / self._reference
        commands = [_steering_effect(steering, s, self._cubic), throttle]
        u = np.column_stack([*_lagged_all(self._lags, commands, bool(samples.restart[0])), s])
        return self._groups.run(samples, u, np.column_stack(y), np.abs(speed) >= self._minimum)


class _Lag:
    """Transport delay (between samples by a straight line) and first-order lag of one signal."""

    def __init__(self, delay_s: float, lag_s: float, rate_hz: float) -> None:
        whole, self._part = divmod(delay_s * rate_hz, 1.0)
        self._past: deque[float] = deque(maxlen=int(whole) + 2)
        self._keep = exp(-1.0 / (lag_s * rate_hz)) if lag_s > 0 else 0.0
        self._value = 0.0

    def restart(self, value: float) -> None:
        """Take the signal to have been at ``value`` for long."""
        self._past.extend([value] * (self._past.maxlen or 0))
        self._value = value

    def feed(self, value: float) -> float:
        past = self._past
        past.append(value)
        delayed = (1.0 - self._part) * past[1] + self._part * past[0]
        self._value = self._keep * self._value + (1.0 - self._keep) * delayed
        return self._value

    def run(self, values: Array) -> Array:
        """Take and return a stretch (n,)."""
        past = np.concatenate([self._past, values])
        self._past.extend(past[-len(self._past) :].tolist())
        delayed = (1.0 - self._part) * past[2 : len(values) + 2] + self._part * past[1 : len(values) + 1]
        found = first_order(self._keep, (1.0 - self._keep) * delayed, self._value)
        self._value = float(found[-1])
        return found


class _Groups:
    """Means over groups of consecutive raw samples, the groups fixed to the grid.

    The mean of inputs and outputs alike leaves a linear relation between them as it is and keeps what is faster
    than the new grid out of it.
    """

    def __init__(self, kind: str, signal_rate_hz: float, rate_hz: float) -> None:
        self._size = round(signal_rate_hz / rate_hz) if rate_hz > 0 else 0
        if self._size < 1 or abs(self._size * rate_hz - signal_rate_hz) > 1e-6 * signal_rate_hz:
            raise TelemetryError(
                f"transform '{kind}': signals at {signal_rate_hz:g} Hz cannot be grouped to samples at {rate_hz:g} Hz; "
                "choose a rate that divides the signals' rate"
            )
        self._u: list[NDArray[np.float64]] = []
        self._y: list[NDArray[np.float64]] = []
        self._complete = True
        self._restart = True

    def feed(self, sample: Sample, u: NDArray[np.float64], y: NDArray[np.float64], evidence: bool) -> Sample | None:
        place = sample.index % self._size
        if sample.restart:
            self._restart = True
        if sample.restart or place == 0:
            self._u.clear()
            self._y.clear()
            self._complete = True
        self._u.append(u)
        self._y.append(y)
        self._complete = self._complete and sample.complete and evidence
        if len(self._u) < self._size or place != self._size - 1:
            return None
        # absurd values may add up to infinity, as in a stretch
        with np.errstate(all="ignore"):
            u, y = np.mean(self._u, axis=0), np.mean(self._y, axis=0)
        given = Sample(
            index=sample.index // self._size,
            vehicle_time_ns=sample.vehicle_time_ns,
            time_ns=sample.time_ns,
            u=u,
            y=y,
            restart=self._restart,
            complete=self._complete,
        )
        self._restart = False
        return given

    def run(self, samples: Samples, u: Array, y: Array, evidence: NDArray[np.bool_]) -> Given:
        """Take consecutive samples, a restart at the first one at most, with their rows of u and y.

        Those before the first whole group and from the last one on are fed, which leaves the state as it has to be.
        """
        size, count = self._size, len(samples)
        self._restart |= bool(samples.restart[0])
        first = min(int(-samples.index[0] % size), count)
        groups = max((count - first) // size - 1, 0)
        last = first + size * groups
        ends = np.arange(first, last, size) + size - 1
        fed = partial(self._fed, samples, u, y, evidence)
        before = fed(0, first)
        restart = np.zeros(groups, np.bool_)
        if groups:
            restart[0], self._restart = self._restart, False
        whole = Samples(
            index=samples.index[ends] // size,
            vehicle_time_ns=samples.vehicle_time_ns[ends],
            time_ns=samples.time_ns[ends],
            u=_means(u[first:last], size),
            y=_means(y[first:last], size),
            restart=restart,
            complete=np.all((samples.complete & evidence)[first:last].reshape(groups, size), axis=1),
            known_ns=samples.known_ns[ends],
            measured=np.ones(groups, np.bool_),
        )
        return joined([before, Given(whole, ends), fed(last, count)], (u.shape[1], y.shape[1]))

    def _fed(self, samples: Samples, u: Array, y: Array, evidence: NDArray[np.bool_], start: int, stop: int) -> Given:
        rows = iter(range(start, stop))

        def feed(sample: Sample) -> Sample | None:
            row = next(rows)
            return self.feed(sample, u[row], y[row], bool(evidence[row]))

        given = one_by_one(feed, samples.part(start, stop), (u.shape[1], y.shape[1]))
        return Given(given.samples, given.rows + start)


def _means(values: Array, size: int) -> Array:
    """Return the means over groups of rows."""
    return np.asarray(values.reshape(-1, size, values.shape[1]).mean(axis=1))


def _surface_commands(s: Real, deflections: Sequence[Real], throttle: Real) -> list[Real]:
    aileron, elevator, rudder = deflections
    return [s * s * aileron, s * s * elevator, s * s * rudder, throttle]


def _airframe(s: Real, path: Real, turns: tuple[Real, Real, Real], rest: Sequence[Real]) -> list[Real]:
    """Return a plane's inputs after the actuators; ``turns`` are sine and cosine of roll, and cosine of pitch."""
    roll_rate, pitch_rate, yaw_rate, _, lateral, vertical = rest
    return [
        s * s,
        (s - 1.0) * roll_rate,
        (s - 1.0) * pitch_rate,
        (s - 1.0) * yaw_rate,
        s * roll_rate,
        s * yaw_rate,
        lateral,
        vertical,
        turns[0] * turns[2] / path,
        turns[1] * turns[2] / path,
        vertical * vertical / (path * path),
    ]


def _speed_ahead(north: Real, east: Real, cosine: Real, sine: Real) -> Real:
    return north * cosine + east * sine


def _steering_effect(steering: Real, s: Real, cubic: float) -> Real:
    return (steering + cubic * steering * steering * steering) * s


def _parameter_names(actuators: tuple[str, ...]) -> set[str]:
    timing = {f"{actuator}_{key}" for actuator in actuators for key in ("delay_s", "lag_s")}
    return {"reference_speed", "minimum_speed"} | timing


def _check_parameters(kind: str, parameters: Mapping[str, float], known: set[str]) -> None:
    unknown = sorted(set(parameters) - known)
    if unknown:
        raise TelemetryError(
            f"transform '{kind}': unknown parameter '{unknown[0]}'; known are {', '.join(sorted(known))}"
        )
    for name in ("reference_speed", "minimum_speed"):
        if not 0.0 < parameters.get(name, 0.0) < 1e4:
            raise TelemetryError(f"transform '{kind}': '{name}' is missing or no positive speed in m/s")
    for name in sorted(parameters):
        if name.endswith("_s") and not 0.0 <= parameters[name] <= 2.0:
            raise TelemetryError(f"transform '{kind}': '{name}' is {parameters[name]:g}; it must lie between 0 and 2 s")
    if not abs(parameters.get("steering_cubic", 0.0)) <= 10.0:
        raise TelemetryError(f"transform '{kind}': 'steering_cubic' is {parameters['steering_cubic']:g}; at most 10")


def _lags(parameters: Mapping[str, float], actuators: tuple[str, ...], rate_hz: float) -> list[_Lag]:
    return [
        _Lag(parameters.get(f"{name}_delay_s", 0.0), parameters.get(f"{name}_lag_s", 0.0), rate_hz)
        for name in actuators
    ]


def _lagged(lags: list[_Lag], commands: list[float], restart: bool) -> list[float]:
    if restart:
        for lag, command in zip(lags, commands, strict=True):
            lag.restart(command)
    return [lag.feed(command) for lag, command in zip(lags, commands, strict=True)]


def _lagged_all(lags: list[_Lag], commands: list[Array], restart: bool) -> list[Array]:
    if restart:
        for lag, command in zip(lags, commands, strict=True):
            lag.restart(float(command[0]))
    return [lag.run(command) for lag, command in zip(lags, commands, strict=True)]
