"""A simulated quadrotor from command to motion: controllers, motors, propellers, battery, with exact faults of each.

A command c sets a share d of the battery's voltage V, after the link's delay. The motor's speed goes towards

    w = W (0.25 + 1.1 d V/Vf - 0.35 (d V/Vf)^2)     with a lag of 40 ms, W = 9000 rpm

and its propeller gives the thrust (w/W)^2 and takes the current 18 A (w/W)^3 Vf/V. Faults act from a moment on: ``esc``
applies less of the voltage; ``prop`` gives less thrust at its speed, and takes as much less current; ``motor`` takes
more current at its speed; ``balance`` shakes the vehicle by so many times the usual 9 m/s^2 an axis at full speed more,
and so many times more by its propeller's line in raw accelerations; ``battery`` has so much more than its usual
resistance of 20 milliohms.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from operator import mul

import numpy as np

from adapters.batch import Batch
from adapters.message import Message
from adapters.source import MAVLINK
from monitor.fitting.fitted import FitRequest, Fitted
from monitor.fitting.survey import survey
from monitor.profile import Profile
from monitor.sampling.gate import GateRule

RATE_HZ, STEPS = 100, 4
"""Messages per second, and steps of the simulation per message."""
FULL_V = 16.6
_ANGLES = np.radians([45.0, 225.0, -45.0, 135.0])
_MIXER = np.column_stack([-np.sin(_ANGLES), np.cos(_ANGLES), [1.0, 1.0, -1.0, -1.0], np.ones(4)]).tolist()
_EFFECT = (160.0, 160.0, 16.0)
_DAMPING = (1.5, 1.5, 1.0)
_SPEED, _LAG_S, _DELAY = 9000.0, 0.04, 4
_AMPS, OHM = 18.0, 0.02
_CAPACITY_AS = 5.0 * 3600.0
_HOVER = 0.36
_LINES = np.array([0.9, 1.3, 0.7, 1.1])
"""Amplitude of each propeller's imbalance at full speed, m/s^2."""
_SHAKE = 0.4
"""Deviation of an axis of the raw accelerations, m/s^2, that is in no line. Twice a turn blades add 0.8 at full
speed."""
_GUSTS = (0.015, 0.015, 0.005, 0.03)
_GAINS = (0.05, 0.05, 0.12)
_MOST_DRAWN = 26
"""Random numbers for a row of messages: wanted motion, gusts, rates, three of each controller, levels of vibration."""


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of one motor (1 to 4), or the battery: ``share`` is what it loses, or has or draws more."""

    part: str
    motor: int
    share: float
    onset_s: float = 30.0
    end_s: float = 1e9


def flight(
    seed: int,
    duration_s: float,
    fault: Fault | None = None,
    *,
    esc_hz: float = 50.0,
    order: tuple[int, ...] = (0, 1, 2, 3),
    sag_v: float = 0.0,
    felt: bool = False,
    climbs: float = 0.3,
    shaken: bool = False,
) -> Iterator[Message]:
    """Yield the telemetry of a flight; ``sag_v`` is what the battery loses of its open voltage over the flight.

    The vertical force is reported where it is ``felt``, raw accelerations at 400 Hz where they are ``shaken``; climbs
    are wanted of so many m/s (standard deviation). Without ``esc_hz`` no speed controller reports; controller k of the
    messages is that of motor ``order[k]`` + 1.
    """
    rows = round(duration_s * RATE_HZ)
    # floats and lists: arrays of four take several times as long
    normal = iter(np.random.default_rng(seed).standard_normal(rows * _MOST_DRAWN).tolist()).__next__
    dt = 1.0 / (RATE_HZ * STEPS)
    turn = dt * 2.0 * np.pi * _SPEED / 60.0
    (p1, p2, p3, p4), (q1, q2, q3, q4), (r1, r2, r3, r4), _ = zip(*_MIXER, strict=True)
    (e_p, e_q, e_r), (d_p, d_q, d_r) = _EFFECT, _DAMPING
    rate, gust, wanted = [0.0] * 3, [0.0] * 4, [0.0] * 4
    speed, volts = [_HOVER**0.5] * 4, FULL_V
    climb, height_sum = 0.0, 0.0
    on_the_way = [[0.35] * 4] * _DELAY
    start_ns = 1_800_000_000_000_000_000
    next_esc_s = 0.0 if esc_hz else float("inf")
    measuring, used_as = np.random.default_rng([seed, 1]), 0.0
    shaking, angle, felt_m_s2 = np.random.default_rng([seed, 2]), np.array([0.3, 2.0, 4.0, 5.5]), -9.81
    for k in range(rows):
        now_s = k / RATE_HZ
        if k % 30 == 0:
            wanted = [sd * normal() for sd in (0.5, 0.5, 0.6, climbs)]
        gust = [force - force / RATE_HZ + sd * normal() for force, sd in zip(gust, _GUSTS, strict=True)]
        errors = [target - turned for target, turned in zip(wanted[:3], rate, strict=True)]
        controls = [_within(gain * error, -0.12, 0.12) for gain, error in zip(_GAINS, errors, strict=True)]
        height_sum = _within(height_sum + (wanted[3] - climb) / RATE_HZ, -20.0, 20.0)
        controls.append(0.35 + 0.05 * (wanted[3] - climb) + 0.02 * height_sum)
        pulses = [round(1000.0 + 1000.0 * _within(_dot(mixer, controls), 0.03, 1.0)) for mixer in _MIXER]
        acts = fault is not None and fault.onset_s <= now_s < fault.end_s
        working = {part: [1.0] * 4 for part in ("esc", "prop", "motor", "balance")}
        if acts and fault is not None and fault.part in working:
            working[fault.part][fault.motor - 1] += (1.0 if fault.part in ("motor", "balance") else -1.0) * fault.share
        on_the_way.append([(pulse - 1000.0) / 1000.0 for pulse in pulses])
        applied = [d * works * volts / FULL_V for d, works in zip(on_the_way.pop(0), working["esc"], strict=True)]
        targets = [0.25 + 1.1 * d - 0.35 * d * d for d in applied]
        # four motors and three axes by name: comprehensions over them take three times as long
        (t1, t2, t3, t4), (k1, k2, k3, k4), (w1, w2, w3, w4) = targets, working["prop"], speed
        (p, q, r), (g_p, g_q, g_r, _) = rate, gust
        for step in range(STEPS):
            w1 += (t1 - w1) * dt / _LAG_S
            w2 += (t2 - w2) * dt / _LAG_S
            w3 += (t3 - w3) * dt / _LAG_S
            w4 += (t4 - w4) * dt / _LAG_S
            f1, f2, f3, f4 = k1 * w1 * w1, k2 * w2 * w2, k3 * w3 * w3, k4 * w4 * w4
            p += dt * (e_p * (p1 * f1 + p2 * f2 + p3 * f3 + p4 * f4) / 4.0 - d_p * p + g_p)
            q += dt * (e_q * (q1 * f1 + q2 * f2 + q3 * f3 + q4 * f4) / 4.0 - d_q * q + g_q)
            r += dt * (e_r * (r1 * f1 + r2 * f2 + r3 * f3 + r4 * f4) / 4.0 - d_r * r + g_r)
            speed = [w1, w2, w3, w4]
            if shaken:
                angle = angle + turn * np.array(speed)
                square = np.square(speed)
                once, twice = _LINES * working["balance"] * square, 0.8 * square
                force = shaking.normal([0.0, 0.0, felt_m_s2], _SHAKE)
                force += (once @ np.cos(angle), once @ np.sin(angle), 0.4 * once @ np.cos(angle + 1.0))
                force[2] += twice @ np.cos(2.0 * angle)
                number = k * STEPS + step
                stamp = {"time_usec": 5_000_000 + 2_500 * number}
                accelerations = dict(zip(("xacc", "yacc", "zacc"), force.tolist(), strict=True))
                yield _message("HIGHRES_IMU", start_ns + 2_500_000 * number, {**stamp, **accelerations})
        rate = [p, q, r]
        lifted = 9.81 * (f1 + f2 + f3 + f4) / (4.0 * _HOVER) + gust[3]
        felt_m_s2 = -lifted
        climb += (lifted - 9.81 - 0.3 * climb) / RATE_HZ
        drawn = zip(speed, working["motor"], working["prop"], strict=True)
        current = [_AMPS * w**3 * FULL_V / volts * draws * pushes for w, draws, pushes in drawn]
        ohm = OHM * (1.0 + (fault.share if acts and fault is not None and fault.part == "battery" else 0.0))
        used_as += sum(current) / RATE_HZ
        volts = FULL_V - sag_v * now_s / duration_s - ohm * sum(current)
        stamp_ms, arrival_ns = 5_000 + 10 * k, start_ns + 10_000_000 * k
        fields = {f"servo{i}_raw": pulse for i, pulse in enumerate(pulses, start=1)}
        yield _message("SERVO_OUTPUT_RAW", arrival_ns, {"time_usec": stamp_ms * 1000, "port": 0, **fields})
        if felt:
            vertical = {"time_boot_ms": stamp_ms, "zacc": round(-1000.0 * lifted / 9.81)}
            yield _message("SCALED_IMU", arrival_ns, vertical)
        noisy = [turned + 1e-3 * normal() for turned in rate]
        rates = dict(zip(("rollspeed", "pitchspeed", "yawspeed"), noisy, strict=True))
        yield _message("ATTITUDE", arrival_ns, {"time_boot_ms": stamp_ms, **rates})
        if now_s >= next_esc_s:
            next_esc_s += 1.0 / esc_hz
            rpm = [round(_SPEED * speed[motor] + 20.0 * normal()) for motor in order]
            amps = [current[motor] + 0.05 * normal() for motor in order]
            measured = {"rpm": rpm, "voltage": [volts + 0.02 * normal() for _ in order], "current": amps}
            yield _message("ESC_STATUS", arrival_ns, {"index": 0, "time_usec": stamp_ms * 1000, **measured})
        if k % 10 == 0:
            level = 9.0 * max(works * w * w for works, w in zip(working["balance"], speed, strict=True))
            levels = {f"vibration_{axis}": level * math.exp(0.2 * normal()) for axis in "xyz"}
            clipped = dict.fromkeys(("clipping_0", "clipping_1", "clipping_2"), 0)
            yield _message("VIBRATION", arrival_ns, {"time_usec": stamp_ms * 1000, **levels, **clipped})
            battery = {
                "voltage_battery": round(1000.0 * volts + measuring.normal(0.0, 8.0)),
                "current_battery": round(100.0 * sum(current) + measuring.normal(0.0, 10.0)),
                "battery_remaining": round(100.0 - 100.0 * used_as / _CAPACITY_AS),
            }
            yield _message("SYS_STATUS", arrival_ns, battery)
        if k % RATE_HZ == 0:
            yield _message("HEARTBEAT", arrival_ns, {"type": 2, "autopilot": 12, "base_mode": 128})
            yield _message("EXTENDED_SYS_STATE", arrival_ns, {"landed_state": 2})


def _within(value: float, low: float, high: float) -> float:
    return low if value < low else min(value, high)


def _dot(a: Iterable[float], b: Iterable[float]) -> float:
    return float(sum(map(mul, a, b)))


def _message(name: str, received_ns: int, fields: Mapping[str, object]) -> Message:
    return Message(MAVLINK, name, received_ns, fields, 1, 1)


GATE = GateRule(settle_s=1.0)


def request(*logs: list[Batch]) -> FitRequest:
    """Return what is asked of a fit of such flights."""
    return FitRequest("quad", [partial(iter, log) for log in logs], tuple(survey(iter(log)) for log in logs))


def profile_of(fitted: Fitted) -> Profile:
    """Return a profile of one fitted observer."""
    return Profile("quad", "multirotor", 0, GATE, 2.0, (fitted.profile(),), (), {}, "")
