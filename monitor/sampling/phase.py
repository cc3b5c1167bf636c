"""Flight phase as the vehicle reports it: armed or not, on the ground or in the air; and its type."""

from __future__ import annotations

from typing import ClassVar, Literal

from adapters.mavlink.heartbeat import is_autopilot_heartbeat
from adapters.message import Message
from adapters.source import MAVLINK

Landed = Literal["ground", "air", "takeoff", "landing"]

# MAV_MODE_FLAG_SAFETY_ARMED, and the values of MAV_LANDED_STATE.
_ARMED = 128
_LANDED: dict[int, Landed] = {1: "ground", 2: "air", 3: "takeoff", 4: "landing"}


class FlightPhase:
    """Follows HEARTBEAT and EXTENDED_SYS_STATE of the autopilot; other stations' heartbeats are ignored.

    Attributes
    ----------
    armed : bool | None
        Bit 128 of HEARTBEAT.base_mode; None before the first heartbeat.
    landed : {"ground", "air", "takeoff", "landing"} | None
        EXTENDED_SYS_STATE.landed_state; None where the vehicle does not report it.
    vehicle_type : int | None
        HEARTBEAT.type; None where it is 0, "generic".
    interests : frozenset[str]
        Names of the messages it reads.
    """

    interests: ClassVar[frozenset[str]] = frozenset({"HEARTBEAT", "EXTENDED_SYS_STATE"})

    def __init__(self) -> None:
        self.armed: bool | None = None
        self.landed: Landed | None = None
        self.vehicle_type: int | None = None

    def __eq__(self, other: object) -> bool:
        return isinstance(other, FlightPhase) and vars(self) == vars(other)

    __hash__ = None  # type: ignore[assignment]

    def copy(self) -> FlightPhase:
        """Return a phase of its own with the same state."""
        phase = FlightPhase()
        phase.armed, phase.landed, phase.vehicle_type = self.armed, self.landed, self.vehicle_type
        return phase

    def feed(self, message: Message) -> None:
        """Follow a message; one of no interest changes nothing."""
        if message.name not in self.interests or message.source is not MAVLINK:
            return
        fields = message.fields
        if message.name == "EXTENDED_SYS_STATE":
            state = fields.get("landed_state")
            self.landed = _LANDED.get(state) if isinstance(state, int) else None
            return
        if not is_autopilot_heartbeat(message):
            return
        mode, kind = fields.get("base_mode"), fields.get("type")
        if isinstance(mode, int):
            self.armed = bool(mode & _ARMED)
        if type(kind) is int and kind:
            self.vehicle_type = kind
