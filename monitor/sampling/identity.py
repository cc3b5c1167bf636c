"""Which vehicle telemetry or a log comes from: its type, autopilot, frame and number of motors, as far as it tells."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from math import isfinite
from types import MappingProxyType
from typing import Any, ClassVar

from adapters.logs.log_parameters import PARAMETER_MESSAGES, parameter
from adapters.mavlink.heartbeat import PX4, enumerated, is_autopilot_heartbeat, vehicle_type
from adapters.message import Message
from adapters.source import MAVLINK

_COPTERS: Mapping[int, tuple[str, str, int]] = MappingProxyType(
    {
        1: ("quad", "quadrotor", 4),
        2: ("hexa", "hexarotor", 6),
        3: ("octa", "octorotor", 8),
        4: ("octaquad", "octorotor", 8),
        5: ("y6", "hexarotor", 6),
        6: ("heli", "helicopter", 0),
        7: ("tri", "tricopter", 3),
        12: ("dodecahexa", "dodecarotor", 12),
        14: ("deca", "decarotor", 10),
    }
)
"""ArduCopter's FRAME_CLASS: its name, the type in its heartbeats, and its motors (AP_Motors_Class.h)."""
_SHAPES = {0: "plus", 1: "x", 2: "v", 3: "h", 4: "v-tail", 5: "a-tail", 12: "betaflight-x", 13: "dji-x", 14: "cw-x"}
"""ArduCopter's FRAME_TYPE (AP_Motors_Class.h): the order and the places of the motors of a class."""
_SHAPED = ("quad", "hexa", "octa", "octaquad", "y6", "dodecahexa", "deca")
_FIRMWARE = {
    **dict.fromkeys(("arducopter", "apm:copter"), "copter"),
    **dict.fromkeys(("arduplane", "apm:plane"), "plane"),
    **dict.fromkeys(("ardurover", "rover", "apmrover2", "apm:rover"), "rover"),
    "ardusub": "submarine",
}
"""First word of the firmware's name in the head of an ArduPilot log, and the kind of vehicle that it flies or
drives."""
_ROTOR_COUNT, _PX4_TYPE = "CA_ROTOR_COUNT", "MAV_TYPE"
_PARAMETERS = frozenset({"FRAME_CLASS", "FRAME_TYPE", "Q_ENABLE", _ROTOR_COUNT, _PX4_TYPE})
_BOAT = 2
"""ArduRover's FRAME_CLASS of a boat."""
_MOST_MOTORS = 32
"""ArduPilot's AP_MOTORS_MAX_NUM_MOTORS; PX4 has 12. A larger number is no count of motors."""


@dataclass(frozen=True, slots=True)
class Identity:
    """What is known about the vehicle's identity; empty or 0: unknown."""

    vehicle_type: str = ""  # HEARTBEAT.type in words (``quadrotor``, ``fixed wing``)
    autopilot: str = ""  # HEARTBEAT.autopilot in words (``ardupilotmega``, ``px4``)
    frame: str = ""  # class and shape of a copter's frame (``quad/x``), which determine the places of its motors
    motors: int = 0  # number of motors

    def difference(self, other: Identity) -> tuple[str, str] | None:
        """Return each difference between two identities in words; None if nothing that both know differs."""
        names = [field.name for field in fields(self)]
        unlike = [name for name in names if len({getattr(self, name), getattr(other, name)} - {"", 0}) > 1]
        return (self._words(unlike), other._words(unlike)) if unlike else None

    def contradiction(self, fitted: Identity) -> str | None:
        """Return why it is not the vehicle that a profile was fitted to; None if nothing shows that."""
        if (unlike := self.difference(fitted)) is None:
            return None
        here, there = unlike
        return f"another vehicle than the profile's: it says it is {here}, the profile was fitted to {there}"

    def _words(self, names: Sequence[str]) -> str:
        """Return its type in words, and what else is asked for."""
        words = {"autopilot": self.autopilot, "frame": f"a {self.frame} frame", "motors": f"{self.motors} motors"}
        more = ", ".join(words[name] for name in names if name in words)
        return f"a {self.vehicle_type or 'vehicle'}" + (f" with {more}" if more else "")

    def table(self) -> dict[str, str | int]:
        """Return the known parts by name."""
        return {field.name: value for field in fields(self) if (value := getattr(self, field.name))}


def common_identity(identities: Iterable[Identity]) -> Identity:
    """Return the parts that any of the identities knows and none contradicts."""
    given = list(identities)
    known = {
        field.name: {value for identity in given if (value := getattr(identity, field.name))}
        for field in fields(Identity)
    }
    return Identity(**{name: values.pop() for name, values in known.items() if len(values) == 1})


