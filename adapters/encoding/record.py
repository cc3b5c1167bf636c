"""Encoded record of a message log, ready to be written to any number of files."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Schema:
    """The type of a topic's records by its full name.

    Our schemas are in ``"protobuf"`` (``data`` is a FileDescriptorSet) or ``"jsonschema"``; other programs use other
    encodings.
    """

    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True, slots=True)
class Record:
    """One encoded record, in ``"protobuf"`` or ``"json"``; other programs use other encodings.

    Times are Unix nanoseconds: the log time, and the publish time if it differs. ``component`` is the MAVLink component
    that sent it, 0 if there is none.
    """

    topic: str
    encoding: str
    schema: Schema | None
    data: bytes
    time_ns: int
    component: int = 0
    publish_ns: int | None = None
