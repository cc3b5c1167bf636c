"""Injected faults do to a recording what was asked for, where and when it was asked for, and say exactly what."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from itertools import pairwise
from math import cos, pi, radians, sin
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import fauio
from adapters.errors import UsageError
from adapters.logs.mcap_log import MessageLogWriter
from adapters.logs.mcap_reader import read_mcap_metadata
from adapters.logs.recordings import read_recording
from adapters.message import Message
from adapters.source import MAVLINK, ZENOH
from gains.plants.plant import Fault, Nonlinearity, Plant
from monitor.profile import Profile
from replay.attacks.attack import ATTACK_KINDS, Attack
from replay.attacks.injector import Injector, inject, plan
from replay.attacks.instruments import INSTRUMENTS, AttackScene, metres_per_degree, pressure_altitude
from replay.attacks.plant_response import PlantResponse, States, find_fault
from replay.player import play

LOG = Path(__file__).parent / "data" / "copter_5s.tlog.xz"
START_NS, END_NS = 57_000_000_000, 59_000_000_000


@cache
def flight() -> list[Message]:
    return list(read_recording(LOG))


@cache
def names() -> frozenset[str]:
    return frozenset(message.name for message in flight() if message.system == 1)


def attack(channel: str, kind: str, **options: Any) -> Attack:
    times = {"start_ns": START_NS, "end_ns": END_NS}
    return Attack(channel=channel, kind=kind, **(times | options))  # type: ignore[arg-type]


def injected(wanted: Attack, messages: list[Message] | None = None) -> tuple[list[Message], dict[str, Any]]:
    injector = Injector(wanted, plan(wanted, names()), 1, {})
    return list(inject(messages or flight(), injector)), injector.truth()


def series(messages: list[Message], name: str, field: str, clock: str = "time_usec") -> list[tuple[float, float]]:
    """Return time (s) and value of a vehicle's field."""
    per_second = 1e6 if clock == "time_usec" else 1e3
    return [
        (message.fields[clock] / per_second, message.fields[field])
        for message in messages
        if message.name == name and message.system == 1
    ]


def changes(messages: list[Message], name: str, field: str, clock: str = "time_usec") -> list[tuple[float, float]]:
    """Return time and change against the recording, message by message."""
    pairs = zip(series(flight(), name, field, clock), series(messages, name, field, clock), strict=True)
    return [(t, after - before) for (t, before), (_, after) in pairs]


def assert_only_inside(moved: list[tuple[float, float]], value: float, abs_: float) -> None:
    assert any(57.0 <= t < 59.0 for t, _ in moved)
    for t, change in moved:
        assert change == pytest.approx(value if 57.0 <= t < 59.0 else 0.0, abs=abs_)


def test_ten_metres_north_are_ten_metres_of_latitude_and_nothing_else() -> None:
    found, truth = injected(attack("gps_north", "bias", size=10.0))
    latitude = next(m.fields["lat"] for m in flight() if m.name == "GPS_RAW_INT") * 1e-7
    metres = metres_per_degree(latitude)[0]
    assert metres == pytest.approx(110_940, abs=50)
    moved = [(t, change * 1e-7 * metres) for t, change in changes(found, "GPS_RAW_INT", "lat")]
    assert_only_inside(moved, 10.0, 0.012)
    assert not any(change for _, change in changes(found, "GPS_RAW_INT", "lon"))
    assert all(isinstance(m.fields["lat"], int) for m in found if m.name == "GPS_RAW_INT")
    assert truth["messages"] == sum(57.0 <= t < 59.0 for t, _ in moved)


def test_east_and_down_move_longitude_and_both_altitudes() -> None:
    found, _ = injected(attack("gps_east", "bias", size=-30.0))
    latitude = next(m.fields["lat"] for m in flight() if m.name == "GPS_RAW_INT") * 1e-7
    metres = metres_per_degree(latitude)[1]
    assert metres == pytest.approx(111_320 * cos(radians(latitude)), rel=0.005)
    assert_only_inside([(t, c * 1e-7 * metres) for t, c in changes(found, "GPS_RAW_INT", "lon")], -30.0, 0.012)
    found, _ = injected(attack("gps_down", "bias", size=4.0))
    for field in ("alt", "alt_ellipsoid"):
        assert_only_inside(changes(found, "GPS_RAW_INT", field), -4000, 0)


