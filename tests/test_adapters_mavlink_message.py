"""Packets to messages: the same values as pymavlink's own decoder, and nothing intact lost in noise."""

from __future__ import annotations

import math
import struct
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from packet_stream import PacketStream, packet_sequence
from pymavlink.dialects.v20 import ardupilotmega

from adapters.mavlink.mavlink_message import message_number, packet_sender
from adapters.source import MAVLINK

ATTITUDE = 30


def link() -> ardupilotmega.MAVLink:
    return ardupilotmega.MAVLink(None, srcSystem=7, srcComponent=9)


def random_packet(number: int, payload: bytes, version_1: bool = False) -> bytes:
    """Return an intact packet with any bytes as payload, packed by pymavlink."""
    table = ardupilotmega.mavlink_map[number]
    message = ardupilotmega.MAVLink_message(number, table.msgname)
    body = payload[: table.unpacker.size].ljust(table.unpacker.size, b"\0")
    return bytes(message._pack(link(), table.crc_extra, body, force_mavlink1=version_1))


def attitude(sequence: int = 0, version_1: bool = False) -> bytes:
    sender = link()
    sender.seq = sequence
    message = ardupilotmega.MAVLink_attitude_message(1000 + sequence, 0.25, 0.0, 0.0, 1.5, 0.0, 0.0)
    return bytes(message.pack(sender, force_mavlink1=version_1))


UNKNOWN = bytes([0xFD, 4, 0, 0, 0, 7, 9, *(59_999).to_bytes(3, "little"), 0xFD, 0xFE, 1, 2, 3, 4])
PIECES = [attitude(), attitude(version_1=True), attitude()[:-1] + b"x", UNKNOWN, b"\xfd", b"\xfe", b"\xfd\xff\0"]


def same(ours: Any, theirs: Any) -> bool:
    if isinstance(ours, list):
        return len(ours) == len(theirs) and all(same(a, b) for a, b in zip(ours, theirs, strict=True))
    if isinstance(ours, float) and math.isnan(ours):
        return isinstance(theirs, float) and math.isnan(theirs)
    return bool(ours == theirs) and type(ours) is type(theirs)


@given(payload=st.binary(min_size=255, max_size=255), version_1=st.booleans())
@settings(max_examples=8, deadline=None)
def test_every_message_of_the_dialect_decodes_as_pymavlink_decodes_it(payload: bytes, version_1: bool) -> None:
    for number in ardupilotmega.mavlink_map:
        if version_1 and number > 255:
            continue
        packet = random_packet(number, payload, version_1)
        (message,) = PacketStream().messages(packet, 12)
        theirs = link().decode(bytearray(packet)).to_dict()
        assert message.name == theirs.pop("mavpackettype")
        assert list(message.fields) == list(theirs)
        assert all(same(message.fields[name], theirs[name]) for name in theirs), message.name
        assert (message.source, message.received_ns, message.system, message.component) == (
            MAVLINK,
            12,
            7,
            9,
        )


def test_fields_are_plain_numbers_text_and_lists() -> None:
    allowed = {int, float, str, list}
    for number in ardupilotmega.mavlink_map:
        (message,) = PacketStream().messages(random_packet(number, bytes(range(255))))
        for value in message.fields.values():
            assert type(value) in allowed
            if isinstance(value, list):
                assert {type(one) for one in value} <= {int, float}


def test_text_ends_at_its_first_zero_byte() -> None:
    packet = bytes(ardupilotmega.MAVLink_statustext_message(6, b"Arming motors").pack(link()))
    (message,) = PacketStream().messages(packet)
    assert message.fields["text"] == "Arming motors"


def test_sender_number_and_sequence_stand_in_both_versions_headers() -> None:
    for version_1 in (False, True):
        packet = attitude(sequence=200, version_1=version_1)
        assert (packet_sender(packet), message_number(packet), packet_sequence(packet)) == ((7, 9), 30, 200)


def test_a_signed_packet_is_taken_with_its_signature_skipped() -> None:
    sender = link()
    sender.signing.secret_key = b"k" * 32
    sender.signing.sign_outgoing = True
    packet = bytes(ardupilotmega.MAVLink_attitude_message(5, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0).pack(sender))
    assert packet[2] == 1
    stream = PacketStream()
    assert stream.packets(packet) == [packet]
    (message,) = stream.messages(packet)
    assert message.fields["roll"] == 1.0
    assert stream.scanner.skipped_bytes == 0


@given(st.lists(st.integers(1, 40), max_size=60), st.booleans())
@settings(deadline=None)
def test_packets_cut_anywhere_are_put_together(cuts: list[int], version_1: bool) -> None:
    data = b"".join(attitude(k, version_1) for k in range(20))
    stream = PacketStream()
    packets = []
    for cut in cuts:
        packets += stream.packets(data[:cut])
        data = data[cut:]
    packets += stream.packets(data)
    assert [packet_sequence(packet) for packet in packets] == list(range(20))
    assert (stream.scanner.damaged, stream.scanner.skipped_bytes) == (0, 0)


