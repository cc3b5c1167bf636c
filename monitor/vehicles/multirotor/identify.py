"""Identify a multirotor from healthy flights: motor commands to body rates and vertical specific force.

The model, in the symbols of the theory (k counts samples, d delays, i motors, o axes):

    v_i(k)   = sum_d h_d ((1 - q) u_i(k-d) + q u_i(k-d)^2)             delay, motor lag and filters; thrust curve
    w_i(k)   = (1 - q') v_i + q' v_i^2                                 drag: in place of v in the equation of yaw
    x_o(k+1) = a_o x_o(k) + sum_i B_oi v_i(k) + c_o                    roll, pitch and yaw rate
    y_o(k)   = x_o(k) + e_o(k),   e_o(k) = sum_j d_oj e_o(k-j) + eps   coloured noise: gusts, measurement
    y_z(k+1) = b_z sum_i v_i(k)                                        vertical specific force

The taps h follow from three times (:func:`gains.identification.lag.lag_taps`). The coefficients minimise the squares of
eps (Gauss-Newton; the noise model is estimated anew at each step): the prediction-error method for a Box-Jenkins model,
which is valid in closed loop and with measurement noise (Ljung, System Identification, 1999, 4.2, 7.2, 13.4). The
simulation of x uses commands only, so a lost measurement costs only its own row. The descent begins with a regression
on many past rates and commands, so that the feedback of the controller is not taken for the vehicle.

No frame type is asked for: B is learned. Where the frame's geometry is known, or the autopilot moves the motors in
fewer directions than there are motors, it is a prior of B with a stated width. Vertical force is NOT regressed on
commands: the altitude controller answers gusts through the accelerometer, so the regression would find the inverse of
the controller. Thrust is zero at zero command, so b_z follows from the two means alone.

Standard errors come from the gradients g_b of blocks of time, H^-1 (sum_b g_b g_b') H^-1, for all coefficients
together. They hold for errors of any colour and changing variance (White 1980, Arellano 1987).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import ceil, exp
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from adapters.errors import ModelError
from gains.identification.coloured_noise import (
    Autoregression,
    autoregression,
    finite_response,
    known_before,
    past_errors,
    whitened,
)
from gains.identification.lag import followed, lag_taps, shortened
from gains.identification.segment import Segment
from gains.plants.plant import Disturbance, Fault, FloatArray, Noise, Plant, on_each

RATE_AXES = ("roll_rate", "pitch_rate", "yaw_rate")
VERTICAL = "vertical_acceleration"
GYROS = ("gyro_x", "gyro_y", "gyro_z")

_LEAST_S = 20.0
"""Least evidence, seconds: twenty blocks of standard errors."""
_BLOCK_S = 1.0
"""Length of the blocks whose gradients are taken as independent, seconds. Measured on 24 simulated flights: 95 %
intervals with blocks of .5, 1 and 2 s cover 93.1, 93.1 and 92.7 %, since innovations are white."""
_LARGEST_ERROR = 0.25
"""Largest relative standard error of an axis' effects for which the flights determine them: with a larger one, zero
lies within four standard errors."""
_LIKELY = 0.9
"""Share of the largest damping from which a damping is no vehicle's."""
_ALIKE = 0.7
"""Least cosine between an axis' effects and those of the frame: half a right angle."""
USUAL = (450.0, 450.0, 22.0)
"""Angular acceleration, rad/s^2, that a whole mean command, along the frame's effects, gives about roll, pitch and yaw:
the geometric mean of two quads of 1 and 3 kg (PX4's SIH 175, 175, 13.5; ArduPilot's simulator 1200, 1200, 37)."""
_GUST_S = 10.0
"""Length of the blocks for the mean of the errors, seconds: gusts and trim move it as a whole."""
_CONTROLS = 4
"""Number of an autopilot's controls: thrust, roll, pitch and yaw."""
_WIDTH = 0.1
"""Expected deviation of a motor's effect from the frame's geometry, as a share. Chosen: motors and propellers of a make
agree within a few per cent, arms are mounted within a per cent; a larger width costs accuracy where flights do not
determine the effects, a smaller one would bend what they determine."""
_LONGEST_S = (0.1, 0.15, 0.025)
"""Longest transport delay, motor lag and delay of filters, seconds. Chosen: no multirotor flies with slower rotors, or
with gyro filters below 5 Hz."""
_CURVES = ((3,), (3,), (3, 4))
"""Indices of each axis' curve among the shared coefficients. Yaw has q, too: the drag of a propeller goes with its
thrust, and may bend on top of that: q' is .5 to .65 on five vehicles of ArduPilot's simulator, 0 on PX4's. Fitted to
three gentle flights it lowers the errors of the yaw rate in two wild ones by a third. A curve (1 - p) u + p u^2 of
drag's own does so by a tenth to a quarter, and turns negative at a fifth of full command."""
_LEAST_BEND = -0.5
"""Least q': below -1 more thrust would mean less drag. Chosen: half of that; no vehicle has been below zero."""
_USUAL = ((0.0, 0.05), (0.0, 0.05), (0.0, 0.03), (0.5, 0.5), (0.0, 0.5))
"""Expected values of the shared coefficients, and their widths: they separate coefficients of which the flights show
only the sum."""
_SLOWEST, _FASTEST = 0.01, 10.0
"""Least and largest damping of a body rate, 1/s. Measured on three simulated vehicles: 0.8 to 2.5; a faster decay is a
lag."""
_ORDER = 16
"""Order of the noise. Measured on simulated flights at 50, 100 and 250 Hz and recorded ones: Schwarz's criterion takes
8 to 16; an order that changes during the descent makes the cost jump."""
_REGRESSED_S = 0.15
"""Length of the commands in the first regression, seconds: more than lag and delay, so that past rates explain the
rest."""
_STARTS = tuple((delay, lag) for lag in (0.01, 0.03, 0.08) for delay in (0.0, 0.02, 0.05))
"""Delays and lags with which the descent may begin, seconds: one of them is within a factor of two of any vehicle's."""
_START_DAMPINGS = (0.3, 1.0, 3.0)
"""Dampings of a rate with which the descent may begin, 1/s: one of them is within a factor of two of any vehicle's."""
_UNKNOWN_S = 0.3
"""Beginning of a stretch that does not count, seconds: the effect of commands before the stretch has mostly died away,
after six lags of 50 ms. Its length is fixed: the cost would jump whenever a lag needs another row."""
_STEPS = 60
"""Largest number of steps of the descent. Measured on five recorded vehicles: 8 to 25 are needed."""
_DAMPING, _EASED = 1e-2, 3.0
"""Damping of the descent: the share of the curvature to begin with, and its factor after a step that helped (the square
after one that did not). Chosen: the first steps bend the taps by more than a slope shows; the last ones should be
those of the slope."""
_STUCK = 1e5
"""Damping from which rounding decides which steps help."""
_ENOUGH = 0.03
"""Squared step, in standard errors, below which the descent ends: all coefficients together would move by less than .17
(the root)."""
_SLOPE = 0.02
"""Relative step of the differences of taps, at least that share of a tenth of a sample: it gives five digits of smooth
taps."""
_PARALLEL = 0.1
"""Largest angle between the effects of two motors that are not told apart, radians; the effects are shares of the
largest about each axis. Chosen: flights determine effects to .5 to 2 %; two motors on one arm that turn in opposite
senses are more than 1 apart."""
_SHARED = len(_USUAL)
"""Number of coefficients of all axes: delay, lag, filter, and q of thrust and of drag."""