@dataclass(frozen=True, slots=True)
class Reports:
    """What a vehicle has told about itself so far; :meth:`after` follows a message."""

    # of the autopilot's newest HEARTBEAT that is not "generic" (0)
    type: int = 0
    autopilot: int = 0
    firmware: str = ""  # a value of :data:`_FIRMWARE`, from the head of an ArduPilot log
    parameters: Mapping[str, int] = field(default_factory=dict)  # parameters that say which frame it has

    # names of the messages that are read: heartbeats, and parameters on a link or in either autopilot's log
    interests: ClassVar[frozenset[str]] = PARAMETER_MESSAGES | {"HEARTBEAT", "MSG"}

    def after(self, message: Message) -> Reports:
        """Return what is known after a message; the same object if the message tells nothing new."""
        said = message.fields
        if message.name == "HEARTBEAT":
            return self._after_heartbeat(said) if is_autopilot_heartbeat(message) else self
        if message.name in PARAMETER_MESSAGES and (message.source.is_onboard_log or message.source is MAVLINK):
            return self._with(parameter(message, px4=self.autopilot == PX4))
        return self._after_text(said.get("Message")) if message.source.is_onboard_log else self

    def joined(self, others: Reports) -> Reports:
        """Return what is known with what others say, too: the records of a log beside the heartbeats made of them."""
        return Reports(
            others.type or self.type,
            others.autopilot or self.autopilot,
            others.firmware or self.firmware,
            {**self.parameters, **others.parameters},
        )

    @property
    def identity(self) -> Identity:
        """The vehicle's identity."""
        return Identity(
            vehicle_type(self.type) or self._type_by_parameters(),
            (enumerated("MAV_AUTOPILOT", self.autopilot) or "") if self.autopilot else "",
            *self._frame(),
        )

    def _after_heartbeat(self, said: Mapping[str, Any]) -> Reports:
        kind, autopilot = (value if type(value) is int else 0 for value in map(said.get, ("type", "autopilot")))
        if kind in (0, self.type) and autopilot in (0, self.autopilot):
            return self
        return replace(self, type=kind or self.type, autopilot=autopilot or self.autopilot)

    def _after_text(self, text: Any) -> Reports:
        words = text.split() if isinstance(text, str) else []
        if words[:1] == ["Frame:"] and "FRAME_CLASS" not in self.parameters:
            # of ArduCopter before 3.5, which has no such parameter
            of = {name.upper(): number for number, (name, *_) in _COPTERS.items()}
            return self._with(("FRAME_CLASS", of.get("".join(words[1:2]).partition("/")[0], 0)))
        firmware = _FIRMWARE.get(words[0].lower(), "") if len(words) > 1 and words[1][:1] in ("V", "v") else ""
        return self if not firmware or firmware == self.firmware else replace(self, firmware=firmware)

    def _with(self, named: tuple[str, float] | None) -> Reports:
        name, value = named or ("", 0.0)
        if name not in _PARAMETERS or not isfinite(value) or self.parameters.get(name) == int(value):
            return self
        return replace(self, parameters={**self.parameters, name: int(value)})

    def _copter(self) -> tuple[str, str, int] | None:
        """Return the frame's class if the parameters are a copter's: rovers number classes of their own."""
        kind = vehicle_type(self.type)
        is_copter = self.firmware == "copter" or (not self.firmware and ("rotor" in kind or "copter" in kind))
        return _COPTERS.get(self.parameters.get("FRAME_CLASS", 0)) if is_copter else None

    def _type_by_parameters(self) -> str:
        if self.firmware == "copter":
            copter = self._copter()
            return "" if copter is None else copter[1]
        if self.firmware == "plane":
            return "" if self.parameters.get("Q_ENABLE", 0) else "fixed wing"
        if self.firmware == "rover":
            return "surface boat" if self.parameters.get("FRAME_CLASS") == _BOAT else "ground rover"
        return self.firmware or vehicle_type(self.parameters.get(_PX4_TYPE))

    def _frame(self) -> tuple[str, int]:
        """Return the frame's name and number of motors."""
        copter = self._copter()
        if copter is None:
            count = self.parameters.get(_ROTOR_COUNT, 0)
            return "", count if 0 < count <= _MOST_MOTORS else 0
        name, _, motors = copter
        if name not in _SHAPED:
            return name, motors
        shape = self.parameters.get("FRAME_TYPE")
        return ("" if shape is None else f"{name}/{_SHAPES.get(shape, shape)}"), motors
