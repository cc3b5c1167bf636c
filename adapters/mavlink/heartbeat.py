"""Heartbeats: whether an autopilot sent one, its kind of vehicle and its flight mode."""

import functools

from adapters.batch import Columns, one_message
from adapters.message import Message
from adapters.source import MAVLINK


@functools.cache
def enumerated(enumeration: str, number: int) -> str | None:
    """Return the name of a number in a MAVLink enumeration, in lower case and without its prefix."""
    from pymavlink.dialects.v20 import ardupilotmega

    entry = ardupilotmega.enums[enumeration].get(number)
    return None if entry is None else str(entry.name).removeprefix(f"{enumeration}_").lower()


def vehicle_type(number: int | None) -> str:
    """Return the kind of vehicle by HEARTBEAT.type (``quadrotor``, ``fixed wing``), empty if it names none.

    The type 0 is "generic": an autopilot that does not know.
    """
    return (enumerated("MAV_TYPE", number) or "").replace("_", " ") if number else ""


AUTOPILOT = 1
"""MAV_COMP_ID_AUTOPILOT1: component id of autopilots."""
ARMED = 128
"""MAV_MODE_FLAG_SAFETY_ARMED of ``base_mode``."""
NO_AUTOPILOT = 8
"""MAV_AUTOPILOT_INVALID: a component that is not a flight controller."""
ARDUPILOT = 3
"""MAV_AUTOPILOT_ARDUPILOTMEGA."""
PX4 = 12
"""MAV_AUTOPILOT_PX4."""
_GROUND_STATION = 6
"""MAV_TYPE_GCS."""


def holds_autopilot_heartbeat(columns: Columns) -> bool:
    """Return whether one of some messages is the heartbeat of an autopilot."""
    rows = range(len(columns.position)) if columns.name == "HEARTBEAT" else ()
    return any(is_autopilot_heartbeat(one_message(columns, row)) for row in rows)


def is_autopilot_heartbeat(message: Message) -> bool:
    """Return whether a message is the heartbeat of an autopilot.

    Heartbeats of a ground station (type 6) and of components without an autopilot (autopilot 8: gimbals, cameras,
    companion computers) are not.
    """
    return (
        message.name == "HEARTBEAT"
        and message.source is MAVLINK
        and message.fields.get("type") != _GROUND_STATION
        and message.fields.get("autopilot") != NO_AUTOPILOT
    )


def mode_name(autopilot: int, kind: int, base: int, custom: int) -> str:
    """Return the name of a mode, empty if it is unknown.

    ``autopilot``, ``kind`` (MAV_TYPE), ``base`` and ``custom`` are those of the heartbeat.
    """
    from pymavlink import mavutil

    if autopilot == PX4:
        return str(mavutil.interpret_px4_mode(base, custom))
    names = mavutil.mode_mapping_bynumber(kind) if autopilot == ARDUPILOT else None
    return str((names or {}).get(custom, ""))