@dataclass(frozen=True, slots=True, eq=False)
class MultirotorFit:
    """The model identified from the flights: n outputs (body rates, perhaps vertical specific force), s motors."""

    rate_hz: float  # samples per second of the model
    a: FloatArray  # rate coefficients a_o per step (3,), or those of the first axes
    B: FloatArray  # effect of each motor's v on the outputs per step (n, s)
    c: FloatArray  # constant offsets per step (n,)
    taps: FloatArray  # h (L,), sum 1
    square: float  # q, share of the square in the thrust curve
    bends: FloatArray  # coefficients of v, v^2, ... of what each motor does to the outputs beyond B v (n, s, degree)
    residual_std: FloatArray  # one-step prediction error (n,), in the units of y
    samples: int  # number of rows that counted

    def effect(self, u: FloatArray) -> FloatArray:
        """Return v(k) of commands ``u`` (N, s) for k = L - 1, ..., N - 2, L the number of taps (max(0, N - L), s)."""
        return self._acting(self._curved(u))

    def drive(self, u: FloatArray) -> FloatArray:
        """Return what commands ``u`` (N, s) do to the outputs in these steps (max(0, N - L), n)."""
        powers = self._curved(u)[:, :, None] ** np.arange(1, 1 + self.bends.shape[2])
        bent = np.einsum("nsd,tsd->tn", self.bends, powers)
        return self.effect(u) @ self.B.T + self._acting(bent)

    def _curved(self, u: FloatArray) -> FloatArray:
        return (1.0 - self.square) * u + self.square * u**2

    def _acting(self, v: FloatArray) -> FloatArray:
        count = max(0, len(v) - len(self.taps))
        return np.asarray(sum(h * v[len(self.taps) - 1 - d :][:count] for d, h in enumerate(self.taps)))


