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
from collections.abc import Mapping
from math import cos, exp, sin
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from adapters.errors import TelemetryError
from adapters.sample import Sample

_SMALLEST_SCALE = 0.2


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
        (
            *deflections,
            throttle,
            airspeed,
            roll,
            pitch,
            roll_rate,
            pitch_rate,
            yaw_rate,
            forward,
            lateral,
            vertical,
        ) = sample.u.tolist()
        s = airspeed / self._reference
        pressure = s * s
        commands = [*(pressure * deflection for deflection in deflections), throttle]
        path = max(s, _SMALLEST_SCALE)
        u = [
            *_lagged(self._lags, commands, sample.restart),
            pressure,
            (s - 1.0) * roll_rate,
            (s - 1.0) * pitch_rate,
            (s - 1.0) * yaw_rate,
            s * roll_rate,
            s * yaw_rate,
            lateral,
            vertical,
            sin(roll) * cos(pitch) / path,
            cos(roll) * cos(pitch) / path,
            vertical * vertical / (path * path),
        ]
        y = [roll_rate, pitch_rate, yaw_rate, forward]
        return self._groups.feed(sample, np.array(u), np.array(y), airspeed >= self._minimum)


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
        steering, throttle, north, east, yaw, yaw_rate, forward = sample.u.tolist()
        speed = north * cos(yaw) + east * sin(yaw)
        s = speed / self._reference
        commands = [(steering + self._cubic * steering * steering * steering) * s, throttle]
        u = [*_lagged(self._lags, commands, sample.restart), s]
        return self._groups.feed(sample, np.array(u), np.array([yaw_rate, forward]), abs(speed) >= self._minimum)


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
        given = Sample(
            index=sample.index // self._size,
            vehicle_time_ns=sample.vehicle_time_ns,
            time_ns=sample.time_ns,
            u=np.mean(self._u, axis=0),
            y=np.mean(self._y, axis=0),
            restart=self._restart,
            complete=self._complete,
        )
        self._restart = False
        return given


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
