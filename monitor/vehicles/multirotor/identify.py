"""Identify a multirotor from healthy flights: motor commands to body rates and vertical specific force.

The model, in the symbols of the theory (k counts samples, d delays, i motors, o axes):

    v_i(k)   = sum_d h_d (u_i(k-d) + kappa u_i(k-d)^2)                      motor lag, transport delay, thrust curve
    y_o(k+1) = a_o y_o(k) + sum_i B_oi v_i(k) + c_o                         roll, pitch and yaw rate
    y_z(k+1) = b_z sum_i v_i(k)                                             vertical specific force

No frame type is asked: B is learned. The thrust curve is seen in the body rates, whose response to the same step
of a command grows with the throttle. Vertical force is NOT regressed on the commands: the altitude controller
answers gusts through the accelerometer, so that regression finds the controller's inverse, not the vehicle.
Thrust is zero at zero command, hence b_z follows from the two means alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adapters.errors import ModelError
from gains.identification.segment import Segment
from gains.plants.plant import Disturbance, Fault, Noise, Plant

RATE_AXES = ("roll_rate", "pitch_rate", "yaw_rate")
VERTICAL = "vertical_acceleration"
GYROS = ("gyro_x", "gyro_y", "gyro_z")

_MAX_DELAY_S = 0.1
"""Longest lag and delay of motors and link to look for, seconds. Chosen: rotors that are slower fly no multirotor."""
_EXCITED_T = 20.0
"""Standard errors that an axis' largest coefficient has to be from zero: it is then known within 5 %."""
_SWEEPS = 12
"""Alternations between effects, taps and curve. Measured on two flights: twelve are within 5e-8 of twenty-four, eight
within 2e-5."""
_CONTROLS = 4
"""Thrust, roll, pitch and yaw."""


@dataclass(frozen=True, slots=True)
class MultirotorFit:
    """What the flights say about the vehicle.

    Parameters
    ----------
    rate_hz : float
        Samples per second of the model.
    a : NDArray[np.float64]
        Rate coefficients a_o per step (3,).
    B : NDArray[np.float64]
        Effect of each motor's v on the outputs per step (4, s); (3, s) without vertical specific force.
    c : NDArray[np.float64]
        Constant offsets per step (4,) or (3,).
    taps : NDArray[np.float64]
        Motor lag and delay h (L,), sum 1.
    kappa : float
        Curvature of thrust over command.
    residual_std : NDArray[np.float64]
        One-step prediction error (4,) or (3,), in the units of y.
    explained : NDArray[np.float64]
        Share of the variance of the one-step change of each body rate that the model explains (3,).
    t_value : NDArray[np.float64]
        Largest coefficient of each body rate over its standard error (3,): how well the axis was excited.
    samples : int
        Number of one-step equations used.
    """

    rate_hz: float
    a: NDArray[np.float64]
    B: NDArray[np.float64]
    c: NDArray[np.float64]
    taps: NDArray[np.float64]
    kappa: float
    residual_std: NDArray[np.float64]
    explained: NDArray[np.float64]
    t_value: NDArray[np.float64]
    samples: int


@dataclass(frozen=True, slots=True)
class _Regression:
    """One-step equations of all segments: u and u^2 at each delay, y now and y next."""

    u: list[NDArray[np.float64]]
    u2: list[NDArray[np.float64]]
    now: NDArray[np.float64]
    after: NDArray[np.float64]


def identify_multirotor(
    segments: Sequence[Segment], rate_hz: float, taps: int | None = None, flights: Sequence[int] | None = None
) -> MultirotorFit:
    """Fit the model of the module's docstring by alternating least squares.

    Each flight has offsets c of its own, of which the fit keeps the mean: another payload or propeller moves the mean
    commands, and taken for the motion's cause that would be the end of every effect.

    Parameters
    ----------
    segments : Sequence[Segment]
        Healthy flight on the grid; y in the order roll, pitch, yaw rate (rad/s), vertical specific force (m/s^2).
    rate_hz : float
        Samples per second of the grid.
    taps : int | None
        Number of taps; None takes the fewest that are as good as the longest delay's.
    flights : Sequence[int] | None
        Which flight each segment is of; None: all of one.

    Raises
    ------
    ModelError
        Too few samples, fewer motors than axes to tell apart, or an axis that was not excited.
    """
    longest = max(2, round(_MAX_DELAY_S * rate_hz))
    numbers = [0] * len(segments) if flights is None else flights
    usable = [segment for segment in segments if len(segment.u) > longest + 2]
    of = [number for number, segment in zip(numbers, segments, strict=True) if len(segment.u) > longest + 2]
    samples = sum(len(segment.u) - longest - 1 for segment in usable)
    if not usable or samples < 20 * rate_hz:
        raise ModelError(
            f"only {samples / rate_hz:.0f} s of healthy flight in the logs; at least 20 s in the air are needed"
        )
    best = _alternate(_regression(usable, of, taps or longest, skip=longest))
    for length in range(1, longest if taps is None else 0):
        shorter = _alternate(_regression(usable, of, length, skip=longest))
        if np.all(shorter.std <= 1.01 * best.std):
            best = shorter
            break
    _check_excitation(best.t_value, best.explained)
    v_mean = float(np.mean(np.vstack([s.u + best.kappa * s.u**2 for s in usable]).sum(axis=1)))
    vertical = np.concatenate([s.y[:, 3] for s in usable])
    b_z = float(vertical.mean()) / v_mean
    motors = usable[0].u.shape[1]
    B = np.vstack([best.theta[:, 1:-1], np.full(motors, b_z)])
    return MultirotorFit(
        rate_hz=rate_hz,
        a=best.theta[:, 0],
        B=B,
        c=np.append(best.theta[:, -1], 0.0),
        taps=best.taps,
        kappa=best.kappa,
        residual_std=np.append(best.std, _vertical_residual(usable, best, b_z)),
        explained=best.explained,
        t_value=best.t_value,
        samples=samples,
    )


