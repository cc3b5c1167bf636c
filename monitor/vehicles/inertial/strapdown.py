"""Raw inertial, attitude, GPS, barometer and compass signals -> the vehicle's motion by each of them.

A transform: samples of raw signals at the IMU's rate in, samples (u, y) at a lower rate out. Strapdown kinematics need
no parameter of the vehicle. With R the rotation from body to north, east, down by the attitude, f the specific force, w
the gyros' rates and T the period of the samples that come out, sample k consists of

    u(k)   means over [t_k, t_k + T]: GPS velocity north, east; acceleration R f + g north, east, down;
           w in body axes; rate of the heading from w
    y(k)   at t_k, each washed out: position north, east and down of the GPS, its velocity north, east;
           down of the barometer; rotation of the attitude about the body's axes; heading of the magnetometer

so that integrals of u can be compared with y. A mean keeps the whole velocity; one sample of four would alias vibration
into it.

Positions, velocities and angles are integrals, whose errors grow without bound. Washed out with time constant tau,

    y+ = phi y + tau (1 - phi) d/T,   phi = exp(-T/tau),   d the change over the period,

the same quantity obeys x+ = phi x + tau (1 - phi) u: both sides forget constants, and everything older than tau.

GPS and barometer report late: everything compared with them is delayed to the older of the two. Yaw and GPS course
wrap: their channels need a ``period``, or the sampler's line across the wrap is no angle. GPS_RAW_INT repeats a fix
with the same time stamp, which the sampler counts once, and has time 0 before the first fix.
"""

from collections.abc import Mapping
from dataclasses import replace
from math import exp, isfinite

import numpy as np
from numpy.typing import NDArray

from adapters.channels import COURSE, SPEED
from adapters.errors import TelemetryError
from adapters.sample import Given, Samples
from monitor.core.navigation import Navigation
from monitor.core.repeats import Frozen
from monitor.core.strapdown import StrapdownCore
from monitor.sampling.scaled import check_parameters, raw_per_sample

IMU = ("xacc", "yacc", "zacc", "xgyro", "ygyro", "zgyro", "roll", "pitch", "yaw")
GPS = ("lat", "lon", "gps_alt", SPEED, COURSE)
BODY_SPEED = ("speed_x", "speed_y", "speed_z")
BAROMETER = ("baro_alt",)
MAGNETOMETER = ("xmag", "ymag", "zmag")
ESTIMATED = ("rate_x", "rate_y", "rate_z")
"""Rates that the autopilot estimates: its gyros without the bias that it has learned."""
LEARNED = "learned_hold_s"
"""Parameter of a transform whose gyros come too seldom to be integrated."""
ACCELEROMETERS = ("accel_x", "accel_y")
"""Outputs of the navigation: the error of an accelerometer while it is held responsible."""

SENSORS = {"baro": BAROMETER, "compass": MAGNETOMETER}
"""Signals of each sensor that may freeze, by the fault that is then named."""

_JUDGED = ("gyro_x", "gyro_y", "gyro_z", *ACCELEROMETERS, "compass")
"""Faults for whose sizes the navigation gives an uncertainty."""
FIX_S = 0.2
"""Time between comparisons of the navigation with the GPS, seconds. Receivers give 5 to 10 fixes a second."""

_MAY_BE_ZERO = ("delay_s", "hold_s", "frozen_s", "reading_s", "_level", "_noise", "_walk", "x_s", "y_s", "z_s")
"""Ends of the names of parameters that may be zero, which is no delay, no noise, or a rule that is not applied."""
DEFAULTS = {
    "gps": 1.0,
    "barometer": 1.0,
    "magnetometer": 1.0,
    "washout_s": 30.0,
    "velocity_washout_s": 10.0,
    "position_washout_s": 3.0,
    "gps_delay_s": 0.0,
    "baro_delay_s": 0.0,
    "compass_delay_s": 0.0,
    "gps_hold_s": 0.0,
    "compass_hold_s": 0.0,
    "imu_hold_s": 0.0,
    LEARNED: 0.0,
    **{f"{sensor}_{time}_s": 0.0 for sensor in SENSORS for time in ("frozen", "reading")},
    "judge_level": 0.0,
    "field_noise": 0.0,
    "field_walk": 0.0,
    "attitude_share": 1.0,
    "bias_angle_x_s": 0.0,
    "bias_angle_y_s": 0.0,
    "bias_angle_z_s": 0.0,
}
"""Values of parameters that are not given. Chosen: positions and angles are forgotten within 30 s, over which receivers
and barometers drift by half a metre; velocities within 10 s, in which an attitude that is wrong by 10 mrad turns
gravity into 1 m/s; positions without a velocity within 3 s, in which such an attitude makes .9 m."""


