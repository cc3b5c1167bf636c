"""One decoded telemetry message, whatever link or recording it came from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from adapters.source import CLOCK, Source

# The year 2116: sums and differences of times below it fit into 64 bits.
LATEST_NS: Final = 1 << 62
SECOND_NS: Final = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Message:
    """A decoded message with its time of arrival.

    Parameters
    ----------
    source : Source
        Kind of source, one of :data:`adapters.source.SOURCES`; recordings keep messages of all of them.
    name : str
        MAVLink message name (``"ATTITUDE"``), Zenoh key expression (``"arm/telemetry"``) or name of a log's record
        (``"sensor_baro/1"``).
    received_ns : int
        Unix time of arrival, nanoseconds; in recordings below :data:`LATEST_NS`, what says otherwise is damaged.
    fields : Mapping[str, Any]
        Decoded fields: numbers, strings, lists and (JSON only) nested mappings.
    system, component : int
        MAVLink ids of the sender; 0 where the link has none.
    """

    source: Source
    name: str
    received_ns: int
    fields: Mapping[str, Any]
    system: int = 0
    component: int = 0


SILENCE = "silence"


def silence(now_ns: int) -> Message:
    """Return the message that says that Unix time has come to ``now_ns`` without telemetry.

    Time that passes is an input like any other: recorded, it replays like any other.
    """
    return Message(source=CLOCK, name=SILENCE, received_ns=now_ns, fields={})
