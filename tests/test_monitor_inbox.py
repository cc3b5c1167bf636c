"""The inbox: order kept, the oldest dropped and counted, links that fail are read again."""

import itertools
import logging
import threading
import time
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


def taken(inbox: Inbox) -> list[Arrival]:
    """Return what waits of all senders."""
    found = []
    while not inbox.empty:
        found += inbox.take(0.0)
    return found


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
    found = each(taken(inbox))
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
        inbox.listen(name, ScriptedLink(*([message(k)] for k in range(300))))
    found: list[tuple[str | None, Message]] = []

    def all_there() -> bool:
        found.extend(each(inbox.take(0.1)))
        return len(found) >= 900

    until(all_there)
    inbox.close()
    assert inbox.statistics().dropped == 0
    assert sorted(message.received_ns for _, message in found) == sorted([*range(300)] * 3)


def attitudes(system: int, count: int, received_ns: int = 0, size: int = 0) -> Batch:
    fields = {"text": "x" * size} if size else {}
    return pack([Message(MAVLINK, "ATTITUDE", received_ns, fields, system, 1) for _ in range(count)])


def test_a_sender_that_floods_loses_its_own_messages_and_waits_for_its_turn() -> None:
    inbox = Inbox(1000)
    for _ in range(100):
        inbox.put(attitudes(7, 900))
        inbox.put(attitudes(1, 1))
    assert [one.system for _, one in each(inbox.take(0.0))] == [7] * 900
    assert [one.system for _, one in each(inbox.take(0.0))] == [1] * 100
    assert inbox.statistics().dropped == 100 * 900 - 900


def test_a_batch_of_two_senders_waits_with_each() -> None:
    inbox = Inbox(10)
    inbox.put(pack([Message(MAVLINK, "ATTITUDE", 0, {}, 1 + k % 2, 1) for k in range(4)]))
    assert sorted(one.system for _, one in each(taken(inbox))) == [1, 1, 2, 2]


def test_what_has_waited_for_a_second_is_dropped_but_for_signs_of_life() -> None:
    inbox = Inbox(10_000, oldest_s=1.0)
    now_ns = time.time_ns()
    for hundredth in range(500, 0, -1):
        inbox.put(attitudes(1, 3, now_ns - hundredth * 10_000_000))
    taken = [one.received_ns for _, one in each(inbox.take(0.0))]
    assert taken == sorted(taken)
    old = sorted({t for t in taken if t < now_ns - 1_100_000_000})
    assert 7 <= len(old) <= 9
    assert max(b - a for a, b in itertools.pairwise([*old, now_ns - 1_000_000_000])) < 700_000_000
    assert sum(t > now_ns - 900_000_000 for t in taken) == 3 * 89
    assert inbox.statistics().dropped == 1500 - len(taken)


def test_of_what_finds_no_room_signs_of_life_are_kept() -> None:
    inbox = Inbox(100, oldest_s=1.0)
    now_ns = time.time_ns()
    for hundredth in range(500, 0, -1):
        at_ns = now_ns - hundredth * 10_000_000
        inbox.put(attitudes(1, 3, at_ns))
        if hundredth % 100 == 70:
            inbox.put(pack([Message(MAVLINK, "HEARTBEAT", at_ns, {"type": 2}, 1, 1)]))
    taken = [one for _, one in each(inbox.take(0.0))]
    times = [now_ns - 5_000_000_000, *(one.received_ns for one in taken)]
    assert max(b - a for a, b in itertools.pairwise(times)) < 700_000_000
    assert [one.name for one in taken].count("HEARTBEAT") == 5
    assert len(taken) < 120
    assert inbox.statistics().dropped == 1505 - len(taken)


def test_where_rounds_take_longer_than_a_second_less_of_each_is_kept_until_they_do_not() -> None:
    inbox = Inbox(100_000, oldest_s=1.0)

    def kept_of_a_round(seconds: float) -> int:
        now_ns = time.time_ns()
        for hundredth in range(round(100 * seconds), 0, -1):
            inbox.put(attitudes(1, 1, now_ns - hundredth * 10_000_000))
        return sum(one.received_ns > now_ns - 1_000_000_000 for _, one in each(inbox.take(0.0)))

    kept = [kept_of_a_round(seconds) for seconds in (3.0, 3.0, 1.0, 0.3, 0.3)]
    assert kept[0] > 90
    assert 25 < kept[1] < 40
    assert 25 < kept[2] < 40
    assert kept[4] == 30
    assert inbox.empty


def test_a_link_collects_what_comes_while_the_loop_is_behind() -> None:
    inbox = Inbox(100)
    inbox.listen("one", ScriptedLink(*([message(k)] for k in range(50))))
    until(lambda: not inbox.empty)
    behind = inbox.statistics().arrived
    until(lambda: inbox.statistics().arrived > behind)
    assert inbox.statistics().arrived < 25
    until(lambda: len(inbox.take(0.1)) == 0)
    inbox.close()
    assert inbox.statistics().arrived == 50


def test_a_time_of_arrival_from_before_the_clock_was_set_is_not_old() -> None:
    inbox = Inbox(10, oldest_s=1.0)
    inbox.put(attitudes(1, 1, time.time_ns() - 3600 * 10**9))
    inbox.put(attitudes(1, 1, time.time_ns() + 3600 * 10**9))
    assert len(each(inbox.take(0.0))) == 2


def test_large_messages_are_bounded_in_memory_and_taken_in_small_portions() -> None:
    inbox = Inbox(10_000)
    megabyte = attitudes(1, 1, size=1_000_000)
    for _ in range(200):
        inbox.put(megabyte)
    assert inbox.statistics().waiting <= (1 << 26) // 1_000_000
    inbox = Inbox(10_000)
    objects = pack([Message(MAVLINK, "ATTITUDE", 0, dict.fromkeys(map(str, range(5_000)), 1.0), 1, 1)])
    for _ in range(200):
        inbox.put(objects)
    assert inbox.statistics().waiting <= (1 << 26) // 500_000
    assert len(inbox.take(0.0)) <= 10
