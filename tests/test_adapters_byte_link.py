"""Byte links on real sockets: what the kernel tells about datagrams, and sending."""

from __future__ import annotations

import contextlib
import os
import pty
import socket
import time
from collections.abc import Iterator

import pytest
from loopback import free_port, until

from adapters.errors import TelemetryError
from adapters.mavlink.byte_link import ByteLink, open_byte_link


@contextlib.contextmanager
def udp_link() -> Iterator[tuple[ByteLink, socket.socket]]:
    """Open a UDP link and a socket that is connected to it."""
    with contextlib.closing(open_byte_link("udpin:127.0.0.1:0", may_send=True)) as link, udp_socket() as out:
        out.connect(link._socket.getsockname())  # type: ignore[attr-defined]
        yield link, out


def udp_socket(port: int = 0) -> socket.socket:
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    out.bind(("127.0.0.1", port))
    out.settimeout(10.0)
    return out


def read(link: ByteLink) -> bytes:
    """Read until something comes; the test's time-out ends it if nothing does."""
    while not (pieces := link.read(0.1)):
        pass
    ((_, data, _),) = pieces
    return data


def test_a_datagrams_time_of_arrival_is_the_kernels_and_not_that_of_reading_it() -> None:
    with udp_link() as (link, out):

        def stamped_before_it_was_read() -> bool:
            before = time.time_ns()
            out.send(b"one")
            time.sleep(0.02)
            reading = time.time_ns()
            ((sender, data, received_ns),) = link.read(1.0)
            assert (sender, data) == (out.getsockname(), b"one")
            assert before <= received_ns <= time.time_ns()
            return received_ns < reading

        # Linux turns time stamps on a moment after it was asked to.
        until(stamped_before_it_was_read)


def test_datagrams_that_the_kernel_dropped_are_counted() -> None:
    with udp_link() as (link, out):
        sent = came = 0
        for burst in (1, 2):
            for _ in range(300):
                out.send(bytes(60_000))
            while pieces := link.read(0.05):
                came += len(pieces)
            out.send(b"last")
            assert read(link) == b"last"
            sent += 300
            assert 0 < came < sent
            assert link.overruns == sent - came, burst


def test_an_answer_goes_to_the_senders_that_are_named() -> None:
    with udp_link() as (link, out), udp_socket() as other:
        other.connect(out.getpeername())
        out.send(b"a")
        other.send(b"b")
        senders = [sender for sender, _, _ in link.read(1.0)]
        link.write(b"all", senders)
        assert (out.recv(100), other.recv(100)) == (b"all", b"all")
        link.write(b"one", senders[:1])
        assert out.recv(100) == b"one"
        link.write(b"nobody", [("127.0.0.1", free_port()), ("255.255.255.255", 9), *senders[:1]])
        assert out.recv(100) == b"nobody"


def test_udpout_is_heard_by_the_other_side_and_hears_its_answer_alone() -> None:
    with udp_socket() as server, udp_socket() as stranger:
        host, port = server.getsockname()
        with contextlib.closing(open_byte_link(f"udpout:{host}:{port}", may_send=True)) as link:
            link.write(b"hello", ())
            data, address = server.recvfrom(100)
            assert data == b"hello"
            stranger.sendto(b"strange", address)
            server.sendto(b"telemetry", address)
            assert read(link) == b"telemetry"


def test_udpout_bears_a_port_where_nobody_listens_yet() -> None:
    port = free_port()
    with contextlib.closing(open_byte_link(f"udpout:127.0.0.1:{port}", may_send=True)) as link:
        for _ in range(3):
            link.write(b"anybody?", ())
            assert link.read(0.02) == []
        with udp_socket(port) as late:
            link.write(b"anybody?", ())
            link.write(b"anybody?", ())
            _, address = late.recvfrom(100)
            late.sendto(b"here", address)
            assert read(link) == b"here"


def test_tcp_links_send_to_the_other_side_and_bear_its_absence() -> None:
    port = free_port()
    with (
        contextlib.closing(open_byte_link(f"tcpin:127.0.0.1:{port}")) as server,
        contextlib.closing(open_byte_link(f"tcp:127.0.0.1:{port}")) as client,
    ):
        server.write(b"nobody", ())
        client.write(b"nobody", ())
        while not client.connections or not server.connections:
            client.read(0.05)
            server.read(0.05)
        client.write(b"up", ())
        assert read(server) == b"up"
        server.write(b"down", ())
        assert read(client) == b"down"
        client.close()
        for _ in range(3):
            server.write(b"gone", ())
        until(lambda: not server.read(0.05))
        server.write(b"gone", ())


def test_a_tcp_peer_that_reads_nothing_blocks_nobody() -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        contextlib.closing(open_byte_link(f"tcp:127.0.0.1:{server.getsockname()[1]}")) as link,
    ):
        assert link.read(0.0) == []
        peer, _ = server.accept()
        with peer:
            for _ in range(2_000):
                link.write(bytes(10_000), ())
            # A packet that went only in part ends the connection; the next one starts with a whole packet.
            until(lambda: not link.read(0.1) and link.connections == 2)


def test_a_serial_line_is_written_to_and_blocks_nobody_when_it_is_full() -> None:
    master, slave = pty.openpty()
    try:
        with contextlib.closing(open_byte_link(f"serial:{os.ttyname(slave)}:57600")) as link:
            link.write(b"request", ())
            assert os.read(master, 100) == b"request"
            for _ in range(1_000):
                link.write(bytes(280), ())
        link.write(b"closed", ())
    finally:
        os.close(master)
        os.close(slave)


def test_a_udpout_without_a_way_is_reported_in_one_line() -> None:
    with pytest.raises(TelemetryError, match=r"udpout:255.255.255.255:1: there is no route to that address: "):
        open_byte_link("udpout:255.255.255.255:1", may_send=True)