@pytest.mark.parametrize("kind", ["noise", "delay", "replay", "ramp", "freeze"])
def test_a_repeated_fix_stays_a_repeated_fix(kind: str) -> None:
    options = {
        "noise": {"size": 3.0},
        "delay": {"size": 0.7},
        "replay": {"source_ns": START_NS - 10**9},
        "ramp": {"rate": 1.0},
        "freeze": {},
    }
    found, _ = injected(attack("gps_north", kind, **options[kind]))
    values: dict[float, set[float]] = {}
    for t, value in series(found, "GPS_RAW_INT", "lat"):
        values.setdefault(t, set()).add(value)
    assert all(len(same) == 1 for same in values.values())


def test_the_velocity_of_a_spoof_is_the_derivative_of_its_position() -> None:
    position, velocity = attack("gps_north", "spoof", rate=-2.0, acceleration=1.5).spoof()
    times = START_NS + np.arange(0, 4_000_000_000, 1_000_000)
    p, v = (np.array([signal(int(t)) for t in times]) for signal in (position, velocity))
    np.testing.assert_allclose(np.gradient(p, 1e-3)[1:-1], v[1:-1], atol=1e-5)
    assert p[0] == v[0] == 0.0
    assert v[-1] == pytest.approx(-2.0)
    assert np.abs(np.gradient(v, 1e-3)).max() == pytest.approx(1.5, rel=1e-3)


def test_a_spoofed_receiver_reports_velocity_and_position_that_agree() -> None:
    wanted = attack("gps_east", "spoof", rate=3.0, acceleration=3.0)
    found, truth = injected(wanted)
    position, velocity = wanted.spoof()

    def east(messages: list[Message]) -> list[tuple[int, float, float]]:
        fixes = [m.fields for m in messages if m.name == "GPS_RAW_INT"]
        metres = metres_per_degree(fixes[0]["lat"] * 1e-7)[1]
        return [
            (f["time_usec"] * 1000, f["lon"] * 1e-7 * metres, f["vel"] / 100 * sin(radians(f["cog"] / 100)))
            for f in fixes
        ]

    for (t, p0, v0), (_, p1, v1) in zip(east(flight()), east(found), strict=True):
        inside = START_NS <= t < END_NS
        assert p1 - p0 == pytest.approx(position(t) if inside else 0.0, abs=0.012)
        assert v1 - v0 == pytest.approx(velocity(t) if inside else 0.0, abs=0.012)
    assert truth["unit"] == "m/s"


def test_a_frozen_value_stays_while_its_clock_goes_on() -> None:
    found, _ = injected(attack("gyro_x", "freeze"))
    for name, field, clock in (("ATTITUDE", "rollspeed", "time_boot_ms"), ("HIGHRES_IMU", "xgyro", "time_usec")):
        inside = [(t, value) for t, value in series(found, name, field, clock) if 57.0 <= t < 59.0]
        before = [value for t, value in series(found, name, field, clock) if t < 57.0]
        assert {value for _, value in inside} == {before[-1]}
        assert all(a < b for (a, _), (b, _) in pairwise(inside))
    moving = [value for t, value in series(found, "ATTITUDE", "pitchspeed", "time_boot_ms") if 57.0 <= t < 59.0]
    assert len(set(moving)) > 100


def test_a_replayed_segment_repeats_what_was_recorded() -> None:
    found, _ = injected(attack("accel_z", "replay", source_ns=START_NS - 1_000_000_000))
    recorded = {value: t for t, value in series(flight(), "HIGHRES_IMU", "zacc") if 56.0 <= t < 57.0}
    inside = [(t, value) for t, value in series(found, "HIGHRES_IMU", "zacc") if 57.0 <= t < 59.0]
    assert len(inside) == 200
    for t, value in inside:
        assert recorded[value] == pytest.approx(56.0 + (t - 57.0) % 1.0, abs=0.0101)


def test_a_delayed_value_is_the_one_of_before() -> None:
    found, _ = injected(attack("airspeed", "delay", size=0.5))
    before = {m.fields["airspeed"] for m in flight() if m.name == "VFR_HUD"}
    assert {m.fields["airspeed"] for m in found if m.name == "VFR_HUD"} <= before
    late, _ = injected(attack("gyro_z", "delay", size=0.5))
    recorded = [value for t, value in series(flight(), "HIGHRES_IMU", "zgyro") if 56.5 <= t < 58.5]
    assert [value for t, value in series(late, "HIGHRES_IMU", "zgyro") if 57.0 <= t < 59.0] == recorded


