"""What somebody who commands a vehicle can do to it in flight, by the message alone."""

from __future__ import annotations

from collections.abc import Sequence

# https://mavlink.io/en/messages/common.html
_DISARM, _TERMINATE, _REBOOT, _MODE = 400, 185, 246, 176
_MISSION = frozenset({"MISSION_COUNT", "MISSION_CLEAR_ALL", "MISSION_WRITE_PARTIAL_LIST"})
SAFETY_PARAMETERS = (
    "FS_", "FENCE_", "ARMING_", "BATT_FS", "BATT_LOW", "BATT_CRT", "GCS_", "RTL_ALT", "SYSID_", "BRD_SAFETY",
    "DISARM_DELAY", "COM_", "NAV_DLL_ACT", "NAV_RCL_ACT", "GF_", "CBRK_", "BAT_", "RTL_RETURN_ALT", "EKF2_GPS_CHECK",
    "MAV_PROTO", "MAV_SYS_ID",
)  # fmt: skip
"""Begins of parameters that decide what a vehicle does when something fails, of ArduPilot and of PX4."""


def command_risk(name: str, values: Sequence[float | str]) -> str | None:
    """Return in words what a message does to a vehicle in flight, None where it is harmless.

    ``name`` is the message's, or the number of the MAV_CMD in it; ``values`` are the parameters of a command, or the
    name of the parameter that is set.
    """
    if name in _MISSION:
        return "rewrites the mission"
    if name == "SET_MODE" or name == str(_MODE):
        return "changes the mode"
    if name == "PARAM_SET":
        parameter = next((value for value in values if isinstance(value, str)), "")
        return f"sets {parameter}" if parameter.startswith(SAFETY_PARAMETERS) else None
    if name == str(_DISARM) and values and values[0] == 0:
        return "disarms"
    return {str(_TERMINATE): "terminates the flight", str(_REBOOT): "reboots the autopilot"}.get(name)


def ends_flight(name: str, values: Sequence[float | str]) -> bool:
    """Return whether a message brings a flying vehicle down, which nobody does by the way."""
    return name in (str(_TERMINATE), str(_REBOOT)) or (name == str(_DISARM) and bool(values) and values[0] == 0)
