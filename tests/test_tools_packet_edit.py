"""Packets under another sender, number and signature: pymavlink reads them, with the same contents."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from packet_edit import checksummed, readdressed, signed
from packet_stream import PacketStream
from pymavlink.dialects.v20 import ardupilotmega

from adapters.errors import TelemetryError
from adapters.logs.tlog import TlogReader
from adapters.mavlink.mavlink_message import MAGIC_1
from adapters.mavlink.signing import SignatureVerdict, SignatureVerifier, SigningKey, unix_stamp

NOW_NS = 1_795_251_917_265_689_600
KEY = SigningKey(bytes(range(32)))


@pytest.fixture(scope="module")
def packets(data: Path) -> list[bytes]:
    return [packet for _, packet in TlogReader(data / "copter_5s.tlog.xz").packets()]


def decoded(packet: bytes) -> Any:
    parser = ardupilotmega.MAVLink(None)
    found = parser.parse_buffer(packet)
    assert len(found) == 1
    return found[0]


def test_a_readdressed_packet_differs_in_sender_and_sequence_number_alone(packets: list[bytes]) -> None:
    for packet in packets[:200]:
        before, after = decoded(packet), decoded(readdressed(packet, 77, 200))
        assert repr(before.to_dict()) == repr(after.to_dict())
        assert after.get_srcSystem() == 77
        assert after.get_seq() == 200
        assert after.get_srcComponent() == before.get_srcComponent()


def test_version_1_is_readdressed_too() -> None:
    packer = ardupilotmega.MAVLink(None, 3, 1)
    packet = ardupilotmega.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3).pack(packer, force_mavlink1=True)
    assert packet[0] == MAGIC_1
    after = decoded(readdressed(packet, 9, 5))
    assert (after.get_srcSystem(), after.get_seq(), after.base_mode) == (9, 5, 81)


def test_a_damaged_packet_becomes_a_valid_one(packets: list[bytes]) -> None:
    damaged = packets[0][:-1] + bytes([packets[0][-1] ^ 1])
    assert PacketStream().packets(damaged) == []
    assert checksummed(damaged) == packets[0]


def test_a_signed_packet_is_valid_for_the_holder_of_the_key_alone(packets: list[bytes]) -> None:
    packet = signed(packets[0], KEY, unix_stamp(NOW_NS), link=3)
    assert SignatureVerifier(KEY).check(packet, NOW_NS) is SignatureVerdict.VALID
    assert SignatureVerifier(SigningKey(bytes(32))).check(packet, NOW_NS) is SignatureVerdict.FORGED
    parser = ardupilotmega.MAVLink(None)
    parser.signing.secret_key = KEY.secret
    assert parser.parse_buffer(packet)[0].get_signed()


def test_a_readdressed_packet_lost_its_signature(packets: list[bytes]) -> None:
    packet = signed(packets[0], KEY, 1)
    assert readdressed(packet, 7, 0) == readdressed(packets[0], 7, 0)


def test_what_cannot_be_done_is_said(packets: list[bytes]) -> None:
    with pytest.raises(TelemetryError, match="not in the dialect"):
        checksummed(packets[0][:7] + b"\xff\xff\xff" + packets[0][10:])
    with pytest.raises(TelemetryError, match="cannot be signed"):
        signed(bytes([MAGIC_1]) + packets[0][1:], KEY, 1)
