"""The reference plant: a single-link flexible-joint arm, simulated with faults whose exact course is known.

    x' = A x + B (u + f_a) + G sin(x_3) + E_1 w_1
    y  = C x + D_f f_s + D_1 w_2

x = [motor angle, motor rate, link angle, link rate] in rad and rad/s; matrices, faults and disturbances are
those of the paper's section "Validating the observer performance" (there E_f = B). The torque u is held
between samples, as a digital controller does; f_a and w are functions of continuous time.

Integration is the classical Runge-Kutta method of order 4 in steps of at most 0.5 ms that end where f_a
jumps, so no step sees a discontinuity. Checked against DOP853 at a relative tolerance of 3e-14: one sample at
100 Hz adds less than 1e-12 to the states, and after 50 s they agree within 2e-10 rad in every scenario but
case 3, where the link passes its upper equilibrium and errors grow to 2e-9.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from adapters.errors import UsageError

ArmSignal = Callable[[float], float]
ArmState = tuple[float, float, float, float]
ArmFaultChannel = Literal["f_a", "f_s"]
ArmFaultKind = Literal["step", "ramp", "sine"]
Torque = Literal["zero", "tracking"]

FAULT_CHANNELS: tuple[ArmFaultChannel, ...] = ("f_a", "f_s")
FAULT_KINDS: tuple[ArmFaultKind, ...] = ("step", "ramp", "sine")
TORQUES: tuple[Torque, ...] = ("zero", "tracking")

DURATION_S = 50.0
"""Duration of a run, seconds: the paper's, whose errors are averaged over 50 s."""
SINE_HZ = 0.5
"""Default frequency of a sine that users request, Hz: a turn in 2 s. The paper's own turn at .5 and 5 rad/s."""
MAX_STEP_S = 5e-4
"""Longest step of the Runge-Kutta method of fourth order, seconds: each sample is then exact to 1e-9, which a test
holds."""

# Joint stiffness over motor and over link inertia, motor damping, torque constant, gravity over link inertia.
_STIFF_MOTOR, _STIFF_LINK, _DAMPING, _TORQUE, _GRAVITY = 48.6, 19.5, 1.25, 21.6, 3.33
# Link swing that the tracking torque asks for: amplitude in rad and angular frequency in rad/s.
_SWING, _SWING_RATE = 0.5, 0.5


@dataclass(frozen=True, slots=True)
class ArmFault:
    """A fault on one channel during [start_s, stop_s)."""

    # actuator fault (added to the torque) or sensor fault (added to the motor angle's reading)
    channel: ArmFaultChannel
    start_s: float  # when it acts, seconds of simulated time
    stop_s: float
    signal: ArmSignal  # its course over simulated time

    def at(self, time_s: float) -> float:
        """Return the fault's size at a time."""
        return self.signal(time_s) if self.start_s <= time_s < self.stop_s else 0.0


@dataclass(frozen=True, slots=True)
class ArmScenario:
    """Faults of a run, which add up on one channel, and whether w_1 = 0.2 sin 10 t and w_2 = 0.1 sin 10 t act."""

    faults: tuple[ArmFault, ...] = field(default=())
    disturbed: bool = True


@dataclass(frozen=True, slots=True)
class ArmRun:
    """A simulated run, one row per sample."""

    t: NDArray[np.float64]  # times k / rate (N,), seconds
    u: NDArray[np.float64]  # torque (N, 1), outputs (N, 3), states (N, 4)
    y: NDArray[np.float64]
    x: NDArray[np.float64]
    f_a: NDArray[np.float64]  # True faults (N, 1); at a jump the value after it
    f_s: NDArray[np.float64]


def _wave(time_s: float) -> float:
    return math.sin(0.5 * time_s) + 0.2 * math.cos(5.0 * time_s)


# Sizes and times are those of the paper's cases.
SCENARIOS: dict[str, ArmScenario] = {
    "healthy": ArmScenario(),
    "undisturbed": ArmScenario(
        (
            ArmFault("f_a", 15.0, 30.0, lambda t: 3.0 * math.sin(0.5 * t) + 2.0 * math.cos(5.0 * t)),
            ArmFault("f_s", 5.0, 35.0, lambda t: 5.0 - 0.5 * (t - 20.0)),
        ),
        disturbed=False,
    ),
    "case1": ArmScenario(
        (
            ArmFault("f_a", 20.0, 20.1, lambda t: 0.1 * (t - 10.0)),
            ArmFault("f_s", 30.0, 30.1, lambda t: 0.1 * (t - 10.0)),
        )
    ),
    "case2": ArmScenario((ArmFault("f_a", 10.0, 20.0, lambda _: 2.0), ArmFault("f_s", 30.0, 35.0, lambda _: 2.0))),
    "case3": ArmScenario((ArmFault("f_a", 15.0, 40.0, _wave), ArmFault("f_s", 15.0, 35.0, _wave))),
}


