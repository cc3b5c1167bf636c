"""What an onboard log's records stand for: built-in tables, a user's own, and the guess between several ways."""

from __future__ import annotations

from pathlib import Path

import pytest

from adapters.errors import TelemetryError
from adapters.logs.log_mapping import ONBOARD_SOURCES, builtin_mapping, parse_mapping, read_mapping
from adapters.mavlink.mavlink_message import message_tables
from adapters.toml_tables import TomlFile
from monitor.fitting.survey import MOTOR_MESSAGE
from monitor.sampling.identity import Reports
from monitor.vehicles.inertial.signals import MESSAGES

RATES = {"timestamp": 1, "xyz": [0.0, 0.0, 0.0]}
ATTITUDE = {"timestamp": 1, "q": [1.0, 0.0, 0.0, 0.0]}
OUTPUTS = {"timestamp": 1, "output": [0.0] * 16}
COMMANDS = {"timestamp": 1, "control": [0.0] * 12}


@pytest.mark.parametrize("source", ONBOARD_SOURCES)
def test_the_built_in_tables_fill_what_profiles_need(source: str) -> None:
    rules = builtin_mapping(source).rules
    # a log's landing is the touch of the ground, so its height does not matter
    wanted = MESSAGES - Reports.interests - {"RAW_IMU", "GLOBAL_POSITION_INT"} | {
        MOTOR_MESSAGE,
        "HEARTBEAT",
        "EXTENDED_SYS_STATE",
        "VFR_HUD",
    }
    assert wanted <= rules.keys()
    has_time = {name for name, table in message_tables().items() if {"time_boot_ms", "time_usec"} & {*table.fieldnames}}
    assert {"SERVO_OUTPUT_RAW", "VIBRATION"} <= has_time & rules.keys()
    for rule in (rule for name in has_time & rules.keys() for rule in rules[name]):
        assert any(field.name in ("time_boot_ms", "time_usec") and field.channel for field in rule.fields)


def test_of_several_ways_the_first_that_the_log_can_fill_is_taken() -> None:
    mapping = builtin_mapping("ulog")
    old = {"vehicle_attitude": {**ATTITUDE, "rollspeed": 0.0, "pitchspeed": 0.0, "yawspeed": 0.0}}
    assert mapping.guess({"vehicle_attitude": 9}, old)["ATTITUDE"].topic == "vehicle_attitude"
    new = {"vehicle_attitude": ATTITUDE, "vehicle_angular_velocity": RATES}
    chosen = mapping.guess({"vehicle_attitude": 9, "vehicle_angular_velocity": 20}, new)
    assert chosen["ATTITUDE"].topic == "vehicle_angular_velocity"
    assert chosen["ATTITUDE"].topics == {"vehicle_angular_velocity", "vehicle_attitude"}
    assert "ATTITUDE" not in mapping.guess({"vehicle_attitude": 9}, {"vehicle_attitude": ATTITUDE})


@pytest.mark.parametrize(("commands", "topic"), [(10, "actuator_outputs"), (40, "actuator_motors")])
def test_a_later_way_is_taken_where_it_comes_much_more_often(commands: int, topic: str) -> None:
    counts = {"actuator_outputs": 10, "actuator_motors": commands}
    chosen = builtin_mapping("ulog").guess(counts, {"actuator_outputs": OUTPUTS, "actuator_motors": COMMANDS})
    assert chosen["SERVO_OUTPUT_RAW"].topic == topic


def test_the_topics_that_could_fill_a_message_are_known() -> None:
    assert builtin_mapping("dataflash").topics({"GPS_RAW_INT", "ATTITUDE"}) == {"GPS", "RATE", "ATT", "IMU"}


