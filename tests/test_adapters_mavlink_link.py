"""Live MAVLink over real sockets and a real serial line on loopback."""

from __future__ import annotations

import contextlib
import os
import pty
import socket
import time
from collections.abc import Callable, Iterator

import pytest
from pymavlink.dialects.v20 import ardupilotmega

from adapters.errors import TelemetryError
from adapters.mavlink_link import MavlinkLink
from adapters.message import Message


def packet(sequence: int, system: int = 1, version_1: bool = False) -> bytes:
    sender = ardupilotmega.MAVLink(None, srcSystem=system, srcComponent=1)
    sender.seq = sequence % 256
    message = ardupilotmega.MAVLink_attitude_message(sequence, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0)
    return bytes(message.pack(sender, force_mavlink1=version_1))


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def collect(link: MavlinkLink, count: int) -> list[Message]:
    """Receive until there are so many; the test's time-out ends it if they do not come."""
    messages: list[Message] = []
    while len(messages) < count:
        messages += link.receive(0.2)
    return messages


def times(messages: list[Message]) -> list[int]:
    return [message.fields["time_boot_ms"] for message in messages]


@contextlib.contextmanager
def udp() -> Iterator[tuple[MavlinkLink, Callable[[bytes], object]]]:
    port = free_port(socket.SOCK_DGRAM)
    with (
        MavlinkLink(f"udpin:127.0.0.1:{port}") as link,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out,
    ):
        out.connect(("127.0.0.1", port))
        yield link, out.send


def test_datagrams_become_messages_with_their_time_of_arrival() -> None:
    with udp() as (link, send):
        before = time.time_ns()
        send(packet(7) + packet(8))
        send(packet(9, version_1=True))
        messages = collect(link, 3)
        assert times(messages) == [7, 8, 9]
        assert messages[0].fields["roll"] == 0.5
        assert all(before <= message.received_ns <= time.time_ns() for message in messages)
        assert link.statistics().messages == 3


def test_a_quiet_link_returns_nothing_when_the_time_is_over() -> None:
    with udp() as (link, _):
        assert link.receive(0.0) == []
        assert link.receive(0.02) == []


def test_a_packet_split_over_datagrams_is_put_together_for_each_sender() -> None:
    with udp() as (link, send), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        assert link._link._socket.getsockname()  # type: ignore[attr-defined]
        whole = packet(1)
        send(whole[:9])
        other.sendto(packet(2, system=5), link._link._socket.getsockname())  # type: ignore[attr-defined]
        assert times(collect(link, 1)) == [2]
        send(whole[9:])
        assert times(collect(link, 1)) == [1]
        assert link.statistics().skipped_bytes == 0


def test_noise_and_lost_packets_are_counted() -> None:
    with udp() as (link, send):
        send(b"\x00noise" + packet(254))
        send(packet(255))
        send(packet(3 + 256))
        send(packet(2 + 256))
        send(packet(3 + 256))
        send(packet(4 + 256))
        collect(link, 6)
        counts = link.statistics()
        assert (counts.lost, counts.damaged, counts.skipped_bytes) == (3, 1, 6)


def test_many_senders_cost_bounded_memory() -> None:
    with udp() as (link, _):
        address = link._link._socket.getsockname()  # type: ignore[attr-defined]
        for k in range(100):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
                out.sendto(b"x" + packet(k, system=k + 1), address)
        collect(link, 100)
        assert len(link._parsers) <= 64
        assert link.statistics().skipped_bytes == 100


def test_a_tcp_server_that_comes_late_and_goes_away_is_connected_to_again() -> None:
    port = free_port(socket.SOCK_STREAM)
    with MavlinkLink(f"tcp:127.0.0.1:{port}") as link:
        assert link.receive(0.05) == []
        for attempt in (1, 2):
            with socket.create_server(("127.0.0.1", port)) as server:
                server.settimeout(0.05)
                client = None
                while client is None:
                    link.receive(0.1)
                    with contextlib.suppress(TimeoutError):
                        client, _ = server.accept()
                with client:
                    client.sendall(packet(attempt)[:7])
                    assert link.receive(0.05) == []
                    client.sendall(packet(attempt)[7:])
                    assert times(collect(link, 1)) == [attempt]
            link.receive(0.05)
        assert link.statistics().connections == 2


