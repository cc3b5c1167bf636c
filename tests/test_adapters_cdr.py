"""CDR against an independent encoder, and against payloads that lie."""

from __future__ import annotations

import math
import struct
import tracemalloc
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap_ros2._dynamic import generate_dynamic, serialize_dynamic

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


def plain(value: Any) -> Any:
    """Return what the other decoder gave as mappings and lists."""
    if isinstance(value, SimpleNamespace):
        return {name: plain(getattr(value, name)) for name in value.__slots__}
    if isinstance(value, list | tuple | bytes):
        return [plain(element) for element in value]
    return value


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


@pytest.mark.parametrize("name", TYPES)
def test_the_shipped_types_decode_as_by_another_decoder(name: str) -> None:
    fields = {
        "header": HEADER,
        "child_frame_id": "imu",
        "name": ["shoulder", "elbow"],
        "position": [0.25, -0.5],
        "velocity": [1.0, 2.0],
        "orientation": {"w": 1.0},
        "angular_velocity": {"x": 0.1, "y": 0.2, "z": 0.3},
        "status": {"status": -1, "service": 3},
        "latitude": 48.1,
        "layout": {"dim": [{"label": "rows", "size": 2, "stride": 2}], "data_offset": 0},
        "data": [1.0, 2.0],
        "twist": {"linear": {"x": 1.5}, "twist": {"linear": {"y": 2.5}}},
    }
    payload = encode(name, TYPES[name], fields)
    assert DECODERS[name].decode(payload) == plain(generate_dynamic(name, TYPES[name])[name](payload))


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


def test_a_text_that_is_no_utf8_does_not_cost_the_message() -> None:
    assert CdrDecoder("a/B", "string s").decode(b"\0\1\0\0\3\0\0\0\xff\xfe\0") == {"s": "��"}


@pytest.mark.parametrize("name", TYPES)
def test_every_message_that_is_cut_off_is_refused(name: str) -> None:
    fields = {"header": HEADER, "name": ["a", "b"], "position": [1.0, 2.0], "velocity": [1.0], "effort": [1.0]}
    fields["data"] = [1.0, 2.0]
    payload = encode(name, TYPES[name], fields)
    DECODERS[name].decode(payload)
    for length in range(len(payload)):
        with pytest.raises(PayloadError):
            DECODERS[name].decode(payload[:length])


@pytest.mark.parametrize(
    "field", ["uint8[]", "float64[]", "string", "string[]", "E[]", "T[]", "bool[]", "float64[<=3]"]
)
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


def test_a_payload_of_another_version_is_refused_but_padding_is_not() -> None:
    decoder = CdrDecoder("a/B", "float64 x")
    payload = b"\0\1\0\0" + struct.pack("<d", 1.5)
    assert decoder.decode(payload + b"\0\0\0") == {"x": 1.5}
    with pytest.raises(PayloadError, match="a/B: 12 bytes where the definition has 8; is it of another version"):
        decoder.decode(payload + b"\0\0\0\0")


def test_px4_may_send_the_rest_of_its_buffer() -> None:
    payload = b"\0\1\0\0" + struct.pack("<Q", 5) + bytes(28)
    assert CdrDecoder("px4_msgs/msg/VehicleOdometry", "uint64 timestamp").decode(payload) == {"timestamp": 5}


@given(st.sampled_from(sorted(TYPES)), st.binary(max_size=400))
def test_any_bytes_are_a_message_or_refused(name: str, body: bytes) -> None:
    for payload in (body, b"\0\1\0\0" + body, b"\0\0\0\0" + body):
        try:
            assert isinstance(DECODERS[name].decode(payload), dict)
        except PayloadError as error:
            assert "\n" not in str(error)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("B x", "a/B is inside itself"),
        ("C x", "a/C is not defined"),
        ("C x\n===\nMSG: a/C\nB y", "a/B is inside itself"),
        ("wstring x", r"wstring \('x'\) is not supported"),
        ("N0 x\n" + "".join(f"===\nMSG: a/N{k}\nN{k + 1} x\n" for k in range(99)), "nested too deeply"),
    ],
)
def test_a_definition_that_cannot_be_used_is_reported(text: str, said: str) -> None:
    with pytest.raises(TelemetryError, match=said):
        CdrDecoder("a/msg/B", text)


def test_types_that_double_at_every_level_cost_no_more_than_their_bytes() -> None:
    text = "T29 x\n" + "".join(f"===\nMSG: a/T{k}\nT{k - 1} x\nT{k - 1} y\n" for k in range(1, 30))
    decoder = CdrDecoder("a/B", text + "===\nMSG: a/T0\nuint8 z\n")
    with pytest.raises(PayloadError, match="cut off"):
        decoder.decode(b"\0\1\0\0" + bytes(1000))
