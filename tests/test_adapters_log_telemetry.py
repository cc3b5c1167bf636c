"""Records of onboard logs become the MAVLink messages they stand for, in MAVLink's units and at the records' times."""

from __future__ import annotations

from collections.abc import Collection
from functools import partial
from math import cos, isnan, pi, radians, sin
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from onboard_flights import messages_of

from adapters.batch import Batch, pack
from adapters.errors import TelemetryError
from adapters.logs.log_mapping import LogMapping, builtin_mapping, parse_mapping
from adapters.logs.log_telemetry import telemetry
from adapters.message import Message
from adapters.source import DATAFLASH, MAVLINK, ULOG
from adapters.toml_tables import TomlFile

MS = 1_000_000
HALF = 0.5**0.5


def record(name: str, ms: float, **fields: Any) -> Message:
    return Message(ULOG, name, round(ms * MS), {"timestamp": round(ms * 1000), **fields})


def rates(ms: float, *xyz: float) -> Message:
    return record("vehicle_angular_velocity", ms, xyz=list(xyz) or [0.1, 0.2, 0.3])


def attitude(ms: float, *q: float) -> Message:
    return record("vehicle_attitude", ms, q=list(q) or [1.0, 0.0, 0.0, 0.0])


def run(records: list[Message], mapping: LogMapping, only: Collection[str] | None) -> list[Message]:
    """Return the records and what they make, however the log is cut into batches."""

    def anew(names: Collection[str]) -> list[Batch]:
        return [pack([one for one in records if one.name in names])]

    whole = messages_of(telemetry([pack(records)], mapping, only, anew))
    for size in (1, 3):
        cut = (pack(records[start : start + size]) for start in range(0, len(records), size))
        assert [repr(m) for m in messages_of(telemetry(cut, mapping, only, anew))] == [repr(m) for m in whole]
    return whole


def made(records: list[Message], *names: str) -> list[Message]:
    return [m for m in run(records, builtin_mapping("ulog"), names) if m.source == MAVLINK]


def test_a_message_has_the_time_and_the_type_of_what_makes_it() -> None:
    found = made([attitude(1000.0), rates(1000.0)], "ATTITUDE")
    assert [(m.name, m.received_ns, m.system, m.component) for m in found] == [("ATTITUDE", 1000 * MS, 1, 1)]
    fields = found[0].fields
    assert list(fields) == ["time_boot_ms", "roll", "pitch", "yaw", "rollspeed", "pitchspeed", "yawspeed"]
    assert fields["time_boot_ms"] == 1000
    assert fields["rollspeed"] == pytest.approx(0.1)
    assert fields["roll"] == 0.0


@pytest.mark.parametrize(
    ("q", "angles"),
    [
        ((HALF, HALF, 0.0, 0.0), (pi / 2, 0.0, 0.0)),
        ((cos(0.25), 0.0, sin(0.25), 0.0), (0.0, 0.5, 0.0)),
        ((HALF, 0.0, 0.0, -HALF), (0.0, 0.0, -pi / 2)),
    ],
)
def test_a_quaternion_turns_into_angles(q: tuple[float, ...], angles: tuple[float, ...]) -> None:
    fields = made([attitude(1.0, *q), rates(1.0)], "ATTITUDE")[0].fields
    assert [fields[name] for name in ("roll", "pitch", "yaw")] == pytest.approx(angles, abs=1e-6)


