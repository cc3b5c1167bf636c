"""The airspeed observer of a plane: whether the pitot tube agrees with GPS and wind.

The true airspeed follows from the indicated one by the altitude and a learned scale. It is compared with the speed
through the air that follows from the GPS's velocity and the wind; the wind is estimated all the time
(:mod:`monitor.core.airspeed`). The compass is used at the start only. A wrong airspeed changes the expected effects of
the surfaces: while its alarm is active, no surface is held responsible.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from adapters.channels import COURSE, SPEED, Channel
from adapters.errors import ModelError, TelemetryError
from adapters.sample import Given, Samples
from monitor.alarms.excuse import ExcuseRule
from monitor.core.airspeed import EXPONENT, LAPSE, AirspeedCore
from monitor.fitting.expectation import Expectation, check_length, fit_expectations
from monitor.fitting.fitted import FitRequest, Fitted
from monitor.fitting.flights import Flight, raw_flights
from monitor.fitting.thresholds import Times
from monitor.sampling.gate import GateRule
from monitor.sampling.scaled import check_parameters, raw_per_sample
from monitor.sampling.transform import LiftRule, SampleSource, TransformRule
from monitor.vehicles.inertial.signals import common_channels
from monitor.vehicles.plane.signals import AIRSPEED, has_airspeed_sensor
from monitor.vehicles.plane.transform import SurfaceInputs

Array = NDArray[np.float64]

OBSERVER = "airspeed"
_PARAMETERS = ("scale", "noise", "level", "minimum_speed")
_GPS = (SPEED, COURSE, "gps_alt")
_SIGNALS = ("airspeed", *_GPS, "yaw")
_FASTEST_HZ = 10.0
"""Fastest rate of the observer, hertz. Chosen: autopilots filter airspeed by 1 to 2 Hz, GPS receivers have 5 to 10
fixes a second."""
_SLOWEST = 0.5
"""Share of the usual speed below which a plane is on the ground, as for its surfaces."""
_SMALLEST, _CRITICAL = 0.1, 0.3
"""Errors that are worth an alarm, and critical, as shares of the usual speed. Chosen: a tenth makes the dynamic
pressure, and with it the expected effect of every surface, a fifth larger; planes are flown at 1.3 times their stall
speed and more, so an airspeed that reads 30 % too high stalls one."""
_LEVEL, _GUSTS = 0.5, 1.5
"""Share of the smallest alarm, and multiple of the noise that gusts make, from which the sensor's error is estimated
freely: before its alarm, which begins at three deviations of gusts or more, and above what gusts leave in a second."""
_TIMES = Times(fast_s=0.2, raise_s=0.7, slow_s=3.0, clear_s=1.5)
"""Times of the alarm. Chosen: gusts last for a second, and no gust changes the airspeed by twice the smallest alarm."""
_STANDARD, _SCALES = 1.0, 0.1
"""Scale of a calibrated sensor, and its standard deviation if the flights have no turns: ArduPilot's uncalibrated ratio
is off by 20 %, the speed by half of that (its square root)."""
_LEAST_NOISE = 0.2
"""Least standard deviation, m/s, in still air: that of a GPS's velocity and of a pitot tube at 15 m/s."""
_ROUNDS = 10
"""Number of Gauss-Newton steps: from no wind at all, five reach the optimum to rounding."""
_FAULT_RATE = 10.0
"""Rate at which the error may grow, m/s per second. Chosen: half the speed in a second."""
_EXCUSED_S = 5.0
"""Time after the end of a wrong airspeed during which it explains evidence of surfaces: the longest time for which
their effectiveness is held."""
_UNLEARNED_S = 30.0
"""Time after the end of a wrong GPS during which it explains a difference: the estimated wind has absorbed the wrong
velocity and takes this long to recover (from 6 s after the end of a spoof by 5 m/s, the airspeed was held
responsible for 8 s)."""


class AirspeedInputs:
    """Samples of the airspeed: the true one that is expected, and the measured one.

    Parameters are ``scale``, true over indicated airspeed at sea level; ``noise``, the deviation of the difference in
    the fitted flights, m/s; ``level``, its mean from which the sensor's error is let free; ``minimum_speed``. Rates and
    errors are those of :class:`monitor.sampling.scaled.ScaledInputs`.
    """

    signals, inputs, outputs = _SIGNALS, ("expected",), ("airspeed",)

    def __init__(self, parameters: Mapping[str, float], signal_rate_hz: float, rate_hz: float) -> None:
        check_parameters("airspeed", parameters, _PARAMETERS)
        if not all(0.0 < parameters[name] < 1e4 for name in _PARAMETERS):
            raise TelemetryError("transform 'airspeed': a parameter is not above 0, or absurdly large")
        if raw_per_sample("airspeed", signal_rate_hz, rate_hz) != 1:
            raise TelemetryError("transform 'airspeed': the observer's rate is not that of its signals")
        self._core = AirspeedCore(1.0 / rate_hz, *(parameters[name] for name in _PARAMETERS))

    def run(self, samples: Samples) -> Given:
        """Return the observer's samples, one for each raw one; one marked ``restart`` forgets the wind."""
        expected, measured, lost, beyond = self._core.run(samples)
        u, y = expected[:, None], measured[:, None]
        unknown = lost & ~samples.lost.any(axis=1)
        return Given(replace(samples, u=u, y=y, lost=np.column_stack([lost, lost])), beyond=beyond, unflown=unknown)


