"""Channel mapping: which field of which message is which input or output, in which unit, on which clock."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from math import isfinite
from typing import Any, Literal

from adapters.errors import TelemetryError

Interpolation = Literal["linear", "previous"]

_STEP = re.compile(r"([^.\[\]]+)|\[(?:(\d+)|([^\[\]]+))\]")
_KEYS = {"message", "field", "where", "scale", "offset", "clock", "clock_unit_ns", "interpolation", "period"}
CLOCK_UNITS_NS = {"time_boot_ms": 1_000_000, "time_usec": 1_000, "time_ns": 1}
MAX_VALUE = 1e12
"""Beyond it no vehicle measures anything, in any unit; an observer that believed it would be blind for seconds."""
# Where messages of ROS 2, and those of Foxglove's schemas, have their time: seconds and nanoseconds.
_ROS_STAMP = ("header", "stamp")
_FOXGLOVE_STAMP = "timestamp"


@dataclass(frozen=True, slots=True)
class Channel:
    """One scalar signal taken from telemetry: ``value = scale * field + offset``.

    Parameters
    ----------
    name : str
        The user's name of the channel, the same as in the plant model.
    message : str
        MAVLink message name, Zenoh key or topic of ROS 2 (without its leading slash) the field is taken from.
    path : tuple[str | int, ...]
        Steps into the message's fields, ``"data[3]"`` being ``("data", 3)``. A name in place of a number,
        ``"position[elbow]"``, is looked up in the list ``name`` beside: the joints of a JointState, whose order may
        change from message to message.
    scale, offset : float
        From the field's unit to the channel's.
    where : tuple[tuple[str, int | str], ...]
        Fields and the values they must have, where several senders share a message name: SERVO_OUTPUT_RAW
        with ``port`` 0 and 1, DEBUG_FLOAT_ARRAY with different ``name``.
    clock : str | None
        Field with the measurement's time on the vehicle's clock, a number or seconds and nanoseconds as ROS 2
        writes them (``sec``, ``nanosec``); None takes ``time_boot_ms``, ``time_usec``, ``time_ns``,
        ``header.stamp`` or such a ``timestamp``, whichever the message has, and the newest vehicle time where it has
        none.
    clock_unit_ns : int | None
        Nanoseconds per count of that field; None: known from the usual names.
    interpolation : {"linear", "previous"}
        How the value between two measurements is found.
    period : float | None
        Of a value that wraps, in the channel's unit: an angle of 359 degrees and one of 1 degree (period 360) are 2
        degrees apart. Interpolation goes the shorter way round and may leave the range.
    """

    name: str
    message: str
    path: tuple[str | int, ...]
    scale: float = 1.0
    offset: float = 0.0
    where: tuple[tuple[str, int | str], ...] = ()
    clock: str | None = None
    clock_unit_ns: int | None = None
    interpolation: Interpolation = "linear"
    period: float | None = None

    def selects(self, fields: Mapping[str, Any]) -> bool:
        """Return whether the message is one of those the channel is taken from."""
        return all(fields.get(name) == value for name, value in self.where)

    def value(self, fields: Mapping[str, Any]) -> float | None:
        """Return the channel's value, None where no number is there that can be one: NaN, beyond :data:`MAX_VALUE`."""
        path = self.path
        # Most paths are one name; they are read some thousand times a second.
        found = fields.get(path[0]) if len(path) == 1 else follow(fields, path)  # type: ignore[arg-type]
        if not isinstance(found, float) and (not isinstance(found, int) or isinstance(found, bool)):
            return None
        try:
            value = self.scale * found + self.offset
        except OverflowError:
            return None
        return value if -MAX_VALUE <= value <= MAX_VALUE else None

    def stamp_ns(self, fields: Mapping[str, Any]) -> int | None:
        """Return the measurement's time on the vehicle's clock in nanoseconds, None where it has none."""
        if self.clock is not None:
            found = fields.get(self.clock)
            if found is None:
                found = follow(fields, field_steps(self.clock))
            return _stamp(found, self.clock_unit_ns or CLOCK_UNITS_NS.get(self.clock, 1))
        for name, unit_ns in CLOCK_UNITS_NS.items():
            stamp = _stamp(fields.get(name), self.clock_unit_ns or unit_ns)
            if stamp is not None:
                return stamp
        if "header" in fields:
            return _stamp(follow(fields, _ROS_STAMP), 1)
        stamped = fields.get(_FOXGLOVE_STAMP)
        return _stamp(stamped, 1) if isinstance(stamped, Mapping) else None


def _stamp(count: Any, unit_ns: int) -> int | None:
    if isinstance(count, Mapping):
        seconds, rest = _whole(count.get("sec"), 1_000_000_000), _whole(count.get("nanosec", count.get("nsec")), 1)
        return None if seconds is None or rest is None else seconds + rest
    return _whole(count, unit_ns)


