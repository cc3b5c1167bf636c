"""The inbox: order kept, the oldest dropped and counted, links that fail are read again."""

import logging
import threading
from collections import deque

import pytest
from hypothesis import given
from hypothesis import strategies as st
from loopback import until

from adapters.batch import Batch, messages, pack
from adapters.message import Message
from adapters.source import MAVLINK
from monitor.service.inbox import Arrival, Inbox


def message(number: int) -> Message:
    return Message(MAVLINK, "ATTITUDE", number, {}, 1, 1)


def each(arrivals: list[Arrival]) -> list[tuple[str | None, Message]]:
    return [(arrival.vehicle, message) for arrival in arrivals for message in messages(arrival.batch)]


class ScriptedLink:
    """Gives its batches one after the other, raises the exceptions among them, then waits like a silent link."""

    def __init__(self, *batches: list[Message] | Exception) -> None:
        self._batches = deque(batches)
        self._closed = threading.Event()

    def receive(self, timeout_s: float) -> Batch:
        if not self._batches:
            self._closed.wait(timeout_s)
            return pack([])
        batch = self._batches.popleft()
        if isinstance(batch, Exception):
            raise batch
        return pack(batch)


@given(st.lists(st.integers(0, 30), max_size=20), st.integers(1, 40))
def test_the_newest_messages_stay_in_order_and_every_other_is_counted(sizes: list[int], limit: int) -> None:
    inbox = Inbox(limit)
    number = 0
    for size in sizes:
        inbox.put(pack([message(number + k) for k in range(size)]))
        number += size
    waiting = inbox.take(0.0)
    assert [message.received_ns for _, message in each(waiting)] == list(range(max(0, number - limit), number))
    counts = inbox.statistics()
    assert (counts.arrived, counts.dropped, counts.waiting) == (number, max(0, number - limit), 0)
    assert inbox.empty


def test_two_links_arrive_under_their_vehicles_and_a_link_that_fails_is_read_again(
    caplog: pytest.LogCaptureFixture,
) -> None:
    inbox = Inbox(100)
    with caplog.at_level(logging.ERROR):
        inbox.listen("shared", ScriptedLink([message(1)], ValueError("cable"), [message(2)]))
        inbox.listen("own", ScriptedLink([message(3)]), "rover-1")
        until(lambda: inbox.statistics().waiting == 3)
    found = each(inbox.take(1.0))
    inbox.close()
    assert [arrival for arrival in found if arrival[0] is None] == [(None, message(k)) for k in (1, 2)]
    assert ("rover-1", message(3)) in found
    assert inbox.statistics().errors == 1
    assert "link shared failed" in caplog.text
    assert inbox.stuck() == ()


def test_taking_from_an_empty_inbox_ends_and_what_waits_outlives_its_closing() -> None:
    inbox = Inbox(10)
    assert inbox.take(0.01) == []
    inbox.put(pack([message(1)]))
    inbox.close()
    assert each(inbox.take(0.0)) == [(None, message(1))]


def test_no_message_is_lost_between_threads() -> None:
    inbox = Inbox(100_000)
    for name in ("a", "b", "c"):
        inbox.listen(name, ScriptedLink(*([message(k)] for k in range(2000))))
    found: list[tuple[str | None, Message]] = []

    def all_there() -> bool:
        found.extend(each(inbox.take(0.1)))
        return len(found) >= 6000

    until(all_there)
    inbox.close()
    assert inbox.statistics().dropped == 0
    assert sorted(message.received_ns for _, message in found) == sorted([*range(2000)] * 3)
