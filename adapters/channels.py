"""Channel mapping: the message, field, unit and clock that each input or output is taken from."""

import re
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
from functools import lru_cache
from math import asin, atan2, hypot, isfinite, nan
from typing import Any, Literal, get_args

from adapters.errors import TelemetryError
from adapters.toml_tables import Table, TomlFile

Interpolation = Literal["linear", "previous", "mean"]
Angle = Literal["roll", "pitch", "yaw"]

_STEP = re.compile(r"([^.\[\]]+)|\[(?:(\d+)|([^\[\]]+))\]")
_INTERPOLATIONS: tuple[Interpolation, ...] = get_args(Interpolation)
_ANGLES: tuple[Angle, ...] = get_args(Angle)
CLOCK_UNITS_NS = {"time_boot_ms": 1_000_000, "time_usec": 1_000, "time_ns": 1}
"""Usual names of clock fields and the nanoseconds per count; the first one that a message has is its clock."""
STANDARD_GRAVITY = 9.80665
"""Standard acceleration of free fall, m/s^2 (ISO 80000-3); MAVLink gives accelerations in thousandths of it."""
SPEED, COURSE = "gps_speed", "gps_course"
"""Channels that are the length and direction of one vector, the velocity over ground. The vector is interpolated on a
straight line: a vehicle that stops and goes back in the opposite direction does not turn meanwhile."""
MAX_VALUE = 1e12
"""Largest value of a measurement, in any unit: no vehicle measures more, and an observer that used a larger one would
be blind for seconds."""
_UNKNOWN_BEYOND = 655.34
"""Largest speed, m/s, and course, degrees, of a GPS: GPS_RAW_INT gives 65535 hundredths for one that is unknown."""
MAX_COMMAND = 2.0
"""Largest command of a motor, of full command 1: twice full command, which no range of pulses reaches."""
STOPPED = -0.01
"""Smallest command of a motor: PX4 sends 900 us to a motor that it has stopped, a tenth below the range."""
_LARGEST_PART, _SMALLEST_LENGTH = 1e3, 0.5
"""Lengths of a quaternion, which should be 1. Chosen: a quaternion shorter than half is invalid (drivers without an
attitude send zeros); elements beyond a thousand are other data."""
# Fields in which messages of ROS 2 and of Foxglove's schemas have their time: seconds and nanoseconds.
_ROS_STAMP = ("header", "stamp")
_FOXGLOVE_STAMP = "timestamp"


