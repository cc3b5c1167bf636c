"""Datagrams of a port that several share: what a flood takes from the others, and what of it is counted."""

from __future__ import annotations

import contextlib
import socket
import time
from collections import Counter
from collections.abc import Iterator

import pytest

from adapters.mavlink.byte_link import ByteLink, open_byte_link

RATE_HZ = 200_000
"""Datagrams a second of a flood; what is emptied takes 250,000."""


@contextlib.contextmanager
def shared_port(senders: int) -> Iterator[tuple[ByteLink, list[socket.socket]]]:
    """Open a port and sockets that send to it."""
    with contextlib.ExitStack() as stack:
        link = stack.enter_context(contextlib.closing(open_byte_link("udpin:127.0.0.1:0")))
        outs = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(senders)]
        for out in outs:
            out.connect(link._socket.getsockname())  # type: ignore[attr-defined]
        yield link, outs


def test_a_flood_costs_its_neighbour_nothing_though_nobody_reads_meanwhile() -> None:
    with shared_port(2) as (link, (flooder, neighbour)):
        begin = time.monotonic()
        for k in range(20_000):
            flooder.send(b"flood" * 10)
            if k % 400 == 0:
                neighbour.send(k.to_bytes(4))
                # no more than the kernel's buffer takes between two turns
                time.sleep(max(0.0, begin + k / RATE_HZ - time.monotonic()))
        pieces = link.read(1.0)
        own = [int.from_bytes(data) for sender, data, _ in pieces if sender == neighbour.getsockname()]
        assert own == list(range(0, 20_000, 400))
        assert Counter(sender for sender, _, _ in pieces)[flooder.getsockname()] <= 256


def test_a_neighbour_finds_room_beside_a_flood_that_fills_the_memory() -> None:
    with shared_port(2) as (link, (flooder, neighbour)):
        for _ in range(600):
            flooder.send(bytes(50_000))
            # the kernel's buffer is emptied a hundred times a second
            time.sleep(0.0002)
        neighbour.send(b"here")
        sent, came = 601, 0
        pieces = link.read(1.0)
        assert b"here" in [data for _, data, _ in pieces]
        while pieces:
            came += len(pieces)
            pieces = link.read(0.05)
        assert 0 < came < sent
        assert link.overruns == sent - came


def test_systems_behind_one_address_are_senders_of_their_own_and_come_in_the_order_of_arrival(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("adapters.mavlink.byte_link._MOST_OF_ONE", 4)
    version_1, version_2 = bytes([0xFE, 0, 0, 7]), bytes([0xFD, 0, 0, 0, 0, 8])
    with shared_port(1) as (link, (router,)):
        for k in range(10):
            router.send(version_1 + bytes([k]) * 2)
        router.send(version_2)
        router.send(b"no packet")
        first = [data for _, data, _ in link.read(1.0)]
        assert first == [*(version_1 + bytes([k]) * 2 for k in range(4)), version_2, b"no packet"]
        assert [data[-1] for _, data, _ in link.read(1.0)] == [4, 5, 6, 7]


def test_what_does_not_get_its_turn_in_time_is_dropped_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("adapters.mavlink.byte_link._MOST_OF_ONE", 4)
    with shared_port(1) as (link, (out,)):
        for _ in range(10):
            out.send(b"old")
        time.sleep(0.4)
        out.send(b"new")
        # The oldest of those that waited are still a turn's, the others go.
        assert [data for _, data, _ in link.read(1.0)] == [b"old"] * 4
        assert [data for _, data, _ in link.read(1.0)] == [b"new"]
        assert link.overruns == 6


def test_more_senders_than_are_kept_apart_share_what_is_left_and_the_known_ones_keep_theirs() -> None:
    with shared_port(100) as (link, outs):
        outs[0].send(b"known")
        assert [data for _, data, _ in link.read(1.0)] == [b"known"]
        for _ in range(50):
            for out in outs[1:]:
                out.send(b"many")
        outs[0].send(b"known")
        # one turn takes 4,096 from the kernel
        assert b"known" in [data for _ in range(2) for _, data, _ in link.read(1.0)]


def test_addresses_of_ipv6_are_those_of_the_socket_module() -> None:
    try:
        link = open_byte_link("udpin:[::1]:0", may_send=True)
    except Exception:
        pytest.skip("no IPv6 here")
    with contextlib.closing(link), socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as out:
        out.bind(("::1", 0))
        out.settimeout(10.0)
        out.sendto(b"hello", link._socket.getsockname())  # type: ignore[attr-defined]
        ((sender, data, _),) = link.read(1.0)
        assert (sender, data) == (out.getsockname(), b"hello")
        link.write(b"answer", [sender])
        assert out.recv(100) == b"answer"
