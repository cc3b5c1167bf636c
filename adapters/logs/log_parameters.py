"""The vehicle's parameters in a recording, from each kind of record that holds one."""

import struct
from collections.abc import Mapping
from typing import Final

from adapters.message import Message

_FIELDS: Final[Mapping[str, tuple[str, str]]] = {
    "log/parameter": ("key", "value"),  # PX4's logs
    "PARM": ("Name", "Value"),  # ArduPilot's
    "PARAM_VALUE": ("param_id", "param_value"),  # MAVLink
}
PARAMETER_MESSAGES: Final = frozenset(_FIELDS)
"""Names of the records and messages that hold a parameter."""

# Codes of MAV_PARAM_TYPE for integers of up to 32 bits.
_INTEGERS = {1: "<B3x", 2: "<b3x", 3: "<H2x", 4: "<h2x", 5: "<I", 6: "<i"}


def parameter(message: Message, *, px4: bool = False) -> tuple[str, float] | None:
    """Return name and value of the parameter that a message holds, or None if it holds none.

    ``px4`` says that PX4 sent it: in PARAM_VALUE it writes the bytes of integers in place of a float
    (https://mavlink.io/en/services/parameter.html, "bytewise"; ArduPilot converts them).
    """
    name_field, value_field = _FIELDS[message.name]
    name, value, kind = (message.fields.get(key) for key in (name_field, value_field, "param_type"))
    if not isinstance(name, str) or not name or isinstance(value, bool) or not isinstance(value, int | float):
        return None
    code = _INTEGERS.get(kind) if px4 and isinstance(kind, int) else None
    try:
        return name, float(value if code is None else struct.unpack(code, struct.pack("<f", value))[0])
    except OverflowError:
        return None