def _whole(count: Any, unit_ns: int) -> int | None:
    if isinstance(count, float) and isfinite(count * unit_ns):
        return round(count * unit_ns)
    return count * unit_ns if isinstance(count, int) and not isinstance(count, bool) else None


def follow(fields: Mapping[str, Any], path: tuple[str | int, ...]) -> Any:
    """Return what stands at ``path`` inside decoded fields, None where there is nothing."""
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
    """Return the value that belongs to a name; None where it is not there, twice, or the lists are not alike long."""
    if not isinstance(names, list) or len(names) != len(values) or names.count(name) != 1:
        return None
    return values[names.index(name)]


@lru_cache(maxsize=1024)
def field_steps(field: str) -> tuple[str | int, ...]:
    """Return the steps of a field as it is written: names, and indices or names in brackets."""
    return tuple(int(index) if index else step or name for step, index, name in _STEP.findall(field))


def parse_channel(name: str, table: Mapping[str, Any], where: str) -> Channel:
    """Read one channel from its TOML table.

    Parameters
    ----------
    name : str
        The channel's name.
    table : Mapping[str, Any]
        Keys ``message`` (a leading slash is dropped) and ``field`` (required), ``where``, ``scale``, ``offset``,
        ``clock``, ``clock_unit_ns``, ``interpolation``, ``period``.
    where : str
        File and key of the table, for errors.

    Raises
    ------
    TelemetryError
        A key is missing, unknown or of the wrong type.
    """
    unknown = sorted(set(table) - _KEYS)
    if unknown:
        raise TelemetryError(f"{where}: unknown key {unknown[0]!r}; known are {', '.join(sorted(_KEYS))}")
    for key in ("message", "field"):
        if not isinstance(table.get(key), str) or not table[key]:
            raise TelemetryError(f"{where}: '{key}' is missing or not text")
    for key in ("scale", "offset"):
        if key in table and not is_number(table[key]):
            raise TelemetryError(f"{where}: '{key}' is not a number")
    where_table = table.get("where", {})
    if not isinstance(where_table, Mapping) or not all(isinstance(v, (int, str)) for v in where_table.values()):
        raise TelemetryError(f"{where}: 'where' is not a table of fields and their values, like {{ port = 0 }}")
    interpolation = table.get("interpolation", "linear")
    if interpolation not in ("linear", "previous"):
        raise TelemetryError(f"{where}: 'interpolation' is unknown; use 'linear' or 'previous'")
    clock = table.get("clock")
    if clock is not None and not isinstance(clock, str):
        raise TelemetryError(f"{where}: 'clock' is not the name of a field")
    unit = table.get("clock_unit_ns")
    if unit is not None and (isinstance(unit, bool) or not isinstance(unit, int) or unit <= 0):
        raise TelemetryError(f"{where}: 'clock_unit_ns' is not a positive whole number of nanoseconds")
    period = table.get("period")
    if period is not None and not (is_number(period) and period > 0):
        raise TelemetryError(f"{where}: 'period' is not a positive number")
    field = str(table["field"])
    path = field_steps(field)
    if not path:
        raise TelemetryError(
            f"{where}: 'field' is {field!r}; write it like 'rollspeed', 'data[3]' or 'position[elbow]'"
        )
    return Channel(
        name=name,
        message=str(table["message"]).removeprefix("/") or "/",
        path=path,
        scale=float(table.get("scale", 1.0)),
        offset=float(table.get("offset", 0.0)),
        where=tuple(where_table.items()),
        clock=clock,
        clock_unit_ns=unit,
        interpolation=interpolation,
        period=None if period is None else float(period),
    )


def is_number(value: Any) -> bool:
    """Return whether a value of a TOML table is a finite number, whole or not."""
    try:
        return type(value) in (int, float) and isfinite(value)
    except OverflowError:
        return False


def channel_table(channel: Channel) -> dict[str, Any]:
    """Return the TOML table that :func:`parse_channel` reads back as the same channel."""
    field = "".join(f"[{step}]" if isinstance(step, int) or "." in step else f".{step}" for step in channel.path)
    table: dict[str, Any] = {"message": channel.message, "field": field.lstrip(".")}
    if channel.where:
        table["where"] = dict(channel.where)
    if channel.scale != 1.0:
        table["scale"] = channel.scale
    if channel.offset != 0.0:
        table["offset"] = channel.offset
    if channel.clock is not None:
        table["clock"] = channel.clock
    if channel.clock_unit_ns is not None:
        table["clock_unit_ns"] = channel.clock_unit_ns
    if channel.interpolation != "linear":
        table["interpolation"] = channel.interpolation
    if channel.period is not None:
        table["period"] = channel.period
    return table