def test_dropped_messages_are_gone_and_all_others_are_there() -> None:
    found, truth = injected(attack("gps_north", "drop"))
    kept = [m for m in flight() if not (m.name == "GPS_RAW_INT" and 57e6 <= m.fields["time_usec"] < 59e6)]
    assert found == kept
    assert truth["messages"] == len(flight()) - len(found)
    some, _ = injected(attack("gyro_x", "drop", size=0.5))
    lost = 1 - (len(some) - (len(flight()) - 400)) / 400
    assert 0.35 < lost < 0.65
    assert injected(attack("gyro_x", "drop", size=0.5))[0] == some
    assert injected(attack("gyro_x", "drop", size=0.5, seed=1))[0] != some


def test_noise_has_its_size_comes_from_its_seed_and_is_the_same_in_all_messages() -> None:
    found, _ = injected(attack("gyro_y", "noise", size=0.1))
    imu = [c for t, c in changes(found, "HIGHRES_IMU", "ygyro") if 57.0 <= t < 59.0]
    attitude = [c for t, c in changes(found, "ATTITUDE", "pitchspeed", "time_boot_ms") if 57.0 <= t < 59.0]
    assert np.std(imu) == pytest.approx(0.1, rel=0.15)
    np.testing.assert_allclose(imu, attitude, atol=1e-12)
    assert injected(attack("gyro_y", "noise", size=0.1))[0] == found
    assert injected(attack("gyro_y", "noise", size=0.1, seed=5))[0] != found


def test_a_barometer_shows_its_bias_in_pressure_and_altitude_alike() -> None:
    found, _ = injected(attack("baro", "bias", size=8.0))
    for name, field, clock in (
        ("SCALED_PRESSURE", "press_abs", "time_boot_ms"),
        ("HIGHRES_IMU", "abs_pressure", "time_usec"),
    ):
        before, after = (series(messages, name, field, clock) for messages in (flight(), found))
        moved = [(t, pressure_altitude(b) - pressure_altitude(a)) for (t, a), (_, b) in zip(before, after, strict=True)]
        assert_only_inside(moved, 8.0, 1e-6)
    assert_only_inside(changes(found, "HIGHRES_IMU", "pressure_alt"), 8.0, 1e-9)
    heights = [
        b.fields["alt"] - a.fields["alt"]
        for a, b in zip(flight(), found, strict=True)
        if a.name == "VFR_HUD" and a != b
    ]
    assert len(heights) == 50
    assert heights == pytest.approx([8.0] * 50)


def test_a_turned_compass_keeps_its_field_and_turns_its_heading() -> None:
    found, _ = injected(attack("compass", "bias", size=0.5))
    pairs = [(a.fields, b.fields) for a, b in zip(flight(), found, strict=True) if a.name == "HIGHRES_IMU" and a != b]
    assert len(pairs) == 200
    for a, b in pairs:
        before, after = (np.array([f["xmag"], f["ymag"], f["zmag"]]) for f in (a, b))
        assert np.linalg.norm(after) == pytest.approx(np.linalg.norm(before))
        # close to level, the heading is that of the field's horizontal part
        turn = np.arctan2(-after[1], after[0]) - np.arctan2(-before[1], before[0])
        assert (turn + pi) % (2 * pi) - pi == pytest.approx(0.5, abs=0.2)


def test_a_field_that_messages_repeat_between_measurements_is_repeated_in_a_turned_compass() -> None:
    field = {"xmag": 200, "ymag": 20, "zmag": 400}
    (compass,) = (quantity for quantity in INSTRUMENTS["compass"] if quantity.message == "RAW_IMU")
    scene, found = AttackScene(), []
    for scene.roll, fields in ((0.0, field), (0.1, field), (0.1, field | {"xmag": 210})):
        value = compass.read(fields, scene)
        assert value is not None
        found.append(compass.write(fields, value + 0.5, scene))
    assert found[0] == found[1] != found[2]


