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

from collections.abc import Mapping
from math import exp, isfinite
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapters.errors import TelemetryError
from adapters.sample import Sample, Samples
from monitor.sampling.stretch import Given, first_order, in_parts, joined, since
from monitor.vehicles.inertial.strapdown_ticks import Sensors, Ticks

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

Array = NDArray[np.float64]


class _Start(NamedTuple):
    """Where a period begins: its tick, and the integrals y there before washing."""

    tick: int
    vehicle_time_ns: int
    time_ns: int
    places: list[float]


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
        gps, baro, mag = (values[key] > 0.0 for key in ("gps", "barometer", "magnetometer"))
        self.signals, self.inputs, self.outputs = _names(gps, baro, mag)
        period = 1.0 / rate_hz
        slow, fast = _washout(values["washout_s"], period), _washout(values["velocity_washout_s"], period)
        self._washouts = [fast if name.startswith("gps_velocity") else slow for name in self.outputs]
        latest = max(values["gps_delay_s"] if gps else 0.0, values["baro_delay_s"] if baro else 0.0)
        self._sensors = Sensors(
            gps=gps,
            baro=baro,
            mag=mag,
            hectopascal=values["barometer"] == 2.0,
            dt=1.0 / signal_rate_hz,
            imu_ticks=round(latest * signal_rate_hz),
            gps_ticks=round((latest - values["gps_delay_s"]) * signal_rate_hz) if gps else 0,
            baro_ticks=round((latest - values["baro_delay_s"]) * signal_rate_hz) if baro else 0,
            compass_ticks=round(values["compass_delay_s"] * signal_rate_hz) if mag else 0,
        )
        self._longest = max(self._sensors.imu_ticks, self._sensors.compass_ticks) + self._count
        self._widths = len(self.inputs), len(self.outputs)
        self._restart()

    def _restart(self) -> None:
        self._ticks = Ticks(self._sensors)
        self._before: list[float] = []
        self._start: _Start | None = None
        self._sum = [0.0] * len(self.inputs)
        self._summed = 0
        self._y = [0.0] * len(self.outputs)
        self._doubt = 0
        self._fresh = True

    def feed(self, sample: Sample) -> Sample | None:
        """Take the raw signals of one tick (``sample.u``); return the observer's sample where a period is over."""
        if sample.restart:
            self._restart()
        # Integrals bear straight lines over one or two lost measurements.
        self._doubt = max(self._doubt - 1, 0) if sample.measured else self._longest + 1
        rates = self._ticks.feed(sample.u.tolist())
        if rates is None:
            return None
        now, places = rates
        if self._before and self._start is not None:
            self._add([0.5 * (a + b) for a, b in zip(self._before, now, strict=True)])
        self._before = now
        if sample.index % self._count:
            return None
        given = None
        if self._start is not None:
            given = self._group(self._start)
            self._advance(self._start.places, places)
        self._begin(_Start(sample.index, sample.vehicle_time_ns, sample.time_ns, places))
        return given

    def run(self, samples: Samples) -> Given:
        """Take a stretch as :meth:`feed` takes samples one by one, to the same bits: a test holds them together."""
        with np.errstate(all="ignore"):
            return in_parts(samples, self._run, self.feed, self._widths)

    def _begin(self, start: _Start) -> None:
        self._start = start
        self._sum = [0.0] * len(self.inputs)
        self._summed = 0

    def _add(self, means: list[float]) -> None:
        """Add the means over one tick to those of the period."""
        self._sum = [total + mean for total, mean in zip(self._sum, means, strict=True)]
        self._summed += 1

    def _group(self, start: _Start) -> Sample:
        """Return the sample of the period that began at ``start``."""
        restart, self._fresh = self._fresh, False
        return Sample(
            index=start.tick // self._count,
            vehicle_time_ns=start.vehicle_time_ns,
            time_ns=start.time_ns,
            u=np.array(self._sum) / self._summed,
            y=np.array(self._y),
            restart=restart,
            complete=self._doubt == 0,
        )

    def _advance(self, start: list[float], places: list[float]) -> None:
        """Wash out the changes since the start of the period."""
        for i, (before, now) in enumerate(zip(start, places, strict=True)):
            keep, gain = self._washouts[i]
            self._y[i] = keep * self._y[i] + gain * (now - before)

    def _run(self, samples: Samples) -> Given:
        """Take finite, consecutive ticks, restarted at the first one at most."""
        if samples.restart[0]:
            self._restart()
        doubt = np.maximum(self._longest + 1 - since(~samples.measured, self._longest + 1 - self._doubt), 0)
        self._doubt = int(doubt[-1])
        now, places = self._ticks.run(np.ascontiguousarray(samples.u.T))
        first = len(samples) - now.shape[1]
        if first == len(samples):
            return joined((), self._widths)
        means = 0.5 * (np.column_stack([self._before or now[:, 0], now[:, :-1]]) + now)
        self._before = now[:, -1].tolist()
        ends = np.arange(int(-samples.index[first] % self._count), now.shape[1], self._count)
        if self._start is not None:
            self._add_all(means[:, : ends[0] + 1] if len(ends) else means)
        if not len(ends):
            return joined((), self._widths)
        last = int(ends[-1])
        given = self._groups(samples, first + ends, means[:, ends[0] + 1 : last + 1], places[:, ends], doubt == 0)
        self._begin(_start(samples, first + last, places[:, last]))
        self._add_all(means[:, last + 1 :])
        return given

    def _add_all(self, means: Array) -> None:
        for mean in means.T.tolist():
            self._add(mean)

    def _groups(
        self, samples: Samples, ends: NDArray[np.intp], means: Array, places: Array, good: NDArray[np.bool_]
    ) -> Given:
        """Return the samples of the periods that end at rows ``ends``, and wash out what changed over them.

        ``means`` over ticks reach from the first end to the last one, ``places`` are those at the ends. The period that
        ends first is summed up already; where none has begun there is nothing at the first end.
        """
        begun = 0 if self._start is not None else 1
        start = self._start or _start(samples, int(ends[0]), places[:, 0])
        u = np.zeros((len(self.inputs), len(ends)))
        for tick in range(self._count):
            u[:, 1:] += means[:, tick :: self._count]
        u[:, 1:] /= self._count
        if not begun:
            u[:, 0] = np.array(self._sum) / self._summed
        changes = np.diff(places, axis=1, prepend=np.array(start.places)[:, None])[:, begun:]
        y = np.empty_like(changes)
        for i, (keep, gain) in enumerate(self._washouts):
            washed = [self._y[i], *first_order(keep, gain * changes[i], self._y[i]).tolist()]
            y[i] = washed[:-1]
            self._y[i] = washed[-1]
        restart = np.zeros(len(ends) - begun, np.bool_)
        if len(restart):
            restart[0], self._fresh = self._fresh, False
        begins = ends[:-1]
        given = Samples(
            index=np.append(start.tick, samples.index[begins])[begun:] // self._count,
            vehicle_time_ns=np.append(start.vehicle_time_ns, samples.vehicle_time_ns[begins])[begun:],
            time_ns=np.append(start.time_ns, samples.time_ns[begins])[begun:],
            u=np.ascontiguousarray(u[:, begun:].T),
            y=np.ascontiguousarray(y.T),
            restart=restart,
            complete=good[ends[begun:]],
            known_ns=np.zeros(len(restart), np.int64),
            measured=np.ones(len(restart), np.bool_),
        )
        return Given(given, ends[begun:])


def _start(samples: Samples, row: int, places: Array) -> _Start:
    return _Start(
        int(samples.index[row]), int(samples.vehicle_time_ns[row]), int(samples.time_ns[row]), places.tolist()
    )


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
