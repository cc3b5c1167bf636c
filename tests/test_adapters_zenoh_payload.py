"""Which type a sample has, and what hostile payloads come to."""

from __future__ import annotations

import contextlib
import math
import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from adapters.errors import PayloadError, TelemetryError, UndefinedTypeError
from adapters.zenoh.zenoh_payload import PayloadDecoder

HASH = "RIHS01_" + "7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b"
ARRAY = b"\0\1\0\0" + struct.pack("<IIIxxxxdd", 0, 0, 2, 1.5, 2.5)
FIELDS = {"layout": {"dim": [], "data_offset": 0}, "data": [1.5, 2.5]}
KIND = "std_msgs/msg/Float64MultiArray"


@pytest.mark.parametrize(
    ("types", "key", "encoding", "name"),
    [
        ({"arm/*": KIND}, "arm/effort", "zenoh/bytes", "arm/effort"),
        ({}, "arm/effort", f"application/cdr;{KIND}", "arm/effort"),
        ({}, "arm/effort", "application/cdr;std_msgs::msg::dds_::Float64MultiArray_", "arm/effort"),
        ({}, f"0/arm/effort/std_msgs::msg::dds_::Float64MultiArray_/{HASH}", "zenoh/bytes", "arm/effort"),
        ({"**/effort/**": KIND}, f"7/effort/x_msgs::msg::dds_::Other_/{HASH}", "zenoh/bytes", "effort"),
        ({"**": KIND}, "a", "application/cdr;sensor_msgs/msg/Imu", "a"),
        ({"a": KIND, "**": "sensor_msgs/msg/Imu"}, "a", "application/json", "a"),
    ],
)
def test_the_type_comes_from_the_mapping_the_encoding_or_the_key(
    types: dict[str, str], key: str, encoding: str, name: str
) -> None:
    decoder = PayloadDecoder(types)
    for _ in range(2):
        assert decoder.decode(key, encoding, ARRAY) == (name, FIELDS)


def test_json_stays_json_whatever_the_encoding_calls_it() -> None:
    decoder = PayloadDecoder({"arm/*": KIND})
    for encoding in ("zenoh/bytes", "application/json", "text/plain"):
        assert decoder.decode("telemetry", encoding, b'{"a": 1}') == ("telemetry", {"a": 1})


@pytest.mark.parametrize(
    ("key", "encoding"),
    [
        ("a", "application/cdr"),
        ("a", "application/cdr;what is this"),
        ("a", "application/cdr;../../etc/passwd"),
        ("a", "application/cdr;px4_msgs/msg/VehicleOdometry"),
        (f"0/a/px4_msgs::msg::dds_::VehicleOdometry_/{HASH}", "zenoh/bytes"),
        (f"0/a/what::ever/{HASH}", "zenoh/bytes"),
    ],
)
def test_a_type_that_nobody_told_or_defined_is_said_to_be_so(key: str, encoding: str) -> None:
    with pytest.raises(UndefinedTypeError):
        PayloadDecoder().decode(key, encoding, ARRAY)


def test_a_type_of_ones_own_is_read_from_its_folder(tmp_path: Path) -> None:
    (tmp_path / "SensorCombined.msg").write_text("uint64 timestamp\nfloat32[3] gyro_rad\n")
    payload = b"\0\1\0\0" + struct.pack("<Qfff", 5_000_000, 0.5, 0.25, -0.5) + bytes(24)
    key = f"0/fmu/out/sensor_combined/px4_msgs::msg::dds_::SensorCombined_/{HASH}"
    assert PayloadDecoder(definitions=[tmp_path]).decode(key, "zenoh/bytes", payload) == (
        "fmu/out/sensor_combined",
        {"timestamp": 5_000_000, "gyro_rad": [0.5, 0.25, -0.5]},
    )


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\xff\xfe",
        b"[1]",
        b"3",
        b"{",
        b"[" * 100_000,
        b'{"a":' * 50_000,
        b'"text"',
        b'{"a": ' + b"9" * 5_000 + b"}",
    ],
    ids=range(9),
)
def test_what_is_no_json_object_is_malformed(payload: bytes) -> None:
    with pytest.raises(PayloadError):
        PayloadDecoder().decode("t", "application/json", payload)


def test_odd_json_is_read_as_it_stands_and_of_two_values_the_last_one() -> None:
    _, fields = PayloadDecoder().decode("t", "", b'{"a": NaN, "b": -Infinity, "c": 1e999, "d": 1, "d": 2}')
    assert math.isnan(fields["a"])
    assert (fields["b"], fields["c"], fields["d"]) == (-math.inf, math.inf, 2)


def test_cdr_that_is_cut_off_is_malformed() -> None:
    with pytest.raises(PayloadError, match="std_msgs/Float64MultiArray: cut off"):
        PayloadDecoder({"a": KIND}).decode("a", "zenoh/bytes", ARRAY[:-1])


@given(key=st.text(max_size=40), encoding=st.text(max_size=40), payload=st.binary(max_size=200))
def test_any_sample_is_a_message_or_refused(key: str, encoding: str, payload: bytes) -> None:
    for encoded in (encoding, "application/cdr;" + encoding, f"application/cdr;{KIND}"):
        with contextlib.suppress(UndefinedTypeError, PayloadError):
            PayloadDecoder().decode(key, encoded, payload)


def test_keys_without_end_do_not_fill_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("adapters.zenoh.zenoh_payload._MAX_KEYS", 10)
    decoder = PayloadDecoder()
    for k in range(100):
        with pytest.raises(UndefinedTypeError):
            decoder.decode(f"k{k}", f"application/cdr;a_msgs/msg/M{k}", ARRAY)
    assert len(decoder._keys) <= 10
    assert len(decoder._decoders) <= 10


@pytest.mark.parametrize(
    ("types", "folders", "said"),
    [
        ({"a//b": KIND}, [], "'a//b' is not a Zenoh key expression"),
        ({"a": "Imu"}, [], "type of 'a': 'Imu' is not a message type; write it like sensor_msgs/msg/Imu"),
        ({"a": "px4_msgs/msg/SensorCombined"}, [], "no definition of px4_msgs/SensorCombined in what is shipped"),
        ({}, [Path("/nowhere")], "/nowhere: no such folder of message definitions"),
    ],
)
def test_a_mapping_that_cannot_work_is_reported_at_the_start(
    types: dict[str, str], folders: list[Path], said: str
) -> None:
    with pytest.raises(TelemetryError) as caught:
        PayloadDecoder(types, folders)
    assert str(caught.value).startswith(said)
    assert "\n" not in str(caught.value)


def test_a_long_key_that_looks_like_one_of_ros_costs_no_more_than_its_length() -> None:
    # As a pattern with the type's colons in it this took seconds, growing with the square of the length.
    key = "0/a/" + "::" * 15_000
    assert PayloadDecoder().decode(key, "", b"{}") == (key, {})
    assert PayloadDecoder().decode("0/a/b/RIHS01_c", "", b"{}")[0] == "0/a/b/RIHS01_c"