@given(st.binary(max_size=300), st.binary(max_size=300))
@settings(deadline=None)
def test_noise_between_packets_costs_no_packet(noise: bytes, more: bytes) -> None:
    data = noise + attitude(1) + more + attitude(2) + attitude(3)
    # What a false start is waiting for comes with later packets, at most 280 bytes of them.
    packets = PacketStream().packets(data + b"".join(attitude(4 + k) for k in range(10)))
    sequences = [packet_sequence(packet) for packet in packets if message_number(packet) == ATTITUDE]
    assert sequences[:3] == [1, 2, 3]


@given(st.data())
@settings(deadline=None)
def test_a_flipped_bit_costs_at_most_its_own_packet(data: st.DataObject) -> None:
    packets = [attitude(k) for k in range(20)]
    stream = bytearray(b"".join(packets))
    place = data.draw(st.integers(0, len(packets[0]) * 10 - 1))
    stream[place] ^= 1 << data.draw(st.integers(0, 7))
    sequences = [packet_sequence(packet) for packet in PacketStream().packets(bytes(stream))]
    assert set(range(10)) - set(sequences) <= {place // len(packets[0])}
    assert set(range(10, 20)) <= set(sequences)


@given(st.lists(st.binary(max_size=400), max_size=20))
@settings(deadline=None)
def test_no_bytes_make_the_parser_fail_or_grow(pieces: list[bytes]) -> None:
    stream = PacketStream()
    for piece in pieces:
        stream.messages(piece)
    assert stream.scanner.waiting <= 280


def test_a_packet_of_an_unknown_message_is_counted_and_skipped_whole() -> None:
    stream = PacketStream()
    packets = stream.packets(attitude(1) + UNKNOWN + attitude(2))
    assert [packet_sequence(packet) for packet in packets] == [1, 2]
    assert (stream.scanner.unknown, stream.scanner.damaged) == (1, 0)


@pytest.mark.parametrize("flags", [2, 0x80, 0xFF])
def test_unknown_incompatibility_flags_make_a_packet_unreadable(flags: int) -> None:
    packet = bytearray(attitude())
    packet[2] = flags
    stream = PacketStream()
    assert stream.packets(bytes(packet) + attitude(1))[-1] == attitude(1)
    assert stream.scanner.damaged >= 1


@pytest.mark.parametrize("junk", [b"\xfe", b"\xfd", b"\xfd\xff\0\0\0"], ids=["1", "2", "2 with a known id"])
def test_junk_in_which_every_byte_could_begin_a_packet_is_skipped(junk: bytes) -> None:
    stream = PacketStream()
    assert stream.packets((junk * 65_507)[:65_507]) == []
    assert stream.scanner.skipped_bytes > 65_000
    assert stream.scanner.waiting <= 280


@pytest.mark.parametrize("version_1", [False, True])
def test_a_payload_longer_than_the_definition_is_a_packet_of_version_2_only(version_1: bool) -> None:
    table = ardupilotmega.mavlink_map[30]
    message = ardupilotmega.MAVLink_message(30, table.msgname)
    body = b"\1" * (table.unpacker.size + 3)
    packet = bytes(message._pack(link(), table.crc_extra, body, force_mavlink1=version_1))
    assert [message.name for message in PacketStream().messages(packet)] == ([] if version_1 else ["ATTITUDE"])


@pytest.mark.parametrize("version_1", [False, True])
def test_packets_of_bad_checksum_are_counted_each(version_1: bool) -> None:
    bad = attitude(version_1=version_1)[:-1] + b"x"
    stream = PacketStream()
    assert stream.packets(attitude(1, version_1) + 5 * bad + attitude(2, version_1) + bad)
    assert (stream.scanner.bad_checksums, stream.scanner.damaged) == (6, 2)
    assert stream.scanner.skipped_bytes == 6 * len(bad)


@given(st.lists(st.one_of(st.binary(max_size=40), st.sampled_from(PIECES)), max_size=12), st.lists(st.integers(1, 60)))
@settings(deadline=None)
def test_what_is_found_and_counted_does_not_depend_on_cuts(pieces: list[bytes], cuts: list[int]) -> None:
    data = b"".join(pieces)
    whole, parts = PacketStream(), PacketStream()
    expected = whole.packets(data)
    packets = []
    for cut in cuts:
        packets += parts.packets(data[:cut])
        data = data[cut:]
    packets += parts.packets(data)
    assert packets == expected
    counts = ("intact", "unknown", "bad_checksums", "damaged", "skipped_bytes", "in_damage", "waiting")
    assert [getattr(parts.scanner, name) for name in counts] == [getattr(whole.scanner, name) for name in counts]


def test_what_motors_turn_is_decoded_though_pymavlink_does_not_know_it() -> None:
    turns, volts, amps = [100, 200, 300, -400], [11.5, 11.25, 11.0, 0.0], [2.5, 3.0, 0.0, 1.0]
    payload = struct.pack("<Q4i4f4fB", 5_000_000, *turns, *volts, *amps, 4)
    packet = bytes(ardupilotmega.MAVLink_message(291, "ESC_STATUS")._pack(link(), 10, payload))
    (message,) = PacketStream().messages(packet, 12)
    expected = {"index": 4, "time_usec": 5_000_000, "rpm": turns, "voltage": volts, "current": amps}
    assert (message.name, message.fields) == ("ESC_STATUS", expected)