@dataclass(frozen=True, slots=True)
class Channel:
    """One scalar signal taken from telemetry: ``value = scale * field + offset``."""

    name: str  # the user's name of the channel, the same as in the plant model
    # MAVLink message name, Zenoh key or topic of ROS 2 (without its leading slash) that holds the field
    message: str
    # Path into the message's fields: ``"data[3]"`` is ``("data", 3)``. A name instead of a number,
    # ``"position[elbow]"``, is looked up in the list ``name`` of the same message, as for the joints of a JointState,
    # whose order may change from message to message.
    path: tuple[str | int, ...]
    scale: float = 1.0  # from the field's unit to the channel's
    offset: float = 0.0
    # fields and the values they must have, if several senders share a message name: SERVO_OUTPUT_RAW with ``port`` 0
    # and 1, DEBUG_FLOAT_ARRAY with different ``name``
    where: tuple[tuple[str, int | str], ...] = ()
    # field with the time of the measurement on the vehicle's clock, a number, or seconds and nanoseconds as in ROS 2
    # (``sec``, ``nanosec``). None: whichever of ``time_boot_ms``, ``time_usec``, ``time_ns``, ``header.stamp`` or a
    # ``timestamp`` like it the message has, otherwise the newest vehicle time
    clock: str | None = None
    clock_unit_ns: int | None = None  # nanoseconds per count of that field; None: derived from the usual names
    # value at a tick of the grid: on the straight line between two measurements, that of the newest measurement, or the
    # mean of the lines until the next tick
    interpolation: Interpolation = "linear"
    # Period of a value that wraps, in the channel's unit: an angle of 359 degrees and one of 1 degree (period 360) are
    # 2 degrees apart. Interpolation goes the shorter way round and may leave the range.
    period: float | None = None
    # Angle to take from a field that holds a quaternion (``x``, ``y``, ``z``, ``w``, as in ROS 2), radians: its
    # rotations are about z, then y, then x. None: the field is a number.
    angle: Angle | None = None
    # Value that replaces a negative motor command, 0 to 1, which an autopilot sends to a motor that it has stopped
    # while others turn. With the command of hovering, a motor stopped in flight delivers none of it.
    stopped_as: float | None = None
    # fields and the smallest values with which the message is a measurement: a receiver without a fix repeats its last
    # one with a lower ``fix_type``
    at_least: tuple[tuple[str, float], ...] = ()

    def selects(self, fields: Mapping[str, Any]) -> bool:
        """Return whether the channel is taken from this message."""
        if not all(fields.get(name) == value for name, value in self.where):
            return False
        found = ((fields.get(name), least) for name, least in self.at_least)
        return all(isinstance(value, int | float) and value >= least for value, least in found)

    @property
    def largest(self) -> float:
        """Return the size above which a value is not a measurement."""
        if self.name in (SPEED, COURSE):
            return _UNKNOWN_BEYOND
        return MAX_VALUE if self.stopped_as is None else MAX_COMMAND

    def value(self, fields: Mapping[str, Any]) -> float | None:
        """Return the channel's value, or None if it is missing, NaN or larger than :attr:`largest`."""
        path = self.path
        # Most paths are a single name; they are read some thousand times a second.
        number = fields.get(path[0]) if len(path) == 1 else follow(fields, path)  # type: ignore[arg-type]
        if self.angle is not None:
            number = _angle(number, self.angle)
        if not isinstance(number, float) and (not isinstance(number, int) or isinstance(number, bool)):
            return None
        try:
            value = self.scale * number + self.offset
        except OverflowError:
            return None
        if self.stopped_as is not None and value < STOPPED:
            return self.stopped_as
        return value if -self.largest <= value <= self.largest else None

    def stamp_ns(self, fields: Mapping[str, Any]) -> int | None:
        """Return the time of the measurement on the vehicle's clock in nanoseconds, or None if the message has none."""
        if self.clock is not None:
            count = fields.get(self.clock)
            if count is None:
                count = follow(fields, field_steps(self.clock))
            return _stamp(count, self.clock_unit_ns or CLOCK_UNITS_NS.get(self.clock, 1))
        for name, unit_ns in CLOCK_UNITS_NS.items():
            stamp = _stamp(fields.get(name), self.clock_unit_ns or unit_ns)
            if stamp is not None:
                return stamp
        if "header" in fields:
            return _stamp(follow(fields, _ROS_STAMP), 1)
        stamped = fields.get(_FOXGLOVE_STAMP)
        return _stamp(stamped, 1) if isinstance(stamped, Mapping) else None


def _angle(quaternion: Any, which: Angle) -> float | None:
    """Return an angle of a quaternion, normalised to length 1, or None if the quaternion is invalid."""
    parts: list[Any] = [quaternion.get(name) for name in "xyzw"] if isinstance(quaternion, Mapping) else []
    if not parts or not all(type(part) in (int, float) and abs(part) <= _LARGEST_PART for part in parts):
        return None
    length = hypot(*parts)
    if length < _SMALLEST_LENGTH:
        return None
    x, y, z, w = (part / length for part in parts)
    if which == "roll":
        return atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    if which == "yaw":
        return atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x))))


ANY_CLOCK = Channel("clock", "", ("",))
"""Reads the usual clock fields."""


def _stamp(count: Any, unit_ns: int) -> int | None:
    if isinstance(count, Mapping):
        seconds, rest = _whole(count.get("sec"), 1_000_000_000), _whole(count.get("nanosec", count.get("nsec")), 1)
        return None if seconds is None or rest is None else seconds + rest
    return _whole(count, unit_ns)


def _whole(count: Any, unit_ns: int) -> int | None:
    if isinstance(count, float) and isfinite(count * unit_ns):
        return round(count * unit_ns)
    return count * unit_ns if isinstance(count, int) and not isinstance(count, bool) else None


def number(value: object) -> float:
    """Return a number from the network, or NaN if it is not a number or is too large for one."""
    if type(value) not in (int, float):
        return nan
    try:
        return float(value)  # type: ignore[arg-type]
    except OverflowError:
        return nan