def test_a_tcp_client_may_come_again_and_the_newest_is_heard() -> None:
    port = free_port(socket.SOCK_STREAM)
    with MavlinkLink(f"tcpin:127.0.0.1:{port}") as link:
        with socket.create_connection(("127.0.0.1", port)) as client:
            client.sendall(packet(1))
            assert times(collect(link, 1)) == [1]
        with socket.create_connection(("127.0.0.1", port)) as client:
            client.sendall(packet(2))
            assert times(collect(link, 1)) == [2]
            with socket.create_connection(("127.0.0.1", port)) as newer:
                newer.sendall(packet(3))
                assert times(collect(link, 1)) == [3]
        assert link.statistics().connections == 3


def test_a_serial_line_is_read_at_its_rate_and_opened_again() -> None:
    master, slave = pty.openpty()
    device = os.ttyname(slave)
    with MavlinkLink(f"serial:{device}:57600") as link:
        assert link._link._port.baudrate == 57600  # type: ignore[attr-defined]
        os.write(master, packet(1)[:5])
        os.write(master, packet(1)[5:] + packet(2))
        assert times(collect(link, 2)) == [1, 2]
        os.close(master)
        os.close(slave)
        while link._link._port is not None:  # type: ignore[attr-defined]
            assert link.receive(0.05) == []
        assert link.receive(0.05) == []
        master, slave = pty.openpty()
        link._link._device = os.ttyname(slave)  # type: ignore[attr-defined]
        while link.statistics().connections < 2:
            link.receive(0.1)
        os.write(master, packet(3))
        assert times(collect(link, 1)) == [3]
    os.close(master)
    os.close(slave)


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("14550", "unknown kind of link"),
        ("mqtt:127.0.0.1:1", "unknown kind of link"),
        ("serial:", "unknown kind of link"),
        ("udpin:14550", "no HOST:PORT"),
        ("udpin::14550", "no HOST:PORT"),
        ("udpin:127.0.0.1:", "no HOST:PORT"),
        ("udpin:127.0.0.1:70000", "no HOST:PORT"),
        ("tcp:127.0.0.1:-1", "no HOST:PORT"),
        ("udpout:127.0.0.1:14550", "only listens"),
        ("udpin:1.2.3.4:14550", "cannot listen there: Cannot assign"),
        ("tcpin:1.2.3.4:5760", "cannot listen there: Cannot assign"),
        ("serial:/dev/no-such-device:57600", "cannot be opened: "),
    ],
)
def test_a_url_that_cannot_be_used_is_reported_in_one_line(url: str, said: str) -> None:
    with pytest.raises(TelemetryError) as caught:
        MavlinkLink(url)
    text = str(caught.value)
    assert text.startswith(url)
    assert said in text
    assert "\n" not in text


@pytest.mark.parametrize(("scheme", "kind"), [("udpin", socket.SOCK_DGRAM), ("tcpin", socket.SOCK_STREAM)])
def test_a_port_in_use_is_reported(scheme: str, kind: socket.SocketKind) -> None:
    url = f"{scheme}:127.0.0.1:{free_port(kind)}"
    with MavlinkLink(url), pytest.raises(TelemetryError, match="cannot listen there: Address already in use"):
        MavlinkLink(url)


def test_ipv6_addresses_are_written_in_brackets() -> None:
    with contextlib.ExitStack() as stack:
        try:
            link = stack.enter_context(MavlinkLink(f"udpin:[::1]:{free_port(socket.SOCK_DGRAM)}"))
        except TelemetryError as error:
            assert "Cannot assign requested address" in str(error) or "not supported" in str(error)
        else:
            assert link.receive(0.0) == []
