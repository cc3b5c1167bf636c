"""Commands to a vehicle in flight, their senders and their rate: the same rule live, in replays and in reviews of logs.

MAVLink without signing obeys everybody. An attacker disarms, reboots, changes the mode, rewrites the mission or changes
parameters; the vehicle obeys, and no part fails.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Columns, rows_of
from adapters.mavlink.heartbeat import AUTOPILOT
from adapters.message import Message
from adapters.source import MAVLINK

FLOOD: Final = 50
"""Commands within a second above which they are a flood. Chosen: a ground station sends missions and parameters with an
answer to each, some ten a second over a radio, some thirty over a wire."""
# Effects of messages by their name, and of MAV_CMDs by their number: https://mavlink.io/en/messages/common.html and
# ardupilotmega.html.
_RISKS = {
    "SET_MODE": "changes the mode",
    "FENCE_POINT": "rewrites the fence",
    "LOG_ERASE": "erases the logs",
    "MISSION_SET_CURRENT": "jumps within the mission",
    "RALLY_POINT": "rewrites the rally points",
    "SETUP_SIGNING": "changes the signing key",
    "SET_GPS_GLOBAL_ORIGIN": "moves the origin",
    "SET_HOME_POSITION": "moves the home position",
    "20": "makes it return",
    "21": "makes it land",
    "176": "changes the mode",
    "179": "moves the home position",
    "183": "sets outputs",
    "185": "triggers termination",
    "187": "sets outputs",
    "189": "makes it land",
    "192": "sends it elsewhere",
    "193": "stops or resumes it",
    "209": "runs motors",
    "218": "switches an auxiliary function",
    "224": "jumps within the mission",
    "241": "calibrates sensors",
    "245": "resets or writes parameters",
    "246": "reboots the autopilot",
    "252": "sends it elsewhere",
    "300": "starts the mission",
    "310": "runs motors",
    "420": "injects a failure",
    "500": "pairs another radio control",
    "42007": "changes the sources of the position",
    "42650": "rewrites the bootloader",
    "43001": "sends it elsewhere",
    "43002": "sends it elsewhere",
}
# The same for a certain value of the first parameter.
_RISKS_WITH = {
    ("207", 0.0): "switches the fence off",
    ("208", 2.0): "releases the parachute",
    ("218", 31.0): "stops the motors",  # RCn_OPTION of ArduPilot
    ("218", 81.0): "disarms",
    ("223", 0.0): "stops the engine",
    ("400", 0.0): "disarms",
}
_ENDS = frozenset(
    {
        "disarms", "reboots the autopilot", "releases the parachute", "stops the engine", "stops the motors",
        "triggers termination",
    }
)  # fmt: skip
# Messages that write plans, and which of their values is the plan's type (MAV_MISSION_TYPE).
_PLANS = {"MISSION_COUNT": 1, "MISSION_CLEAR_ALL": 0, "MISSION_WRITE_PARTIAL_LIST": 2}
_PLAN_TYPES = {1: "rewrites the fence", 2: "rewrites the rally points"}
_SETS_PARAMETERS = ("PARAM_SET", "PARAM_EXT_SET")
_STREAMS = {
    "FILE_TRANSFER_PROTOCOL": "writes files",
    "GPS_INPUT": "feeds it positions",
    "HIL_GPS": "feeds it positions",
    "HIL_SENSOR": "feeds it measurements",
    "MANUAL_CONTROL": "steers it by joystick",
    "MISSION_ITEM": "sends it elsewhere",
    "MISSION_ITEM_INT": "sends it elsewhere",
    "RC_CHANNELS_OVERRIDE": "overrides its radio control",
    "SERIAL_CONTROL": "writes to its serial ports",
    "SET_ACTUATOR_CONTROL_TARGET": "sets outputs",
    "SET_ATTITUDE_TARGET": "sets its attitude",
    "SET_POSITION_TARGET_GLOBAL_INT": "sends it elsewhere",
    "SET_POSITION_TARGET_LOCAL_NED": "sends it elsewhere",
}
"""Effects of messages that come as often as their sender likes: they do not count as a flood, and only one a second of
each sender is processed."""
_STREAM_NS = 1_000_000_000
"""Interval between processed messages of a stream. Chosen: as often as an alarm is updated."""
_MOST_STREAMS = 64
"""Names and targets for which streams are thinned, 0.5 MB each; of further ones all messages are processed. Chosen: all
names for six vehicles; a monitor has one vehicle, a forged log may name 256."""
_FTP_OPCODE, _FTP_WRITES = 3, range(6, 14)
"""Index of the opcode in the payload, and the opcodes from CreateFile to Rename:
https://mavlink.io/en/services/ftp.html."""
_ALL_VEHICLES = ("GPS_INPUT", "HIL_GPS", "HIL_SENSOR", "SERIAL_CONTROL")
"""Messages that name no vehicle."""
_SERIAL_REPLY = 1
"""SERIAL_CONTROL_FLAG_REPLY: the autopilot reports the data of a port."""
_GOES_THERE = (2, 3)
"""MISSION_ITEM.current in ArduPilot's guided mode: fly there, climb to there. With other values the item is a part of a
mission."""
COMMANDS: Final = frozenset(
    {
        "COMMAND_LONG", "COMMAND_INT", *_SETS_PARAMETERS, *_PLANS, *_STREAMS,
        *(name for name in _RISKS if not name.isdigit()),
    }
)  # fmt: skip
"""Names of the messages that command a vehicle."""
_HARMLESS_PARAMETERS = ("CAM", "LOG_", "MNT", "NTF_", "OSD", "SDLOG_", "SR0_", "SR1_", "SR2_", "STAT_", "TRIG_")
"""Prefixes of parameters of ArduPilot and PX4 on which a flight does not depend: logs, rates of telemetry, payload."""
_MOST_SENDERS = 64
"""Most senders that are remembered. Chosen: more than ever command one vehicle; forged ids cost no further memory."""
_MOST_RISKS = 5
"""Most effects in a finding's text. Chosen: as many as fit a sentence."""


