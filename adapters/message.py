"""One decoded telemetry message, whatever link or recording it came from."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from adapters.source import CLOCK, Source

# Latest time, in the year 2116: sums and differences of earlier times fit into 64 bits.
LATEST_NS: Final = 1 << 62
SECOND_NS: Final = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Message:
    """A decoded message with its time of arrival."""

    source: Source  # kind of source, one of :data:`adapters.source.SOURCES`; recordings keep messages of all of them
    # MAVLink message name (``"ATTITUDE"``), Zenoh key expression (``"arm/telemetry"``) or name of a log's record
    # (``"sensor_baro/1"``)
    name: str
    # Unix time of arrival, nanoseconds; in recordings below :data:`LATEST_NS`, a later one is damage
    received_ns: int
    fields: Mapping[str, Any]  # decoded fields: numbers, strings, lists and (JSON only) nested mappings
    # MAVLink ids of the sender; 0 if the link has none
    system: int = 0
    component: int = 0


SILENCE = "silence"


def silence(now_ns: int) -> Message:
    """Return the message that tells the pipeline that Unix time has reached ``now_ns`` without telemetry.

    The passage of time is an input like any other: it is recorded, and replayed.
    """
    return Message(source=CLOCK, name=SILENCE, received_ns=now_ns, fields={})
