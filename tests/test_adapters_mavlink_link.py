"""Live MAVLink over real sockets and a real serial line on loopback."""

from __future__ import annotations

import contextlib
import os
import pty
import random
import socket
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from loopback import free_port
from pymavlink.dialects.v20 import ardupilotmega

from adapters.batch import messages as each
from adapters.errors import TelemetryError
from adapters.mavlink.mavlink_columns import SequenceFindings, dialect, wanted_kinds
from adapters.mavlink.mavlink_link import MavlinkLink
from adapters.mavlink.message_rates import RateRequests
from adapters.mavlink.packets import PacketList, PacketScanner
from adapters.mavlink.signing import SigningGuard, SigningKey, unix_stamp
from adapters.message import Message
from adapters.source import LINK, MAVLINK

KEY = SigningKey(bytes(range(32)))


def packet(
    sequence: int,
    system: int = 1,
    version_1: bool = False,
    component: int = 1,
    key: SigningKey | None = None,
    stamp: int | None = None,
) -> bytes:
    sender = ardupilotmega.MAVLink(None, srcSystem=system, srcComponent=component)
    sender.seq = sequence % 256
    if key is not None:
        sender.signing.secret_key = key.secret
        sender.signing.sign_outgoing = True
        sender.signing.timestamp = unix_stamp(time.time_ns()) if stamp is None else stamp
    message = ardupilotmega.MAVLink_attitude_message(sequence, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0)
    return bytes(message.pack(sender, force_mavlink1=version_1))


def collect(link: MavlinkLink, count: int) -> list[Message]:
    """Receive until there are so many; the test's time-out ends it if they do not come."""
    messages: list[Message] = []
    while len(messages) < count:
        messages += [*each(link.receive(0.2))]
    return messages


def times(messages: list[Message]) -> list[int]:
    return [message.fields["time_boot_ms"] for message in messages]


@contextlib.contextmanager
def udp(**options: Any) -> Iterator[tuple[MavlinkLink, Callable[[bytes], object]]]:
    port = free_port(socket.SOCK_DGRAM)
    with (
        MavlinkLink(f"udpin:127.0.0.1:{port}", **options) as link,
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
        assert [*each(link.receive(0.0))] == []
        assert [*each(link.receive(0.02))] == []


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
        assert (counts.lost, counts.damaged, counts.skipped_bytes) == (2, 1, 6)


def test_many_senders_cost_bounded_memory() -> None:
    with udp() as (link, _):
        address = link._link._socket.getsockname()  # type: ignore[attr-defined]
        for k in range(100):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
                out.sendto(b"x" + packet(k, system=k + 1), address)
        collect(link, 100)
        assert len(link._scanners) <= 64
        assert link.statistics().skipped_bytes == 100


def test_a_tcp_server_that_comes_late_and_goes_away_is_connected_to_again() -> None:
    port = free_port()
    with MavlinkLink(f"tcp:127.0.0.1:{port}") as link:
        assert [*each(link.receive(0.05))] == []
        for attempt in (1, 2):
            with socket.create_server(("127.0.0.1", port)) as server:
                server.settimeout(0.05)
                client = None
                while client is None:
                    [*each(link.receive(0.1))]
                    with contextlib.suppress(TimeoutError):
                        client, _ = server.accept()
                with client:
                    client.sendall(packet(attempt)[:7])
                    assert [*each(link.receive(0.05))] == []
                    client.sendall(packet(attempt)[7:])
                    assert times(collect(link, 1)) == [attempt]
            [*each(link.receive(0.05))]
        assert link.statistics().connections == 2


def test_a_tcp_client_may_come_again_and_the_newest_is_heard() -> None:
    port = free_port()
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
            assert [*each(link.receive(0.05))] == []
        assert [*each(link.receive(0.05))] == []
        master, slave = pty.openpty()
        link._link._device = os.ttyname(slave)  # type: ignore[attr-defined]
        while link.statistics().connections < 2:
            [*each(link.receive(0.1))]
        os.write(master, packet(3))
        assert times(collect(link, 1)) == [3]
    os.close(master)
    os.close(slave)


def test_systems_and_components_on_one_link_lose_packets_each_on_its_own() -> None:
    with udp() as (link, send):
        for k in range(10):
            for system, component, step in ((1, 1, 1), (1, 2, 3), (2, 1, 1), (9, 1, 5)):
                send(packet(k * step, system=system, component=component))
        messages = collect(link, 40)
        assert {(m.system, m.component) for m in messages} == {(1, 1), (1, 2), (2, 1), (9, 1)}
        assert link.statistics().lost_by_system == {1: 18, 9: 36}
        assert link.statistics().lost == 54


def test_what_a_ground_station_sent_elsewhere_is_not_lost_here() -> None:
    with udp() as (link, send):
        station = ardupilotmega.MAVLink(None, srcSystem=255, srcComponent=190)
        for k in range(20):
            station.seq = 7 * k % 256
            send(bytes(ardupilotmega.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3).pack(station)))
            send(packet(2 * k))
        collect(link, 40)
        assert link.statistics().lost_by_system == {1: 19}
        assert link.statistics().lost == 19