def test_a_scale_factor_of_a_position_counts_from_home_and_of_a_rate_from_zero() -> None:
    found, _ = injected(attack("gps_down", "scale", size=2.0))
    home = series(flight(), "GPS_RAW_INT", "alt")[0][1]
    before, after = series(flight(), "GPS_RAW_INT", "alt"), series(found, "GPS_RAW_INT", "alt")
    for (t, a), (_, b) in zip(before, after, strict=True):
        assert b - home == pytest.approx((2 if 57.0 <= t < 59.0 else 1) * (a - home), abs=1)
    found, _ = injected(attack("gyro_x", "scale", size=0.5))
    inside = [(t, b) for t, b in series(found, "HIGHRES_IMU", "xgyro") if 57.0 <= t < 59.0]
    recorded = dict(series(flight(), "HIGHRES_IMU", "xgyro"))
    assert all(b == 0.5 * recorded[t] for t, b in inside)


def test_a_ramp_grows_with_the_vehicles_clock_up_to_its_size() -> None:
    found, _ = injected(attack("gyro_z", "ramp", rate=0.2, size=0.3))
    for t, change in changes(found, "HIGHRES_IMU", "zgyro"):
        expected = min(0.2 * (t - 57.0), 0.3) if 57.0 <= t < 59.0 else 0.0
        assert change == pytest.approx(expected, abs=1e-9)


def test_any_field_can_be_attacked_and_whole_numbers_stay_whole() -> None:
    found, _ = injected(attack("SERVO_OUTPUT_RAW.servo2_raw", "bias", size=-50.4))
    assert_only_inside(changes(found, "SERVO_OUTPUT_RAW", "servo2_raw"), -50, 0)


def test_nested_fields_of_any_source_and_a_clock_of_its_own_are_found() -> None:
    recorded = [
        Message(ZENOH, "arm/v1.2/joint", 10**18 + k * 10**7, {"time_ns": k * 10**7, "q": {"angle": [0.0, float(k)]}})
        for k in range(100)
    ]
    wanted = Attack("arm/v1.2/joint.q.angle[1]", "bias", 500_000_000, 600_000_000, size=0.25)
    injector = Injector(wanted, plan(wanted, {"arm/v1.2/joint", "arm/v1"}), 0, {})
    found = list(inject(recorded, injector))
    moved = [b.fields["q"]["angle"][1] - a.fields["q"]["angle"][1] for a, b in zip(recorded, found, strict=True)]
    assert moved == [0.25 if 50 <= k < 60 else 0.0 for k in range(100)]
    assert recorded[50].fields["q"]["angle"] == [0.0, 50.0]


def test_other_vehicles_are_left_alone() -> None:
    crowd = [copy for message in flight() for copy in (message, replace(message, system=7))]
    found, _ = injected(attack("gyro_x", "bias", size=1.0), crowd)
    assert [m for m in found if m.system == 7] == [m for m in crowd if m.system == 7]
    assert [m for m in found if m.system == 1] != [m for m in crowd if m.system == 1]


SIZES = {
    "bias": {"size": 0.7},
    "ramp": {"rate": 0.7},
    "scale": {"size": 1.7},
    "freeze": {},
    "noise": {"size": 0.7},
    "delay": {"size": 0.7},
    "drop": {},
    "spoof": {"rate": 2.0},
}


