"""Identify a multirotor whose motor commands come slowly: mean command against mean motion, over a tick of the grid.

Outputs logged at 10 Hz, or sent over a radio once a second, do not show the controller's actions in between. Their mean
over a tick T does: it is the torque that the vehicle needed. For each axis o, with the frame's effects g_o of the s
motors (:mod:`monitor.vehicles.multirotor.frames`) and the lag of motors and link as the share h of a tick:

    v(k)     = (1 - h) u(k) + h u(k-1)                     u(k): mean command from tick k to tick k+1
    e_o(k)   = g_o v(k) / s                                commanded torque, in units of command
    e_o(k)   = p_0 + p_1 (y_o(k+1) - y_o(k)) / T + p_2 (y_o(k+1) + y_o(k)) / 2 + error

The torque is regressed on the motion, not the motion on the torque: the error (aliasing of u, gusts) is in e_o, and
least squares in the other direction underestimates the effect, by a factor of 1.1 to 5 on recordings at 10 Hz. Solved
for the rate, y' = (e_o - p_0 - p_2 y) / p_1, it gives the discrete model of the observer

    y_o(k+1) = a_o y_o(k) + B_o v(k) + c_o,     a_o = exp(-T p_2 / p_1),     B_o = (1 - a_o) / p_2  g_o / s.

The size of a lost share does not depend on p_1, as e_o alone shows it while the motion does not change. So the frame
and two minutes of hovering are enough; p_1 is the torque that manoeuvres need.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adapters.errors import ModelError
from gains.identification.segment import Segment
from gains.plants.plant import FloatArray
from monitor.fitting.thresholds import Times
from monitor.sampling.slow_telemetry import COMMANDS_PER_TICK
from monitor.vehicles.multirotor.frames import Frame, standard_frames
from monitor.vehicles.multirotor.identify import USUAL, MultirotorFit

SLOW_COMMANDS_HZ = 25.0
"""Rate of motor commands below which their means are used, hertz. At 25 Hz two samples fall into the lag of a motor (50
to 100 ms with its link); fewer cannot show how it answers."""
TRIM_HZ = 1.0
"""Rate of the observer beside a faster one, ticks per second. Measured on 120 flights of a real quadcopter of 30 g with
cut propellers (15 s each, docs/leaderboard.md): ticks of 0.2 s name a motor in 9 flights, of 1 s in 66."""
_SHOWS = 0.5
"""Share of the torque's variance that motion has to explain for p_1 to be taken from the flights as it is. With a
smaller share, p_1 lies between the regressions of either on the other, which are further apart than a factor of two."""
TURNED = 0.3
"""Least flown rate of yaw, rad/s, for which the yaw axis counts. A turn needs more torque than manoeuvres about other
axes (p_1 is 13 to 32 times larger), and hovering does not show how much: at 0.3 rad/s^2 as much as a motor that lost
15 %."""
_BRISK = 0.5
"""Least flown rate of roll or pitch, rad/s, for which the flights show manoeuvres."""
SMALLEST_LOSS, SMALLEST_UNSHOWN = 0.03, 0.08
"""Smallest losses in hover that are worth an alarm: learned from flights with manoeuvres, and from hovering alone.
Measured: in flights that were left out of the fit, estimates reached 2.6 % (sticks at 60 degrees of tilt, over a
radio); in brisk flights watched with a profile of two hovering minutes, 5 %."""
_LOSS_PER_S = 0.05
"""Smallest loss per second of a tick: commands a second apart miss more of the motion. Measured over a radio at 1 Hz,
ticks of 2 s: a jump of GPS that the vehicle followed moved an estimate by 8 %."""
_LONGEST_S = 2.0
"""Length of a tick up to which that loss grows, seconds: the vehicle's reaction to a jump or a gust is over then, and
two commands represent the mean command equally well however far apart they are."""
_FEWEST_S = 20.0
"""Least healthy flight from which the trim is learned, seconds: as much as for fast commands."""
_SLOWEST = 1e-6
"""Least decay of a rate in a tick: no vehicle turns on for ever, and the formulas divide by the decay."""
_LAGS = np.linspace(0.0, 0.9, 10)
"""Lags that are tried, as shares of a tick; a tenth of a tick is less than the jitter of such streams."""
_LATEST = 2
"""Largest delay of the motion after the command, ticks: at 15 to 25 Hz more than motor and link take together."""
_TELLS = 3.0
"""Standard errors from which motion tells one frame from another: a wrong one passes once in 400 times."""


def smallest_loss(segments: Sequence[Segment], commands_hz: float) -> float:
    """Return the smallest loss in hover that a trim of these flights can show, with commands at this rate."""
    brisk = max(float(np.abs(segment.y[:, :2]).max()) for segment in segments) > _BRISK
    tick_s = min(COMMANDS_PER_TICK / commands_hz, _LONGEST_S)
    return max(SMALLEST_LOSS if brisk else SMALLEST_UNSHOWN, _LOSS_PER_S * tick_s)


def slow_times(rate_hz: float) -> Times:
    """Return how long evidence has to last on a slow grid.

    Measured on eleven healthy flights at 10 Hz and four over a radio at 2 Hz, in ticks of two commands: the level that
    is exceeded once in 150 hours falls from 9 to 28 % of a motor's command where evidence lasts two ticks to 5 to 15 %
    for three, 1.7 to 5.8 % for four and 1.4 to 3.6 % for five. Four show 15 % at 10 Hz after 1 to 1.5 s.
    """
    tick_s = 1.0 / rate_hz
    return Times(fast_s=2 * tick_s, raise_s=4 * tick_s, slow_s=10 * tick_s, clear_s=3 * tick_s)


@dataclass(frozen=True, slots=True)
class _Axis:
    """Result of one axis' regression."""

    p: FloatArray
    error_std: float
    explained: float