@dataclass(frozen=True, slots=True, eq=False)
class MotorUncertainty:
    """How well the flights, and the geometry if it was used, determine the motors' effects at their median commands."""

    hover: FloatArray  # those commands (s,)
    times_s: FloatArray  # delay, lag and filter (3,)
    B_error: FloatArray  # standard errors of the effects on body rates, in units of B (3, s)
    relative: FloatArray  # relative standard error of each motor's effect (s,), axes weighted by their information
    of_axes: FloatArray  # relative standard error of each axis' effects together (3,)
    drive: FloatArray  # rms error of the next body rates from the errors of all coefficients (3,)

    def told(self, fit: MultirotorFit, effects: FloatArray | None) -> NDArray[np.bool_]:
        """Return the axes about which these flights show the motors' effects, given the frame's effects if known (3,).

        If only the controller moves the motors, commands follow from motion, and the best fit is the controller's
        inverse: its effects have the wrong sign, or a damping that no vehicle has takes them back.
        """
        damped = -np.log(fit.a) * fit.rate_hz < _LIKELY * _FASTEST
        right = np.ones(3, np.bool_)
        if effects is not None:
            sizes = np.linalg.norm(effects, axis=1) * np.linalg.norm(fit.B[:3], axis=1)
            right = np.einsum("os,os->o", effects, fit.B[:3]) > _ALIKE * sizes
        return np.asarray((self.of_axes < _LARGEST_ERROR) & damped & right)


def identify_multirotor(
    segments: Sequence[Segment],
    rate_hz: float,
    effects: FloatArray | None = None,
    flights: Sequence[int] | None = None,
) -> tuple[MultirotorFit, MotorUncertainty]:
    """Fit the model of the module's docstring, and say how far to trust it.

    Each flight has offsets c of its own, of which the fit keeps the mean: another payload or propeller moves the mean
    commands, and taken for the motion's cause that would be the end of every effect.

    Parameters
    ----------
    segments : Sequence[Segment]
        Healthy flight on the grid; y in the order roll, pitch, yaw rate (rad/s) and, where it is there, vertical
        specific force (m/s^2).
    rate_hz : float
        Samples per second of the grid.
    effects : FloatArray | None
        Relative effect of each motor on roll, pitch and yaw by the frame's geometry (3, s), for axes that the flights
        do not tell: known by the usual size of such effects only. Zeros, or None for all: the flights tell them.
    flights : Sequence[int] | None
        Which flight each segment is of; None: all of one.

    Raises
    ------
    ModelError
        Too few samples.
    """
    numbers = [0] * len(segments) if flights is None else flights
    usable = [
        _Stretch.of(segment, number)
        for segment, number in zip(segments, numbers, strict=True)
        if segment.evidence.any()
    ]
    samples = sum(int(stretch.own.sum()) for stretch in usable)
    if samples < _LEAST_S * rate_hz:
        raise ModelError(
            f"only {samples / rate_hz:.0f} s of healthy flight in the logs; at least {_LEAST_S:.0f} s in the air are "
            "needed"
        )
    descent = _Descent(usable, rate_hz, np.zeros((3, len(usable[0].u))) if effects is None else effects)
    descent.start()
    descent.run()
    return descent.fitted()


@dataclass(frozen=True, slots=True, eq=False)
class _Stretch:
    """Rows from the first that is evidence."""

    u: FloatArray  # commands (s, N)
    y: FloatArray  # outputs (p, N)
    own: NDArray[np.bool_]  # which rows are evidence (N,)
    flight: int  # index of the flight

    @classmethod
    def of(cls, segment: Segment, flight: int) -> _Stretch:
        own = segment.evidence
        first, last = np.flatnonzero(own)[[0, -1]]
        rows = slice(int(first), int(last) + 1)
        return cls(np.ascontiguousarray(segment.u[rows].T), np.ascontiguousarray(segment.y[rows].T), own[rows], flight)


