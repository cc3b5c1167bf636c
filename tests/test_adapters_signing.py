"""Signatures: what the key holders send gets in, and nothing that others send can keep it out."""

from __future__ import annotations

import hashlib
import struct
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega

from adapters.errors import TelemetryError
from adapters.mavlink.signing import (
    SignatureVerdict,
    SignatureVerifier,
    SigningGuard,
    SigningKey,
    read_key,
    unix_stamp,
)
from adapters.source import LINK

SECOND_NS = 1_000_000_000
NOW_NS = 1_795_251_917 * SECOND_NS
KEY = SigningKey(bytes(range(32)))
LARGEST_STAMP = (1 << 48) - 1


def signed(
    stamp: int, system: int = 1, component: int = 1, link_id: int = 0, key: SigningKey = KEY, number: int = 0
) -> bytes:
    """Return an ATTITUDE message as pymavlink packs and signs it."""
    sender = ardupilotmega.MAVLink(None, srcSystem=system, srcComponent=component)
    sender.signing.secret_key = key.secret
    sender.signing.sign_outgoing = True
    sender.signing.timestamp = stamp
    sender.signing.link_id = link_id
    return bytes(ardupilotmega.MAVLink_attitude_message(number, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0).pack(sender))


def unsigned(message: Any, system: int = 1, version_1: bool = False) -> bytes:
    return bytes(message.pack(ardupilotmega.MAVLink(None, system, 1), force_mavlink1=version_1))


def attitude() -> Any:
    return ardupilotmega.MAVLink_attitude_message(0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0)


def forged(stamp: int, system: int = 1) -> bytes:
    """Return what somebody without the key can make: right in everything but the hash."""
    return signed(stamp, system, key=SigningKey(b"\xff" * 32))


STAMP = unix_stamp(NOW_NS)


def test_what_pymavlink_signs_is_valid_and_what_changes_in_it_is_not() -> None:
    packet = signed(STAMP)
    assert SignatureVerifier(KEY).check(packet, NOW_NS) is SignatureVerdict.VALID
    for place in range(10, len(packet)):
        changed = bytearray(packet)
        changed[place] ^= 0x10
        assert SignatureVerifier(KEY).check(bytes(changed), NOW_NS) is SignatureVerdict.FORGED


def test_the_signature_is_the_first_six_bytes_of_the_hash_that_the_guide_states() -> None:
    packet = signed(STAMP, link_id=3)
    assert packet[-13:-6] == struct.pack("<BQ", 3, STAMP)[:7]
    assert KEY.signature(packet[:-6]) == hashlib.sha256(KEY.secret + packet[:-6]).digest()[:6] == packet[-6:]


def test_a_forged_packet_with_the_largest_time_stamp_locks_nobody_out() -> None:
    # pymavlink stores the time stamp before it verifies the hash, so there this traffic ends with the second packet.
    traffic = [signed(STAMP), forged(LARGEST_STAMP), *(signed(STAMP + k) for k in range(1, 20))]
    library = ardupilotmega.MAVLink(None)
    library.signing.secret_key = KEY.secret
    theirs = [library.check_signature(bytearray(packet), 1, 1) for packet in traffic]
    verifier = SignatureVerifier(KEY)
    ours = [verifier.check(packet, NOW_NS) for packet in traffic]
    assert ours == [SignatureVerdict.VALID, SignatureVerdict.FORGED, *[SignatureVerdict.VALID] * 19]
    assert theirs.count(True) <= ours.count(SignatureVerdict.VALID)


def test_a_forged_first_packet_takes_no_stream_and_no_memory() -> None:
    verifier = SignatureVerifier(KEY)
    for system in range(256):
        for component in range(0, 256, 5):
            packet = bytearray(forged(LARGEST_STAMP, system))
            packet[6] = component
            assert verifier.check(bytes(packet), NOW_NS) is SignatureVerdict.FORGED
    assert not verifier._streams
    assert verifier.check(signed(STAMP), NOW_NS) is SignatureVerdict.VALID


