"""The vibration observer of a multirotor: whether it shakes more than expected from throttle and motion.

The logarithm of the level, which autopilots report a few times a second, is compared with

    c0 + c1 m + c2 d + c3 r      m: mean command, d: difference between commands, r: size of the body rates

of the recent past, identified from healthy flights by least squares: twice the expected level is as remarkable in hover
as in a climb. A second channel is how many samples a second an accelerometer clipped, by the autopilot's counters: what
is clipped is missing in every speed and position.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from adapters.channels import Channel
from adapters.errors import ModelError, TelemetryError
from adapters.sample import Given, Samples
from gains.synthesis.convex import design_convex
from monitor.alarms.alarm import CLIPS, LOG_TIMES
from monitor.alarms.excuse import ExcuseRule
from monitor.core.lagged import LaggedMeans
from monitor.fitting.expectation import Expectation, check_length, fit_expectations
from monitor.fitting.fitted import FitRequest, Fitted
from monitor.fitting.flights import Flight, raw_flights
from monitor.fitting.survey import least_hz
from monitor.fitting.thresholds import FALSE_ALARMS_PER_HOUR, Times
from monitor.sampling.gate import GateRule
from monitor.sampling.scaled import check_parameters, raw_per_sample
from monitor.sampling.transform import SampleSource, TransformRule
from monitor.vehicles.multirotor.identify import RATE_AXES
from monitor.vehicles.multirotor.signals import multirotor_channels
from monitor.vehicles.multirotor.transform import OneTickLater

Array = NDArray[np.float64]

OBSERVER = "vibration"

CLIPPING = "clipping"
_MESSAGE, _AXES = "VIBRATION", "xyz"
_COUNTERS = tuple(f"clipping_{at}" for at in range(3))
"""Names of the clip counters of the three IMUs."""
_SIGNAL_HZ, _FASTEST_HZ, _SLOWEST_HZ = 25.0, 5.0, 0.3
"""Rate of the grid of commands and rates, and bounds of the observer's rate, hertz. Chosen: levels are means over half
a second and more, and a level every three seconds still shows the course of a flight of minutes."""
_LAG_S = 0.5
"""Lag of the level, seconds: ArduPilot takes the root of a square that went through a low-pass filter of 2 Hz, behind
one of 5 Hz; PX4 averages the level over a second, updated with each sample."""
_LEAST_LEVEL = 3.0
"""Smallest level that counts, m/s^2; a smaller one counts as this. It is the level of a good vehicle, a tenth of the
largest that ArduPilot's guide accepts. Air alone changes smaller levels: in eight healthy flights in its simulator
the medians are 0.2 to 2.1, the highest single levels, in gusts, 5.8; the others differ tenfold from a flight in calm
air."""
_LEAST_LEFT = 0.05
"""Least remaining deviation of logarithms, for flights with all levels below the smallest: a twentieth, no level is
steadier."""
_WIDTH = 2.0
"""Expected change of a logarithm between no throttle and full, between commands together and apart, and per rad/s.
Chosen: a factor of seven; it decides if flights show less."""
_SMALLEST, _CRITICAL = math.log(3.0), math.log(10.0)
"""Ratios to the expected level that are worth an alarm, and critical, as logarithms. Chosen: flights leave a factor of
two unexplained; ten times the 3 m/s^2 of a good vehicle is the largest level that ArduPilot's guide accepts."""
_CLIPPED, _CRITICALLY = 10.0, 100.0
"""Clipped samples per second that are worth an alarm, and critical. Chosen: a hundredth and a tenth of the thousand
that IMUs take, each a loss of a sample of 16 g and more; healthy flights have none, a stone or a hard landing causes
some at once."""
_TIMES = Times(fast_s=1.0, raise_s=2.0, slow_s=10.0, clear_s=2.0)
"""Times of the alarms. Chosen: a touchdown or a gust is over within a second; samples are clipped in bursts."""
_CLEAR_S = 1.0
"""How long a level has to be low again. Chosen: ArduPilot's falls to an eleventh in 0.4 s after the end of a vibration
(in its simulator), so that the alarm clears within two seconds."""
_MISMEASURED = ("accel_x", "accel_y", "accel_z", "motion_north", "motion_east")
"""Channels that compare accelerations with other sensors: vibration beyond the range or the bandwidth of an
accelerometer leaves a mean."""
_EXCUSED_S = 20.0
"""How long these show it afterwards: twice the time constant with which velocities forget
(:mod:`monitor.vehicles.inertial.fit`)."""
_FAULT_RATE = 0.5
"""Rate at which vibration may grow, logarithms per second. Chosen: a crack doubles it in some seconds."""


