"""Encoded records as plain tuples beside a table of their topics: the form in which recorder and black box take them.

The black box holds 20,000 of them per vehicle. A full collection of Python's garbage collector visits every object that
it tracks: with 80,000 records held for four vehicles it took 0.1 s, in which no alarm could be raised. CPython stops
tracking a tuple of nothing but numbers and bytes (not an instance of a class) at the first collection that meets it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

from adapters.encoding.record import Schema

EncodedRecord: TypeAlias = tuple[int, bytes, int]
"""Number of the topic in a :class:`TopicTable`, data, log time in Unix nanoseconds (0 <= time < 2^63)."""


@dataclass(frozen=True, slots=True)
class Topic:
    """What all records of one sender on one topic have in common."""

    # as ``topic``, ``encoding``, ``schema`` and ``component`` of :class:`~adapters.encoding.record.Record`
    name: str
    encoding: str
    schema: Schema | None
    component: int = 0


class TopicTable:
    """Numbers topics from 0 in the order in which they are first met.

    One table belongs to a vehicle's encoder and to everything that takes its records. It has as many entries as a
    recording has channels and senders.
    """

    def __init__(self) -> None:
        self._numbers: dict[Topic, int] = {}
        self._topics: list[Topic] = []

    def number(self, topic: Topic) -> int:
        """Return a topic's number; a new topic gets the next one."""
        number = self._numbers.get(topic)
        if number is None:
            number = self._numbers[topic] = len(self._topics)
            self._topics.append(topic)
        return number

    def __getitem__(self, number: int) -> Topic:
        """Return the topic of a number."""
        return self._topics[number]