def test_time_stamps_have_to_increase_within_each_stream_alone() -> None:
    verifier = SignatureVerifier(KEY)
    streams = [(1, 1, 0), (2, 1, 0), (1, 2, 0), (1, 1, 1)]
    for k, stream in enumerate(streams):
        assert verifier.check(signed(STAMP - k, *stream), NOW_NS) is SignatureVerdict.VALID
    for k, stream in enumerate(streams):
        assert verifier.check(signed(STAMP - k, *stream), NOW_NS) is not SignatureVerdict.VALID
        assert verifier.check(signed(STAMP - k + 1, *stream), NOW_NS) is SignatureVerdict.VALID


def test_a_packet_recorded_earlier_and_sent_again_is_a_replay() -> None:
    verifier = SignatureVerifier(KEY)
    for tenth in range(100):
        now = NOW_NS + tenth * SECOND_NS // 10
        assert verifier.check(signed(unix_stamp(now)), now) is SignatureVerdict.VALID
    now = NOW_NS + 10 * SECOND_NS
    verdicts = [verifier.check(signed(STAMP + tenth * 10_000), now) for tenth in range(100)]
    assert set(verdicts[:80]) == {SignatureVerdict.REPLAYED}
    assert set(verdicts[90:]) == {SignatureVerdict.LATE}
    assert verifier.check(signed(unix_stamp(now)), now) is SignatureVerdict.VALID


