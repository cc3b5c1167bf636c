"""Sequence numbers show two senders of one id, and nothing that links do to the packets of one does."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable

import pytest
from pymavlink.dialects.v20 import ardupilotmega

from adapters.mavlink.mavlink_columns import SEQUENCE, SequenceFindings, dialect, wanted_kinds
from adapters.mavlink.packets import PacketList, PacketScanner
from adapters.message import Message
from adapters.source import LINK

SECOND = 1_000_000_000
T0 = 1_790_000_000 * SECOND
Stream = list[tuple[float, bytes]]


def stream(seconds: float, rate_hz: float, first: int = 0, start_s: float = 0.0, counts: bool = True) -> Stream:
    """Return packets of one sender, each with its time of arrival in seconds."""
    sender = ardupilotmega.MAVLink(None, srcSystem=1, srcComponent=1)
    packets = []
    for k in range(round(seconds * rate_hz)):
        sender.seq = (first + k) % 256 if counts else 0
        time_s = start_s + k / rate_hz
        message = ardupilotmega.MAVLink_attitude_message(round(time_s * 1e3), 0.1, 0, 0, 0, 0, 0)
        packets.append((time_s, bytes(message.pack(sender))))
    return packets


def findings(packets: Iterable[tuple[float, bytes]]) -> list[Message]:
    scanner, listed = PacketScanner(dialect()), PacketList(dialect())
    for time_s, packet in sorted(packets):
        scanner.scan(packet, listed, T0 + round(time_s * SECOND))
    batch = SequenceFindings().decoded(listed, wanted_kinds())
    assert batch.count - len(batch.others) == len(listed)
    return [message for _, message in sorted(batch.others.items())]


@pytest.mark.parametrize(
    "rival",
    [
        stream(20, 1, 77, start_s=5.0),
        stream(20, 5, 200, start_s=5.0),
        stream(20, 200, 131, start_s=5.0),
        stream(20, 37, 3, start_s=5.0),
    ],
    ids=["1_hz", "5_hz", "the_same_rate", "another_rate"],
)
@pytest.mark.parametrize("lost", [0.0, 0.3])
def test_two_senders_of_one_id_are_seen_within_five_seconds(rival: Stream, lost: float) -> None:
    draw = random.Random(5)
    packets = [
        packet for packet in stream(25, 200) + [(t + 0.0013, data) for t, data in rival] if draw.random() >= lost
    ]
    first, *others = findings(packets)
    assert (first.source, first.name, first.system, first.component) == (LINK, SEQUENCE, 1, 1)
    assert (first.received_ns - T0) / SECOND - 5.0 < 5.0
    assert len(others) <= 20
    assert [message.fields["conflicts"] for message in others] == sorted(m.fields["conflicts"] for m in others)


def delayed(packets: Stream, by_s: Callable[[], float]) -> Stream:
    return [(time_s + by_s(), packet) for time_s, packet in packets]


@pytest.mark.parametrize("rate_hz", [10, 200, 500])
@pytest.mark.parametrize("seed", range(3))
def test_nothing_that_links_do_to_one_senders_packets_makes_it_two(rate_hz: int, seed: int) -> None:
    draw = random.Random(seed)
    sent = stream(20, rate_hz)
    kept = [packet for packet in sent if draw.random() >= 0.3]
    assert findings(kept) == []
    assert findings(kept + delayed(sent, lambda: 0.15)) == []
    assert findings(sent + sent) == []
    assert findings(delayed(kept, lambda: draw.uniform(0.0, 0.2))) == []
    assert findings([packet for packet in sent if packet[0] % 2.0 < 1.5]) == []
    assert findings([packet for k, packet in enumerate(sent) if k % 5 == 0]) == []


@pytest.mark.parametrize("away_s", [0.0, 0.5, 3.0])
def test_a_sender_that_starts_anew_is_not_two(away_s: float) -> None:
    assert findings(stream(10, 50, 100) + stream(10, 50, 0, start_s=10.0 + away_s)) == []


def test_a_second_radio_that_is_seconds_late_makes_no_second_sender() -> None:
    once = stream(30, 40)
    assert findings(once + [(time_s + 3.5, packet) for time_s, packet in once]) == []


def test_a_sender_that_does_not_count_is_not_two() -> None:
    assert findings(stream(10, 50, counts=False)) == []