class Strapdown:
    """The transform of one observer; :mod:`monitor.core.strapdown` goes through the ticks.

    Parameters
    ----------
    parameters : Mapping[str, float]
        ``gps``, ``barometer``, ``magnetometer``: 1 where the vehicle has their signals, 0 where it has not
        (``barometer`` 2: its signal is its pressure in hPa, to be taken to an altitude in metres; ``gps`` 2: positions
        without a velocity; 3: with a velocity in body axes in place of speed and course);
        ``washout_s``: tau of positions and angles; ``velocity_washout_s``: tau of the velocity; ``position_washout_s``:
        tau of positions without a velocity, which are washed out twice; ``gps_delay_s``,
        ``baro_delay_s``, ``compass_delay_s``: by how much they are late against the IMU; ``gps_hold_s``: how long a
        fix may stay the same until the receiver is stuck, 0 for ever; ``compass_hold_s``: how long a magnetic field
        may, which is followed by the gyro until then; ``imu_hold_s``: how long IMU and attitude together may, after
        which they are not measured any more; ``baro_frozen_s``, ``compass_frozen_s``: how long a reading may stay the
        same until the sensor is frozen, 0 for ever, in proportion longer after a reading that lasted longer than
        ``baro_reading_s``, ``compass_reading_s``; ``learned_hold_s``: how long the bias that the autopilot's estimator
        has learned may be unknown, where gyros come too seldom to tell more (the signals end with ``ESTIMATED``),
        0: gyros are integrated; ``judge_level``: logarithm of the likelihood from which a gyro or accelerometer is
        held responsible for what the GPS's velocity shows (:mod:`monitor.core.navigation`), 0: never asked;
        ``field_noise``, ``field_walk``: noise of the magnetic field's direction, rad, and its random walk, rad per root
        of a second, as the navigation takes its heading from them; 0: it has the autopilot's and does not judge gyro z;
        ``attitude_share``: what counts of the difference of attitude and gyros while none is held responsible;
        ``bias_angle_x_s`` (y, z): by what angle the rotation is set back for each rad/s by which the observer's
        estimate of a gyro is off while a fault of it is known, and as that ends, as much as makes the estimate jump
        there; 0: once, by what the vehicle turned since its onset.
        What is left out is taken from ``DEFAULTS``.
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
        count = raw_per_sample("strapdown", signal_rate_hz, rate_hz)
        gps, baro, mag = (values[key] > 0.0 for key in ("gps", "barometer", "magnetometer"))
        speed = (GPS[3:], (), BODY_SPEED)[int(values["gps"]) - 1] if gps else ()
        judged = values["judge_level"] > 0.0 and bool(speed)
        self.signals, self.inputs, self.outputs = _names(gps, speed, baro, mag)
        hold = round(values[LEARNED] * signal_rate_hz)
        self._learned = LearnedBias(hold) if hold else None
        self._frozen = {name: held for name in SENSORS if (held := values[f"{name}_frozen_s"]) > 0.0}
        sensors = [SENSORS[name] for name in self._frozen]
        firsts, widths = [self.signals.index(one[0]) for one in sensors], [len(one) for one in sensors]
        holds = [round(held * signal_rate_hz) for held in self._frozen.values()]
        readings = [max(1, round(values[f"{name}_reading_s"] * signal_rate_hz)) for name in self._frozen]
        self._repeats = Frozen(firsts, widths, holds, readings, len(IMU))
        self.signals += ESTIMATED if self._learned else ()
        self.outputs += ACCELEROMETERS * judged
        period = 1.0 / rate_hz
        slow, fast = _washout(values["washout_s"], period), _washout(values["velocity_washout_s"], period)
        bare = {} if speed else dict.fromkeys(("gps_north", "gps_east"), _washout(values["position_washout_s"], period))
        latest = max(values["gps_delay_s"] if gps else 0.0, values["baro_delay_s"] if baro else 0.0)
        self.navigation = (
            Navigation(
                1.0 / signal_rate_hz,
                max(1, round(FIX_S * signal_rate_hz)),
                values["judge_level"],
                values["compass_delay_s"],
                values["field_noise"],
                values["field_walk"],
            )
            if judged
            else None
        )
        self._core = StrapdownCore(
            gps=gps,
            speeds=len(speed),
            baro=baro,
            mag=mag,
            hectopascal=values["barometer"] == 2.0,
            dt=1.0 / signal_rate_hz,
            imu_ticks=round(latest * signal_rate_hz),
            gps_ticks=round((latest - values["gps_delay_s"]) * signal_rate_hz) if gps else 0,
            baro_ticks=round((latest - values["baro_delay_s"]) * signal_rate_hz) if baro else 0,
            compass_ticks=round(values["compass_delay_s"] * signal_rate_hz) if mag else 0,
            gps_hold=round(values["gps_hold_s"] * signal_rate_hz),
            compass_hold=round(values["compass_hold_s"] * signal_rate_hz),
            count=count,
            inputs=len(self.inputs),
            washouts=[bare.get(name, fast if name.startswith("gps_velocity") else slow) for name in self.outputs],
            twice=[name in bare for name in self.outputs],
            navigation=self.navigation,
            attitude_share=values["attitude_share"],
            imu_hold=round(values["imu_hold_s"] * signal_rate_hz),
            angles_s=[values[f"bias_angle_{axis}_s"] for axis in "xyz"],
            learned=self._learned is not None,
        )

    def run(self, samples: Samples) -> Given:
        """Return the observer's samples that raw signals (``samples.u``) complete, each at the end of its period."""
        raw = self._learned.run(samples) if self._learned else samples
        given = self._core.run(raw)
        if self._frozen:
            frozen = self._repeats.run(
                np.ascontiguousarray(raw.u), np.ascontiguousarray(raw.lost).view(np.uint8), raw.restart.view(np.uint8)
            )
            given = given._replace(frozen=dict(zip(self._frozen, frozen[given.rows].T, strict=True)))
        if self._core.frozen_ns:
            given = given._replace(still=dict.fromkeys(IMU, self._core.frozen_ns))
        if self.navigation is None:
            return given
        return given._replace(
            spread=dict(zip(_JUDGED, self._core.spreads.T, strict=True)),
            sizes=dict(zip(_JUDGED, self._core.sizes.T, strict=False)),
        )

    @property
    def scores(self) -> NDArray[np.float64]:
        """Logarithm of the likelihood of the likeliest fault of gyros and accelerometers in each sample of the run."""
        return self._core.scores


