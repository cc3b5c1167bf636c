"""Channels: how they are written in TOML, and what they take from a message."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from adapters.channels import Channel, channel_table, parse_channel, read_channel
from adapters.errors import ProfileError, TelemetryError
from adapters.toml_tables import parse_toml

NAMES = st.text("abcdefgh_0123", min_size=1, max_size=8).filter(lambda name: not name[0].isdigit())


@given(
    message=NAMES,
    path=st.lists(st.one_of(NAMES, st.integers(0, 99)), max_size=3),
    head=NAMES,
    scale=st.floats(-1e6, 1e6),
    offset=st.floats(-1e6, 1e6),
    where=st.dictionaries(NAMES, st.one_of(st.integers(), NAMES), max_size=2),
    clock=st.none() | NAMES,
    unit=st.none() | st.integers(1, 10**9),
    interpolation=st.sampled_from(["linear", "previous", "mean"]),
)
def test_a_channel_survives_the_way_through_its_table(message: str, path: list[Any], head: str, **rest: Any) -> None:
    channel = Channel(
        name="c",
        message=message,
        path=(head, *path),
        scale=rest["scale"],
        offset=rest["offset"],
        where=tuple(rest["where"].items()),
        clock=rest["clock"],
        clock_unit_ns=rest["unit"],
        interpolation=rest["interpolation"],
    )
    assert parse_channel("c", channel_table(channel), "here") == channel


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ({"field": "a"}, "'message' is missing"),
        ({"message": "A", "field": ""}, "write it like"),
        ({"message": "A", "field": "a", "unit": "m"}, "'unit' is not a key of this table; known here: angle, at_least"),
        ({"message": "A", "field": "a", "scale": "2"}, "which is not a number"),
        ({"message": "A", "field": "a", "where": [1]}, "'where' is not a table"),
        ({"message": "A", "field": "a", "where": {"port": 1.5}}, "'where' is not a table"),
        ({"message": "A", "field": "a", "clock": 1}, "'clock' is 1, which is not text in quotes"),
        ({"message": "A", "field": "a", "clock_unit_ns": 0}, "'clock_unit_ns' is 0; it must be at least 1"),
        ({"message": "A", "field": "a", "interpolation": "cubic"}, "it must be 'linear', 'previous' or 'mean'"),
    ],
)
def test_a_wrong_table_is_reported_in_one_line_that_names_it(table: dict[str, Any], said: str) -> None:
    with pytest.raises(TelemetryError, match=r"profile\.toml: channels\.a") as caught:
        parse_channel("a", table, "profile.toml: channels.a")
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_value_is_scaled_and_found_inside_lists_and_tables() -> None:
    fields = {"data": [1.0, 2.0], "pose": {"x": [3, 4]}}
    assert Channel("c", "M", ("data", 1), scale=2.0, offset=1.0).value(fields) == 5.0
    assert Channel("c", "M", ("pose", "x", 0)).value(fields) == 3.0


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"a": "1"},
        {"a": None},
        {"a": True},
        {"a": [1]},
        {"a": math.nan},
        {"a": -math.inf},
        {"a": 10**400},
        {"a": 1e301},
        {"a": -1.1e12},
    ],
)
def test_what_is_no_finite_number_is_no_value(fields: dict[str, Any]) -> None:
    assert Channel("c", "M", ("a",)).value(fields) is None


@pytest.mark.parametrize("path", [("a", 7), ("a", "b"), ("a", 0, 0), ("b", 0)])
def test_a_path_that_leads_nowhere_gives_no_value(path: tuple[str | int, ...]) -> None:
    assert Channel("c", "M", path).value({"a": [1.0]}) is None


@pytest.mark.parametrize(
    ("fields", "stamp"),
    [
        ({"time_boot_ms": 5}, 5_000_000),
        ({"time_usec": 5}, 5_000),
        ({"time_ns": 5}, 5),
        ({"time_boot_ms": 1, "time_usec": 5}, 1_000_000),
        ({"time_boot_ms": "x", "time_usec": 5}, 5_000),
        ({"time_boot_ms": True}, None),
        ({"time_usec": math.nan}, None),
        ({}, None),
    ],
)
def test_the_usual_clocks_are_known(fields: dict[str, Any], stamp: int | None) -> None:
    assert Channel("c", "M", ("a",)).stamp_ns(fields) == stamp


def test_a_clock_of_ones_own_may_count_fractions() -> None:
    channel = Channel("c", "M", ("a",), clock="t", clock_unit_ns=1_000_000_000)
    assert channel.stamp_ns({"t": 1.25, "time_boot_ms": 7}) == 1_250_000_000
    assert channel.stamp_ns({"time_boot_ms": 7}) is None


@pytest.mark.parametrize(
    ("clock", "fields", "stamp"),
    [
        (None, {"header": {"stamp": {"sec": 2, "nanosec": 3}}}, 2_000_000_003),
        (None, {"time_usec": 5, "header": {"stamp": {"sec": 2, "nanosec": 3}}}, 5_000),
        ("header.stamp", {"time_usec": 5, "header": {"stamp": {"sec": 2, "nanosec": 3}}}, 2_000_000_003),
        ("stamp", {"stamp": {"sec": -1, "nanosec": 1}}, -999_999_999),
        ("states[1].stamp", {"states": [{}, {"stamp": {"sec": 0, "nanosec": 9}}]}, 9),
        ("info.time", {"info": {"time": 7}}, 7),
        (None, {"header": {"stamp": {"sec": 2}}}, None),
        (None, {"header": {"stamp": {"sec": "2", "nanosec": 3}}}, None),
        (None, {"header": {"stamp": {"sec": math.inf, "nanosec": 3}}}, None),
        (None, {"header": {"stamp": [2, 3]}}, None),
        (None, {"header": 5}, None),
        ("header.stamp", {"header": None}, None),
    ],
)
def test_seconds_and_nanoseconds_of_a_nested_field_are_a_clock(
    clock: str | None, fields: dict[str, Any], stamp: int | None
) -> None:
    assert Channel("c", "M", ("a",), clock=clock).stamp_ns(fields) == stamp


def test_the_microseconds_of_px4_are_a_clock_with_a_unit() -> None:
    channel = parse_channel(
        "c", {"message": "M", "field": "xyz[2]", "clock": "timestamp", "clock_unit_ns": 1000}, "profile.toml"
    )
    assert channel.stamp_ns({"timestamp": 5_000_000}) == 5_000_000_000


def test_a_joint_is_found_by_its_name_whatever_the_order() -> None:
    channel = parse_channel("elbow", {"message": "joints", "field": "position[arm.elbow]"}, "profile.toml")
    assert channel.value({"name": ["arm.elbow", "wrist"], "position": [0.5, 1.0]}) == 0.5
    assert channel.value({"name": ["wrist", "base", "arm.elbow"], "position": [1.0, 2.0, 3.0]}) == 3.0
    assert parse_channel("elbow", channel_table(channel), "again") == channel


@pytest.mark.parametrize(
    "fields",
    [
        {"position": [1.0]},
        {"name": "elbow", "position": [1.0]},
        {"name": ["wrist"], "position": [1.0]},
        {"name": ["elbow", "wrist"], "position": [1.0]},
        {"name": ["elbow"], "position": []},
        {"name": ["elbow", "elbow"], "position": [1.0, 2.0]},
    ],
)
def test_a_joint_that_cannot_be_told_gives_no_value(fields: dict[str, Any]) -> None:
    assert Channel("c", "M", ("position", "elbow")).value(fields) is None


def test_where_selects_among_messages_of_one_name() -> None:
    channel = Channel("c", "SERVO_OUTPUT_RAW", ("servo1_raw",), where=(("port", 0),))
    assert channel.selects({"port": 0})
    assert not channel.selects({"port": 1})
    assert not channel.selects({})


def test_a_message_below_a_least_value_is_no_measurement() -> None:
    table = {"message": "GPS_RAW_INT", "field": "lat", "at_least": {"fix_type": 2}}
    channel = parse_channel("lat", table, "profile.toml: signals")
    assert [channel.selects({"fix_type": fix}) for fix in (0, 1, 2, 3)] == [False, False, True, True]
    assert not channel.selects({})
    assert not channel.selects({"fix_type": "3"})
    assert parse_channel("lat", channel_table(channel), "again") == channel
    with pytest.raises(TelemetryError, match=r"'at_least\.fix_type' is"):
        parse_channel("lat", {**table, "at_least": {"fix_type": "3D"}}, "profile.toml: signals")


def test_a_period_is_read_and_written_and_has_to_be_positive() -> None:
    table = {"message": "GPS_RAW_INT", "field": "cog", "scale": 0.01, "period": 360}
    channel = parse_channel("course", table, "profile.toml: signals")
    assert channel.period == 360.0
    assert parse_channel("course", channel_table(channel), "again") == channel
    for bad in (0, -1.0, True, "360"):
        with pytest.raises(TelemetryError, match="'period' is "):
            parse_channel("course", {**table, "period": bad}, "profile.toml: signals")


def test_a_motor_that_is_stopped_counts_as_the_command_it_is_given() -> None:
    channel = Channel("motor1", "S", ("servo1_raw",), scale=0.001, offset=-1.0, stopped_as=0.5)
    values = [channel.value({"servo1_raw": pulse}) for pulse in (900, 995, 1000, 1600)]
    assert values == pytest.approx([0.5, -0.005, 0.0, 0.6])
    assert parse_channel("motor1", channel_table(channel), "t") == channel


def test_a_time_inside_a_time_is_none() -> None:
    stamp: dict[str, Any] = {"sec": 1, "nanosec": 2}
    for _ in range(2000):
        stamp = {"sec": stamp, "nanosec": 2}
    assert Channel("c", "M", ("x",)).stamp_ns({"header": {"stamp": stamp}}) is None


def test_the_documented_mapping_of_px4_topics_reads_their_messages() -> None:
    page = (Path(__file__).parent.parent / "docs/how-to/own-channels.md").read_text()
    example = page.partition("## Example: speeds, battery and vibration from PX4's topics")[2]
    tables = parse_toml("profile.toml", example.split("```")[1].removeprefix("toml").encode(), ProfileError)
    observers = tables.root.table("observers")
    found: dict[str, Channel] = {}
    for observer in observers:
        signals = observers.table(observer).table("signals")
        found |= {name: read_channel(name, signals.table(name)) for name in signals}
    tables.check()
    reports = [{"esc_rpm": 4000 + at, "esc_current": 1.5 + at} for at in range(4)]
    fields = {
        "timestamp": 7,
        "esc": reports,
        "voltage_v": 15.2,
        "accel_vibration_metric": 3.0,
        "accel_clipping": [0, 5, 0],
    }
    values = {name: channel.value(fields) for name, channel in found.items()}
    assert values == pytest.approx(
        {"rpm2": 4001.0, "amps2": 2.5, "volts": 15.2, "vibration_x": 3.0 / 3**0.5, "clipping_1": 5.0}, rel=1e-5
    )
    assert {channel.stamp_ns(fields) for channel in found.values()} == {7000}