def make_fault(
    channel: ArmFaultChannel, kind: ArmFaultKind, start_s: float, stop_s: float, size: float, *, hz: float = SINE_HZ
) -> ArmFault:
    """Return a fault of a simple kind on a channel during [start_s, stop_s).

    A step is constant ``size``, a ramp grows from 0 to ``size`` at ``stop_s``, a sine of ``hz`` and amplitude ``size``
    starts at 0.
    """
    if kind == "step":
        return ArmFault(channel, start_s, stop_s, lambda _: size)
    if kind == "ramp":
        return ArmFault(channel, start_s, stop_s, lambda t: size * (t - start_s) / (stop_s - start_s))
    return ArmFault(channel, start_s, stop_s, lambda t: size * math.sin(2.0 * math.pi * hz * (t - start_s)))


def parse_fault(text: str) -> ArmFault:
    """Return the fault that ``CHANNEL:KIND:START:STOP:SIZE[:HZ]`` describes (``f_a:step:10:20:2``).

    UsageError is raised if the text is invalid.
    """
    form = f"fault '{text}': write CHANNEL:KIND:START:STOP:SIZE[:HZ], like f_a:step:10:20:2"
    parts = text.split(":")
    if len(parts) not in (5, 6):
        raise UsageError(form)
    channel = next((name for name in FAULT_CHANNELS if name == parts[0]), None)
    if channel is None:
        raise UsageError(f"fault '{text}': unknown channel '{parts[0]}'; use {' or '.join(FAULT_CHANNELS)}")
    kind = next((name for name in FAULT_KINDS if name == parts[1]), None)
    if kind is None:
        raise UsageError(f"fault '{text}': unknown kind '{parts[1]}'; use {', '.join(FAULT_KINDS)}")
    try:
        numbers = [float(part) for part in parts[2:]]
    except ValueError:
        raise UsageError(form) from None
    if not all(math.isfinite(number) for number in numbers):
        raise UsageError(form)
    start_s, stop_s, size, *hz = numbers
    if not 0.0 <= start_s < stop_s:
        raise UsageError(f"fault '{text}': has to start at 0 s or later, and before it stops")
    return make_fault(channel, kind, start_s, stop_s, size, hz=hz[0] if hz else SINE_HZ)


def simulate_arm(
    scenario: ArmScenario, duration_s: float = DURATION_S, rate_hz: float = 100.0, torque: Torque = "zero"
) -> ArmRun:
    """Simulate the arm; samples are at k / rate_hz < duration_s.

    Without torque it starts at rest; the torque ``"tracking"`` makes the healthy link swing as 0.5 sin(0.5 t) rad.

    Raises
    ------
    UsageError
        Duration or rate is not positive.
    """
    if not (0.0 < duration_s < math.inf and 0.0 < rate_hz < math.inf):
        raise UsageError("the arm needs a positive duration and rate")
    t = np.arange(math.ceil(duration_s * rate_hz - 1e-9)) / rate_hz
    state, start_u = _start(torque)
    x, u, y = np.empty((len(t), 4)), np.empty((len(t), 1)), np.empty((len(t), 3))
    for k, time_s in enumerate(t.tolist()):
        held = start_u(time_s)
        x[k], u[k], y[k] = state, held, measure_arm(scenario, state, time_s)
        state = step_arm(scenario, state, time_s, (k + 1) / rate_hz, held)
    f_a, f_s = (
        np.array([[fault_size(scenario, channel, s)] for s in t.tolist()]).reshape(-1, 1) for channel in FAULT_CHANNELS
    )
    return ArmRun(t=t, u=u, y=y, x=x, f_a=f_a, f_s=f_s)


def fault_size(scenario: ArmScenario, channel: ArmFaultChannel, time_s: float) -> float:
    """Return the true size of a channel's faults at a time; at a jump the value after it."""
    return sum(fault.at(time_s) for fault in scenario.faults if fault.channel == channel)


def measure_arm(scenario: ArmScenario, state: ArmState, time_s: float) -> tuple[float, float, float]:
    """Return the outputs C x + D_f f_s + D_1 w_2 at a state."""
    w_2 = 0.1 * math.sin(10.0 * time_s) if scenario.disturbed else 0.0
    f_s = fault_size(scenario, "f_s", time_s)
    return state[0] + f_s + 0.1 * w_2, state[1] - 0.02 * w_2, state[2] + state[3]


def step_arm(scenario: ArmScenario, state: ArmState, start_s: float, end_s: float, torque: float) -> ArmState:
    """Return the state at ``end_s`` of an arm that was in ``state`` at ``start_s`` and whose torque is held."""
    edges = sorted({edge for fault in scenario.faults for edge in (fault.start_s, fault.stop_s)})
    borders = [start_s, *(edge for edge in edges if start_s < edge < end_s), end_s]
    for first, last in pairwise(borders):
        acting = [f.signal for f in scenario.faults if f.channel == "f_a" and f.start_s <= first < f.stop_s]
        state = _integrate(state, first, last, u=torque, f_a=acting, disturbed=scenario.disturbed)
    return state


