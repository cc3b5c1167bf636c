"""Flight phase as the vehicle reports it: armed or not, on the ground or in the air; and which vehicle it is."""

from __future__ import annotations

from typing import ClassVar, Literal

from adapters.mavlink.heartbeat import ARMED, is_autopilot_heartbeat
from adapters.message import Message
from adapters.source import MAVLINK
from monitor.sampling.identity import Identity, Reports

Landed = Literal["ground", "air", "takeoff", "landing"]

# The values of MAV_LANDED_STATE.
_LANDED: dict[int, Landed] = {1: "ground", 2: "air", 3: "takeoff", 4: "landing"}


class FlightPhase:
    """Follows HEARTBEAT and EXTENDED_SYS_STATE of the autopilot; other stations' heartbeats are ignored.

    Parameters
    ----------
    fitted : Identity | None
        The vehicle that the profile was fitted to; none of another's samples are evidence. None: of any vehicle.

    Attributes
    ----------
    armed : bool | None
        Bit 128 of HEARTBEAT.base_mode; None before the first heartbeat.
    landed : {"ground", "air", "takeoff", "landing"} | None
        EXTENDED_SYS_STATE.landed_state; None where the vehicle does not report it.
    reports : Reports
        What the vehicle has said of itself.
    contradiction : str | None
        What says that it is another vehicle than the one the profile was fitted to; None where nothing does.
    interests : frozenset[str]
        Names of the messages it reads.
    """

    interests: ClassVar[frozenset[str]] = Reports.interests | {"EXTENDED_SYS_STATE"}

    def __init__(self, fitted: Identity | None = None) -> None:
        self.armed: bool | None = None
        self.landed: Landed | None = None
        self.reports = Reports()
        self.contradiction: str | None = None
        self._fitted = fitted

    def __eq__(self, other: object) -> bool:
        return isinstance(other, FlightPhase) and vars(self) == vars(other)

    __hash__ = None  # type: ignore[assignment]

    def copy(self) -> FlightPhase:
        """Return a phase of its own with the same state."""
        phase = FlightPhase()
        vars(phase).update(vars(self))
        return phase

    def feed(self, message: Message) -> None:
        """Follow a message; one of no interest changes nothing."""
        if message.name not in self.interests:
            return
        reports = self.reports.after(message)
        if reports is not self.reports:
            self.reports = reports
            self.contradiction = None if self._fitted is None else reports.identity.contradiction(self._fitted)
        if message.source is not MAVLINK:
            return
        if message.name == "EXTENDED_SYS_STATE":
            state = message.fields.get("landed_state")
            self.landed = _LANDED.get(state) if isinstance(state, int) else None
        elif is_autopilot_heartbeat(message):
            mode = message.fields.get("base_mode")
            if isinstance(mode, int):
                self.armed = bool(mode & ARMED)