class LearnedBias:
    """The bias that the autopilot's estimator subtracts: seldom raw gyros minus its rates of the same time.

    A difference holds for ``hold`` samples; then the gyros are lost.
    """

    def __init__(self, hold: int) -> None:
        self._hold, self._age = hold, hold
        self._before, self._bias = np.zeros((1, 6)), np.zeros((1, 3))
        self._news = np.zeros((1, 2), np.bool_)

    def run(self, samples: Samples) -> Samples:
        """Return samples with that bias in place of the gyros, and without the estimated rates."""
        u, lost = samples.u[:, :-3].copy(), samples.lost[:, :-3].copy()
        if not len(samples):
            return replace(samples, u=u, lost=lost)
        both = np.hstack([u[:, 3:6], samples.u[:, -3:]])
        changed = both != np.vstack([self._before, both[:-1]])
        news = np.vstack([self._news, np.column_stack([changed[:, :3].any(axis=1), changed[:, 3:].any(axis=1)])])
        # Messages of one time come at one sample or at two. Messages that are further apart belong to different
        # motions: with rates on the line between two messages, the smallest bias that can be seen would be ten times as
        # large.
        together = (news[1:] | news[:-1]).all(axis=1) & ~news[:-1].all(axis=1)
        rows = np.arange(1, len(both) + 1)
        newest = np.maximum.accumulate(np.where(together, rows, 0))
        u[:, 3:6] = np.vstack([self._bias, both[:, :3] - both[:, 3:]])[newest]
        age = np.where(newest > 0, rows - newest, self._age + rows)
        lost[:, 3:6] |= (age > self._hold)[:, None] | samples.lost[:, -3:]
        self._before, self._news, self._bias, self._age = both[-1:], news[-1:], u[-1:, 3:6].copy(), int(age[-1])
        return replace(samples, u=u, lost=lost)


def _washout(tau: float, period: float) -> tuple[float, float]:
    keep = exp(-period / tau)
    return keep, tau * (1.0 - keep) / period


def _checked(parameters: Mapping[str, float]) -> dict[str, float]:
    check_parameters("strapdown", parameters, (), optional=DEFAULTS)
    values = {**DEFAULTS, **parameters}
    for key, value in values.items():
        if key in ("gps", "barometer", "magnetometer"):
            good = value in range({"gps": 4, "barometer": 3}.get(key, 2))
        else:
            good = isfinite(value) and (value > 0.0 or (value == 0.0 and key.endswith(_MAY_BE_ZERO)))
        if not good:
            raise TelemetryError(f"strapdown: '{key}' = {value} is out of range")
    return values


def _names(
    gps: bool, speed: tuple[str, ...], baro: bool, mag: bool
) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    signals = IMU + (GPS[:3] + speed) * gps + BAROMETER * baro + MAGNETOMETER * mag
    moves = bool(speed)
    inputs = (
        ("speed_north", "speed_east") * moves
        + ("acceleration_north", "acceleration_east") * gps
        + ("acceleration_down",) * (gps or baro)
        + ("rate_x", "rate_y", "rate_z")
        + ("heading_rate",) * mag
    )
    outputs = (
        ("gps_north", "gps_east") * gps
        + ("gps_velocity_north", "gps_velocity_east") * moves
        + ("gps_down",) * gps
        + ("baro_down",) * baro
        + ("rotation_x", "rotation_y", "rotation_z")
        + ("heading",) * mag
    )
    return signals, inputs, outputs
