"""Names of flight modes."""

from __future__ import annotations

from typing import Final

ARDUPILOT: Final = 3
"""MAV_AUTOPILOT_ARDUPILOTMEGA"""
PX4: Final = 12
"""MAV_AUTOPILOT_PX4"""


def mode_name(autopilot: int, kind: int, base: int, custom: int) -> str:
    """Return the name of a mode, an empty one where nobody knows it.

    ``autopilot``, ``kind`` (MAV_TYPE), ``base`` and ``custom`` are those of the heartbeat.
    """
    from pymavlink import mavutil

    if autopilot == PX4:
        return str(mavutil.interpret_px4_mode(base, custom))
    names = mavutil.mode_mapping_bynumber(kind) if autopilot == ARDUPILOT else None
    return str((names or {}).get(custom, ""))
