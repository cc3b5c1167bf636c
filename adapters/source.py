"""Sources of messages: each kind with the traits that decide how its messages are processed.

Ask a message's source for the trait in question; do not compare names. A new source is a value here and a module that
yields its batches.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """A kind of source; there is one value of each name, so values are compared by identity."""

    name: str  # name in recordings: the first part of a message's topic
    # Whether its messages are measurements of a vehicle, which samplers read. All other messages tell the pipeline
    # about something else: the passage of time, operators, the journal.
    is_telemetry: bool = False
    # Whether its messages carry the ids of a MAVLink system (and of a component, if they are telemetry), so that a
    # monitor has to choose its vehicle's. Messages without ids belong to the vehicle of the link.
    has_ids: bool = False
    # whether a time stamp of zero means that the sender does not know the time, as in MAVLink; otherwise it is the
    # first moment of the vehicle's clock
    zero_stamp_is_unset: bool = False
    is_onboard_log: bool = False  # whether its messages are records of a log that the vehicle wrote itself

    def __str__(self) -> str:
        return self.name

    def __reduce__(self) -> tuple[object, tuple[str]]:
        # Another process gets its own value of this name.
        return _of_name, (self.name,)


MAVLINK: Final = Source("mavlink", is_telemetry=True, has_ids=True, zero_stamp_is_unset=True)
"""MAVLink packets, from a link or a telemetry log; also the messages that onboard logs are translated to."""

ZENOH: Final = Source("zenoh", is_telemetry=True)
"""Named topics without ids: Zenoh, and ROS 2 bags and MCAP files of others. Recorded topics share the source of live
ones on purpose: one profile then serves a robot both live and in its recordings."""

ULOG: Final = Source("ulog", is_telemetry=True, is_onboard_log=True)
"""Records of a log that PX4 wrote."""

DATAFLASH: Final = Source("dataflash", is_telemetry=True, is_onboard_log=True)
"""Records of a log that ArduPilot wrote."""

CLOCK: Final = Source("clock")
"""Passage of time without telemetry (:func:`adapters.message.silence`)."""

LINK: Final = Source("link", has_ids=True)
"""Findings of a link itself: packets with forged signatures."""

OPERATOR: Final = Source("operator")
"""Operators' commands and the rules from a configuration."""

JOURNAL: Final = Source("journal")
"""Alarms that were active before a restart."""

SOURCES: Final[Mapping[str, Source]] = MappingProxyType(
    {source.name: source for source in (MAVLINK, ZENOH, ULOG, DATAFLASH, CLOCK, LINK, OPERATOR, JOURNAL)}
)
"""All sources by name."""


def _of_name(name: str) -> Source:
    return SOURCES[name]
