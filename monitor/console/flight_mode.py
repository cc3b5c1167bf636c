"""The name of a flight mode, from an autopilot's heartbeat."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

_PX4: Final = 12
"""MAV_AUTOPILOT_PX4"""
_ARDUPILOT: Final = 3
"""MAV_AUTOPILOT_ARDUPILOTMEGA"""
_ARMED: Final = 128
"""MAV_MODE_FLAG_SAFETY_ARMED"""


def flight_mode(beat: Mapping[str, Any]) -> str:
    """Return ``LOITER`` or ``LOITER, disarmed``; empty where the heartbeat, which may hold anything, tells neither."""
    kind, autopilot, base, custom = (beat.get(key) for key in ("type", "autopilot", "base_mode", "custom_mode"))
    if not (type(kind) is int and type(base) is int and type(custom) is int and 0 <= custom < 1 << 32):
        return ""
    from pymavlink import mavutil

    if autopilot == _PX4:
        name = str(mavutil.interpret_px4_mode(base, custom))
    elif autopilot == _ARDUPILOT:
        name = str((mavutil.mode_mapping_bynumber(kind) or {}).get(custom, f"mode {custom}"))
    else:
        name = f"mode {custom}"
    return name if base & _ARMED else f"{name}, disarmed"