def test_what_is_joined_is_interpolated_the_shorter_way_round() -> None:
    east_of_south, west_of_south = ((cos(angle), 0.0, 0.0, sin(angle)) for angle in (pi / 2 - 0.1, pi / 2 + 0.1))
    records = [attitude(0.0, *east_of_south), rates(5.0), rates(15.0), attitude(20.0, *west_of_south), rates(19.0)]
    found = made(records, "ATTITUDE")
    assert [m.received_ns // MS for m in found] == [5, 15, 19]
    yaws = [m.fields["yaw"] % (2 * pi) for m in found]
    assert yaws == pytest.approx([pi - 0.2 + 0.4 * share for share in (0.25, 0.75, 0.95)], abs=1e-6)


def test_a_roll_that_is_joined_goes_through_upside_down() -> None:
    records = [
        Message(DATAFLASH, name, at * MS, {"TimeUS": at * 1000, **fields})
        for name, at, fields in (
            ("ATT", 0, {"Roll": 170.0, "Pitch": 0.0, "Yaw": 0.0}),
            ("RATE", 50, {"R": 400.0, "P": 0.0, "Y": 0.0}),
            ("ATT", 100, {"Roll": -150.0, "Pitch": 0.0, "Yaw": 0.0}),
            ("RATE", 100, {"R": 400.0, "P": 0.0, "Y": 0.0}),
        )
    ]
    found = run(records, builtin_mapping("dataflash"), ("ATTITUDE",))
    assert found[0].fields["roll"] == pytest.approx(pi + radians(10.0), abs=1e-6)


def test_a_message_does_not_wait_forever_for_what_is_joined() -> None:
    records = [attitude(0.0), rates(0.0), *(rates(10.0 * step) for step in range(1, 300))]
    found = made(records, "ATTITUDE")
    assert [m.received_ns // MS for m in found] == [10 * step for step in range(300)]
    assert isnan(found[1].fields["roll"])
    assert found[-1].fields["rollspeed"] == pytest.approx(0.1)


def test_nothing_is_interpolated_across_a_gap() -> None:
    records = [attitude(0.0), rates(0.0), rates(2000.0), attitude(3000.0), rates(3000.0), attitude(3010.0)]
    assert [m.received_ns // MS for m in made(records, "ATTITUDE")][-1] == 3000
    assert not any(m.received_ns == 2000 * MS and m.fields["roll"] == 0.0 for m in made(records, "ATTITUDE"))


IMU = {"gyro_rad": [0.0] * 3, "accelerometer_m_s2": [0.0, 0.0, -9.81]}


def field(ms: float, x: float) -> Message:
    return record("vehicle_magnetometer", ms, magnetometer_ga=[x, 0.0, 0.4])


def test_slow_sensors_are_interpolated_but_for_a_field_that_turns_and_unknown_before() -> None:
    imu = [record("sensor_combined", 4.0 * n, **IMU) for n in range(126)]
    air = [record("vehicle_air_data", ms, baro_pressure_pa=95_000.0 + ms, baro_alt_meter=540.0) for ms in (2.0, 202.0)]
    records = sorted([*imu, *air, field(3.0, 0.1), field(503.0, -0.1)], key=lambda one: one.received_ns)
    found = made(records, "HIGHRES_IMU")
    assert [m.received_ns for m in found] == [m.received_ns for m in imu]
    assert isnan(found[0].fields["pressure_alt"])
    assert isnan(found[0].fields["xmag"])
    assert [found[k].fields["abs_pressure"] for k in (1, 26, 51)] == pytest.approx([950.04, 951.04, 952.02])
    assert [found[k].fields["xmag"] for k in (1, 63, 125)] == pytest.approx([0.1, 0.1, 0.1])
    assert found[1].fields["time_usec"] == 4000


def test_a_slow_sensor_that_stops_keeps_its_last_value_and_holds_nothing_up() -> None:
    imu = [record("sensor_combined", 4.0 * n, **IMU) for n in range(600)]
    records = sorted([*imu, field(1.0, 0.1), field(501.0, -0.1)], key=lambda one: one.received_ns)
    found = made(records, "HIGHRES_IMU")
    assert [m.received_ns for m in found] == [m.received_ns for m in imu]
    assert {m.fields["xmag"] for m in found[126:]} == {found[-1].fields["xmag"]}
    assert found[-1].fields["xmag"] == pytest.approx(-0.1)
    assert all(isnan(m.fields["abs_pressure"]) for m in found)


def test_what_is_made_comes_behind_the_record_that_makes_it() -> None:
    records = [attitude(0.0), rates(5.0), record("cpuload", 6.0, load=0.1), attitude(20.0), rates(20.0)]
    names = [m.name for m in run(records, builtin_mapping("ulog"), None)]
    assert names == [
        "vehicle_attitude",
        "vehicle_angular_velocity",
        "ATTITUDE",
        "cpuload",
        "vehicle_attitude",
        "vehicle_angular_velocity",
        "ATTITUDE",
    ]


def test_numbers_are_as_the_message_carries_them() -> None:
    fix = {"fix_type": 3, "latitude_deg": 47.12345678, "longitude_deg": -8.5, "altitude_msl_m": 500.1234}
    gps = record("vehicle_gps_position", 1.0, **fix, vel_m_s=3.456, cog_rad=-pi / 2, hdop=float("nan"), vdop=1e9)
    fields = made([gps], "GPS_RAW_INT")[0].fields
    assert (fields["lat"], fields["lon"], fields["alt"]) == (471234568, -85_000_000, 500123)
    assert (fields["vel"], fields["cog"], fields["eph"], fields["epv"]) == (346, 27_000, 65_535, 65_535)
    assert all(type(value) is int for name, value in fields.items())


def test_a_state_is_told_again_every_second() -> None:
    records = [record("vehicle_status", 0.0, arming_state=2, nav_state=4, system_type=2)]
    records += [record("cpuload", 100.0 * step) for step in range(1, 35)]
    found = made(records, "HEARTBEAT")
    assert [m.received_ns // MS for m in found] == [0, 1000, 2000, 3000]
    assert all(m.fields["base_mode"] & 128 and m.fields["type"] == 2 for m in found)


def test_a_value_that_stands_for_nothing_makes_no_message() -> None:
    mapping = builtin_mapping("dataflash")
    events = [
        Message(DATAFLASH, "EV", 50 * n * MS, {"TimeUS": n, "Id": event}) for n, event in enumerate((15, 10, 28, 11))
    ]
    found = run(events, mapping, ("HEARTBEAT", "EXTENDED_SYS_STATE"))
    states = [(m.name, m.fields.get("base_mode", m.fields.get("landed_state"))) for m in found]
    assert states == [("HEARTBEAT", 1), ("HEARTBEAT", 129), ("EXTENDED_SYS_STATE", 2), ("HEARTBEAT", 1)]


def test_an_imu_of_old_ardupilot_whose_temperature_has_another_name_is_one() -> None:
    axes = {f"{kind}{axis}": 1.0 for kind in ("Gyr", "Acc") for axis in "XYZ"}
    imu = [Message(DATAFLASH, "IMU", 20 * n * MS, {"TimeUS": 20_000 * n, **axes, "Temp": 25.0}) for n in range(3)]
    found = run(imu, builtin_mapping("dataflash"), ("HIGHRES_IMU", "RAW_IMU", "SCALED_IMU"))
    assert {(m.name, m.fields["zacc"]) for m in found} >= {("HIGHRES_IMU", 1.0)}
    assert len(found) == 9


def test_an_ardupilot_that_may_have_landed_is_landing_at_its_height_above_home() -> None:
    events = [Message(DATAFLASH, "EV", 50 * n * MS, {"TimeUS": n, "Id": event}) for n, event in enumerate((28, 17, 18))]
    height = Message(
        DATAFLASH, "POS", 75 * MS, {"TimeUS": 75_000, "Lat": 0, "Lng": 0, "Alt": 584.0, "RelHomeAlt": 0.05}
    )
    found = run([*events[:2], height, events[2]], builtin_mapping("dataflash"), ("EXTENDED_SYS_STATE",))
    assert [m.fields["landed_state"] for m in found] == [2, 4, 1]
    old = Message(DATAFLASH, "CTUN", 75 * MS, {"TimeUS": 75_000, "BarAlt": 0.05})
    for said in (height, old):
        found = run([said], builtin_mapping("dataflash"), ("GLOBAL_POSITION_INT",))
        assert [m.fields["relative_alt"] for m in found] == [50.0]


def test_from_the_first_contact_with_the_ground_px4_is_landing() -> None:
    states = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (1, 1, 1), (0, 0, 0)]
    names = ("ground_contact", "maybe_landed", "landed")
    records = [
        record("vehicle_land_detected", 100.0 * n, **dict(zip(names, state, strict=True)))
        for n, state in enumerate(states)
    ]
    assert [m.fields["landed_state"] for m in made(records, "EXTENDED_SYS_STATE")] == [2, 4, 4, 1, 2]
    old = [record("vehicle_land_detected", 100.0 * n, landed=landed) for n, landed in enumerate((0, 1))]
    assert [m.fields["landed_state"] for m in made(old, "EXTENDED_SYS_STATE")] == [2, 1]


def test_a_topic_that_comes_late_fills_its_messages_from_then_on() -> None:
    records = [rates(1000.0 * step) for step in range(8)]
    late = [one for step in range(8, 12) for one in (attitude(1000.0 * step), rates(1000.0 * step))]
    assert [m.received_ns // (1000 * MS) for m in made(records + late, "ATTITUDE")] == [8, 9, 10, 11]


def test_records_pass_where_they_are_wanted_and_always_without_a_choice() -> None:
    records = [attitude(1.0), rates(1.0), record("cpuload", 2.0, load=0.5)]
    mapping = builtin_mapping("ulog")
    assert [m.name for m in run(records, mapping, None)] == [
        "vehicle_attitude",
        "vehicle_angular_velocity",
        "ATTITUDE",
        "cpuload",
    ]
    assert [m.name for m in run(records, mapping, ("cpuload",))] == ["cpuload"]


def test_a_damaged_time_harms_no_other_message() -> None:
    good = [one for step in range(20) for one in (attitude(10.0 * step), rates(10.0 * step))]
    wild = [*good[:21], attitude(1e9), rates(1e9), *good[21:]]
    found = [m.received_ns for m in made(wild, "ATTITUDE") if m.received_ns < 1e15]
    expected = [m.received_ns for m in made(good, "ATTITUDE")]
    assert len(set(expected) - set(found)) <= 1


def test_a_table_of_ones_own_is_followed() -> None:
    table = {"SCALED_PRESSURE": [{"topic": "tank", "press_abs": {"field": "p.raw[1]", "scale": 2.0, "offset": 1.0}}]}
    found = run(
        [record("tank", 1.0, p={"raw": [1, 3]})],
        parse_mapping(TomlFile("x", table, TelemetryError)),
        ("SCALED_PRESSURE",),
    )
    assert found[0].fields["press_abs"] == 7.0


def test_what_overflows_between_two_records_is_left_unknown() -> None:
    table = {"topic": "a", "cog": {"topic": "b", "field": "v", "interpolation": "linear", "unknown": 7}}
    mapping = parse_mapping(TomlFile("x", {"GPS_RAW_INT": [table]}, TelemetryError))
    records = [record("b", 0, v=-1e300), record("a", 400), record("b", 900, v=1e300)]
    [found] = run(records, mapping, {"GPS_RAW_INT"})
    assert found.fields["cog"] == 7


def dataflash(name: str, ms: float, **fields: Any) -> Message:
    return Message(DATAFLASH, name, round(ms * MS), {"TimeUS": round(ms * 1000), **fields})


def armed(records: list[Message]) -> list[tuple[int, bool]]:
    found = run(records, builtin_mapping("dataflash"), ("HEARTBEAT",))
    return [(m.received_ns // MS, bool(m.fields["base_mode"] & 128)) for m in found]


MOTORS = [dataflash("RCOU", 100.0 * step, C1=1500, C2=1500, C3=1500, C4=1500) for step in range(1, 82)]


def test_a_log_that_begins_at_arming_is_of_an_armed_vehicle_until_it_says_otherwise() -> None:
    assert armed(MOTORS) == [(100 + 1000 * n, True) for n in range(9)]
    end = dataflash("EV", 8150, Id=11)
    assert armed([*MOTORS, end]) == [*((100 + 1000 * n, True) for n in range(9)), (8150, False)]


@pytest.mark.parametrize(("name", "value"), [("LOG_DISARMED", 1.0), ("LOG_BITMASK", 131070.0)])
def test_a_log_that_begins_before_arming_is_of_a_disarmed_vehicle(name: str, value: float) -> None:
    records = [dataflash("PARM", 100, Name=name, Value=value), *MOTORS]
    assert armed(records) == [(100 + 1000 * n, False) for n in range(9)]


def test_before_it_is_armed_for_the_first_time_a_vehicle_is_disarmed() -> None:
    late = [*MOTORS[:61], dataflash("EV", 6150, Id=10), *MOTORS[61:]]
    assert armed(late) == [*((100 + 1000 * n, False) for n in range(7)), (6150, True), (7200, True)]


def test_a_stopped_motor_is_what_px4_sends_of_one() -> None:
    commands = record("actuator_motors", 1.0, control=[0.5, float("nan"), 0.25, 0.0, *[float("nan")] * 8])
    fields = made([commands], "SERVO_OUTPUT_RAW")[0].fields
    assert [fields[f"servo{n}_raw"] for n in range(1, 6)] == [1500, 900, 1250, 1000, 900]


def test_what_the_controllers_ask_for_is_a_message() -> None:
    torque = [record("vehicle_torque_setpoint", ms, xyz=[0.1, -0.2, 0.3]) for ms in (1.0, 21.0)]
    thrust = [record("vehicle_thrust_setpoint", ms, xyz=[0.25, 0.0, -0.5]) for ms in (1.0, 21.0)]
    [found, _] = made([torque[0], thrust[0], torque[1], thrust[1]], "ACTUATOR_CONTROL_TARGET")
    assert found.fields["time_usec"] == 1000
    assert found.fields["controls"][:5] == pytest.approx([0.1, -0.2, 0.3, 0.5, 0.25])
    assert all(isnan(value) for value in found.fields["controls"][5:])
    old = record("actuator_controls_0", 1.0, control=[0.1, -0.2, 0.3, 0.5, 0.0, 0.0, 0.0, 0.0])
    [found] = made([old], "ACTUATOR_CONTROL_TARGET")
    assert found.fields["controls"][:5] == pytest.approx([0.1, -0.2, 0.3, 0.5, 0.5])
    rate = [
        dataflash("MOTB", 0.5, LiftMax=0.9, ThrOut=0.31),
        dataflash("RATE", 1, ROut=0.1, POut=0.2, YOut=0.3, AOut=0.3),
    ]
    [found] = [m for m in run(rate, builtin_mapping("dataflash"), ("ACTUATOR_CONTROL_TARGET",)) if m.source == MAVLINK]
    assert found.fields["controls"][:6] == pytest.approx([0.1, 0.2, 0.3, 0.3, 0.31, 0.9])


def test_a_message_has_the_logs_own_resolution_of_time() -> None:
    assert made([attitude(1000.003), rates(1000.003)], "ATTITUDE")[0].fields["time_boot_ms"] == 1000.003
    unix_ms = 1_710_773_350_354.004
    [fields] = [m.fields for m in made([attitude(unix_ms), rates(unix_ms)], "ATTITUDE")]
    assert fields["time_boot_ms"] == pytest.approx(unix_ms, abs=1e-3)


@pytest.mark.parametrize("stamp_us", [0, 1_500_000_000_000_000])
def test_a_message_of_a_topic_with_another_clock_has_the_logs_time(stamp_us: int) -> None:
    fix = {"fix_type": 3, "latitude_deg": 47.0, "longitude_deg": 8.0, "altitude_msl_m": 500.0, "vel_m_s": 0.0}
    fix |= {"cog_rad": 0.0, "hdop": 1.0, "vdop": 1.0, "timestamp": stamp_us}
    records = [rates(1000.0 + step) for step in range(10)]
    records += [Message(ULOG, "vehicle_gps_position", 1009 * MS, fix)]
    assert made(records, "GPS_RAW_INT")[0].fields["time_usec"] == 1_009_000
    old = [*MOTORS[:5], Message(DATAFLASH, "BARO", 500 * MS, {"TimeMS": 499, "Press": 1e5, "Alt": 1.0})]
    [found] = [m for m in run(old, builtin_mapping("dataflash"), ("SCALED_PRESSURE",)) if m.source == MAVLINK]
    assert found.fields["time_boot_ms"] == 500.0


STEPS = st.integers(-40, 400)


@given(
    drawn=st.lists(
        st.tuples(st.sampled_from(["rates", "attitude", "imu", "field"]), st.integers(-40, 400), st.booleans()),
        max_size=40,
    ),
    sizes=st.lists(st.integers(1, 9), min_size=1, max_size=5),
)
def test_however_disordered_a_log_is_its_messages_do_not_depend_on_cuts(
    drawn: list[tuple[str, int, bool]], sizes: list[int]
) -> None:
    now, records = 10_000.0, []
    for name, step, wild in drawn:
        now += step
        ms = now + 1e7 * wild
        one = {"rates": rates, "attitude": attitude, "field": partial(field, x=0.1)}.get(name)
        records.append(record("sensor_combined", ms, **IMU) if one is None else one(ms))
    names, mapping = ("ATTITUDE", "HIGHRES_IMU"), builtin_mapping("ulog")
    cut, start = [], 0
    while start < len(records):
        cut.append(pack(records[start : start + sizes[start % len(sizes)]]))
        start += sizes[start % len(sizes)]
    whole, parts = (
        [repr(m) for m in messages_of(telemetry(b, mapping, names, no_more))] for b in ([pack(records)], cut)
    )
    assert parts == whole


def no_more(_: Collection[str]) -> list[Batch]:
    return []


def outputs(ms: float, instance: int, *values: float) -> Message:
    name = "actuator_outputs" + (f"/{instance}" if instance else "")
    return record(name, ms, output=[*values, *[0.0] * (16 - len(values))])


@pytest.mark.parametrize("begin_ms", [0.0, 8000.0])
def test_of_a_topics_instances_the_one_that_moves_fills_the_message(begin_ms: float) -> None:
    records = [rates(0.0)] * (begin_ms > 0.0)
    for k in range(20):
        # moves only after the seconds that are looked at first
        pulse = 1500.0 + 10.0 * max(0, k - 15)
        ms = begin_ms + 500.0 * k
        records += [outputs(ms, 0), outputs(ms + 1, 1, pulse, pulse), outputs(ms + 2, 2, 900.0 + k)]
    made_of = [m.fields["servo1_raw"] for m in made(records, "SERVO_OUTPUT_RAW")]
    assert made_of == [1500 + 10 * max(0, k - 15) for k in range(20)]


def test_where_no_instance_moves_more_than_another_the_first_fills_the_message() -> None:
    records = [outputs(ms, instance, 1000.0 + ms + instance) for ms in (0.0, 100.0) for instance in (0, 1)]
    assert [m.fields["servo1_raw"] for m in made(records, "SERVO_OUTPUT_RAW")] == [1000, 1100]


def test_what_speed_controllers_say_is_a_message_in_the_order_of_the_log() -> None:
    escs = [{"esc_rpm": 1000 + k, "esc_voltage": 16.5 - k, "esc_current": 0.5 * k} for k in range(8)]
    [found] = made([record("esc_status", 1000.0, esc_count=4, esc=escs)], "ESC_STATUS")
    assert found.fields == {
        "index": 0,
        "time_usec": 1_000_000,
        "rpm": [1000, 1001, 1002, 1003],
        "voltage": [16.5, 15.5, 14.5, 13.5],
        "current": [0.0, 0.5, 1.0, 1.5],
    }


def test_speed_controllers_that_are_logged_one_by_one_are_a_message_together() -> None:
    records = [
        dataflash(
            "ESC" if k == 0 else f"ESC/{k}", 1000.0 + 100.0 * step + k, RPM=5000.0 + 100.0 * k, Volt=16.0, Curr=2.5
        )
        for step in range(3)
        for k in range(4)
    ]
    found = [m for m in run(records, builtin_mapping("dataflash"), ["ESC_TELEMETRY_1_TO_4"]) if m.source == MAVLINK]
    assert [m.fields["rpm"] for m in found][1:] == [[5000, 5100, 5200, 5300]] * 2
    assert (found[1].fields["voltage"], found[1].fields["current"]) == ([1600] * 4, [250] * 4)


def test_the_mixers_battery_record_is_beside_what_the_controllers_ask_for() -> None:
    mixer = dataflash("MOTB", 1000.0, LiftMax=0.9, BatVolt=0.95, ThLimit=1.0, ThrAvMx=0.8, ThrOut=0.4)
    asked = dataflash("RATE", 1001.0, ROut=0.1, POut=0.2, YOut=0.0, AOut=0.5)
    found = run([mixer, asked], builtin_mapping("dataflash"), ["ACTUATOR_CONTROL_TARGET"])
    [controls] = [m.fields["controls"] for m in found if m.source == MAVLINK]
    assert controls == pytest.approx([0.1, 0.2, 0.0, 0.5, 0.4, 0.9, 0.95, 1.0])


@pytest.mark.parametrize("name", ["SYS_STATUS", "BATTERY_STATUS"])
def test_a_battery_is_a_message_of_either_kind(name: str) -> None:
    px4 = record("battery_status", 1000.0, voltage_v=15.5, current_a=12.25, discharged_mah=800.0, remaining=0.5)
    ardupilot = dataflash("BAT", 1000.0, Volt=15.5, Curr=12.25, CurrTot=800.0, RemPct=50)
    for one, source in ((px4, "ulog"), (ardupilot, "dataflash")):
        [found] = [m for m in run([one], builtin_mapping(source), [name]) if m.source == MAVLINK]
        volts = found.fields["voltage_battery"] if name == "SYS_STATUS" else found.fields["voltages"][0]
        assert (volts, found.fields["current_battery"], found.fields["battery_remaining"]) == (15_500, 1225, 50)


def test_vibration_is_a_message_with_what_was_clipped() -> None:
    metrics = {"accel_vibration_metric": 2.5, "gyro_vibration_metric": 0.25, "accel_clipping": [1, 2, 3]}
    [px4] = made([record("vehicle_imu_status", 1000.0, **metrics)], "VIBRATION")
    assert (px4.fields["vibration_x"], px4.fields["vibration_z"], px4.fields["clipping_2"]) == (0.0, 2.5, 3)
    vibe = dataflash("VIBE", 1000.0, VibeX=1.5, VibeY=2.0, VibeZ=2.5, Clip=4)
    [ours] = [m for m in run([vibe], builtin_mapping("dataflash"), ["VIBRATION"]) if m.source == MAVLINK]
    assert (ours.fields["vibration_x"], ours.fields["vibration_z"], ours.fields["clipping_0"]) == (1.5, 2.5, 4)


@pytest.mark.parametrize(("count", "indices"), [(4, [0, 0]), (6, [0, 4, 0, 4])])
def test_speed_controllers_beyond_the_fourth_make_a_message_of_their_own(count: int, indices: list[int]) -> None:
    escs = [{"esc_rpm": 1000 + k, "esc_voltage": 16.0, "esc_current": 1.0 + k} for k in range(8)]
    found = made([record("esc_status", ms, esc_count=count, esc=escs) for ms in (1000.0, 1100.0)], "ESC_STATUS")
    assert [one.fields["index"] for one in found] == indices
    assert [one.fields["rpm"][1] for one in found] == [1001 + index for index in indices]