def tracking_reference(time_s: float) -> tuple[ArmState, float]:
    """Return state and torque of the healthy, undisturbed arm whose link swings as 0.5 sin(0.5 t) rad.

    The link angle q = x_3 is a flat output: x_1 = q + (q'' + 3.33 sin q) / 19.5 follows from the link's
    equation, and u from the motor's with the derivatives of x_1.
    """
    phase = _SWING_RATE * time_s
    s, c = math.sin(phase), math.cos(phase)
    q, q_1 = _SWING * s, _SWING * _SWING_RATE * c
    q_2, q_3, q_4 = (-(_SWING_RATE**2) * v for v in (q, q_1, -(_SWING_RATE**2) * q))
    sin_q, cos_q = math.sin(q), math.cos(q)
    x_1 = q + (q_2 + _GRAVITY * sin_q) / _STIFF_LINK
    x_2 = q_1 + (q_3 + _GRAVITY * cos_q * q_1) / _STIFF_LINK
    x_2_1 = q_2 + (q_4 + _GRAVITY * (cos_q * q_2 - sin_q * q_1 * q_1)) / _STIFF_LINK
    return (x_1, x_2, q, q_1), (x_2_1 + _STIFF_MOTOR * (x_1 - q) + _DAMPING * x_2) / _TORQUE


def _integrate(
    state: ArmState, start_s: float, end_s: float, *, u: float, f_a: Sequence[ArmSignal], disturbed: bool
) -> ArmState:
    """Return the state at ``end_s``; the signals in ``f_a`` act during the whole step."""
    steps = max(1, math.ceil((end_s - start_s) / MAX_STEP_S - 1e-9))
    h = (end_s - start_s) / steps
    half, sin, (x_1, x_2, x_3, x_4) = 0.5 * h, math.sin, state
    push_1 = push_2 = push_3 = _TORQUE * u
    w_1 = w_2 = w_3 = 0.0
    for step in range(steps):
        now = start_s + step * h
        times = now, now + half, now + h
        if f_a:
            push_1, push_2, push_3 = [_TORQUE * (u + sum([signal(s) for signal in f_a])) for s in times]
        if disturbed:
            w_1, w_2, w_3 = [0.2 * sin(10.0 * s) for s in times]
        # Runge and Kutta's four slopes of A x + B (u + f_a) + G sin(x_3) + E_1 w_1, written out: a call of each takes
        # half as long again
        twist = x_1 - x_3
        a_2 = -_STIFF_MOTOR * twist - _DAMPING * x_2 + push_1
        a_4 = _STIFF_LINK * twist - _GRAVITY * sin(x_3) + w_1
        p_1, p_2, p_3, p_4 = x_1 + half * x_2, x_2 + half * a_2, x_3 + half * x_4, x_4 + half * a_4
        twist = p_1 - p_3
        b_2 = -_STIFF_MOTOR * twist - _DAMPING * p_2 + push_2
        b_4 = _STIFF_LINK * twist - _GRAVITY * sin(p_3) + w_2
        q_1, q_2, q_3, q_4 = x_1 + half * p_2, x_2 + half * b_2, x_3 + half * p_4, x_4 + half * b_4
        twist = q_1 - q_3
        c_2 = -_STIFF_MOTOR * twist - _DAMPING * q_2 + push_2
        c_4 = _STIFF_LINK * twist - _GRAVITY * sin(q_3) + w_2
        r_1, r_2, r_3, r_4 = x_1 + h * q_2, x_2 + h * c_2, x_3 + h * q_4, x_4 + h * c_4
        twist = r_1 - r_3
        d_2 = -_STIFF_MOTOR * twist - _DAMPING * r_2 + push_3
        d_4 = _STIFF_LINK * twist - _GRAVITY * sin(r_3) + w_3
        x_1 += h * ((x_2 + 2.0 * (p_2 + q_2) + r_2) / 6.0)
        x_2 += h * ((a_2 + 2.0 * (b_2 + c_2) + d_2) / 6.0)
        x_3 += h * ((x_4 + 2.0 * (p_4 + q_4) + r_4) / 6.0)
        x_4 += h * ((a_4 + 2.0 * (b_4 + c_4) + d_4) / 6.0)
    return x_1, x_2, x_3, x_4


def _start(torque: Torque) -> tuple[ArmState, ArmSignal]:
    """Return the state at time 0 and the torque over time."""
    if torque == "zero":
        return (0.0, 0.0, 0.0, 0.0), lambda _: 0.0
    return tracking_reference(0.0)[0], lambda time_s: tracking_reference(time_s)[1]
