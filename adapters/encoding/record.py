"""Encoded records of a message log, one or many of a topic, ready to be written to any number of files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Schema:
    """What a topic's records look like.

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
        What ``data`` looks like.
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


@dataclass(frozen=True, slots=True)
class Records:
    """Many encoded records of one topic.

    Parameters
    ----------
    topic, encoding, schema
        As of :class:`Record`.
    data : Sequence[bytes]
        The n records.
    time_ns : NDArray[np.int64]
        Log times (n,), Unix nanoseconds.
    place : NDArray[np.int64]
        Place of each among all records that are written together (n,).
    """

    topic: str
    encoding: str
    schema: Schema | None
    data: Sequence[bytes]
    time_ns: NDArray[np.int64]
    place: NDArray[np.int64]


def single(record: Record, place: int) -> Records:
    """Return one record as the only one of its topic."""
    times = np.array([record.time_ns])
    return Records(record.topic, record.encoding, record.schema, [record.data], times, np.array([place]))


def in_order(topics: Sequence[Records]) -> list[Record]:
    """Return the records of several topics one by one, by their places."""
    found = [
        (place, Record(one.topic, one.encoding, one.schema, data, time_ns))
        for one in topics
        for place, data, time_ns in zip(one.place.tolist(), one.data, one.time_ns.tolist(), strict=True)
    ]
    return [record for _, record in sorted(found, key=lambda entry: entry[0])]