def multirotor_plant(
    fit: MultirotorFit,
    name: str,
    motors: Sequence[str],
    fault_rate: float = 0.5,
    doubt: Sequence[float] | NDArray[np.float64] = (0.0, 0.0, 0.0),
    gyros: bool = True,
) -> Plant:
    """Return the fitted model as a plant with one actuator fault per motor and one sensor fault per gyro axis.

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
    fault_rate : float
        How fast a loss may develop, in units of full command per second: the bandwidth knob.
    doubt : Sequence[float]
        What the uncertainty of the coefficients puts into the next body rates (3,), rad/s.
    gyros : bool
        Whether faults of the gyros are told from those of motors; over ticks of seconds they are not.
    """
    n, s = fit.B.shape
    states = (*RATE_AXES, VERTICAL)[:n]
    identity = np.eye(n)
    disturbed = fit.residual_std + np.append(doubt, 0.0)[:n]
    full = 1.0 + fit.kappa
    curve = np.array([1.0, fit.kappa]) / full
    return Plant(
        name=name,
        domain="discrete",
        rate_hz=fit.rate_hz,
        states=states,
        inputs=tuple(motors),
        outputs=states,
        A=np.diag(np.append(fit.a, 0.0)[:n]),
        B=fit.B * full,
        c=fit.c,
        C=identity,
        G=np.zeros((n, 0)),
        nonlinearities=(),
        faults=tuple(
            Fault(
                name=motor,
                kind="actuator",
                column=fit.B[:, i] * full,
                rate=fault_rate,
                error=0.01,
                unit="fraction of full command",
                input=motor,
            )
            for i, motor in enumerate(motors)
        )
        + tuple(
            Fault(name=gyro, kind="sensor", column=identity[:, o], error=float(fit.residual_std[o]), unit="rad/s")
            for o, gyro in enumerate(GYROS if gyros else ())
        ),
        disturbances=tuple(
            Disturbance(name=f"disturbance_{state}", column=identity[:, o], scale=float(disturbed[o]))
            for o, state in enumerate(states)
        ),
        noises=tuple(
            Noise(name=f"noise_{state}", column=identity[:, o], scale=float(fit.residual_std[o]))
            for o, state in enumerate(states)
        ),
        state_errors=fit.residual_std,
        taps=tuple(float(h) for h in fit.taps),
        curves=tuple(tuple(float(x) for x in curve) for _ in range(s)),
    )


@dataclass(frozen=True, slots=True)
class _Alternation:
    """Result of the alternating least squares for one length of the taps."""

    theta: NDArray[np.float64]
    taps: NDArray[np.float64]
    kappa: float
    std: NDArray[np.float64]
    explained: NDArray[np.float64]
    t_value: NDArray[np.float64]


