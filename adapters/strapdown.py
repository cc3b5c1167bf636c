"""Raw inertial, attitude, GPS, barometer and compass signals -> what each says about the vehicle's motion.

A transform: samples of raw signals at the IMU's rate in, samples (u, y) at a lower rate out. Strapdown kinematics
need no parameter of the vehicle. With R the rotation body -> north, east, down of the attitude, f the specific
force, w the gyro's rate and T the period of the samples that come out, sample k holds

    u(k)   means over [t_k, t_k + T]: GPS velocity north, east; acceleration R f + g north, east, down;
           w in body axes; rate of the heading from w
    y(k)   at t_k, each washed out: position north, east and down of the GPS, its velocity north, east;
           down of the barometer; rotation of the attitude about the body's axes; heading of the magnetometer

so that integrals of u are compared with y. A mean loses nothing of a velocity, where picking one sample of four
would alias vibration into it.

Positions, velocities and angles are integrals, whose errors grow without end. Washed out with time constant tau,

    y+ = phi y + tau (1 - phi) d/T,   phi = exp(-T/tau),   d the change over the period,

the same quantity obeys x+ = phi x + tau (1 - phi) u: what is constant or older than tau is forgotten on both sides.

GPS and barometer report late. Everything they are compared with is delayed to the older of the two.
Yaw and GPS course wrap: their channels need a ``period``, or the sampler's straight line between both sides of a wrap
is no angle. GPS_RAW_INT repeats a fix under the same time stamp, which the sampler takes once, and has time 0 before
the first one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from math import atan2, cos, exp, isfinite, pi, radians, sin, sqrt
from typing import Generic, TypeVar

import numpy as np

from adapters.errors import TelemetryError
from adapters.sample import Sample

IMU = ("xacc", "yacc", "zacc", "xgyro", "ygyro", "zgyro", "roll", "pitch", "yaw")
GPS = ("lat", "lon", "gps_alt", "gps_speed", "gps_course")
BAROMETER = ("baro_alt",)
MAGNETOMETER = ("xmag", "ymag", "zmag")

DEFAULTS = {
    "gps": 1.0,
    "barometer": 1.0,
    "magnetometer": 1.0,
    "washout_s": 30.0,
    "velocity_washout_s": 10.0,
    "gps_delay_s": 0.0,
    "baro_delay_s": 0.0,
    "compass_delay_s": 0.0,
}

STANDARD_GRAVITY = 9.80665
_WGS84_A, _WGS84_E2 = 6_378_137.0, 6.694_379_990_14e-3
_STEEPEST_COSINE = 0.05
# An attitude that turns this much faster than the gyro says was reset (another estimator took over): no rotation.
_RESET_RATE = 1.0
_RESET_TICKS = 3

Vector = tuple[float, float, float]
T = TypeVar("T")


class Strapdown:
    """State of the transform.

    Parameters
    ----------
    parameters : Mapping[str, float]
        ``gps``, ``barometer``, ``magnetometer``: 1 where the vehicle has their signals, 0 where it has not
        (2: the barometer's signal is its pressure in hPa, to be taken to an altitude in metres);
        ``washout_s``: tau of positions and angles; ``velocity_washout_s``: tau of the velocity; ``gps_delay_s``,
        ``baro_delay_s``, ``compass_delay_s``: by how much they are late against the IMU. What is left out is taken
        from ``DEFAULTS``.
    signal_rate_hz : float
        Samples per second that come in.
    rate_hz : float
        Samples per second that go out: a whole fraction of it.

    Attributes
    ----------
    signals, inputs, outputs : tuple[str, ...]
        Names of what comes in, and of u and y. Signals are in SI units, latitude, longitude and GPS course
        in degrees, the altitudes in metres, the magnetic field in any unit.

    Raises
    ------
    TelemetryError
        A parameter is unknown or out of range, or the rates do not fit.
    """

    signals: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    def __init__(self, parameters: Mapping[str, float], signal_rate_hz: float, rate_hz: float) -> None:
        values = _checked(parameters)
        self._count = round(signal_rate_hz / rate_hz)
        if self._count < 1 or abs(self._count * rate_hz - signal_rate_hz) > 1e-9 * signal_rate_hz:
            raise TelemetryError(
                f"strapdown: {signal_rate_hz:g} Hz of signals is no whole multiple of {rate_hz:g} Hz; change 'rate_hz'"
            )
        self._gps, self._baro, self._mag = (values[key] > 0.0 for key in ("gps", "barometer", "magnetometer"))
        self._hectopascal = values["barometer"] == 2.0
        self.signals, self.inputs, self.outputs = _names(self._gps, self._baro, self._mag)
        self._dt, period = 1.0 / signal_rate_hz, 1.0 / rate_hz
        self._slow = _washout(values["washout_s"], period)
        self._fast = _washout(values["velocity_washout_s"], period)
        latest = max(values["gps_delay_s"] if self._gps else 0.0, values["baro_delay_s"] if self._baro else 0.0)
        self._imu_ticks = round(latest * signal_rate_hz)
        self._gps_ticks = round((latest - values["gps_delay_s"]) * signal_rate_hz)
        self._baro_ticks = round((latest - values["baro_delay_s"]) * signal_rate_hz)
        self._compass_ticks = round(values["compass_delay_s"] * signal_rate_hz) if self._mag else 0
        self._longest = max(self._imu_ticks, self._compass_ticks) + self._count
        self._restart()

    def _restart(self) -> None:
        self._motion = _Delay[Vector](self._imu_ticks)
        self._fixes = _Delay[tuple[float, ...]](self._gps_ticks)
        self._altitudes = _Delay[float](self._baro_ticks)
        self._levels = _Delay[Vector](self._compass_ticks)
        self._rotation: tuple[float, ...] | None = None
        self._origin: tuple[float, float] | None = None
        self._heading = 0.0
        self._turned = [0.0, 0.0, 0.0]
        self._resets = 0
        self._before: list[float] = []
        self._sum = [0.0] * len(self.inputs)
        self._ticks = 0
        self._start: tuple[Sample, list[float]] | None = None
        self._y = [0.0] * len(self.outputs)
        self._doubt = 0
        self._fresh = True

    def feed(self, sample: Sample) -> Sample | None:
        """Take the raw signals of one tick (``sample.u``); return the observer's sample where a period is over."""
        if sample.restart:
            self._restart()
        # Integrals bear straight lines over one or two lost measurements.
        self._doubt = max(self._doubt - 1, 0) if sample.measured else self._longest + 1
        values = sample.u.tolist()
        rates = self._inertial(values)
        if rates is None:
            return None
        now, places = rates
        if self._before and self._start is not None:
            for i, (a, b) in enumerate(zip(self._before, now, strict=True)):
                self._sum[i] += 0.5 * (a + b)
            self._ticks += 1
        self._before = now
        if sample.index % self._count:
            return None
        given = None
        if self._start is not None:
            given = self._group(self._start[0])
            self._advance(self._start[1], places)
        self._start = sample, places
        self._sum = [0.0] * len(self.inputs)
        self._ticks = 0
        return given

    def _group(self, start: Sample) -> Sample:
        """Return the sample of the period that began at ``start``."""
        restart, self._fresh = self._fresh, False
        return Sample(
            index=start.index // self._count,
            vehicle_time_ns=start.vehicle_time_ns,
            time_ns=start.time_ns,
            u=np.array(self._sum) / self._ticks,
            y=np.array(self._y),
            restart=restart,
            complete=self._doubt == 0,
        )

    def _advance(self, start: list[float], places: list[float]) -> None:
        """Wash out the changes since the start of the period."""
        for i, (before, now) in enumerate(zip(start, places, strict=True)):
            keep, gain = self._fast if self.outputs[i].startswith("gps_velocity") else self._slow
            self._y[i] = keep * self._y[i] + gain * (now - before)

    def _inertial(self, values: list[float]) -> tuple[list[float], list[float]] | None:
        """Return u of this tick and the integrals y before washing; None before every delay line is full."""
        force, rate, (roll, pitch, yaw) = values[0:3], values[3:6], values[6:9]
        cosine = cos(pitch)
        if abs(cosine) < _STEEPEST_COSINE:
            cosine = _STEEPEST_COSINE if cosine >= 0.0 else -_STEEPEST_COSINE
        yaw_rate = (rate[1] * sin(roll) + rate[2] * cos(roll)) / cosine
        R = rotation_matrix(roll, pitch, yaw)
        if self._rotation is not None:
            angles = small_rotation(self._rotation, R)
            steps = [value * self._dt for value in rate]
            jumps = max(abs(a - b) for a, b in zip(angles, steps, strict=True)) > _RESET_RATE * self._dt
            self._resets = self._resets + 1 if jumps else 0
            for i, angle in enumerate(steps if 0 < self._resets <= _RESET_TICKS else angles):
                self._turned[i] += angle
        self._rotation = R
        motion = self._motion.push(
            (
                R[0] * force[0] + R[1] * force[1] + R[2] * force[2],
                R[3] * force[0] + R[4] * force[1] + R[5] * force[2],
                R[6] * force[0] + R[7] * force[1] + R[8] * force[2] + STANDARD_GRAVITY,
            )
        )
        rest = values[9:]
        u: list[float] = []
        y: list[float] = []
        fix, altitude = None, None
        if self._gps:
            fix = self._fixes.push(self._fix(rest))
            rest = rest[len(GPS) :]
        if self._baro:
            altitude = self._altitudes.push(pressure_altitude(rest[0]) if self._hectopascal else rest[0])
            rest = rest[1:]
        level = self._levels.push((roll, pitch, yaw_rate))
        if motion is None or level is None or (self._gps and fix is None) or (self._baro and altitude is None):
            return None
        if fix is not None:
            u += [fix[3], fix[4], motion[0], motion[1]]
            y += [fix[0], fix[1], fix[3], fix[4], fix[2]]
        if altitude is not None:
            y.append(-altitude)
        if y:
            u.append(motion[2])
        u += rate
        y += self._turned
        if self._mag:
            u.append(level[2])
            heading = magnetic_heading(level[0], level[1], rest)
            self._heading += _wrapped(heading - self._heading)
            y.append(self._heading)
        return u, y

    def _fix(self, values: list[float]) -> tuple[float, ...]:
        """Return north, east and down in metres (of any origin), and the velocity north and east."""
        latitude, longitude, altitude, speed, course = values[: len(GPS)]
        if self._origin is None:
            self._origin = latitude, longitude
            self._metres = metres_per_degree(latitude)
        course = radians(course)
        north = (latitude - self._origin[0]) * self._metres[0]
        east = _wrapped_degrees(longitude - self._origin[1]) * self._metres[1]
        return north, east, -altitude, speed * cos(course), speed * sin(course)


class _Delay(Generic[T]):
    """A line that gives back what went in some ticks ago."""

    def __init__(self, ticks: int) -> None:
        self._line: deque[T] = deque(maxlen=ticks + 1)
        self._full = ticks + 1

    def push(self, value: T) -> T | None:
        """Take a value; return the oldest, None while the line fills."""
        self._line.append(value)
        return self._line[0] if len(self._line) == self._full else None


def rotation_matrix(roll: float, pitch: float, yaw: float) -> tuple[float, ...]:
    """Return R (body to north, east, down) of the Euler angles, row by row."""
    cr, sr, cp, sp, cy, sy = cos(roll), sin(roll), cos(pitch), sin(pitch), cos(yaw), sin(yaw)
    return (
        *(cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy),
        *(cp * sy, sr * sp * sy + cr * cy, cr * sp * sy - sr * cy),
        *(-sp, sr * cp, cr * cp),
    )


def small_rotation(before: tuple[float, ...], after: tuple[float, ...]) -> Vector:
    """Return the rotation from one attitude to the next about the body's axes (right to third order), radians."""

    def turned(i: int, j: int) -> float:
        return sum(before[3 * row + i] * after[3 * row + j] for row in range(3))

    x, y, z = (
        0.5 * (turned(2, 1) - turned(1, 2)),
        0.5 * (turned(0, 2) - turned(2, 0)),
        0.5 * (turned(1, 0) - turned(0, 1)),
    )
    stretch = 1.0 + (x * x + y * y + z * z) / 6.0
    return x * stretch, y * stretch, z * stretch


def magnetic_heading(roll: float, pitch: float, field: list[float]) -> float:
    """Return the heading of the levelled magnetic field (from magnetic north, clockwise), radians."""
    x, y, z = field
    across = y * cos(roll) - z * sin(roll)
    along = x * cos(pitch) + (y * sin(roll) + z * cos(roll)) * sin(pitch)
    return atan2(-across, along)


def metres_per_degree(latitude: float) -> tuple[float, float]:
    """Return the length of a degree of latitude and of longitude on the WGS-84 ellipsoid."""
    square = 1.0 - _WGS84_E2 * sin(radians(latitude)) ** 2
    north = _WGS84_A * (1.0 - _WGS84_E2) / (square * sqrt(square))
    return radians(north), radians(_WGS84_A / sqrt(square) * cos(radians(latitude)))


def pressure_altitude(pressure_hpa: float) -> float:
    """Return the altitude in the standard atmosphere, metres."""
    return 44_330.77 * (1.0 - float((max(pressure_hpa, 0.0) / 1013.25) ** 0.190_263))


def _wrapped(angle: float) -> float:
    return (angle + pi) % (2.0 * pi) - pi


def _wrapped_degrees(angle: float) -> float:
    return (angle + 180.0) % 360.0 - 180.0


def _washout(tau: float, period: float) -> tuple[float, float]:
    keep = exp(-period / tau)
    return keep, tau * (1.0 - keep) / period


def _checked(parameters: Mapping[str, float]) -> dict[str, float]:
    unknown = sorted(set(parameters) - set(DEFAULTS))
    if unknown:
        raise TelemetryError(f"strapdown: unknown parameter '{unknown[0]}'; known are {', '.join(DEFAULTS)}")
    values = {**DEFAULTS, **parameters}
    for key, value in values.items():
        if key in ("gps", "barometer", "magnetometer"):
            good = value in (0.0, 1.0) or (value == 2.0 and key == "barometer")
        else:
            good = isfinite(value) and (value > 0.0 or (value == 0.0 and key.endswith("delay_s")))
        if not good:
            raise TelemetryError(f"strapdown: '{key}' = {value} is out of range")
    return values


def _names(gps: bool, baro: bool, mag: bool) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    signals = IMU + GPS * gps + BAROMETER * baro + MAGNETOMETER * mag
    inputs = (
        ("speed_north", "speed_east", "acceleration_north", "acceleration_east") * gps
        + ("acceleration_down",) * (gps or baro)
        + ("rate_x", "rate_y", "rate_z")
        + ("heading_rate",) * mag
    )
    outputs = (
        ("gps_north", "gps_east", "gps_velocity_north", "gps_velocity_east", "gps_down") * gps
        + ("baro_down",) * baro
        + ("rotation_x", "rotation_y", "rotation_z")
        + ("heading",) * mag
    )
    return signals, inputs, outputs