class VibrationInputs:
    """Samples of vibration: the expected logarithm of its level, the measured one, and clipped samples per second.

    Parameters are ``motors``, their number, ``least``, the smallest level that counts, ``c0`` to ``c3``. Rates and
    errors are those of :class:`monitor.sampling.scaled.ScaledInputs`.
    """

    inputs, outputs = ("expected",), ("level", "clips")

    def __init__(self, parameters: Mapping[str, float], signal_rate_hz: float, rate_hz: float) -> None:
        check_parameters("vibration", parameters, ("motors", "least", "c0", "c1", "c2", "c3"))
        if not (1.0 <= parameters["motors"] <= 16.0 and parameters["least"] > 0.0):
            raise TelemetryError("transform 'vibration': 'motors' is none of 1 to 16, or 'least' not above 0")
        size = raw_per_sample("vibration", signal_rate_hz, rate_hz)
        self._motors, self._least = int(parameters["motors"]), parameters["least"]
        self.signals = signal_names(self._motors)
        self._c = [parameters[f"c{term}"] for term in range(4)]
        self._means = LaggedMeans([(0.0, _LAG_S)], signal_rate_hz, size, 1, 2)
        self._rate_hz, self._counted = rate_hz, math.nan
        self._later = OneTickLater(slice(1))

    def run(self, samples: Samples) -> Given:
        """Return the observer's samples that raw samples complete; one marked ``restart`` forgets lag and tick."""
        with np.errstate(all="ignore"):  # absurd values may overflow; they are no evidence
            level, causes = explained(samples.u.T, self._motors)
            counted = samples.u[:, -len(_COUNTERS) :].sum(axis=1)
            expected = self._c[0] + self._c[1] * causes[0] + self._c[2] * causes[1] + self._c[3] * causes[2]
            measured = np.log(np.maximum(level, self._least))
        given = self._means.run(samples, [expected, measured, counted], np.ones(len(samples), np.bool_))
        return Given(self._later.run(self._clipped(given.samples)), given.rows)

    def _clipped(self, samples: Samples) -> Samples:
        """Return samples with clips per second in place of their counter; a counter that restarts counts nothing."""
        if not len(samples):
            return samples
        counter = samples.y[:, 1]
        before = np.append(self._counted, counter[:-1])
        known = np.isfinite(before) & ~samples.restart
        self._counted = float(counter[-1])
        clips = np.where(known, np.maximum(counter - before, 0.0), 0.0) * self._rate_hz
        return replace(samples, y=np.column_stack([samples.y[:, 0], clips]))


def signal_names(motors: int) -> tuple[str, ...]:
    """Return the names of the raw signals."""
    return (
        *(f"vibration_{axis}" for axis in _AXES),
        *(f"motor{n}" for n in range(1, motors + 1)),
        *RATE_AXES,
        *_COUNTERS,
    )


def explained(signals: Array, motors: int) -> tuple[Array, tuple[Array, ...]]:
    """Return the level (n,) and its causes, of raw signals (number of signals, n)."""
    x, y, z, *more = signals
    commands, rates = more[:motors], more[motors : motors + len(RATE_AXES)]
    apart = np.maximum.reduce(commands) - np.minimum.reduce(commands)
    roll, pitch, yaw = rates
    # added one after the other, so that the sum does not depend on the number of rows
    mean = np.asarray(sum(commands) / motors)
    return np.sqrt(x * x + y * y + z * z), (mean, apart, np.sqrt(roll * roll + pitch * pitch + yaw * yaw))