def _regression(segments: Sequence[Segment], flights: Sequence[int], length: int, skip: int) -> _Regression:
    u = [np.vstack([s.u[skip - d : len(s.u) - 1 - d] for s in segments]) for d in range(length)]
    flight = np.repeat(flights, [len(s.u) - skip - 1 for s in segments])

    def within(values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Take each flight's mean away, and the mean of all instead: offsets of flights no longer matter."""
        if len(set(flights)) == 1:
            return values
        centred = values.copy()
        for number in set(flights):
            centred[flight == number] -= values[flight == number].mean(axis=0)
        return np.asarray(centred + values.mean(axis=0))

    return _Regression(
        u=[within(block) for block in u],
        u2=[within(block**2) for block in u],
        now=within(np.vstack([s.y[skip:-1, :3] for s in segments])),
        after=within(np.vstack([s.y[skip + 1 :, :3] for s in segments])),
    )


def _alternate(data: _Regression) -> _Alternation:
    length = len(data.u)
    taps = np.full(length, 1.0 / length)
    kappa = 0.0
    ones = np.ones((len(data.now), 1))
    for _ in range(_SWEEPS):
        v = [u + kappa * u2 for u, u2 in zip(data.u, data.u2, strict=True)]
        filtered = _mix(taps, v)
        theta, std, t_value = _axes(data, filtered, ones)
        gram, moment = np.zeros((length, length)), np.zeros(length)
        for o in range(3):
            effect = np.stack([block @ theta[o, 1:-1] for block in v], axis=1) / std[o]
            target = (data.after[:, o] - theta[o, 0] * data.now[:, o] - theta[o, -1]) / std[o]
            gram += effect.T @ effect
            moment += effect.T @ target
        taps = np.linalg.lstsq(gram, moment, rcond=None)[0]
        taps = taps / taps.sum()
        kappa = max(0.0, kappa + _curvature_step(data, theta, std, _mix(taps, v), _mix(taps, data.u2), ones))
    filtered = _mix(taps, [u + kappa * u2 for u, u2 in zip(data.u, data.u2, strict=True)])
    theta, std, t_value = _axes(data, filtered, ones)
    change = (data.after - data.now).std(axis=0)
    return _Alternation(theta, taps, kappa, std, 1.0 - (std / change) ** 2, t_value)


def _axes(
    data: _Regression, filtered: NDArray[np.float64], ones: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    mean, V = control_directions(filtered)
    z = (filtered - mean) @ V
    theta = np.empty((3, filtered.shape[1] + 2))
    std, t_value = np.empty(3), np.empty(3)
    for o in range(3):
        X = np.hstack([data.now[:, [o]], z, ones])
        found = np.linalg.lstsq(X, data.after[:, o], rcond=None)[0]
        std[o] = (data.after[:, o] - X @ found).std()
        spread = np.sqrt(np.diag(np.linalg.pinv(X.T @ X)))[1:-1]
        t_value[o] = float(np.max(np.abs(found[1:-1]) / np.maximum(std[o] * spread, 1e-300)))
        effect = V @ found[1:-1]
        theta[o] = np.concatenate([found[:1], effect, found[-1:] - mean @ effect])
    return theta, std, t_value


def control_directions(v: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the mean of the motors' v (s,) and the directions (s, <= 4) in which an autopilot moves them.

    Four controls drive any number of motors, so what more than four motors do is known in four directions only;
    the others hold rounding. Along them B is taken to be zero: that is the vehicle's own B where its mixer and its
    geometry agree, as those of a symmetric frame do.
    """
    mean = v.mean(axis=0)
    _, directions = np.linalg.eigh((v - mean).T @ (v - mean))
    return mean, directions[:, -_CONTROLS:]


def _curvature_step(
    data: _Regression,
    theta: NDArray[np.float64],
    std: NDArray[np.float64],
    filtered: NDArray[np.float64],
    squared: NDArray[np.float64],
    ones: NDArray[np.float64],
) -> float:
    """Return the change of kappa that roll and pitch ask for, each weighted by how well it sees the curve."""
    numerator = denominator = 0.0
    mean, V = control_directions(filtered)
    for o in range(2):
        sensitivity = squared @ theta[o, 1:-1]
        X = np.hstack([data.now[:, [o]], (filtered - mean) @ V, ones, sensitivity[:, None]])
        step = np.linalg.lstsq(X, data.after[:, o], rcond=None)[0][-1]
        weight = float(sensitivity.var() / std[o] ** 2)
        numerator += weight * float(step)
        denominator += weight
    return numerator / denominator if denominator > 0 else 0.0


def _mix(taps: NDArray[np.float64], blocks: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    mixed: NDArray[np.float64] = sum(
        (h * block for h, block in zip(taps, blocks, strict=True)), start=np.zeros_like(blocks[0])
    )
    return mixed


def _check_excitation(t_value: NDArray[np.float64], explained: NDArray[np.float64]) -> None:
    for axis, t, share in zip(("roll", "pitch", "yaw"), t_value, explained, strict=True):
        if t < _EXCITED_T or share < 0.2:
            raise ModelError(
                f"the {axis} axis was not excited enough to learn it (t = {t:.0f}, {100 * share:.0f} % explained): "
                f"add a healthy flight with brisk {axis} manoeuvres"
            )


def _vertical_residual(segments: Sequence[Segment], best: _Alternation, b_z: float) -> float:
    length = len(best.taps)
    errors = []
    for s in segments:
        v = s.u + best.kappa * s.u**2
        filtered = _mix(best.taps, [v[length - d : len(v) - 1 - d] for d in range(length)])
        errors.append(s.y[length + 1 :, 3] - b_z * filtered.sum(axis=1))
    return float(np.concatenate(errors).std())