def control_directions(v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the mean of the motors' v (s,) and the directions (s, <= 4) in which an autopilot moves them."""
    mean = v.mean(axis=0)
    _, directions = np.linalg.eigh((v - mean).T @ (v - mean))
    return mean, directions[:, -_CONTROLS:]


class _Point(NamedTuple):
    """Results at a set of coefficients: cost, half its curvature, its negative gradient, by block, and the prior."""

    cost: float
    H: FloatArray
    gradient: FloatArray
    scores: FloatArray
    prior: FloatArray


class _Descent:
    """State of the least squares: coefficients of each axis and shared ones.

    Those of an axis are B_o (s), c_o / (1 - a_o) of each flight, and a_o. ``effects`` are the geometry's effects by
    axis, which are used instead of those of the flights; zeros for axes that the flights determine (3, s).
    """

    def __init__(self, stretches: Sequence[_Stretch], rate_hz: float, effects: FloatArray) -> None:
        self.stretches, self.rate_hz = stretches, rate_hz
        self.s = len(stretches[0].u)
        self.usual = effects * np.array(USUAL)[:, None] / (self.s * rate_hz)
        self.silent = self.usual.any(axis=1)
        u = np.hstack([stretch.u[:, stretch.own] for stretch in stretches])
        # Four controls drive any number of motors: other directions hold rounding only.
        self.moved = control_directions(u.T)[1] if self.s > _CONTROLS else None
        self.places = {flight: j for j, flight in enumerate(sorted({stretch.flight for stretch in stretches}))}
        self.width = self.s + len(self.places) + 1
        self.size = 3 * self.width + _SHARED
        self.shared = np.array([mean for mean, _ in _USUAL])
        slowest, fastest = (exp(-damping / rate_hz) for damping in (_SLOWEST, _FASTEST))
        axis = np.full(self.width - 1, np.inf)
        self.least = np.array([*[*-axis, fastest] * 3, -1.0 / rate_hz, *[0.0] * (_SHARED - 2), _LEAST_BEND])
        self.most = np.array([*[*axis, slowest] * 3, *_LONGEST_S, 1.0, 1.0])
        self.a = np.full(3, exp(-_START_DAMPINGS[1] / rate_hz))
        self.B = np.zeros((3, self.s))
        self.offset = np.zeros((3, len(self.places)))
        self.noise: list[Autoregression] = []

    def start(self) -> None:
        """Find the initial coefficients: the best of some timings, weighted with a regression's noise."""
        self.noise = [self._regressed(o) for o in range(3)]
        of_geometry = np.column_stack([self.usual, self.offset, self.a])
        best = np.inf
        for delay, lag in _STARTS:
            self.shared[:2] = delay, lag
            taps = lag_taps(self.shared[:3], self.rate_hz)
            delayed = [self._delayed(stretch, taps, 0) for stretch in self.stretches]  # drag begins as thrust
            tried = [self._solved(delayed, exp(-damping / self.rate_hz)) for damping in _START_DAMPINGS]
            axes = [
                (0.0, of_geometry[o]) if self.silent[o] else min((axes[o] for axes in tried), key=itemgetter(0))
                for o in range(3)
            ]
            cost = sum(axis[0] for axis in axes)
            if cost < best:
                best, start = cost, np.append(np.concatenate([axis[1] for axis in axes]), self.shared)
        self._place(start)

    def _solved(self, delayed: Sequence[FloatArray], a: float) -> dict[int, tuple[float, FloatArray]]:
        """Return the cost of each axis, and its least-squares coefficients with the regression's noise, at one a."""
        told = np.flatnonzero(~self.silent).tolist()
        grams = {o: np.zeros((self.width, self.width)) for o in told}
        for stretch, columns in zip(self.stretches, delayed, strict=True):
            x, own = self._followed(columns, a), self._counted(stretch)
            at = np.append(np.arange(self.s + 1), 1 + self.s + self.places[stretch.flight])
            for o in told:
                rest = stretch.y[o] - stretch.y[o, 0] * a ** np.arange(len(own))
                _, white = whitened(np.vstack([rest, x]), own, self.noise[o])
                grams[o][np.ix_(at, at)] += white @ white.T
        solved = {}
        for o, gram in grams.items():
            solution = np.linalg.lstsq(gram[1:, 1:], gram[1:, 0], rcond=None)[0]
            left = max(float(gram[0, 0] - gram[0, 1:] @ solution), np.finfo(np.float64).tiny)
            solved[o] = np.log(left), np.append(solution, a)
        return solved

    def run(self) -> None:
        """Descend to the least squares (Levenberg and Marquardt)."""
        self.point = self._linearise()
        base, damping = self._coefficients(), _DAMPING
        for _ in range(_STEPS):
            gradient = np.where(self._free(), self.point.gradient, 0.0)
            if damping > _STUCK or float(gradient @ self._inverse(self.point.H, self._free()) @ gradient) < _ENOUGH:
                break
            self._place(base + self._step(damping))
            there = self._linearise()
            gained = self.point.cost - there.cost
            if gained > 0.0:
                self.point, base, damping = there, self._coefficients(), damping / _EASED
                if gained < _ENOUGH:
                    break
            else:
                damping *= _EASED**2
        self._place(base)

    def fitted(self) -> tuple[MultirotorFit, MotorUncertainty]:
        """Return the identified model with its standard errors."""
        inverse, scores = self._inverse(self.point.H, self._free()), self.point.scores
        scores = scores[np.any(scores != 0.0, axis=1)]
        blocks = len(scores)
        covariance = inverse @ (scores.T @ scores * (blocks / (blocks - 1)) + self.point.prior) @ inverse
        taps = shortened(lag_taps(self.shared[:3], self.rate_hz))
        motors = np.hstack([stretch.u[:, stretch.own] for stretch in self.stretches])
        hover = np.median(motors, axis=1)
        thrust = self._curves(0)[0]
        slope = thrust.deriv()(hover)
        B, B_error, of_axes = self.B.copy(), np.empty((3, self.s)), np.empty(3)
        c, std, drive, bends = np.empty(3), np.empty(3), np.empty(3), np.zeros((len(self.stretches[0].y), self.s, 2))
        for o in range(3):
            own, *bent = self._curves(o)
            own_slope = own.deriv()(hover)
            B[o] *= own_slope / slope  # a fault is a change of v: what it does to each axis is exact at hover
            if len(bent) > 1:
                steeper = float(self.shared[4])
                bends[o] = np.outer(self.B[o], [1.0 - steeper, steeper]) - np.outer(B[o], [1.0, 0.0])
            part = self._places_of(o)[[*range(self.s), *range(-len(bent), 0)]]
            J = np.column_stack([np.diag(own_slope), *(self.B[o] * curve.deriv()(hover) for curve in bent)])
            errors = J @ covariance[np.ix_(part, part)] @ J.T
            effect = B[o] * slope
            B_error[o] = np.sqrt(np.diag(errors)) / slope
            of_axes[o] = np.sqrt(effect @ errors @ effect) / max(float(effect @ effect), 1e-300)
            c[o], std[o], drive[o] = self._equations(o, taps, covariance)
        weight = slope / std[:, None]
        relative = np.linalg.norm(weight * B_error, axis=0) / np.linalg.norm(weight * B, axis=0)
        if len(self.stretches[0].y) > len(RATE_AXES):
            b_z, c_z, std_z = self._vertical(taps)
            B, c, std = np.vstack([B, np.full(self.s, b_z)]), np.append(c, c_z), np.append(std, std_z)
        samples = sum(int(stretch.own.sum()) for stretch in self.stretches)
        return (
            MultirotorFit(self.rate_hz, self.a, B, c, taps, float(self.shared[3]), bends, std, samples),
            MotorUncertainty(hover, self.shared[:3], B_error, relative, of_axes, drive),
        )

    def _regressed(self, o: int) -> Autoregression:
        """Return the noise of an axis by a regression of its rate on past rates and commands (Ljung 10.1)."""
        taps = max(_CONTROLS, round(_REGRESSED_S * self.rate_hz))
        u = np.hstack([stretch.u[:, stretch.own] for stretch in self.stretches])
        mean, directions = control_directions(u.T)
        gram = np.zeros((_ORDER + taps * directions.shape[1] + 2,) * 2)
        for stretch in self.stretches:
            y, moved = stretch.y[o], directions.T @ (stretch.u - mean[:, None])
            rows = np.flatnonzero(stretch.own & (known_before(stretch.own) >= _ORDER))
            rows = rows[rows >= taps]
            past = [y[rows - j] for j in range(_ORDER + 1)]
            columns = np.vstack([*past, *(moved[:, rows - d] for d in range(1, taps + 1)), np.ones((1, len(rows)))])
            gram += columns @ columns.T
        scale = np.sqrt(np.maximum(np.diag(gram), np.finfo(np.float64).tiny))
        gram = gram / np.outer(scale, scale) + 1e-9 * np.eye(len(gram))
        theta = np.linalg.solve(gram[1:, 1:], gram[1:, 0]) * scale[0] / scale[1:]
        coefficients = tuple(theta[:m] for m in range(_ORDER + 1))
        return Autoregression(coefficients, np.ones(_ORDER + 1))

    def _curves(self, o: int) -> list[Polynomial]:
        """Return an axis' curve over the command, and its derivatives by its coefficients."""
        q, steeper = float(self.shared[3]), float(self.shared[4])
        v, by_q = Polynomial([0.0, 1.0 - q, q]), Polynomial([0.0, -1.0, 1.0])
        if len(_CURVES[o]) == 1:
            return [v, by_q]
        return [v + steeper * (v**2 - v), by_q * (1.0 - steeper + 2.0 * steeper * v), v**2 - v]

    def _delayed(self, stretch: _Stretch, taps: FloatArray, o: int) -> FloatArray:
        """Return the inputs of an axis: each motor's effect after lag and delay, and a constant (s + 1, N)."""
        return np.array([*_lagged(taps, self._curves(o)[0](stretch.u)), np.ones(len(stretch.own))])

    def _followed(self, driven: FloatArray, a: float) -> FloatArray:
        """Return the response of an axis to its inputs (c, N), whose constant has a response that settles at one."""
        x = followed(driven[:, :-1], a)
        x[self.s] *= 1.0 - a
        return x

    def _counted(self, stretch: _Stretch) -> NDArray[np.bool_]:
        """Return which rows of a stretch count (N,)."""
        own = stretch.own.copy()
        own[: round(_UNKNOWN_S * self.rate_hz)] = False
        return own

    def _columns(
        self, o: int, taps: FloatArray, moved: Sequence[FloatArray]
    ) -> Iterator[tuple[FloatArray, NDArray[np.bool_]]]:
        """Yield by stretch an axis' residual, the derivatives of x by its coefficients (c, N), and the rows that count.

        ``moved`` are the derivatives of the taps.
        """
        a = float(self.a[o])
        for stretch in self.stretches:
            u, y = stretch.u, stretch.y[o]
            effect, *bent = (self.B[o] @ curve(u) for curve in self._curves(o))
            slopes = [*(_lagged(h, effect) for h in moved), *(_lagged(taps, part) for part in bent)]
            x = self._followed(np.vstack([self._delayed(stretch, taps, o), *slopes]), a)
            offset = self.offset[o, self.places[stretch.flight]]
            simulated = self.B[o] @ x[: self.s] + offset * x[self.s] + y[0] * a ** np.arange(len(y))
            by_a = followed((simulated - offset)[:-1], a)
            yield np.vstack([y - simulated, x[: self.s + 1], by_a, x[self.s + 1 :]]), self._counted(stretch)

    def _moved_taps(self, length: int) -> list[FloatArray]:
        """Return the derivatives of the taps with respect to delay, lag and filter."""
        derivatives = []
        for j in range(3):
            size = _SLOPE * max(abs(float(self.shared[j])), 0.1 / self.rate_hz)
            up, down = self.shared[:3].copy(), self.shared[:3].copy()
            up[j] += size
            down[j] = max(self.least[j], down[j] - size)
            ends = (lag_taps(times, self.rate_hz, length) for times in (up, down))
            derivatives.append(np.subtract(*ends) / (up[j] - down[j]))
        return derivatives

    def _linearise(self) -> _Point:
        """Return cost and slopes at the coefficients, with the noise of their residuals."""
        prior, pull, cost = self._expected()
        H, gradient = prior.copy(), -pull
        blocks = np.cumsum([0, *(ceil(len(stretch.own) / (_BLOCK_S * self.rate_hz)) for stretch in self.stretches)])
        scores = np.zeros((blocks[-1], self.size))
        taps = lag_taps(self.shared[:3], self.rate_hz)
        moved = self._moved_taps(len(taps))
        for o in np.flatnonzero(~self.silent).tolist():
            parts = list(self._columns(o, taps, moved))
            mean = sum(columns[0, own].sum() for columns, own in parts) / sum(own.sum() for _, own in parts)
            noise = autoregression([columns[0] - mean for columns, _ in parts], [own for _, own in parts], _ORDER)
            part = self._places_of(o)
            inner, order = len(part) + 1, len(noise.variances) - 1
            gram, count = np.zeros((inner + order,) * 2), 0
            of_axis = np.zeros((blocks[-1], inner + order))
            for stretch, (columns, own), first in zip(self.stretches, parts, blocks, strict=False):
                rows, white = whitened(columns, own, noise)
                white = np.vstack([white, past_errors(columns[0] - mean, own, rows, order)])
                flight = 1 + self.s + self.places[stretch.flight]
                at = np.r_[: self.s + 1, flight, self.width : inner + order]
                gram[np.ix_(at, at)] += white @ white.T
                count += len(rows)
                edges = np.searchsorted(rows, np.arange(0, len(own), _BLOCK_S * self.rate_hz))
                filled = np.flatnonzero(np.diff(np.append(edges, len(rows))))
                if len(filled):
                    of_axis[np.ix_(first + filled, at)] += np.add.reduceat(white * white[0], edges[filled], axis=1).T
            # in a closed loop commands know past errors: the part that the noise's coefficients explain carries no
            # information
            share = np.linalg.lstsq(gram[inner:, inner:], gram[inner:, :inner], rcond=None)[0]
            rest = gram[:inner, :inner] - gram[:inner, inner:] @ share
            variance = rest[0, 0] / max(count, 1)
            H[np.ix_(part, part)] += rest[1:, 1:] / variance
            gradient[part] += rest[1:, 0] / variance
            scores[:, part] += (of_axis[:, 1:inner] - of_axis[:, inner:] @ share[:, 1:]) / variance
            cost += 0.5 * count * np.log(variance)
        return _Point(cost, H, gradient, scores, prior)

    def _places_of(self, o: int) -> NDArray[np.intp]:
        """Return which coefficients an axis has: effects, offsets, damping, three times and its curve."""
        shared = self.size - _SHARED
        axis, times = range(o * self.width, (o + 1) * self.width), range(shared, shared + 3)
        return np.array([*axis, *times, *(shared + j for j in _CURVES[o])])

    def _expected(self) -> tuple[FloatArray, FloatArray, float]:
        """Return the information in the expectations of times, curves and geometry, its gradient, and its cost."""
        information = np.zeros((self.size, self.size))
        away = self._coefficients()
        away[-_SHARED:] -= [mean for mean, _ in _USUAL]
        np.fill_diagonal(information[-_SHARED:, -_SHARED:], [width**-2 for _, width in _USUAL])
        for o, usual in enumerate(self.usual):
            part = slice(o * self.width, o * self.width + self.s)
            if self.silent[o]:
                along = np.outer(usual, usual) / float(usual @ usual)
                across = np.eye(self.s) - along
                information[part, part] = (along + across * self.s / _WIDTH**2) / float(usual @ usual)
                away[part] -= usual
            elif self.moved is not None:
                size = max(float(np.linalg.norm(self.moved.T @ self.B[o])), np.finfo(np.float64).tiny)
                across = np.eye(self.s) - self.moved @ self.moved.T
                information[part, part] = across * self.s / (_WIDTH * size) ** 2
        pull = information @ away
        return information, pull, 0.5 * float(away @ pull)

    def _free(self) -> NDArray[np.bool_]:
        """Return the coefficients that the slope does not hold at their bounds."""
        at, fall = self._coefficients(), self.point.gradient
        return ~(((at <= self.least) & (fall < 0.0)) | ((at >= self.most) & (fall > 0.0)))

    def _step(self, damping: float) -> FloatArray:
        """Return the step to the least squares of the linear model.

        Coefficients that would leave their bounds end at them.
        """
        H = self.point.H + damping * np.diag(np.diag(self.point.H))
        at, step, free = self._coefficients(), np.zeros(self.size), self._free()
        while True:
            held = np.where(free, 0.0, step)
            step = held + self._inverse(H, free) @ (self.point.gradient - H @ held)
            inside = np.clip(at + step, self.least, self.most)
            outside = free & (inside != at + step)
            if not outside.any():
                return step
            step[outside] = (inside - at)[outside]
            free &= ~outside

    def _inverse(self, H: FloatArray, free: NDArray[np.bool_]) -> FloatArray:
        """Return the inverse of H among some coefficients, zero for the others."""
        scale = np.where(free, 1.0 / np.sqrt(np.maximum(np.diag(H), np.finfo(np.float64).tiny)), 0.0)
        inverse = np.linalg.pinv(H * np.outer(scale, scale), rcond=1e-12, hermitian=True)
        return np.asarray(inverse * np.outer(scale, scale))

    def _coefficients(self) -> FloatArray:
        axes = np.column_stack([self.B, self.offset, self.a])  # (3, width)
        return np.append(axes.ravel(), self.shared)

    def _place(self, coefficients: FloatArray) -> None:
        coefficients = np.clip(coefficients, self.least, self.most)
        axes = coefficients[:-_SHARED].reshape(3, self.width)
        self.B, self.offset, self.a = axes[:, : self.s].copy(), axes[:, self.s : -1].copy(), axes[:, -1].copy()
        self.shared = coefficients[-_SHARED:].copy()

    def _equations(self, o: int, taps: FloatArray, covariance: FloatArray) -> tuple[float, float, float]:
        """Return the offset of an axis' equation, the deviation of its error, and what the coefficients' drive."""
        moved, part = self._moved_taps(len(taps)), np.delete(self._places_of(o), np.s_[self.s : self.width - 1])
        errors, regressors = [], []
        for stretch in self.stretches:
            u, y = stretch.u, stretch.y[o]
            v, *bent = (curve(u) for curve in self._curves(o))
            rows = np.flatnonzero(stretch.own[:-1] & stretch.own[1:])
            rows = rows[rows >= len(taps)]
            effect = self.B[o] @ v
            moves = (_lagged(h, effect) for h in moved)
            columns = [*_lagged(taps, v), y, *moves, *(_lagged(taps, self.B[o] @ part) for part in bent)]
            errors.append(y[rows + 1] - self.a[o] * y[rows] - _lagged(taps, effect)[rows])
            regressors.append(np.array(columns)[:, rows])
        c = float(np.concatenate(errors).mean())
        for flight in self.places:  # each flight has its own offset
            at = [j for j, stretch in enumerate(self.stretches) if stretch.flight == flight]
            away = np.concatenate([errors[j] for j in at]).mean() - c
            errors = [error - away if j in at else error for j, error in enumerate(errors)]
        e, X = np.concatenate(errors), np.hstack(regressors)
        X = X - X.mean(axis=1, keepdims=True)
        of_blocks = [
            b for series in errors for b in np.array_split(series, ceil(len(series) / (_GUST_S * self.rate_hz)) or 1)
        ]
        of_mean = float(np.linalg.norm([(block - c).sum() for block in of_blocks])) / len(e)
        of_others = float(np.trace(covariance[np.ix_(part, part)] @ (X @ X.T))) / len(e)
        return c, float(e.std()), float(np.hypot(of_mean, np.sqrt(max(of_others, 0.0))))

    def _vertical(self, taps: FloatArray) -> tuple[float, float, float]:
        """Return b_z, a zero offset, and the standard deviation of the vertical specific force."""
        thrust, force, driven = self._curves(0)[0], [], []
        for stretch in self.stretches:
            total = _lagged(taps, thrust(stretch.u).sum(axis=0))
            rows = np.flatnonzero(stretch.own[:-1] & stretch.own[1:])
            force.append(stretch.y[3, rows + 1])
            driven.append(total[rows])
        y, v = np.concatenate(force), np.concatenate(driven)
        b_z = float(y.mean() / v.mean())
        return b_z, 0.0, float((y - b_z * v).std())


def _lagged(taps: FloatArray, v: FloatArray) -> FloatArray:
    """Return sum_d h_d v(k-d) along the last axis, v being constant before its start."""
    first = v[..., :1]
    return np.asarray(finite_response(taps, v - first) + first * taps.sum())


_FAULT_RATE = 0.5
"""Rate at which a loss may develop, units of full command per second: it sets the bandwidth."""


def turning_alike(B: FloatArray) -> list[list[int]]:
    """Return groups of motors by their effects B (3, s) on body rates: motors with parallel effects share a group.

    Two motors on one arm that turn in the same sense have parallel effects: whichever loses thrust, the vehicle moves
    the same.
    """
    shares = B / np.maximum(np.abs(B).max(axis=1, keepdims=True), np.finfo(np.float64).tiny)
    directions = (shares / np.linalg.norm(shares, axis=0)).T
    groups: list[list[int]] = []
    for i, direction in enumerate(directions):
        same = (group for group in groups if np.linalg.norm(direction - directions[group[0]]) < _PARALLEL)
        if (group := next(same, None)) is None:
            groups.append([i])
        else:
            group.append(i)
    return groups


def multirotor_plant(
    fit: MultirotorFit,
    name: str,
    motors: Sequence[str],
    doubt: Sequence[float] | NDArray[np.float64] = (0.0, 0.0, 0.0),
    gyros: bool = True,
    unit: str = "fraction of full command",
) -> Plant:
    """Return the fitted model as a plant with one sensor fault per gyro axis and one actuator fault per motor.

    Motors that are not told apart have one together, named after all of them.

    Process disturbance and measurement noise are both scaled by the one-step prediction error, so that the
    design trusts the model and each sensor as far as the flights allow. What uncertain coefficients do is added to the
    disturbance, not to its square: through a manoeuvre it keeps its sign.

    Parameters
    ----------
    fit : MultirotorFit
        The fitted model.
    name : str
        Name of the plant.
    motors : Sequence[str]
        Channel names of the motors (s,).
    doubt : Sequence[float]
        What the uncertainty of the coefficients puts into the next body rates (3,), rad/s.
    gyros : bool
        Whether faults of the gyros are told from those of motors; over ticks of seconds they are not.
    unit : str
        Unit of the motors' inputs.
    """
    n, s = fit.B.shape
    states = (*RATE_AXES, VERTICAL)[:n]
    identity = np.eye(n)
    return Plant(
        name=name,
        domain="discrete",
        rate_hz=fit.rate_hz,
        states=states,
        inputs=tuple(motors),
        outputs=states,
        A=np.diag(np.append(fit.a, 0.0)[:n]),
        B=fit.B,
        c=fit.c,
        C=identity,
        faults=tuple(
            Fault(
                name="_or_".join(motors[i] for i in alike),
                kind="actuator",
                column=fit.B[:, alike[0]],
                rate=_FAULT_RATE,
                error=0.01,
                unit=unit,
                input=motors[alike[0]],
            )
            for alike in turning_alike(fit.B[:3])
        )
        + tuple(
            Fault(name=gyro, kind="sensor", column=identity[:, o], error=float(fit.residual_std[o]), unit="rad/s")
            for o, gyro in enumerate(GYROS if gyros else ())
        ),
        disturbances=on_each(Disturbance, states, fit.residual_std + np.append(doubt, 0.0)[:n]),
        noises=on_each(Noise, states, fit.residual_std),
        state_errors=fit.residual_std,
        taps=tuple(float(h) for h in fit.taps),
        curves=((1.0 - fit.square, fit.square),) * s,
        bends=fit.bends,
    )