def identify_trim(segments: Sequence[Segment], rate_hz: float, frame: Frame) -> MultirotorFit:
    """Fit the model of the module's docstring; use it where motor commands come below :data:`SLOW_COMMANDS_HZ`.

    Parameters
    ----------
    segments : Sequence[Segment]
        Healthy flight on the slow grid: u mean commands until the next tick, y body rates at the tick (rad/s).
    rate_hz : float
        Ticks per second.
    frame : Frame
        How the motors turn the vehicle.

    Returns
    -------
    MultirotorFit
        Of roll and pitch alone where the flights never turned.

    Raises
    ------
    ModelError
        Too little healthy flight.
    """
    usable = usable_segments(segments, rate_hz)
    turned = max(float(np.abs(segment.y[:, 2]).max()) for segment in usable) > TURNED and frame.effects[2].any()
    g = frame.effects[: 3 if turned else 2] / frame.effects.shape[1]
    change, middle = _motion(usable, rate_hz)
    lag = min(_LAGS, key=lambda h: sum(np.log(axis.error_std) for axis in _axes(usable, g, h, change, middle)))
    axes = _axes(usable, g, lag, change, middle)
    # y' = (e - p_0 - p_2 y) / p_1, held over a tick (exact discretisation of a first-order system).
    p1 = np.array([_torque_per_motion(axis, 1.0 / usual) for axis, usual in zip(axes, USUAL, strict=False)])
    decay = np.maximum([axis.p[2] / slope / rate_hz for axis, slope in zip(axes, p1, strict=True)], _SLOWEST)
    a = np.exp(-decay)
    gain = -np.expm1(-decay) / decay / p1 / rate_hz
    c = -gain * np.array([axis.p[0] for axis in axes])
    B = gain[:, None] * g
    taps = np.array([1.0 - lag, lag]) if lag > 0.0 else np.ones(1)
    return MultirotorFit(
        rate_hz=rate_hz,
        a=a,
        B=B,
        c=c,
        taps=taps,
        square=0.0,
        bends=np.zeros((*B.shape, 2)),
        residual_std=_one_step_std(usable, a, B, c, taps),
        samples=sum(len(segment.u) - 2 for segment in usable),
    )


def usable_segments(segments: Sequence[Segment], rate_hz: float) -> list[Segment]:
    """Return the segments that are long enough to be used.

    Raises
    ------
    ModelError
        Together they are too short.
    """
    usable = [segment for segment in segments if len(segment.u) > 2]
    seconds = sum(len(segment.u) - 2 for segment in usable) / rate_hz
    if seconds < _FEWEST_S:
        raise ModelError(
            f"only {seconds:.0f} s of healthy flight in the logs; at least {_FEWEST_S:.0f} s in the air are needed"
        )
    return usable


