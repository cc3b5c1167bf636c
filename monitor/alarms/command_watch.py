"""Who commands a vehicle in flight, and how often: the same rule for live telemetry, replays and reviews of logs.

MAVLink without signing obeys everybody. An attacker disarms, reboots, changes the mode, rewrites the mission or takes
safety parameters away; the vehicle does as it is told, and nothing fails.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

from adapters.batch import Columns
from adapters.mavlink.heartbeat import AUTOPILOT
from adapters.message import Message
from adapters.source import MAVLINK

FLOOD: Final = 50
"""Commands within a second. Chosen: a ground station sends missions and parameters with an answer to each, some
ten a second over a radio, some thirty over a wire."""
# https://mavlink.io/en/messages/common.html and ardupilotmega.html: of messages, then of MAV_CMDs by their number.
_RISKS = {
    "SET_MODE": "changes the mode",
    "FENCE_POINT": "rewrites the fence",
    "LOG_ERASE": "erases the logs",
    "MISSION_SET_CURRENT": "jumps within the mission",
    "SETUP_SIGNING": "changes the signing key",
    "SET_GPS_GLOBAL_ORIGIN": "moves the origin",
    "SET_HOME_POSITION": "moves the home position",
    "20": "makes it return",
    "21": "makes it land",
    "176": "changes the mode",
    "179": "moves the home position",
    "185": "terminates the flight",
    "192": "sends it elsewhere",
    "209": "runs motors",
    "224": "jumps within the mission",
    "241": "calibrates sensors",
    "245": "resets or writes parameters",
    "246": "reboots the autopilot",
    "252": "sends it elsewhere",
    "300": "starts the mission",
    "42007": "changes the sources of the position",
    "42650": "rewrites the bootloader",
}
# The same where the first parameter has a value.
_RISKS_WITH = {
    ("207", 0.0): "switches the fence off",
    ("208", 2.0): "releases the parachute",
    ("400", 0.0): "disarms",
}
_ENDS = frozenset({"disarms", "terminates the flight", "reboots the autopilot", "releases the parachute"})
# Messages that write plans, and which of their values is the plan's type; MAV_MISSION_TYPE.
_PLANS = {"MISSION_COUNT": 1, "MISSION_CLEAR_ALL": 0, "MISSION_WRITE_PARTIAL_LIST": 2}
_PLAN_TYPES = {1: "rewrites the fence", 2: "rewrites the rally points"}
_SETS_PARAMETERS = ("PARAM_SET", "PARAM_EXT_SET")
COMMANDS: Final = frozenset(
    {"COMMAND_LONG", "COMMAND_INT", *_SETS_PARAMETERS, *_PLANS, *(name for name in _RISKS if not name.isdigit())}
)
"""Names of the messages that command a vehicle, which their ``target_system`` names."""
SAFETY_PARAMETERS = (
    "FS_", "FENCE_", "ARMING_", "BATT_FS", "BATT_LOW", "BATT_CRT", "GCS_", "RTL_ALT", "SYSID_", "BRD_SAFETY",
    "DISARM_DELAY", "COM_", "NAV_DLL_ACT", "NAV_RCL_ACT", "GF_", "CBRK_", "BAT_", "RTL_RETURN_ALT", "EKF2_GPS_CHECK",
    "MAV_PROTO", "MAV_SYS_ID",
)  # fmt: skip
"""Begins of parameters that decide what a vehicle does when something fails, of ArduPilot and of PX4."""
_MOST_SENDERS = 64
"""Senders that are remembered. Chosen: more than ever command one vehicle; forged ids cost no memory beyond."""


Weight = Literal["information", "warning", "critical"]


@dataclass(frozen=True, slots=True)
class CommandSent:
    """A command that somebody sent the vehicle."""

    time_s: float
    system: int
    component: int
    name: str  # of the message, or the number of the MAV_CMD in it
    values: tuple[float | str, ...] = ()


def command_sent(
    name: str, fields: Mapping[str, Any], time_s: float, system: int, component: int, vehicle: int
) -> CommandSent | None:
    """Return the command in a message to a vehicle's autopilot; None where it is none, or meant for another."""
    meant = fields.get("target_system") in (0, vehicle) and fields.get("target_component", 0) in (0, AUTOPILOT)
    if name not in COMMANDS or not meant:
        return None
    number = fields.get("command")
    if isinstance(number, int):
        values = tuple(fields.get(f"param{k}", 0.0) for k in range(1, 5))
        return CommandSent(time_s, system, component, str(number), values)
    said = tuple(value for key, value in fields.items() if isinstance(value, int | float | str) and "target" not in key)
    return CommandSent(time_s, system, component, name, said)