def follow(fields: Mapping[str, Any], path: tuple[str | int, ...]) -> Any:
    """Return the value at ``path`` inside decoded fields, or None if it is missing."""
    here: Any = fields
    above: Any = None
    for step in path:
        if isinstance(step, str) and isinstance(here, (dict, Mapping)):
            above, here = here, here.get(step)
        elif isinstance(step, str) and isinstance(here, list) and isinstance(above, (dict, Mapping)):
            here = _named(above.get("name"), here, step)
        elif isinstance(step, int) and isinstance(here, list | tuple) and step < len(here):
            here = here[step]
        else:
            return None
    return here


def _named(names: Any, values: list[Any], name: str) -> Any:
    """Return the value of a name, or None if it is missing or twice there, or the lists differ in length."""
    if not isinstance(names, list) or len(names) != len(values) or names.count(name) != 1:
        return None
    return values[names.index(name)]


@lru_cache(maxsize=1024)
def field_steps(field: str) -> tuple[str | int, ...]:
    """Return the path of a field from its text: names, and indices or names in brackets."""
    return tuple(int(index) if index else step or name for step, index, name in _STEP.findall(field))


_SELECTING = ("where", "at_least")
"""Keys of a channel that are tables of fields."""


def read_channel(name: str, table: Table) -> Channel:
    """Read one channel from its TOML table; mistakes are recorded in the table's file.

    Keys are ``message`` (a leading slash is dropped) and ``field``, both required, ``where``, ``scale``, ``offset``,
    ``clock``, ``clock_unit_ns``, ``interpolation``, ``period``, ``angle``, ``stopped_as``, ``at_least``.
    """
    least = table.table("at_least") if table.has("at_least") else None
    selection = table.raw("where") or {}
    if not isinstance(selection, Mapping) or not all(isinstance(v, (int, str)) for v in selection.values()):
        table.mistake("where", "is not a table of fields and their values, like { port = 0 }")
        selection = {}
    channel = Channel(
        name=name,
        message=table.text("message", check=not_empty).removeprefix("/") or "/",
        path=field_steps(table.text("field", check=_field)),
        scale=table.number("scale", 1.0),
        offset=table.number("offset", 0.0),
        where=tuple(selection.items()),
        clock=table.optional_text("clock"),
        clock_unit_ns=table.integer("clock_unit_ns", at_least=1) if table.has("clock_unit_ns") else None,
        interpolation=table.choice("interpolation", _INTERPOLATIONS, "linear"),
        period=table.number("period", above=0.0) if table.has("period") else None,
        angle=table.choice("angle", _ANGLES) if table.has("angle") else None,
        stopped_as=table.number("stopped_as") if table.has("stopped_as") else None,
        at_least=() if least is None else tuple((name, least.number(name)) for name in least),
    )
    table.done()
    return channel


def parse_channel(name: str, content: Mapping[str, Any], where: str) -> Channel:
    """Return the channel of a table that does not come from a file, as :func:`read_channel` reads it.

    Raises
    ------
    TelemetryError
        A key is missing, unknown or wrong; the lines begin with ``where``.
    """
    file = TomlFile(where, content, TelemetryError)
    channel = read_channel(name, file.root)
    file.check()
    return channel


def not_empty(text: str) -> None:
    """Refuse an empty text."""
    if not text:
        raise ValueError("is empty")


def _field(text: str) -> None:
    if not field_steps(text):
        raise ValueError(f"is {text!r}; write it like 'rollspeed', 'data[3]' or 'position[elbow]'")


def channel_table(channel: Channel) -> dict[str, Any]:
    """Return the TOML table from which :func:`parse_channel` reads the same channel."""
    field = "".join(f"[{step}]" if isinstance(step, int) or "." in step else f".{step}" for step in channel.path)
    table: dict[str, Any] = {"message": channel.message, "field": field.lstrip(".")}
    table |= {key: dict(pairs) for key in _SELECTING if (pairs := getattr(channel, key))}
    options = {field.name: field.default for field in fields(Channel) if field.default is not MISSING}
    for option, default in options.items():
        if option not in _SELECTING and getattr(channel, option) != default:
            table[option] = getattr(channel, option)
    return table
