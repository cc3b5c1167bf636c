"""Encoded record of a message log, ready to be written to any number of files."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Schema:
    """The type of a topic's records.

    Parameters
    ----------
    name : str
        Full name of the type.
    encoding : str
        ``"protobuf"`` (``data`` is a FileDescriptorSet) or ``"jsonschema"``; others use others.
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
        Topic.
    encoding : str
        ``"protobuf"`` or ``"json"``; others use others.
    schema : Schema | None
        Type of ``data``.
    data : bytes
        The encoded record.
    time_ns : int
        Log time, Unix nanoseconds.
    component : int
        MAVLink component that sent it, 0 where there is none.
    publish_ns : int | None
        Publish time, Unix nanoseconds, where it is another than the log time.
    """

    topic: str
    encoding: str
    schema: Schema | None
    data: bytes
    time_ns: int
    component: int = 0
    publish_ns: int | None = None
