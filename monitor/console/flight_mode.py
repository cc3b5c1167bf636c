"""The name of a flight mode, from an autopilot's heartbeat."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from adapters.mavlink.flight_modes import mode_name

_ARMED: Final = 128
"""MAV_MODE_FLAG_SAFETY_ARMED"""


def flight_mode(beat: Mapping[str, Any]) -> str:
    """Return ``LOITER`` or ``LOITER, disarmed``; empty where the heartbeat, which may hold anything, tells neither."""
    kind, autopilot, base, custom = (beat.get(key) for key in ("type", "autopilot", "base_mode", "custom_mode"))
    if not (type(kind) is int and type(base) is int and type(custom) is int and 0 <= custom < 1 << 32):
        return ""
    name = mode_name(autopilot if type(autopilot) is int else 0, kind, base, custom) or f"mode {custom}"
    return name if base & _ARMED else f"{name}, disarmed"