Weight = Literal["information", "warning", "critical"]


@dataclass(frozen=True, slots=True)
class CommandSent:
    """A command that somebody sent the vehicle."""

    time_s: float
    system: int
    component: int
    name: str  # name of the message, or the number of the MAV_CMD in it
    values: tuple[float | str, ...] = ()


def command_sent(
    name: str, fields: Mapping[str, Any], time_s: float, system: int, component: int, vehicle: int
) -> CommandSent | None:
    """Return the command in a message to a vehicle's autopilot, or None if it has none or is meant for another."""
    if name not in COMMANDS or not _is_for(name, fields, vehicle):
        return None
    number = fields.get("command")
    if isinstance(number, int) and name not in _STREAMS:
        values = tuple(fields.get(f"param{k}", 0.0) for k in range(1, 5))
        return CommandSent(time_s, system, component, str(number), values)
    said = tuple(value for key, value in fields.items() if isinstance(value, int | float | str) and "target" not in key)
    return CommandSent(time_s, system, component, name, said)


def _is_for(name: str, fields: Mapping[str, Any], vehicle: int | None) -> bool:
    """Return whether a message commands a vehicle's autopilot (None: that of any vehicle), by its content."""
    if name in _ALL_VEHICLES:
        return name != "SERIAL_CONTROL" or not _whole(fields.get("flags")) & _SERIAL_REPLY
    if vehicle is not None and _whole(fields.get(_target(name))) not in (0, vehicle):
        return False
    if _whole(fields.get("target_component", 0)) not in (0, AUTOPILOT):
        return False
    if name == "FILE_TRANSFER_PROTOCOL":
        payload = fields.get("payload")
        known = isinstance(payload, Sequence | np.ndarray) and len(payload) > _FTP_OPCODE
        return payload is not None and known and _whole(payload[_FTP_OPCODE]) in _FTP_WRITES
    return not name.startswith("MISSION_ITEM") or _whole(fields.get("current")) in _GOES_THERE


def _target(name: str) -> str:
    return "target" if name == "MANUAL_CONTROL" else "target_system"


def _whole(value: object) -> int:
    return int(value) if isinstance(value, int | np.integer) else -1


def commanded_systems(entry: Message | Columns) -> set[int]:
    """Return the systems that a message (or columns) commands, 0 for all; an empty set if it is not a command."""
    if entry.name not in COMMANDS or entry.source is not MAVLINK:
        return set()
    if entry.name in _ALL_VEHICLES:
        return {0}
    target = entry.fields.get(_target(entry.name))
    if isinstance(entry, Columns):
        return set() if target is None else set(target.ravel().tolist())
    return {target} if isinstance(target, int) else set()


class StreamFilter:
    """Thins out streams: it passes one message a second of each name, sender and target."""

    def __init__(self) -> None:
        # Times of the last message passed, by name and target, one for each sender: the number of senders is not
        # limited.
        self._last_ns: dict[tuple[str, int], NDArray[np.int64]] = {}

    def rows(self, entry: Columns, vehicle: int | None = None) -> Columns:
        """Return the rows to process of those that command a vehicle's autopilot, or all if they are no stream."""
        if entry.name not in _STREAMS:
            return entry
        keys = ("flags", "current", "payload", "target_component", _target(entry.name))
        known = {key: entry.fields[key] for key in keys if key in entry.fields}
        rows = [
            row
            for row, at_ns in enumerate(entry.received_ns.tolist())
            if self._passes(entry, {key: values[row] for key, values in known.items()}, at_ns, vehicle)
        ]
        return rows_of(entry, np.array(rows, np.intp))

    def passes(self, message: Message, vehicle: int) -> bool:
        """Return whether to process a message."""
        return message.name not in _STREAMS or self._passes(message, message.fields, message.received_ns, vehicle)

    def _passes(self, entry: Message | Columns, fields: Mapping[str, Any], at_ns: int, vehicle: int | None) -> bool:
        key = entry.name, _whole(fields.get(_target(entry.name)))
        sender, last_ns = (entry.system & 255, entry.component & 255), self._last_ns.get(key)
        if last_ns is not None and 0 <= at_ns - int(last_ns[sender]) < _STREAM_NS:
            return False
        if not _is_for(entry.name, fields, vehicle):
            return False
        if last_ns is None:
            if len(self._last_ns) >= _MOST_STREAMS:
                return True
            last_ns = self._last_ns[key] = np.zeros((256, 256), np.int64)
        last_ns[sender] = at_ns
        return True


