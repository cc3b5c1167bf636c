"""CDR from bytes to fields, and payloads that lie."""

from __future__ import annotations

import contextlib
import math
import struct
import tracemalloc
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap_ros2._dynamic import serialize_dynamic

from adapters.encoding.cdr import CdrDecoder
from adapters.encoding.message_definition import find_definition
from adapters.errors import PayloadError, TelemetryError

TYPES = {
    name: find_definition(name, [])
    for name in (
        "sensor_msgs/msg/Imu",
        "sensor_msgs/msg/NavSatFix",
        "sensor_msgs/msg/JointState",
        "nav_msgs/msg/Odometry",
        "geometry_msgs/msg/TwistStamped",
        "std_msgs/msg/Float64MultiArray",
    )
}
DECODERS = {name: CdrDecoder(name, text) for name, text in TYPES.items()}
HEADER = {"stamp": {"sec": 1_795_251_917, "nanosec": 265_689_600}, "frame_id": "base_link"}
MIXED = """bool flag
uint8 a
uint64 b
int16[3] c
float32 d
string e
Inner[] inner
Inner[2] pair
string[] texts
uint8[] raw
bool[] flags
int64[<=4] few
Empty empty
===
MSG: x_msgs/Inner
uint8 id
float64 value
===
MSG: x_msgs/Empty
"""


def encode(name: str, text: str, fields: dict[str, Any]) -> bytes:
    return bytes(serialize_dynamic(name, text)[name](fields))


FLOATS = st.floats(width=64)
TEXTS = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=9)


@given(
    a=st.integers(0, 255),
    b=st.integers(0, 2**64 - 1),
    c=st.lists(st.integers(-(2**15), 2**15 - 1), min_size=3, max_size=3),
    d=st.floats(width=32, allow_nan=False),
    e=TEXTS,
    values=st.lists(st.floats(allow_nan=False), max_size=5),
    texts=st.lists(TEXTS, max_size=4),
    raw=st.binary(max_size=9),
)
def test_any_message_decodes_to_what_an_independent_encoder_wrote(values: list[float], **given: Any) -> None:
    fields = {
        **given,
        "flag": True,
        "inner": [{"id": k, "value": value} for k, value in enumerate(values)],
        "pair": [{"id": 1, "value": 0.5}, {"id": 2, "value": -0.5}],
        "flags": [True, False],
        "few": [-1, 2],
        "empty": {},
    }
    decoded = CdrDecoder("x_msgs/msg/Mixed", MIXED).decode(encode("x_msgs/msg/Mixed", MIXED, fields))
    assert decoded == {**fields, "raw": list(given["raw"])}


def test_numbers_may_stand_in_either_byte_order() -> None:
    text = "uint8 a\nuint32 b\nfloat64 c\nstring d\nint16[] e\n"
    body = struct.pack(">BxxxIdI3sxIhh", 7, 70_000, 1.5, 3, b"ab\0", 2, -1, 2)
    assert CdrDecoder("a/B", text).decode(b"\0\0\0\0" + body) == {
        "a": 7,
        "b": 70_000,
        "c": 1.5,
        "d": "ab",
        "e": [-1, 2],
    }


def test_nan_and_infinity_come_through_as_they_are() -> None:
    name = "geometry_msgs/msg/TwistStamped"
    twist = {"linear": {"x": math.inf, "y": -math.inf, "z": math.nan}}
    linear = DECODERS[name].decode(encode(name, TYPES[name], {"twist": twist}))["twist"]["linear"]
    assert (linear["x"], linear["y"]) == (math.inf, -math.inf)
    assert math.isnan(linear["z"])


def test_a_text_that_is_no_utf8_is_refused() -> None:
    with pytest.raises(PayloadError, match="a/B: 'utf-8' codec"):
        CdrDecoder("a/B", "string s").decode(b"\0\1\0\0\3\0\0\0\xff\xfe\0")


@pytest.mark.parametrize("name", TYPES)
def test_every_message_whose_numbers_are_cut_off_is_refused(name: str) -> None:
    fields = {"header": HEADER, "name": ["a", "b"], "position": [1.0, 2.0], "velocity": [1.0], "effort": [1.0]}
    fields["data"] = [1.0, 2.0]
    payload = encode(name, TYPES[name], fields)
    DECODERS[name].decode(payload)
    # the last byte of a header's text may be missing where a number follows it only
    for length in range(len(payload)):
        with pytest.raises(PayloadError):
            DECODERS[name].decode(payload[:length])