def fit_airspeed(request: FitRequest, gate: GateRule) -> Fitted:
    """Learn on healthy recordings how well airspeed, GPS and wind agree, design the observer, calibrate its alarm.

    Raises
    ------
    ModelError
        There is no airspeed sensor, no velocity by GPS, or too little healthy flight in which the wind is known.
    """
    surveys = request.surveys
    known = {channel.name: channel for channel in common_channels(surveys).channels}
    if not all(map(has_airspeed_sensor, surveys)):
        raise ModelError("the vehicle has no airspeed sensor: its airspeed is an estimate")
    if not set(_GPS) <= set(known):
        raise ModelError("no speed and course of a GPS in every log; record GPS_RAW_INT")
    channels: tuple[Channel, ...] = (AIRSPEED, *(known[name] for name in _SIGNALS[1:]))
    rate_hz = _FASTEST_HZ
    raw = raw_flights(request.logs, channels, rate_hz, gate)
    parameters = _learned(raw, rate_hz)
    lift = LiftRule("wings") if any(survey.is_vtol for survey in surveys) else None
    source = SampleSource(transform=TransformRule(OBSERVER, rate_hz, parameters), signals=channels, lift=lift)
    smallest, critical = (share * parameters["minimum_speed"] / _SLOWEST for share in (_SMALLEST, _CRITICAL))
    expected = Expectation("airspeed", parameters["noise"], "airspeed", "m/s", smallest, critical, _FAULT_RATE)
    fitted = fit_expectations(request.name, source, rate_hz, raw, gate, [expected], _TIMES)
    [alarm] = fitted.alarms
    alarm = replace(alarm, rule=replace(alarm.rule, kind="sensor"))
    sensors = [f"{name}_{axis}" for name in ("gps", "gps_velocity", "motion") for axis in ("north", "east")]
    return replace(
        fitted,
        alarms=(alarm,),
        excuses=(
            ExcuseRule(SurfaceInputs.actuators, ("airspeed",), _EXCUSED_S, precedes=True),
            ExcuseRule(("airspeed",), tuple(sensors), _UNLEARNED_S, precedes=True),
        ),
        findings={"rate_hz": rate_hz, **parameters},
        lines=(
            f"true airspeed {parameters['scale']:.3f} times the indicated one at sea level, within "
            f"{parameters['noise']:.2g} m/s of the speed expected from GPS and wind (standard deviation); alarm from "
            f"{alarm.rule.threshold:.1f} m/s",
        ),
    )


def _learned(raw: Sequence[Flight], rate_hz: float) -> dict[str, float]:
    """Return the transform's parameters."""
    flown = [flight.samples.u[flight.armed & ~flight.samples.lost.any(axis=1)] for flight in raw]
    usual = float(np.median(np.concatenate(flown)[:, 0])) if sum(map(len, flown)) else 0.0
    moving = [rows[rows[:, 0] > _SLOWEST * usual] for rows in flown]
    check_length(sum(map(len, moving)), rate_hz, "airspeed and GPS")
    scale, noise = _scale([rows for rows in moving if len(rows)], rate_hz)
    level = max(_LEVEL * _SMALLEST * scale * usual, _GUSTS * noise)
    values = (scale, noise, level, _SLOWEST * scale * usual)
    return {name: float(f"{value:.4g}") for name, value in zip(_PARAMETERS, values, strict=True)}


def _scale(flights: Sequence[Array], rate_hz: float) -> tuple[float, float]:
    """Return the scale with which all flights, each with its own wind, agree best, and the remaining deviation, m/s."""
    x = np.zeros(1 + 2 * len(flights))
    x[0], noise = _STANDARD, 1.0
    for _ in range(_ROUNDS):
        normal, right, total, rows = np.zeros((len(x), len(x))), np.zeros(len(x)), 0.0, 0
        for number, (airspeed, speed, course, altitude, _) in enumerate(values.T for values in flights):
            wind = slice(1 + 2 * number, 3 + 2 * number)
            north, east = (
                speed * turn(np.radians(course)) - w for turn, w in zip((np.cos, np.sin), x[wind], strict=True)
            )
            climb = np.gradient(altitude) * rate_hz if len(altitude) > 1 else np.zeros(len(altitude))
            true = airspeed * (1.0 - LAPSE * altitude) ** -EXPONENT
            s = np.maximum(np.sqrt(north * north + east * east + climb * climb), 1e-6)
            J = np.zeros((len(s), len(x)))
            J[:, 0], J[:, wind] = true, np.column_stack([north / s, east / s])
            off = x[0] * true - s
            normal, right, total, rows = normal + J.T @ J, right - J.T @ off, total + float(off @ off), rows + len(s)
        # the samples of a second count as one
        noise = max(float(np.sqrt(total / rows)), _LEAST_NOISE)
        doubt = noise * noise * rate_hz
        normal[0, 0] += doubt / _SCALES**2
        right[0] += doubt / _SCALES**2 * (_STANDARD - x[0])
        normal[1:, 1:] += doubt / 10.0**2 * np.eye(len(x) - 1)
        right[1:] -= doubt / 10.0**2 * x[1:]
        x += np.linalg.solve(normal, right)
    return float(x[0]), noise