@dataclass(frozen=True, slots=True)
class CommandFinding:
    """A finding from commands in flight."""

    sender: tuple[int, int] | None  # system and component of a new sender; None: too many commands, from any senders
    weight: Weight  # information alone raises no alarm
    text: str  # what happened since take-off, without a full stop


def command_risk(name: str, values: Sequence[float | str]) -> str | None:
    """Return the effect of a message on a vehicle in flight in words, or None if it is harmless.

    ``name`` is the message's name, or the number of the MAV_CMD in it; ``values`` are the parameters of a command, or
    the name of the parameter that is set.
    """
    if name in _PLANS:
        plan = dict(enumerate(values)).get(_PLANS[name], 0)
        return _PLAN_TYPES.get(int(plan), "rewrites the mission") if isinstance(plan, int | float) else None
    if name in _SETS_PARAMETERS:
        parameter = next((value for value in values if isinstance(value, str)), "")
        return f"sets {parameter}" if parameter and not parameter.startswith(_HARMLESS_PARAMETERS) else None
    first = values[0] if values else None
    exactly = _RISKS_WITH.get((name, first)) if isinstance(first, int | float) else None
    return exactly or _RISKS.get(name) or _STREAMS.get(name)


def ends_flight(name: str, values: Sequence[float | str]) -> bool:
    """Return whether a message brings a flying vehicle down, which nobody does incidentally."""
    return command_risk(name, values) in _ENDS


class CommandWatch:
    """Remembers who commanded a vehicle while it did not fly, and the effects of commands from other senders in flight.

    A risky command of a new sender is critical if others had commanded before. If nobody had (a vehicle armed by its
    radio control, a monitor that started in flight), it is a warning if it ends the flight, otherwise information.

    ``known`` are system and component of the senders while it did not fly, ``most`` is the largest number of commands
    within a second in flight.
    """

    def __init__(self) -> None:
        self.known: dict[tuple[int, int], None] = {}
        self.most = 0
        self._risks: dict[tuple[int, int], list[str]] = {}  # effects of commands from new senders in flight
        self._times_s: deque[float] = deque()
        self._flooded_s: float | None = None

    def follow(self, command: CommandSent, flying: bool) -> list[CommandFinding]:
        """Process the next command; return its findings, again for a repeated command."""
        sender = command.system, command.component
        if not flying:
            _remember(self.known, sender, None)
            self._risks.pop(sender, None)
            self._times_s.clear()
            return []
        found = []
        risk = command_risk(command.name, command.values)
        if risk is not None and sender not in self.known:
            found.append(self._stranger(sender, risk))
        if command.name not in _STREAMS and self._floods(command.time_s):
            text = f"more than {FLOOD} commands a second reached the vehicle in flight"
            found.append(CommandFinding(None, "warning", text))
        return found

    def _stranger(self, sender: tuple[int, int], risk: str) -> CommandFinding:
        risks = self._risks.get(sender)
        if risks is None:
            risks = []
            _remember(self._risks, sender, risks)
        if risk not in risks:
            # commands that end the flight come first, so that they are never cut off
            risks.insert(0 if risk in _ENDS else len(risks), risk)
            del risks[_MOST_RISKS:]
        weight: Weight = "critical" if self.known else "warning" if risk in _ENDS else "information"
        said = f"{', '.join(risks[:-1])} and {risks[-1]}" if len(risks) > 1 else risks[0]
        text = f"system {sender[0]}, component {sender[1]}, which had not commanded before, {said} in flight"
        return CommandFinding(sender, weight, text)

    def _floods(self, now_s: float) -> bool:
        """Return whether this command exceeds the limit within a second; true at most once a second."""
        times_s = self._times_s
        if times_s and now_s < times_s[-1]:
            times_s.clear()
        times_s.append(now_s)
        while now_s - times_s[0] >= 1.0 or len(times_s) > FLOOD * _MOST_SENDERS:
            times_s.popleft()
        self.most = max(self.most, len(times_s))
        quiet = self._flooded_s is None or not 0 <= now_s - self._flooded_s < 1.0
        if len(times_s) <= FLOOD or not quiet:
            return False
        self._flooded_s = now_s
        return True


def _remember(senders: dict[tuple[int, int], Any], sender: tuple[int, int], value: object) -> None:
    senders[sender] = value
    if len(senders) > _MOST_SENDERS:
        del senders[next(iter(senders))]