def test_replays_to_a_vehicle_whose_stamps_only_count_its_packets_are_noticed_too() -> None:
    verifier = SignatureVerifier(KEY)
    recorded = [signed(STAMP + k) for k in range(100)]
    for k, packet in enumerate(recorded):
        assert verifier.check(packet, NOW_NS + k * SECOND_NS // 10) is SignatureVerdict.VALID
    now = NOW_NS + 60 * SECOND_NS
    assert [verifier.check(packet, now) for packet in recorded] == [SignatureVerdict.REPLAYED] * 100


@given(st.data())
@settings(deadline=None, max_examples=20)
def test_duplicates_and_reordering_on_the_way_are_refused_but_are_no_replays(data: st.DataObject) -> None:
    verifier = SignatureVerifier(KEY)
    order = data.draw(st.permutations(range(5)))
    found = []
    for block in range(8):
        for place in order:
            now = NOW_NS + (5 * block + place) * SECOND_NS // 20
            packet = signed(unix_stamp(now))
            arrival = NOW_NS + (5 * block + 5) * SECOND_NS // 20
            found += [verifier.check(packet, arrival), verifier.check(packet, arrival)]
    assert set(found) <= {SignatureVerdict.VALID, SignatureVerdict.LATE}
    assert found.count(SignatureVerdict.VALID) >= 8


@pytest.mark.parametrize(
    ("behind_s", "verdict"),
    [
        (0, SignatureVerdict.VALID),
        (-3600, SignatureVerdict.VALID),
        (60, SignatureVerdict.VALID),
        (61, SignatureVerdict.REPLAYED),
    ],
)
def test_the_first_packet_of_a_stream_may_be_a_minute_behind(behind_s: int, verdict: SignatureVerdict) -> None:
    packet = signed(STAMP - behind_s * 100_000)
    assert SignatureVerifier(KEY).check(packet, NOW_NS) is verdict


def test_without_a_clock_the_newest_valid_stamp_is_what_first_packets_are_held_against() -> None:
    verifier = SignatureVerifier(KEY)
    assert verifier.check(signed(STAMP), 0) is SignatureVerdict.VALID
    assert verifier.check(signed(STAMP - 6_000_001, system=2), 0) is SignatureVerdict.REPLAYED
    assert verifier.check(signed(STAMP - 6_000_000, system=3), 0) is SignatureVerdict.VALID


def test_a_clock_set_back_costs_no_packet() -> None:
    verifier = SignatureVerifier(KEY)
    for k in range(20):
        assert verifier.check(signed(STAMP + k), NOW_NS - k * 3600 * SECOND_NS) is SignatureVerdict.VALID


def test_even_holders_of_the_key_get_only_bounded_memory() -> None:
    verifier = SignatureVerifier(KEY)
    for k in range(1300):
        assert verifier.check(signed(STAMP + k, 1 + k % 250, 1 + k // 250), NOW_NS) is SignatureVerdict.VALID
    assert len(verifier._streams) == 1024


@pytest.mark.parametrize("version_1", [False, True])
def test_unsigned_packets_pass_only_where_signatures_are_not_required(version_1: bool) -> None:
    packet = unsigned(attitude(), version_1=version_1)
    assert SigningGuard(KEY, require_signed=False).refusal(packet, NOW_NS) is None
    assert SigningGuard(KEY).refusal(packet, NOW_NS) is SignatureVerdict.UNSIGNED


@pytest.mark.parametrize("version_1", [False, True])
def test_what_radios_add_needs_no_signature(version_1: bool) -> None:
    guard = SigningGuard(KEY)
    for kind in (ardupilotmega.MAVLink_radio_status_message, ardupilotmega.MAVLink_radio_message):
        assert guard.refusal(unsigned(kind(1, 1, 1, 1, 1, 1, 1), 51, version_1), NOW_NS) is None
    assert guard.findings(NOW_NS) == []


def test_refused_packets_are_told_of_by_system_at_once_and_then_every_second() -> None:
    guard = SigningGuard(KEY)
    assert guard.findings(NOW_NS) == []
    assert guard.refusal(forged(STAMP, system=7), NOW_NS) is not None
    (first,) = guard.findings(NOW_NS)
    assert (first.source, first.name, first.system, first.received_ns) == (LINK, "signing", 7, NOW_NS)
    assert first.fields == {"forged": 1, "replayed": 0, "unsigned": 0}
    for k in range(100):
        now = NOW_NS + k
        assert guard.refusal(forged(STAMP, system=7), now) is not None
        assert guard.refusal(unsigned(attitude(), system=9), now) is not None
        assert guard.refusal(signed(STAMP + k), now) is None
        assert [message.system for message in guard.findings(now)] == ([9] if k == 0 else [])
    later = guard.findings(NOW_NS + SECOND_NS + 1)
    assert [(message.system, dict(message.fields)) for message in later] == [
        (7, {"forged": 101, "replayed": 0, "unsigned": 0}),
        (9, {"forged": 0, "replayed": 0, "unsigned": 100}),
    ]
    assert guard.findings(NOW_NS + 5 * SECOND_NS) == []
    assert first.fields["forged"] == 1


def test_replays_are_told_of_and_late_packets_only_counted() -> None:
    guard = SigningGuard(KEY)
    old = signed(STAMP)
    assert guard.refusal(old, NOW_NS) is None
    assert guard.refusal(old, NOW_NS) is SignatureVerdict.LATE
    assert guard.findings(NOW_NS) == []
    assert guard.refusal(old, NOW_NS + 60 * SECOND_NS) is not None
    (found,) = guard.findings(NOW_NS + 60 * SECOND_NS)
    assert found.fields == {"forged": 0, "replayed": 1, "unsigned": 0}


def test_what_was_recorded_before_a_restart_is_a_replay_after_it(tmp_path: Path) -> None:
    recorded = [signed(STAMP + k, link_id=k % 2) for k in range(50)]
    state = tmp_path / "made" / "signing.state"
    guard = SigningGuard(KEY, state=state)
    assert all(guard.refusal(packet, NOW_NS) is None for packet in recorded)
    guard.save()
    again = SigningGuard(KEY, state=state)
    assert {again.refusal(packet, NOW_NS + SECOND_NS) for packet in recorded} == {SignatureVerdict.REPLAYED}
    assert again.refusal(signed(STAMP + 50), NOW_NS + SECOND_NS) is None
    # without it the packets of the last minute are a new stream's
    assert SigningGuard(KEY).refusal(recorded[0], NOW_NS + SECOND_NS) is None


@pytest.mark.parametrize("content", ["", "[]", '{"1/1": 3}', '{"1/1/1": -3}', '{"1/1/1": "x"}', '{"a/b/c": 1}'])
def test_a_state_file_that_cannot_be_read_stops_nothing_and_is_said(
    content: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    state = tmp_path / "signing.state"
    state.write_text(content)
    guard = SigningGuard(KEY, state=state)
    assert "signing.state: time stamps of signatures cannot be read" in caplog.text
    assert guard.refusal(signed(STAMP), NOW_NS) is None
    guard.save()
    assert SigningGuard(KEY, state=state).refusal(signed(STAMP), NOW_NS + SECOND_NS) is SignatureVerdict.REPLAYED


@given(st.lists(st.binary(min_size=12, max_size=300), max_size=30), st.booleans())
@settings(deadline=None)
def test_no_bytes_make_the_guard_fail(packets: list[bytes], require_signed: bool) -> None:
    guard = SigningGuard(KEY, require_signed)
    for packet in packets:
        guard.refusal(b"\xfd" + packet[:1] + b"\x01" + packet.ljust(25, b"\0"), NOW_NS)
        guard.refusal(b"\xfe" + packet, NOW_NS)
    assert all(message.fields for message in guard.findings(NOW_NS))


def key_file(path: Path, content: bytes, mode: int = 0o600) -> Path:
    path.write_bytes(content)
    path.chmod(mode)
    return path


@pytest.mark.parametrize(
    ("content", "secret"),
    [
        (KEY.secret.hex().encode(), KEY.secret),
        (KEY.secret.hex().upper().encode() + b"\r\n", KEY.secret),
        (KEY.secret, KEY.secret),
        (b"\xff" * 32, b"\xff" * 32),
        (b"correct horse battery", hashlib.sha256(b"correct horse battery").digest()),
        (b"correct horse battery\n", hashlib.sha256(b"correct horse battery").digest()),
        (b"thirty-two characters long it is", hashlib.sha256(b"thirty-two characters long it is").digest()),
        ("schlüssel\n".encode(), hashlib.sha256("schlüssel".encode()).digest()),
        (b"z" * 64, hashlib.sha256(b"z" * 64).digest()),
    ],
)
def test_a_key_file_holds_hexadecimal_digits_a_passphrase_or_the_bytes(
    tmp_path: Path, content: bytes, secret: bytes
) -> None:
    assert read_key(key_file(tmp_path / "key", content)).secret == secret


@pytest.mark.parametrize(
    "content", [b"", b"\n", b"   \n", b"two\nlines", b"\xff" * 31, b"\xff" * 33, b"a" * 5000, b"\x00"]
)
def test_a_file_without_a_key_is_reported_in_one_line(tmp_path: Path, content: bytes) -> None:
    path = key_file(tmp_path / "key", content)
    with pytest.raises(TelemetryError, match="holds no signing key") as caught:
        read_key(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_a_key_that_every_user_may_read_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TelemetryError, match="chmod o-rwx"):
        read_key(key_file(tmp_path / "key", b"secret", 0o644))
    assert read_key(key_file(tmp_path / "key", b"secret", 0o640))


def test_a_key_file_that_is_missing_is_reported(tmp_path: Path) -> None:
    with pytest.raises(TelemetryError, match="cannot be read: No such file"):
        read_key(tmp_path / "none")
    with pytest.raises(TelemetryError, match="cannot be read: Is a directory"):
        read_key(tmp_path)


def test_a_key_does_not_show_its_secret() -> None:
    assert repr(SigningKey(b"s" * 32)) == "SigningKey()"
    with pytest.raises(TelemetryError, match="32 bytes, not 3"):
        SigningKey(b"abc")
