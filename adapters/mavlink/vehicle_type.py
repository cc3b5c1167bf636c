"""Names of the kinds of vehicle that autopilots say they are."""

from __future__ import annotations

import functools


@functools.cache
def enumerated(enumeration: str, number: int) -> str | None:
    """Return the name of a number in one of MAVLink's enumerations, small and without the enumeration's."""
    from pymavlink.dialects.v20 import ardupilotmega

    entry = ardupilotmega.enums[enumeration].get(number)
    return None if entry is None else str(entry.name).removeprefix(f"{enumeration}_").lower()


def vehicle_type(number: int | None) -> str:
    """Return what HEARTBEAT.type says of a vehicle (``quadrotor``, ``fixed wing``); empty where it says nothing.

    The type 0 is "generic": an autopilot that does not know.
    """
    return (enumerated("MAV_TYPE", number) or "").replace("_", " ") if number else ""
