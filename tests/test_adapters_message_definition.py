"""Message definitions: their text, their names, the folders they are found in."""

from __future__ import annotations

from pathlib import Path

import pytest

from adapters.encoding.cdr import CdrDecoder
from adapters.encoding.message_definition import SHIPPED, canonical_type, find_definition
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


@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*/*.msg")), ids=lambda path: path.stem)
def test_every_shipped_definition_has_all_it_needs(path: Path) -> None:
    name = f"{path.parent.name}/msg/{path.stem}"
    assert CdrDecoder(name, find_definition(name, [])).decode(b"\0\1\0\0" + bytes(1000))


@pytest.mark.parametrize("place", ["px4_msgs/msg", "px4_msgs", "msg", "."])
def test_definitions_are_found_wherever_projects_keep_them(tmp_path: Path, place: str) -> None:
    (tmp_path / place).mkdir(parents=True, exist_ok=True)
    (tmp_path / place / "Outer.msg").write_text("uint64 timestamp\nInner inner\nstd_msgs/Header header\n")
    (tmp_path / place / "Inner.msg").write_text("float32 x\n")
    found = CdrDecoder("px4_msgs/msg/Outer", find_definition("px4_msgs/msg/Outer", [tmp_path]))
    fields = found.decode(b"\0\1\0\0" + bytes(100))
    assert (fields["inner"], fields["header"]["frame_id"]) == ({"x": 0.0}, "")


def test_ones_own_definition_goes_before_a_shipped_one(tmp_path: Path) -> None:
    (tmp_path / "Vector3.msg").write_text("float32 x\n")
    assert find_definition("geometry_msgs/Vector3", [tmp_path]) == "float32 x\n"


def test_a_type_without_definition_is_named_with_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "Outer.msg").write_text("Inner inner\n")
    with pytest.raises(TelemetryError, match=r"no definition of px4_msgs/Inner in .*; put Inner\.msg into a folder"):
        find_definition("px4_msgs/Outer", [tmp_path])


def test_a_broken_file_is_reported(tmp_path: Path) -> None:
    (tmp_path / "Outer.msg").write_text("what?\n")
    with pytest.raises(TelemetryError, match=r"'a/what\?' is not a message type"):
        find_definition("a/Outer", [tmp_path])