@pytest.mark.parametrize("field", ["float64[]", "string[]", "E[]", "T[]", "bool[]", "float64[<=3]"])
@pytest.mark.parametrize("claim", [0xFFFFFFFF, 0x7FFFFFFF, 0x10000000, 4_000])
def test_a_length_that_cannot_be_is_refused_before_anything_is_allocated(field: str, claim: int) -> None:
    text = f"{field} x\n===\nMSG: a/E\n===\nMSG: a/T\nfloat64 y\nstring s"
    decoder = CdrDecoder("a/B", text)
    payload = b"\0\1\0\0" + struct.pack("<I", claim) + bytes(64)
    tracemalloc.start()
    with pytest.raises(PayloadError):
        decoder.decode(payload)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100_000


@pytest.mark.parametrize("size", [1_000_000, 999_999_999])
def test_a_definition_of_absurd_arrays_costs_nothing(size: int) -> None:
    text = f"A[{size}] x\n===\nMSG: a/A\nfloat64[{size}] y\n"
    with pytest.raises(PayloadError, match="a/B: cut off"):
        CdrDecoder("a/B", text).decode(b"\0\1\0\0" + bytes(64))


@pytest.mark.parametrize(
    "head", ["", "00", "0001", "000100", "00020000", "00030000", "00070000", "01000000", "7b226122"]
)
def test_what_is_no_plain_cdr_is_refused(head: str) -> None:
    with pytest.raises(PayloadError, match="a/B: not plain CDR"):
        CdrDecoder("a/B", "float64 x").decode(bytes.fromhex(head) + bytes(8 if len(head) == 8 else 0))


def test_bytes_after_the_message_are_passed_over() -> None:
    payload = b"\0\1\0\0" + struct.pack("<Q", 5)
    for padding in (bytes(3), bytes(28)):
        assert CdrDecoder("px4_msgs/msg/VehicleOdometry", "uint64 timestamp").decode(payload + padding) == {
            "timestamp": 5
        }


@given(st.sampled_from(sorted(TYPES)), st.binary(max_size=400))
def test_any_bytes_are_a_message_or_refused(name: str, body: bytes) -> None:
    for payload in (body, b"\0\1\0\0" + body, b"\0\0\0\0" + body):
        try:
            assert isinstance(DECODERS[name].decode(payload), dict)
        except PayloadError as error:
            assert "\n" not in str(error)


@pytest.mark.parametrize(
    "text",
    ["float64", "float64 x\nfloat64 x", "float64 1x", "float64[-1] x", "uint8[0] a", "a/b/c", "::", "x" * (1 << 20)],
)
def test_what_is_no_definition_is_reported_in_one_line(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(TelemetryError, match="definition of a/B: ") as caught:
        CdrDecoder("a/B", "uint8 c\n" + text + "\x1b[2J")
    assert "\n" not in str(caught.value)
    assert "\x1b" not in capsys.readouterr().err


@given(st.text(max_size=200))
def test_any_text_is_a_definition_or_refused(text: str) -> None:
    with contextlib.suppress(TelemetryError):
        CdrDecoder("a/B", text)


@pytest.mark.parametrize(
    "text", ["B x", "C x", "C x\n===\nMSG: a/C\nB y", "wstring x", "uint8 x[" + "  " * 40_000 + "#["]
)
def test_messages_of_a_definition_that_cannot_be_used_are_refused(text: str) -> None:
    with pytest.raises((PayloadError, TelemetryError)):
        CdrDecoder("a/msg/B", text).decode(b"\0\1\0\0" + bytes(64))


def test_types_that_double_at_every_level_cost_no_more_than_their_bytes() -> None:
    text = "T29 x\n" + "".join(f"===\nMSG: a/T{k}\nT{k - 1} x\nT{k - 1} y\n" for k in range(1, 30))
    decoder = CdrDecoder("a/B", text + "===\nMSG: a/T0\nuint8 z\n")
    with pytest.raises(PayloadError, match="cut off"):
        decoder.decode(b"\0\1\0\0" + bytes(1000))