def test_each_bad_checksum_is_counted() -> None:
    with udp() as (link, send):
        for k in range(50):
            send(packet(k)[:-1] + bytes([packet(k)[-1] ^ 0x55]))
        send(packet(50))
        assert times(collect(link, 1)) == [50]
        assert link.statistics().bad_checksums == 50


def test_duplicates_come_twice_and_neither_they_nor_reordering_count_as_lost() -> None:
    with udp() as (link, send):
        order = [0, 1, 2, 3, 3, 5, 4, 4, 9, 8, 7, 6, 10]
        for k in order:
            send(packet(k))
        assert times(collect(link, len(order))) == order
        assert link.statistics().lost == 0


def test_what_jitter_overtakes_is_no_loss_and_what_is_missing_is() -> None:
    draw = random.Random(3)
    due = [(k * 0.003 + draw.uniform(0.0, 0.2), k) for k in range(3000) if draw.random() >= 0.3]
    counter, lost = SequenceFindings(), 0
    for at_s, k in sorted(due):
        packets = PacketList(dialect())
        PacketScanner(dialect()).scan(packet(k), packets, 10**18 + round(1e9 * at_s))
        counter.decoded(packets, wanted_kinds())
        assert counter.lost().get(1, 0) >= lost
        lost = counter.lost().get(1, 0)
    assert 3000 - len(due) - 10 < lost < 3000 - len(due) + 60


def test_the_same_packet_a_turn_of_numbers_later_is_neither_a_duplicate_nor_a_loss() -> None:
    counter = SequenceFindings()
    for k in range(1024):
        packets = PacketList(dialect())
        # one says what the one 256 before it said
        PacketScanner(dialect()).scan(packet(344 if k == 600 else k), packets, 10**18 + 3_000_000 * k)
        counter.decoded(packets, wanted_kinds())
    assert counter.lost() == {}


def test_a_restart_or_a_long_gap_is_no_loss() -> None:
    with udp() as (link, send):
        for k in (*range(100, 120), *range(0, 30), *range(160, 180)):
            send(packet(k))
        collect(link, 70)
        assert link.statistics().lost == 0
        send(packet(182))
        collect(link, 1)
        assert link.statistics().lost == 2


def test_half_packets_of_a_thousand_senders_cost_bounded_memory_and_nobody_elses_packets() -> None:
    with udp(may_send=True) as (link, send):
        address = link._link._socket.getsockname()  # type: ignore[attr-defined]
        for k in range(1000):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
                out.sendto(packet(k)[:15], address)
            if k % 100 == 0:
                send(packet(k))
                assert times(collect(link, 1)) == [k]
        assert len(link._scanners) <= 64
        assert len(link._telemetry_ns) == 1
        assert all(scanner.waiting < 280 for scanner in link._scanners.values())