def test_tables_of_a_user_replace_those_of_the_same_message(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(
        'ATTITUDE = []\n[[SCALED_PRESSURE]]\ntopic = "my_baro"\npress_abs = { field = "p[2]", scale = 10 }\n'
    )
    mapping = read_mapping(path, "ulog")
    assert mapping.rules["ATTITUDE"] == ()
    assert [rule.topic for rule in mapping.rules["SCALED_PRESSURE"]] == ["my_baro"]
    assert mapping.rules["HIGHRES_IMU"] == builtin_mapping("ulog").rules["HIGHRES_IMU"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[[NO_MESSAGE]]\ntopic = 'a'", "'NO_MESSAGE' is no MAVLink message"),
        ("[ATTITUDE]\ntopic = 'a'", r"write \[\[ATTITUDE\]\]"),
        ("[[ATTITUDE]]\nroll = { field = 'a' }", "topic' is missing"),
        ("[[ATTITUDE]]\ntopic = 'a'\nrol = { field = 'a' }", "rol' is not a key of this table; did you mean 'roll'"),
        ("[[ATTITUDE]]\ntopic = 'a'\nroll = 'x'", 'roll\' is "x", which is not a table'),
        ("[[ATTITUDE]]\ntopic = 'a'\nroll = { feld = 'x' }", "feld' is not a key of this table; did you mean 'field'"),
        ("[[ATTITUDE]]\ntopic = 'a'\nroll = { field = '' }", "field' is ''; write it like"),
        (
            "[[ATTITUDE]]\ntopic = 'a'\nroll = { field = 'x', topic = 'b' }",
            "interpolation' is missing: the topic is another one",
        ),
        ("[[ATTITUDE]]\ntopic = 'a'\nroll = { field = 'x', angle = 'bank' }", 'angle\' is "bank"; it must be'),
        ("[[ATTITUDE]]\ntopic = 'a'\nroll = { field = 'x', values = 3 }", "values' is no table"),
        ("[[ATTITUDE]]\ntopic = 'a'\nroll = { value = 'x' }", 'value\' is "x", which is not a number'),
        ("[[ATTITUDE]]\ntopic = 'a'\nroll = { field = 'x', otherwise = { field = 'y' } }", "otherwise' goes with"),
        ("[[HEARTBEAT]]\ntopic = 'a'\ntype = { value = 300 }", "is 300, which is no value of this field"),
        ("[[HEARTBEAT]]\ntopic = 'a'\nrepeat_s = 0", "repeat_s' is 0; it must be more than 0"),
        ("[[STATUSTEXT]]\ntopic = 'a'\ntext = { field = 'x' }", "is text, which cannot be filled"),
        ("[[ACTUATOR_CONTROL_TARGET]]\ntopic = 'a'\ncontrols = { field = 'x' }", r"write \[\[controls\]\]"),
        (
            "[[ACTUATOR_CONTROL_TARGET]]\ntopic = 'a'\ncontrols = [" + "{ value = 1 }," * 9 + "]",
            "or a list of more than 8",
        ),
        (
            "[[ACTUATOR_CONTROL_TARGET]]\ntopic = 'a'\ncontrols = [{ feld = 'x' }]",
            r"controls\[0\].feld' is not a key of this table",
        ),
        ("[[HEARTBEAT]]\ntopic = 'a'\ntype = { field = 'x', before = 3 }", "before' is no pair of whole numbers"),
        (
            "[[HEARTBEAT]]\ntopic = 'a'\ntype = { field = 'x', unknown = nan }",
            "is nan, which is no value of this field",
        ),
        ("[[ATTITUDE]\n", "not valid TOML"),
        ("a = " + "[" * 4000, "nested too deeply"),
        ("a = " + "9" * 5000, "not valid TOML"),
        ('"a\\nb" = 1', "is no MAVLink message"),
        (f"[[ATTITUDE]]\ntopic = 'a'\nroll = {{ value = {10**400} }}", "which is not a finite number"),
        (f"[[ATTITUDE]]\ntopic = 'a'\nroll = {{ field = 'x', scale = {10**400} }}", "which is not a finite number"),
        ("[[ATTITUDE]]\ntopic = 'a'\nroll = { field = 'x', period = inf }", "period' is inf, which is not a finite"),
    ],
)
def test_a_table_that_makes_no_sense_is_refused_with_its_line(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(TelemetryError, match=said) as error:
        read_mapping(path, "dataflash")
    assert str(path) in str(error.value)


def test_a_mapping_that_is_not_there_is_reported(tmp_path: Path) -> None:
    with pytest.raises(TelemetryError, match="no such file"):
        read_mapping(tmp_path / "none.toml", "ulog")
    assert parse_mapping(TomlFile("x", {}, TelemetryError)).rules == {}