def fit_vibration(request: FitRequest, gate: GateRule) -> Fitted | None:
    """Learn on healthy recordings what explains the level, design the observer, calibrate its alarm.

    None where levels are not reported.

    Raises
    ------
    ModelError
        Too little healthy flight.
    """
    reported_hz = least_hz(request.surveys, _MESSAGE)
    if reported_hz < _SLOWEST_HZ:
        return None
    commands, outputs = multirotor_channels(request.surveys)
    levels = (
        Channel(f"vibration_{axis}", _MESSAGE, (f"vibration_{axis}",), interpolation="previous") for axis in _AXES
    )
    named = [replace(channel, name=f"motor{n}") for n, channel in enumerate(commands, start=1)]
    counters = (Channel(name, _MESSAGE, (name,), interpolation="previous") for name in _COUNTERS)
    channels = (*levels, *named, *outputs[: len(RATE_AXES)], *counters)
    rate_hz = float(f"{min(reported_hz, _FASTEST_HZ):.3g}")
    signal_hz = rate_hz * max(1, round(_SIGNAL_HZ / rate_hz))
    raw = raw_flights(request.logs, channels, signal_hz, gate)
    parameters, left = _learned(raw, len(commands), signal_hz, rate_hz)
    source = SampleSource(transform=TransformRule(OBSERVER, signal_hz, parameters), signals=channels)
    expectations = (
        Expectation("level", left, OBSERVER, LOG_TIMES, _SMALLEST, _CRITICAL, _FAULT_RATE),
        Expectation("clips", 1.0, CLIPPING, CLIPS, _CLIPPED, _CRITICALLY, _CLIPPED),
    )
    times = replace(_TIMES, raise_s=max(_TIMES.raise_s, 3.0 / rate_hz), fast_s=max(_TIMES.fast_s, 2.0 / rate_hz))
    fitted = fit_expectations(
        request.name,
        source,
        rate_hz,
        raw,
        gate,
        expectations,
        times,
        B=np.eye(2, 1),  # no clip is ever expected
        alarms_per_hour=FALSE_ALARMS_PER_HOUR,  # healthy flights have no clips
        design=design_convex,
    )
    alarm, clipping = fitted.alarms
    # A slow mean would raise from half the size, which for a logarithm is a factor of 1.7: a storm shakes a vehicle as
    # much.
    rule = replace(alarm.rule, slow=max(alarm.rule.slow, alarm.rule.threshold), clear_s=_CLEAR_S)
    alarm = replace(alarm, rule=rule)
    return replace(
        fitted,
        alarms=(alarm, clipping),
        excuses=(
            ExcuseRule(_MISMEASURED, (OBSERVER, CLIPPING), _EXCUSED_S, precedes=True),
            # Bursts beyond the range of an accelerometer are part of the vibration.
            ExcuseRule((CLIPPING,), (OBSERVER,), times.clear_s, precedes=True),
        ),
        findings={"rate_hz": rate_hz, "left": left},
        lines=(
            f"levels {rate_hz:g} times a second, within a factor of {math.exp(left):.2f} of the level expected "
            f"from throttle and motion (standard deviation); alarm from {math.exp(alarm.rule.threshold):.1f} times",
        ),
    )


def _learned(raw: Sequence[Flight], motors: int, signal_hz: float, rate_hz: float) -> tuple[dict[str, float], float]:
    """Return the transform's parameters, and the remaining standard deviation of the logarithm."""
    rows = []
    for flight in raw:
        level, causes = explained(flight.samples.u.T, motors)
        means = LaggedMeans([(0.0, _LAG_S)] * 3, signal_hz, round(signal_hz / rate_hz), 3, 1)
        given = means.run(flight.samples, [*causes, level], np.ones(len(flight), np.bool_))
        kept = flight.armed[given.rows] & ~given.samples.lost.any(axis=1)
        rows.append(np.hstack([given.samples.u[kept], given.samples.y[kept]]))
    values = np.concatenate(rows)
    check_length(len(values), rate_hz, "vibration")
    if not (values[:, 3] > 0.0).any():
        raise ModelError("the vehicle reports no vibration: each level is zero")
    measured = np.log(np.maximum(values[:, 3], _LEAST_LEVEL))
    X = np.column_stack([np.ones(len(values)), values[:, :3]])
    # levels within a second are correlated; terms that the flights do not show are expected to be zero
    prior = np.diag([0.0, 1.0, 1.0, 1.0]) * max(float(measured.std()), _LEAST_LEFT) * math.sqrt(rate_hz) / _WIDTH
    c = np.linalg.lstsq(np.vstack([X, prior]), np.append(measured, np.zeros(4)), rcond=None)[0]
    left = max(float((measured - X @ c).std()), _LEAST_LEFT)
    return {
        "motors": float(motors),
        "least": _LEAST_LEVEL,
        **{f"c{term}": float(f"{value:.6g}") for term, value in enumerate(c)},
    }, left