def test_the_largest_datagrams_are_taken_whole_be_they_packets_or_noise() -> None:
    with udp() as (link, send):
        whole = b"".join(packet(k) for k in range(65_507 // len(packet(0))))
        send(whole)
        assert times(collect(link, 1)) == list(range(len(whole) // len(packet(0))))
        for noise in (b"\xfe" * 65_507, b"\xfd" * 65_507, bytes(65_507), random.Random(1).randbytes(65_507)):
            send(noise)
            send(bytes(280) + packet(1) + bytes(280))
            assert times(collect(link, 1))[-1] == 1


def test_a_flood_of_junk_does_not_keep_the_caller_waiting_for_a_message(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("adapters.mavlink.mavlink_link._PIECES", 8)
    monkeypatch.setattr("adapters.mavlink.byte_link._MOST_OF_ONE", 8)
    with udp() as (link, send):
        send(packet(1))
        for _ in range(20):
            send(b"junk")
        assert times([*each(link.receive(30.0))]) == [1]
        assert [*each(link.receive(30.0))] == []


def test_flipped_bits_and_random_bytes_cost_no_intact_packet_and_make_none_up() -> None:
    rng = random.Random(2)
    intact = [packet(k) for k in range(400)]
    with udp() as (link, send):
        kept = []
        for k, whole in enumerate(intact):
            data = bytearray(whole)
            if k % 4 == 1:
                data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
            else:
                kept.append(k)
            send(bytes(data))
            if k % 10 == 0:
                send(rng.randbytes(rng.randrange(1, 200)))
        # What false starts wait for.
        for _ in range(20):
            send(packet(1000, system=2))
        messages = [m for m in collect(link, len(kept) + 20) if m.system == 1]
        assert times(messages) == kept
        assert link.statistics().damaged > 0


def test_a_key_lets_in_what_is_signed_and_keeps_out_forgeries_which_are_told_of() -> None:
    forger = SigningKey(b"f" * 32)
    with udp(guard=SigningGuard(KEY)) as (link, send):
        send(packet(1, key=KEY))
        send(packet(2, key=forger, stamp=(1 << 48) - 1))
        send(packet(3))
        send(packet(4, key=KEY, system=2))
        send(packet(5, key=KEY))
        messages = collect(link, 4)
        assert times([m for m in messages if m.source == MAVLINK]) == [1, 4, 5]
        (finding,) = (m for m in messages if m.source == LINK)
        assert (finding.name, finding.system) == ("signing", 1)
        assert finding.fields == {"forged": 1, "replayed": 0, "unsigned": 1}
        assert finding.received_ns >= messages[0].received_ns
        counts = link.statistics()
        assert (counts.messages, counts.signing.forged, counts.signing.unsigned) == (3, 1, 1)


def test_refused_packets_are_told_of_even_when_nothing_else_comes() -> None:
    with udp(guard=SigningGuard(KEY)) as (link, send):
        for _ in range(3):
            send(packet(1, key=SigningKey(b"f" * 32)))
        messages: list[Message] = []
        while sum(m.fields["forged"] for m in messages[-1:]) < 3:
            messages += [*each(link.receive(0.05))]
        assert {m.source for m in messages} == {LINK}
        assert len(messages) <= 2


def test_forged_packets_change_neither_losses_nor_who_is_answered() -> None:
    with udp(guard=SigningGuard(KEY), may_send=True) as (link, send):
        send(packet(1, key=KEY))
        collect(link, 1)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as forger:
            forger.sendto(packet(90, key=SigningKey(b"f" * 32)), link._link._socket.getsockname())  # type: ignore[attr-defined]
            assert [m.source for m in collect(link, 1)] == [LINK]
        send(packet(2, key=KEY))
        collect(link, 1)
        assert link.statistics().lost == 0
        assert len(link._telemetry_ns) == 1


def test_without_a_key_signed_packets_are_taken_as_they_are() -> None:
    with udp() as (link, send):
        send(packet(1, key=KEY) + packet(2, key=SigningKey(b"f" * 32)) + packet(3))
        assert times(collect(link, 3)) == [1, 2, 3]


def test_what_one_link_has_brought_is_a_replay_on_every_other_link() -> None:
    guard = SigningGuard(KEY)
    with udp(guard=guard) as (first, send_first), udp(guard=guard) as (second, send_second):
        recorded = [packet(k, key=KEY, stamp=unix_stamp(time.time_ns()) + k) for k in range(20)]
        for data in recorded:
            send_first(data)
        collect(first, 20)
        for data in recorded:
            send_second(data)
        while sum(vars_of(second)) < 20:
            assert not [m for m in each(second.receive(0.05)) if m.source == MAVLINK]
        send_second(packet(40, key=KEY, stamp=unix_stamp(time.time_ns()) + 40))
        assert times(collect(second, 1)) == [40]


def vars_of(link: MavlinkLink) -> tuple[int, int]:
    counts = link.statistics().signing
    return counts.late, counts.replayed


def test_the_secret_of_a_key_that_is_handed_out_on_the_link_is_not_passed_on() -> None:
    setup = ardupilotmega.MAVLink_setup_signing_message(1, 1, list(KEY.secret), 0)
    with udp() as (link, send):
        send(bytes(setup.pack(ardupilotmega.MAVLink(None, 255, 1))) + packet(1))
        assert [m.name for m in collect(link, 1)] == ["ATTITUDE"]


def test_times_of_arrival_do_not_fall_while_the_clock_does_not() -> None:
    with udp(guard=SigningGuard(KEY)) as (link, send):
        messages: list[Message] = []
        for k in range(200):
            send(packet(k, key=KEY if k % 3 else SigningKey(b"f" * 32), system=1 + k % 5))
            messages += [*each(link.receive(0.0))]
        arrivals = [m.received_ns for m in messages]
        assert arrivals == sorted(arrivals)
        newest = link._received_ns
        assert link._arrival(newest - 10) == newest
        assert link._arrival(newest - 3_600_000_000_000) == newest - 3_600_000_000_000


def test_a_vehicle_behind_udpout_is_asked_for_rates_and_answers() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:
        vehicle.bind(("127.0.0.1", 0))
        vehicle.settimeout(10.0)
        with MavlinkLink(
            f"udpout:127.0.0.1:{vehicle.getsockname()[1]}", guard=SigningGuard(KEY), may_send=True
        ) as link:
            requests = RateRequests(KEY)
            link.send(requests.requests(time.monotonic_ns(), time.time_ns()))
            heartbeat, monitor = vehicle.recvfrom(1000)
            parser = ardupilotmega.MAVLink(None)
            parser.signing.secret_key = KEY.secret
            assert parser.decode(bytearray(heartbeat)).get_type() == "HEARTBEAT"
            vehicle.sendto(packet(1, key=KEY), monitor)
            assert times(collect(link, 1)) == [1]


def test_on_a_udp_port_those_are_answered_who_sent_intact_packets() -> None:
    with udp(may_send=True) as (link, send), contextlib.ExitStack() as stack:
        first, second, stranger = (
            stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(3)
        )
        address = link._link._socket.getsockname()  # type: ignore[attr-defined]
        first.sendto(packet(1, system=1), address)
        second.sendto(packet(1, system=2), address)
        stranger.sendto(b"let me in", address)
        send(packet(1, system=3))
        collect(link, 3)
        link.send([b"request"])
        for one in (first, second):
            one.settimeout(10.0)
            assert one.recv(100) == b"request"
        stranger.setblocking(False)
        with pytest.raises(BlockingIOError):
            stranger.recv(100)


def test_a_link_opened_to_listen_does_not_send() -> None:
    with udp() as (link, _), pytest.raises(TelemetryError, match="opened only to listen"):
        link.send([b"request"])


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
        ("udpout:127.0.0.1:14550", "never sends"),
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
            assert [*each(link.receive(0.0))] == []