@given(
    channel=st.sampled_from([name for name in INSTRUMENTS if name != "compass"]),
    kind=st.sampled_from(sorted(SIZES)),
    start_ms=st.integers(55_000, 60_000),
    length_ms=st.integers(1, 6_000),
)
def test_nothing_outside_the_attack_is_altered_and_the_truth_is_exact(
    channel: str, kind: str, start_ms: int, length_ms: int
) -> None:
    if kind == "spoof" and channel not in ("gps_north", "gps_east"):
        kind = "bias"
    start_ns, end_ns = start_ms * 1_000_000, (start_ms + length_ms) * 1_000_000
    wanted = attack(channel, kind, start_ns=start_ns, end_ns=end_ns, **SIZES[kind])
    found, truth = injected(wanted)
    copies = iter(found)
    newest_ns, altered = 0, []
    waiting = next(copies, None)
    for message in flight():
        stamp_ns = newest_ns
        if message.system == 1:
            fields = message.fields
            stamp_ns = fields.get("time_boot_ms", 0) * 1_000_000 or fields.get("time_usec", 0) * 1_000 or newest_ns
            newest_ns = max(newest_ns, stamp_ns)
        if waiting == message:
            waiting = next(copies, None)
            continue
        assert message.system == 1
        assert start_ns <= stamp_ns < end_ns
        altered.append(stamp_ns // 1_000_000)
        if kind != "drop":
            assert waiting is not None
            assert (waiting.name, waiting.received_ns) == (message.name, message.received_ns)
            clocks = {"time_boot_ms", "time_usec"}
            assert {k: waiting.fields[k] for k in clocks & waiting.fields.keys()} == {
                k: message.fields[k] for k in clocks & message.fields.keys()
            }
            waiting = next(copies, None)
    assert waiting is None
    assert truth["messages"] == len(altered)
    if altered:
        assert truth["on"] == {"time_boot_ms": min(altered)}
        assert truth["off"] == {"time_boot_ms": max(altered)}
    else:
        assert truth["on"] is truth["off"] is None


def loss(profile: Profile, log: Path, **options: Any) -> tuple[list[Message], dict[str, Any]]:
    messages = list(read_recording(log))
    wanted = attack("motor3", "loss", **({"start_ns": 90 * 10**9, "end_ns": 95 * 10**9} | options))
    made = plan(wanted, {message.name for message in messages}, profile)
    injector = Injector(wanted, made, 1, {})
    return list(inject(messages, injector)), injector.truth()


def test_a_lost_motor_is_named_within_two_points_and_clears_when_it_is_back(quad_profile: Profile, data: Path) -> None:
    log = data / "copter_healthy_square.tlog.xz"
    messages, truth = loss(quad_profile, log, size=0.1)
    events = [event for event in play(quad_profile, messages).events if event.observer == "motors"]
    assert {event.channel for event in events} == {"motor3"}
    raised, cleared = events[0], events[-1]
    assert truth["on"]["time_boot_ms"] == pytest.approx(90_000, abs=11)
    assert truth["off"]["time_boot_ms"] == pytest.approx(95_000, abs=11)
    assert 0 < raised.vehicle_time_ms - truth["on"]["time_boot_ms"] < 500
    assert raised.relative == pytest.approx(-0.1, abs=0.02)
    assert cleared.state == "cleared"
    assert 0 < cleared.vehicle_time_ms - truth["off"]["time_boot_ms"] < 5_000


def test_the_autopilot_answers_a_loss_and_nothing_but_the_motor_alarms(quad_profile: Profile, data: Path) -> None:
    log = data / "copter_healthy_square.tlog.xz"
    before = list(read_recording(log))
    messages, _ = loss(quad_profile, log, size=0.05, start_ns=80 * 10**9, end_ns=110 * 10**9)
    assert {event.channel for event in play(quad_profile, messages).events} == {"motor3"}
    for a, b in zip(before, messages, strict=True):
        if a != b:
            assert a.name == "SERVO_OUTPUT_RAW"
            command, answer = ((m.fields["servo3_raw"] - 1000) / 1000 for m in (a, b))
            assert 0.95 * answer == pytest.approx(command, abs=0.0005)


def test_what_full_command_cannot_hold_shows_in_every_gyro_alike(quad_profile: Profile, data: Path) -> None:
    log = data / "copter_healthy_square.tlog.xz"
    messages, _ = loss(quad_profile, log, size=0.6)
    before = list(read_recording(log))
    moved: dict[str, list[tuple[float, float]]] = {"ATTITUDE": [], "HIGHRES_IMU": []}
    for a, b in zip(before, messages, strict=True):
        if a.name == "ATTITUDE":
            moved[a.name].append((a.fields["time_boot_ms"] / 1e3, b.fields["pitchspeed"] - a.fields["pitchspeed"]))
        elif a.name == "HIGHRES_IMU":
            moved[a.name].append((a.fields["time_usec"] / 1e6, b.fields["ygyro"] - a.fields["ygyro"]))
        elif a != b:
            assert b.fields["servo3_raw"] == 2000
    attitude, imu = (np.array(moved[name]) for name in moved)
    assert not attitude[attitude[:, 0] < 90.0, 1].any()
    during = (imu[:, 0] > 90.5) & (imu[:, 0] < 95.0)
    assert np.abs(imu[during, 1]).max() > 1.0
    resampled = np.interp(imu[during, 0], attitude[:, 0], attitude[:, 1])
    np.testing.assert_allclose(resampled, imu[during, 1], atol=0.02 * np.abs(imu[during, 1]).max())


@pytest.mark.parametrize("size", [0.2, 0.6])
@pytest.mark.parametrize("held", [True, False])
def test_the_answer_of_a_plant_is_that_of_its_equations(size: float, held: bool, quad_profile: Profile) -> None:
    found = find_fault(quad_profile, "motor2")
    assert found is not None
    observer, plant, fault = found
    name = "SERVO_OUTPUT_RAW" if held else "somebody/outputs"
    inputs = [replace(channel, message=name) for channel in observer.source.inputs]
    response = PlantResponse(plant, fault, inputs, lambda stamp_ns: size if stamp_ns >= 10**10 else 0.0)
    ticks = range(900, 1200)
    given_y = []
    for tick in ticks:
        stamp_ns = tick * 10_000_000
        given_y.append(response.at(stamp_ns))
        fields = {"time_usec": stamp_ns // 1000, "port": 0, "servo2_raw": 1500 + tick % 7}
        response.feed(Message(MAVLINK, name, 0, fields), stamp_ns)
    x, phis, expected = np.zeros(4), [0.0] * len(plant.taps), []
    c1, c2 = plant.curves[1]
    for tick in ticks:
        expected.append(plant.C @ x)
        u = 0.5 + (tick - 1) % 7 / 1000  # the newest command when tick's outputs come
        answer = min(u / (1.0 - size), 1.0) if held else u
        whole, lost = (c1 * v + c2 * v * v for v in (u, (1.0 - size) * answer))
        phis = [lost - whole if tick >= 1000 else 0.0, *phis[:-1]]
        x = plant.A @ x + fault.column * float(np.dot(plant.taps, phis))
    np.testing.assert_allclose(given_y, expected, atol=1e-12)


def test_the_command_writes_recording_and_truth_and_keeps_earlier_truth(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = tmp_path / "one.mcap", tmp_path / "two.mcap"
    options = ["--channel", "gyro_x", "--kind", "bias", "--size", "0.1"]
    assert fauio.main(["inject", str(LOG), *options, "--start", "1", "--for", "2", "-o", str(first), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    truth = json.loads((tmp_path / "one.truth.json").read_text())
    assert said == truth == json.loads(read_mcap_metadata(first)["truth"]["json"])
    assert read_mcap_metadata(first)["fauio"]["converted_from"] == LOG.name
    fault = truth["faults"][0]
    assert (fault["kind"], fault["target"], fault["magnitude"], fault["unit"]) == ("bias", "gyro_x", 0.1, "rad/s")
    begin = truth["first"]["time_boot_ms"] + 1000
    assert begin <= fault["on"]["time_boot_ms"] < begin + 11
    assert begin + 1989 <= fault["off"]["time_boot_ms"] < begin + 2000
    before, after = list(read_recording(LOG)), list(read_recording(first))
    different = [(a, b) for a, b in zip(before, after, strict=True) if a != b]
    assert len(different) == fault["messages"]
    assert {a.name for a, _ in different} == {"ATTITUDE", "HIGHRES_IMU"}
    options = ["--channel", "gps_north", "--kind", "freeze", "--at-ms", "57000"]
    assert fauio.main(["inject", str(first), *options, "-o", str(second)]) == 0
    assert [f["target"] for f in json.loads((tmp_path / "two.truth.json").read_text())["faults"]] == [
        "gyro_x",
        "gps_north",
    ]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--channel", "gps_up", "--kind", "bias", "--size", "1"], "no such channel"),
        (["--channel", "ATTITUDE.", "--kind", "bias", "--size", "1"], "no such channel"),
        (["--channel", "ATTITUDE.lean", "--kind", "bias", "--size", "1"], "altered nothing"),
        (["--channel", "motor1", "--kind", "loss", "--size", "0.1"], "--profile"),
        (["--channel", "gyro_x", "--kind", "shake", "--size", "1"], "no such kind"),
        (["--channel", "gyro_x", "--kind", "loss", "--size", "0.1"], "is a sensor"),
        (["--channel", "baro", "--kind", "spoof", "--rate", "1"], "gps_north"),
        (["--channel", "compass", "--kind", "scale", "--size", "2"], "no size to scale"),
        (["--channel", "gyro_x", "--kind", "bias"], "needs --size"),
        (["--channel", "gyro_x", "--kind", "freeze", "--size", "1"], "has no effect"),
        (["--channel", "gyro_x", "--kind", "noise", "--size", "-1"], "not positive"),
        (["--channel", "gyro_x", "--kind", "replay", "--from", "2"], "not before --start"),
        (["--channel", "gyro_x", "--kind", "bias", "--size", "1", "--end", "0.5"], "not after --start"),
        (["--channel", "gyro_x", "--kind", "bias", "--size", "1", "--system", "9"], "system 9"),
        (["--channel", "gps_north", "--kind", "bias", "--size", "1e-9"], "altered nothing"),
    ],
)
def test_what_cannot_be_injected_is_refused_in_one_line_and_leaves_no_file(
    options: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.mcap"
    assert fauio.main(["inject", str(LOG), *options, "--start", "1", "-o", str(out)]) == 2
    said = capsys.readouterr().err
    assert says in said
    assert said.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_start_outside_the_log_and_a_channel_it_lacks_are_refused(
    tmp_path: Path, data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["-o", str(tmp_path / "out.mcap")]
    bias = ["--kind", "bias", "--size", "1", "--start"]
    assert fauio.main(["inject", str(LOG), "--channel", "gyro_x", *bias, "100", *out]) == 2
    assert "begin outside" in capsys.readouterr().err
    poor = str(data / "copter_wind_step.tlog.xz")
    assert fauio.main(["inject", poor, "--channel", "gps_north", *bias, "1", *out]) == 2
    assert "needs GPS_RAW_INT" in capsys.readouterr().err


def test_a_recording_is_never_written_over_itself(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "flight.mcap"
    with MessageLogWriter(path) as writer:
        for message in flight()[:100]:
            writer.write(message)
    before = path.read_bytes()
    options = ["--channel", "gyro_x", "--kind", "freeze", "--start", "0", "-o", str(path)]
    assert fauio.main(["inject", str(path), *options]) == 2
    assert "the recording itself" in capsys.readouterr().err
    assert path.read_bytes() == before


def test_malformed_messages_pass_as_they_are() -> None:
    bad = [Message(MAVLINK, name, flight()[0].received_ns, {"roll": "x"}, 1, 1) for name in sorted(names())]
    found, _ = injected(attack("baro", "bias", size=1.0), [*flight()[:1000], *bad, *flight()[1000:]])
    assert [m for m in found if m.fields == {"roll": "x"}] == bad


@pytest.mark.parametrize("kind", ATTACK_KINDS)
def test_every_kind_says_what_it_does(kind: str) -> None:
    assert attack("gyro_x", kind, size=0.5, rate=2.0).meaning


def test_an_attack_without_what_it_needs_is_refused_before_anything_is_read() -> None:
    with pytest.raises(UsageError, match="needs --rate"):
        attack("gps_north", "spoof").check()


def test_the_help_lists_every_kind_and_every_channel(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        fauio.main(["inject", "--help"])
    said = capsys.readouterr().out
    assert ", ".join(ATTACK_KINDS) in " ".join(said.split())
    for channel in INSTRUMENTS:
        axis = channel.removesuffix("_y").removesuffix("_z")
        assert axis in said


@given(st.integers(0, 2**32 - 1), st.floats(-5.0, 5.0))
def test_the_answer_of_a_nonlinear_plant_follows_the_states_along_the_recording(seed: int, push: float) -> None:
    anywhere = np.array([[-np.inf, np.inf]])
    swing = Nonlinearity("sin(v)", ("v",), np.array([[1.0, 0.5]]), np.array([[-1.0, 1.0]]), anywhere)
    fault = Fault("push", "actuator", np.array([0.0, 1.0]))
    plant = Plant(
        name="toy",
        domain="discrete",
        rate_hz=100.0,
        states=("a", "b"),
        inputs=("drive",),
        outputs=("a", "sum"),
        A=np.array([[0.9, 0.1], [-0.2, 0.8]]),
        B=np.array([[0.1], [0.3]]),
        C=np.array([[1.0, 0.0], [1.0, 1.0]]),
        G=np.array([[0.0], [0.3]]),
        nonlinearities=(swing,),
        faults=(fault,),
    )
    commands = np.random.default_rng(seed).uniform(0.0, 1.0, 40)

    def run(pushed: float) -> np.ndarray:
        states = [np.array([0.3, -0.4])]
        for u in commands:
            x = states[-1]
            swinging = plant.G @ np.sin(swing.rows @ x)
            states.append(plant.A @ x + plant.B @ [u] + fault.column * pushed + swinging)
        return np.stack(states)

    healthy, ticks = run(0.0), np.arange(41) * 10_000_000
    response = PlantResponse(plant, plant.faults[0], (), lambda _: push, States(ticks, healthy))
    given_y = [response.at(stamp_ns) for stamp_ns in ticks.tolist()]
    np.testing.assert_allclose(given_y, (run(push) - healthy) @ plant.C.T, atol=1e-9)
