"""One encoded record of a message log, ready to be written to any number of files."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Schema:
    """What a topic's records look like.

    Parameters
    ----------
    name : str
        Full name of the type.
    encoding : str
        ``"protobuf"`` (``data`` is a FileDescriptorSet) or ``"jsonschema"``.
    data : bytes
        The schema itself.
    """

    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True, slots=True)
class Record:
    """One encoded record.

    Parameters
    ----------
    topic : str
        Topic, unique together with ``encoding`` within a file.
    encoding : str
        ``"protobuf"`` or ``"json"``.
    schema : Schema | None
        The topic's schema; the one of the topic's first record goes into a file.
    data : bytes
        The encoded record.
    time_ns : int
        Log time and publish time, Unix nanoseconds.
    component : int
        MAVLink component that sent it, 0 where there is none.
    """

    topic: str
    encoding: str
    schema: Schema | None
    data: bytes
    time_ns: int
    component: int = 0
