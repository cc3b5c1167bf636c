"""Message definitions: their text, their names, the folders they are found in."""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from adapters.encoding.message_definition import (
    SHIPPED,
    MessageField,
    canonical_type,
    find_definition,
    parse_definitions,
)
from adapters.errors import TelemetryError


@pytest.mark.parametrize(
    "name", ["sensor_msgs/msg/Imu", "sensor_msgs/Imu", "sensor_msgs::msg::Imu", "sensor_msgs::msg::dds_::Imu_"]
)
def test_all_spellings_of_a_type_are_the_same_type(name: str) -> None:
    assert canonical_type(name) == "sensor_msgs/Imu"


@pytest.mark.parametrize("name", ["", "Imu", "a/b/c/D", "../a/B", "a/../B", "a::msg::dds_::B", "a/B_", "a/ B", "a/Ü"])
def test_what_is_no_type_is_refused(name: str) -> None:
    with pytest.raises(TelemetryError, match="is not a message type"):
        canonical_type(name)


def test_fields_arrays_bounds_constants_defaults_and_comments_are_read() -> None:
    text = """# about the message
uint8 MODE_A = 1  # a constant
uint8 MODE_B=2
string NAME = "a b"
float64 x 1.5
float32[3] q  # a comment
int32[] more
int32[<=4] few
string<=10 label "none = 0"
Inner inner
other_msgs/Thing[2] things
"""
    (fields,) = [found for kind, found in parse_definitions("a_msgs/msg/Outer", text).items() if kind == "a_msgs/Outer"]
    assert fields == (
        MessageField("x", "float64"),
        MessageField("q", "float32", size=3),
        MessageField("more", "int32", sequence=True),
        MessageField("few", "int32", sequence=True, at_most=4),
        MessageField("label", "string"),
        MessageField("inner", "a_msgs/Inner"),
        MessageField("things", "other_msgs/Thing", size=2),
    )


def test_the_types_behind_the_separators_are_known_by_their_names() -> None:
    text = "Point p\n================\nMSG: a/Point\nfloat64 x\n===\nMSG: b/msg/Other\nfloat64 y\n"
    assert set(parse_definitions("a/msg/Top", text)) == {
        "a/Top",
        "a/Point",
        "b/Other",
        "builtin_interfaces/Time",
        "builtin_interfaces/Duration",
    }


@pytest.mark.parametrize(
    "text",
    ["float64", "float64 x\nfloat64 x", "float64 1x", "float64[-1] x", "float64[99999999999] x", "a/b/c", "::"],
)
def test_what_is_no_definition_is_reported_in_one_line(text: str) -> None:
    with pytest.raises(TelemetryError, match="definition of a/B: ") as caught:
        list(parse_definitions("a/B", "a/b c\n" + text))
    assert "\n" not in str(caught.value)


@given(st.text(max_size=200))
def test_any_text_is_a_definition_or_refused(text: str) -> None:
    with contextlib.suppress(TelemetryError):
        parse_definitions("a/B", text)


@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*/*.msg")), ids=lambda path: path.stem)
def test_every_shipped_definition_has_all_it_needs(path: Path) -> None:
    name = f"{path.parent.name}/msg/{path.stem}"
    definitions = parse_definitions(name, find_definition(name, []))
    for fields in definitions.values():
        assert all(field.primitive or field.type in definitions for field in fields)


@pytest.mark.parametrize("place", ["px4_msgs/msg", "px4_msgs", "msg", "."])
def test_definitions_are_found_wherever_projects_keep_them(tmp_path: Path, place: str) -> None:
    (tmp_path / place).mkdir(parents=True, exist_ok=True)
    (tmp_path / place / "Outer.msg").write_text("uint64 timestamp\nInner inner\nstd_msgs/Header header\n")
    (tmp_path / place / "Inner.msg").write_text("float32 x\n")
    found = parse_definitions("px4_msgs/msg/Outer", find_definition("px4_msgs/msg/Outer", [tmp_path]))
    assert found["px4_msgs/Inner"] == (MessageField("x", "float32"),)
    assert found["std_msgs/Header"][1] == MessageField("frame_id", "string")


def test_ones_own_definition_goes_before_a_shipped_one(tmp_path: Path) -> None:
    (tmp_path / "Vector3.msg").write_text("float32 x\n")
    assert find_definition("geometry_msgs/Vector3", [tmp_path]) == "float32 x\n"


def test_a_type_without_definition_is_named_with_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "Outer.msg").write_text("Inner inner\n")
    with pytest.raises(TelemetryError, match=r"no definition of px4_msgs/Inner in .*; put Inner\.msg into a folder"):
        find_definition("px4_msgs/Outer", [tmp_path])


def test_a_broken_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "Outer.msg").write_text("what?\n")
    with pytest.raises(TelemetryError, match=r"Outer\.msg: definition of a/Outer: 'what\?' is no field"):
        find_definition("a/Outer", [tmp_path])


@pytest.mark.parametrize("text", ["uint8[0] a", "Inner[0] inner"])
def test_an_array_of_no_elements_is_refused(text: str) -> None:
    """Sequences of what takes no bytes could claim four thousand million elements in four bytes."""
    with pytest.raises(TelemetryError, match=r"definition of x_msgs/A: '(a|inner)' is an array of no elements"):
        parse_definitions("x_msgs/A", text)
