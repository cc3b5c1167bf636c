"""A simulated hexacopter that flies random manoeuvres in gusts and reports as an autopilot does, with exact faults."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from adapters.message import Message
from adapters.source import MAVLINK

MOTORS = 6
RATE_HZ = 100
STEPS = 4
"""Steps of the simulation per message."""

_ANGLES = np.radians([90.0, 270.0, 330.0, 150.0, 30.0, 210.0])
_SPIN = np.array([-1.0, 1.0, -1.0, 1.0, 1.0, -1.0])
_MIXER = np.column_stack([-np.sin(_ANGLES), np.cos(_ANGLES), _SPIN, np.ones(MOTORS)])
_EFFECT = np.array([90.0, 90.0, 12.0])
"""Angular acceleration for one unit of thrust of each control, rad/s^2."""
_DAMPING = np.array([2.0, 2.0, 1.5])
_HOVER = 0.5
_LAG_S = 0.03


def hexacopter_flight(
    seed: int,
    duration_s: float,
    loss: dict[int, float] | None = None,
    onset_s: float = 20.0,
    end_s: float = 40.0,
    push: tuple[float, float, float] = (0.0, 0.0, 0.0),
    lively: float = 1.0,
) -> Iterator[Message]:
    """Yield the telemetry of a flight.

    ``loss`` maps motor numbers to the share of thrust lost from onset to end; ``push`` turns the vehicle about its axes
    from outside, rad/s^2, at 10 s for half a second; ``lively`` multiplies the wanted motion.
    """
    rng = np.random.default_rng(seed)
    dt = 1.0 / (RATE_HZ * STEPS)
    rate, thrust, gust, wanted = np.zeros(3), np.full(MOTORS, _HOVER), np.zeros(4), np.zeros(4)
    start_ns = 1_800_000_000_000_000_000
    for k in range(round(duration_s * RATE_HZ)):
        now_s = k / RATE_HZ
        if k % 30 == 0:
            wanted = lively * rng.normal(0.0, [0.4, 0.4, 0.6, 0.04])
        gust += -gust / RATE_HZ + rng.normal(0.0, [0.02, 0.02, 0.01, 0.1])
        error = wanted[:3] - rate
        controls = np.append(np.clip(error * [0.08, 0.08, 0.15], -0.12, 0.12), _HOVER + wanted[3])
        pulses = np.round(1000.0 + 1000.0 * np.clip(_MIXER @ controls, 0.02, 1.0))
        command = (pulses - 1000.0) / 1000.0
        working = np.ones(MOTORS)
        for motor, lost in (loss or {}).items() if onset_s <= now_s < end_s else ():
            working[motor - 1] -= lost
        pushed = np.array(push) if 10.0 <= now_s < 10.5 else 0.0
        for _ in range(STEPS):
            thrust += (command - thrust) * dt / _LAG_S
            torque = _EFFECT * (_MIXER[:, :3].T @ (working * thrust)) / MOTORS * 2.0
            rate = rate + dt * (torque - _DAMPING * rate + gust[:3] + pushed)
        vertical = -9.81 / (_HOVER * MOTORS) * float(working @ thrust) + gust[3]
        stamp_ms, arrival_ns = 5_000 + 10 * k, start_ns + 10_000_000 * k
        noise = rng.normal(0.0, 5e-4, 3)
        fields = {f"servo{i}_raw": int(pulse) for i, pulse in enumerate(pulses, start=1)}
        yield _message("SERVO_OUTPUT_RAW", arrival_ns, {"time_usec": stamp_ms * 1000, "port": 0, **fields})
        rates = dict(zip(("rollspeed", "pitchspeed", "yawspeed"), (rate + noise).tolist(), strict=True))
        yield _message("ATTITUDE", arrival_ns, {"time_boot_ms": stamp_ms, **rates})
        accelerations = {"zacc": vertical + float(rng.normal(0.0, 0.05))}
        yield _message("HIGHRES_IMU", arrival_ns, {"time_usec": stamp_ms * 1000, **accelerations})
        if k % RATE_HZ == 0:
            yield _message("HEARTBEAT", arrival_ns, {"type": 13, "autopilot": 3, "base_mode": 128})
            yield _message("EXTENDED_SYS_STATE", arrival_ns, {"landed_state": 2})


def _message(name: str, received_ns: int, fields: dict[str, object]) -> Message:
    return Message(MAVLINK, name, received_ns, fields, 1, 1)