def choose_frame(segments: Sequence[Segment], rate_hz: float) -> Frame | None:
    """Return the standard frame whose torques go with the motion of a recording, None where none clearly does.

    Parameters
    ----------
    segments : Sequence[Segment]
        Healthy flight on a grid about as fast as the body rates: u the newest commands at the tick (N, s), y body
        rates.
    rate_hz : float
        Ticks per second.

    Notes
    -----
    The commanded torque of the right frame grows with the angular acceleration some ticks later and, by damping, with
    the rate. Each axis of a frame counts with the squared t-values of both coefficients, negative where their sign is
    wrong. Only ticks with new commands count: an older one says nothing of the motion now.
    """
    usable = [segment for segment in segments if len(segment.u) > _LATEST + 2]
    if not usable:
        return None
    stop = -1 - _LATEST
    fresh = np.concatenate([np.any(s.u[1:stop] != s.u[: stop - 1], axis=1) for s in usable])
    u = np.vstack([s.u[1:stop] for s in usable])[fresh]
    best: tuple[float, Frame | None] = (0.0, None)
    for lag in range(_LATEST + 1):
        rates = [s.y[lag : len(s.y) - _LATEST + lag, :3] for s in usable]
        change = np.vstack([(y[2:] - y[:-2]) * rate_hz / 2.0 for y in rates])[fresh]
        middle = np.vstack([y[1:-1] for y in rates])[fresh]
        for frame in standard_frames(u.shape[1]):
            scores = _agreement(u, change, middle, frame)
            if np.all(scores[frame.effects.any(axis=1)] > _TELLS**2) and scores.sum() > best[0]:
                best = float(scores.sum()), frame
    return best[1]


def _agreement(u: FloatArray, change: FloatArray, middle: FloatArray, frame: Frame) -> FloatArray:
    """Return how clearly the torques of a frame agree with the motion, per axis (3,)."""
    scores = np.zeros(3)
    for o in range(3):
        e = u @ frame.effects[o]
        X = np.column_stack([np.ones(len(e)), change[:, o], middle[:, o]])
        p = np.linalg.lstsq(X, e, rcond=None)[0]
        errors = np.sqrt(np.diag(np.linalg.pinv(X.T @ X))) * (e - X @ p).std()
        t = (p / np.maximum(errors, 1e-300))[1:]
        scores[o] = float(np.sum(np.sign(t) * t**2))
    return scores


def _motion(segments: Sequence[Segment], rate_hz: float) -> tuple[FloatArray, FloatArray]:
    """Return change per second and mean of the rates over each tick except a segment's first (N, 3)."""
    change = np.vstack([(s.y[2:, :3] - s.y[1:-1, :3]) * rate_hz for s in segments])
    middle = np.vstack([(s.y[2:, :3] + s.y[1:-1, :3]) / 2.0 for s in segments])
    return change, middle


def _axes(
    segments: Sequence[Segment], g: FloatArray, lag: float, change: FloatArray, middle: FloatArray
) -> list[_Axis]:
    v = np.vstack([(1.0 - lag) * s.u[1:-1] + lag * s.u[:-2] for s in segments])
    axes = []
    for o in range(len(g)):
        e = v @ g[o]
        X = np.column_stack([np.ones(len(e)), change[:, o], middle[:, o]])
        p = np.linalg.lstsq(X, e, rcond=None)[0]
        std = float((e - X @ p).std())
        axes.append(_Axis(p, max(std, 1e-12), 1.0 - std**2 / max(float(e.var()), 1e-300)))
    return axes


def _torque_per_motion(axis: _Axis, usual: float) -> float:
    """Return p_1 of the flights if they show it, otherwise the usual one within the range that they allow.

    If gusts move a vehicle more than its pilot, torque follows gust and not motion, and the regression gives a p_1 that
    is too small; the regression of motion on torque gives one that is too large by one over the explained share.
    """
    least = max(axis.p[1], 0.0)
    if axis.explained >= _SHOWS and least > 0.0:
        return float(least)
    return float(np.clip(usual, least, least / max(axis.explained, 1e-3) if least > 0.0 else np.inf))


def _one_step_std(
    segments: Sequence[Segment], a: FloatArray, B: FloatArray, c: FloatArray, taps: FloatArray
) -> FloatArray:
    """Return the standard deviation of the errors of one step (n,)."""
    h, n = np.append(taps, 0.0)[:2], len(a)
    errors = [s.y[2:, :n] - a * s.y[1:-1, :n] - (h[0] * s.u[1:-1] + h[1] * s.u[:-2]) @ B.T - c for s in segments]
    return np.asarray(np.vstack(errors).std(axis=0))
