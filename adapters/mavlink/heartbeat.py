"""Whose heartbeat it is."""

from __future__ import annotations

from adapters.message import Message
from adapters.source import MAVLINK

_GROUND_STATION = 6
"""MAV_TYPE_GCS."""
_NO_AUTOPILOT = 8
"""MAV_AUTOPILOT_INVALID: a component that is no flight controller."""


def is_autopilot_heartbeat(message: Message) -> bool:
    """Return whether a message is the heartbeat of an autopilot.

    Neither a ground station's (type 6) nor that of a component without one (autopilot 8: gimbals, cameras, companion
    computers).
    """
    return (
        message.name == "HEARTBEAT"
        and message.source is MAVLINK
        and message.fields.get("type") != _GROUND_STATION
        and message.fields.get("autopilot") != _NO_AUTOPILOT
    )
