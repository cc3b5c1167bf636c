"""The arm's controller: feedforward and state feedback, and faults taken back out, within limits.

    u = u_ref - K [x_m - x_ref; u' - u_ref'; e] - c_a,      x_m = [y_1 - c_s, y_2, q^, y_3 - q^]

x = [motor angle, motor rate, link angle, link rate]; y = [motor angle, motor rate, link angle plus link rate].
The link angle follows from q' = y_3 - q, a low-pass that forgets a wrong start within seconds and that no fault
of the encoder reaches. u' is the command before, c_a and c_s what the monitor says of actuator and encoder, as far
as :class:`Compensation` believes it, e the integral of the link's error where the controller has one.

Nothing here comes from fauio: what the monitor publishes is JSON.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_discrete_are

Reference = Callable[[float], tuple[tuple[float, ...], float]]
"""Time in seconds -> states to follow (4,) and the torque that does it without faults and disturbances."""

LINK = 2
"""Which state is the link angle."""


@dataclass(frozen=True, slots=True)
class Limits:
    """What a controller takes back out at most, whatever the monitor says.

    Parameters
    ----------
    size : float
        Largest compensation, in the fault's unit: no more than the loop survives if it is wrong.
    rate : float
        Its largest change, units per second.
    sd : float
        Estimates whose standard deviation is larger are not used.
    """

    size: float
    rate: float
    sd: float


@dataclass(slots=True)
class Compensation:
    """What is taken back out for one fault channel.

    An estimate is used while the monitor's observer is armed (settled, measured, not coasting over lost samples), not
    older than ``oldest_s`` on the vehicle's clock, finite, and as certain as ``limits.sd`` asks. Otherwise the
    compensation goes to zero, no faster than its largest rate.

    Parameters
    ----------
    channel : str
        Fault channel in the monitor's estimates.
    limits : Limits
        What it may do.
    oldest_s : float
        Largest age of an estimate.
    """

    channel: str
    limits: Limits
    oldest_s: float = 0.1
    value: float = field(default=0.0, init=False)

    def update(self, estimate: Mapping[str, Any] | None, now_s: float, period_s: float) -> float:
        """Take the newest estimate there is, None for none, and return the compensation."""
        wanted = self._wanted(estimate, now_s)
        wanted = max(-self.limits.size, min(self.limits.size, wanted))
        step = self.limits.rate * period_s
        self.value += max(-step, min(step, wanted - self.value))
        return self.value

    def _wanted(self, estimate: Mapping[str, Any] | None, now_s: float) -> float:
        if estimate is None or not estimate["armed"] or estimate["coasted_s"]:
            return 0.0
        if now_s - estimate["vehicle_time_ms"] / 1000.0 > self.oldest_s:
            return 0.0
        size, sd = estimate["fault"][self.channel], estimate["sd"][self.channel]
        if size is None or sd is None or not math.isfinite(size) or sd > self.limits.sd:
            return 0.0
        return float(size)


@dataclass(slots=True)
class Controller:
    """State of the controller, one step per sample.

    Parameters
    ----------
    gain : NDArray[np.float64]
        K (5,) or, with integral action, (6,); see :func:`feedback_gain`.
    reference : Reference
        What to follow.
    period_s : float
        Time between samples.
    actuator, sensor : Compensation | None
        Takes the fault out of the command, or of the encoder's reading; None leaves it in.
    """

    gain: NDArray[np.float64]
    reference: Reference
    period_s: float
    actuator: Compensation | None = None
    sensor: Compensation | None = None
    _link: float | None = field(default=None, init=False)
    _last_sum: float = field(default=0.0, init=False)
    _integral: float = field(default=0.0, init=False)
    _own: float | None = field(default=None, init=False)

    def step(self, now_s: float, y: NDArray[np.float64], estimate: Mapping[str, Any] | None) -> float:
        """Return the torque to apply one period after the measurement y (3,) of ``now_s``."""
        wanted, torque = self.reference(now_s)
        _, next_torque = self.reference(now_s + self.period_s)
        angle = float(y[0])
        if self.sensor is not None:
            angle -= self.sensor.update(estimate, now_s, self.period_s)
        link = self._follow_link(float(y[2]), wanted[LINK])
        error = np.array([angle, y[1], link, y[2] - link]) - wanted
        own = torque if self._own is None else self._own
        self._integral += float(error[LINK]) * self.period_s
        feedback = np.array([*error, own - torque, self._integral])[: len(self.gain)]
        self._own = next_torque - float(self.gain @ feedback)
        if self.actuator is None:
            return self._own
        return self._own - self.actuator.update(estimate, now_s, self.period_s)

    def _follow_link(self, link_sum: float, start: float) -> float:
        """Return q of q' = y_3 - q, with y_3 linear between its samples."""
        if self._link is None:
            self._link = start
        else:
            h = self.period_s
            mean = 0.5 * (self._last_sum + link_sum)
            self._link += (mean - self._link) * h / (1.0 + 0.5 * h)
        self._last_sum = link_sum
        return self._link


def feedback_gain(
    A: NDArray[np.float64], B: NDArray[np.float64], period_s: float, *, integral: bool = False
) -> NDArray[np.float64]:
    """Return the linear-quadratic gain K for the arm that hangs, A (4, 4) and B (4, 1) in continuous time.

    The command follows from a measurement one period later; the command before is therefore a state.
    """
    held = expm(np.block([[A, B], [np.zeros((1, 5))]]) * period_s)
    F = np.zeros((6, 6))
    F[:4, :5] = held[:4]
    F[5, LINK], F[5, 5] = period_s, 1.0
    G = np.zeros((6, 1))
    G[4, 0] = 1.0
    Q = np.diag([1.0, 0.0, 100.0, 1.0, 0.0, 100.0])
    n = 6 if integral else 5
    F, G, Q = F[:n, :n], G[:n], Q[:n, :n]
    R = np.array([[1.0]])
    P = solve_discrete_are(F, G, Q, R)
    gain: NDArray[np.float64] = np.linalg.solve(R + G.T @ P @ G, G.T @ P @ F)[0]
    return gain