def commanded_systems(entry: Message | Columns) -> set[int]:
    """Return the systems that a message (or columns) commands, 0 for all; none where it is no command."""
    if entry.name not in COMMANDS or entry.source is not MAVLINK:
        return set()
    target = entry.fields.get("target_system")
    if isinstance(entry, Columns):
        return set() if target is None else set(target.ravel().tolist())
    return {target} if isinstance(target, int) else set()


@dataclass(frozen=True, slots=True)
class CommandFinding:
    """What a command in flight shows."""

    kind: Literal["sender", "flood"]  # a risky command of a new sender, or too many commands
    weight: Weight  # information alone is no alarm
    text: str  # what happened, without a full stop


def command_risk(name: str, values: Sequence[float | str]) -> str | None:
    """Return in words what a message does to a vehicle in flight, None where it is harmless.

    ``name`` is the message's, or the number of the MAV_CMD in it; ``values`` are the parameters of a command, or the
    name of the parameter that is set.
    """
    if name in _PLANS:
        plan = dict(enumerate(values)).get(_PLANS[name], 0)
        return _PLAN_TYPES.get(int(plan), "rewrites the mission") if isinstance(plan, int | float) else None
    if name in _SETS_PARAMETERS:
        parameter = next((value for value in values if isinstance(value, str)), "")
        return f"sets {parameter}" if parameter.startswith(SAFETY_PARAMETERS) else None
    first = values[0] if values else None
    return _RISKS.get(name) or (_RISKS_WITH.get((name, first)) if isinstance(first, int | float) else None)


def ends_flight(name: str, values: Sequence[float | str]) -> bool:
    """Return whether a message brings a flying vehicle down, which nobody does by the way."""
    return command_risk(name, values) in _ENDS


class CommandWatch:
    """Who commanded a vehicle while it did not fly, and what those who did not do in flight.

    A risky command of a new sender is critical where others had commanded before; where nobody had (a vehicle armed by
    its radio control, a monitor that started in flight) it is a warning if it ends the flight, else information.

    ``known`` are system and component of who commanded it while it did not fly, ``most`` the most commands of any
    second in flight.
    """

    def __init__(self) -> None:
        self.known: dict[tuple[int, int], None] = {}
        self.most = 0
        self._told: dict[tuple[int, int], tuple[Weight, ...]] = {}
        self._times_s: deque[float] = deque()
        self._flooded_s: float | None = None

    def follow(self, command: CommandSent, flying: bool) -> list[CommandFinding]:
        """Take the next command; return what it shows."""
        sender = command.system, command.component
        if not flying:
            _remember(self.known, sender, None)
            self._told.pop(sender, None)
            self._times_s.clear()
            return []
        found = []
        risk = command_risk(command.name, command.values)
        now_s, times_s = command.time_s, self._times_s
        if times_s and now_s < times_s[-1]:
            times_s.clear()
        times_s.append(now_s)
        while now_s - times_s[0] >= 1.0 or len(times_s) > FLOOD * _MOST_SENDERS:
            times_s.popleft()
        self.most = max(self.most, len(times_s))
        weight: Weight = "critical" if self.known else "information"
        if not self.known and ends_flight(command.name, command.values):
            weight = "warning"
        # Once for each sender, and again where what it does is graver.
        if risk is not None and sender not in self.known and weight not in self._told.get(sender, ()):
            _remember(self._told, sender, ("information", "warning") if weight == "warning" else (weight,))
            text = f"system {command.system}, component {command.component}, which had not commanded before, {risk}"
            found.append(CommandFinding("sender", weight, f"{text} in flight"))
        quiet = self._flooded_s is None or not 0 <= now_s - self._flooded_s < 1.0
        if len(times_s) > FLOOD and quiet:
            self._flooded_s = now_s
            text = f"more than {FLOOD} commands a second reached the vehicle in flight"
            found.append(CommandFinding("flood", "warning", text))
        return found


def _remember(senders: dict[tuple[int, int], Any], sender: tuple[int, int], value: object) -> None:
    senders[sender] = value
    if len(senders) > _MOST_SENDERS:
        del senders[next(iter(senders))]
