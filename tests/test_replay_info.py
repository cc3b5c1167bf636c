"""``fauio info`` says what is in recordings, profiles, models and gains, as text and as one JSON object."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
from dataflash_writer import DataflashWriter
from foreign_logs import ARM_DEFINITION, ARM_TYPE, START_NS, arm_rows, ros2_bag, stamp
from ulog_writer import UlogWriter

import fauio
from adapters.logs.mcap_log import MessageLogWriter
from adapters.logs.recordings import read_recording
from adapters.message import Message
from adapters.simulation.arm import SCENARIOS, simulate_arm
from adapters.simulation.arm_source import arm_messages
from adapters.source import MAVLINK
from monitor.profile import Profile
from replay.inspection.log_info import first_raised
from replay.player import play

FLIGHT = Path(__file__).parent / "data" / "copter_5s.tlog.xz"
START = 10**18


def ask(capsys: pytest.CaptureFixture[str], path: object) -> dict[str, Any]:
    assert fauio.main(["info", str(path), "--json"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def told(capsys: pytest.CaptureFixture[str], path: object) -> str:
    assert fauio.main(["info", str(path)]) == 0
    return capsys.readouterr().out


def profile_folder(profile: Profile, folder: Path) -> Path:
    folder.mkdir()
    for name, content in profile.files.items():
        (folder / name).write_bytes(content)
    return folder


def test_a_flight_says_who_sent_what_and_what_could_be_watched(capsys: pytest.CaptureFixture[str]) -> None:
    found = ask(capsys, FLIGHT)
    assert (found["kind"], found["format"], found["count"]) == ("recording", "tlog", 2683)
    assert found["start"] == "2026-11-21T09:04:20Z"
    assert found["duration_s"] == pytest.approx(5.0, abs=0.1)
    assert found["messages"]["HIGHRES_IMU"]["count"] == 500
    assert found["messages"]["HIGHRES_IMU"]["rate_hz"] == pytest.approx(100.0, abs=1.0)
    vehicle, *stations = found["systems"]
    assert (vehicle["system"], vehicle["type"], vehicle["autopilot"]) == (1, "quadrotor", "ardupilotmega")
    assert 3.0 < vehicle["armed_s"] < 5.1
    assert [one["type"] for one in stations] == ["gcs", "gcs"]
    assert (found["vehicle"]["system"], found["vehicle"]["likely"]) == (1, "multirotor")
    fits = found["vehicle"]["fits"]
    assert fits["multirotor"]["watches"] == ["motor1", "motor2", "motor3", "motor4", "gyro_x", "gyro_y", "gyro_z"]
    assert fits["multirotor"]["channels"]["motor1"] == "SERVO_OUTPUT_RAW.servo1_raw"
    assert fits["multirotor"]["rate_hz"] == 100.0
    assert {"gps_north", "gps_down", "baro", "compass", "accel_z"} <= set(fits["inertial"]["watches"])
    assert found["damage"] == found["alarms"] == []


def test_what_is_missing_is_named_with_what_it_is_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "part.mcap"
    with MessageLogWriter(path) as log:
        for message in read_recording(FLIGHT):
            if message.name not in ("SERVO_OUTPUT_RAW", "GPS_RAW_INT", "VFR_HUD"):
                log.write(message)
    fits = ask(capsys, path)["vehicle"]["fits"]
    assert not fits["multirotor"]["possible"]
    assert fits["multirotor"]["missing"] == ["no motor commands; record SERVO_OUTPUT_RAW at 50 Hz or more"]
    assert fits["inertial"]["missing"] == ["gps_*: no GPS_RAW_INT with position, speed and course"]
    text = told(capsys, path)
    assert "multirotor: not possible: no motor commands" in text
    assert "lacks gps_*" in text
    assert "plane" not in text


def test_what_comes_in_a_burst_has_no_rate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "burst.mcap"
    with MessageLogWriter(path) as log:
        for number, message in enumerate(read_recording(FLIGHT)):
            log.write(message)
            if number < 10:
                log.write(replace(message, name="PARAM_VALUE", fields={"param_id": f"P{number}", "param_value": 1.0}))
    messages = ask(capsys, path)["messages"]
    assert messages["PARAM_VALUE"] == {"count": 10, "rate_hz": None}
    assert messages["ATTITUDE"]["rate_hz"] == pytest.approx(100.0, abs=1.0)


def test_a_bag_of_another_kind_lists_the_fields_that_channels_can_take(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    joints = {"header": {"stamp": stamp(START_NS)}, "name": ["elbow", "wrist"], "position": [1.0, 2.0]}
    run = simulate_arm(SCENARIOS["healthy"], 1.0, 100.0, "zero")
    path = ros2_bag(
        tmp_path / "bag.mcap",
        {
            "/arm/sample": (ARM_TYPE, ARM_DEFINITION, arm_rows(run)),
            "/joints": ("sensor_msgs/msg/JointState", None, [(START_NS, joints)]),
        },
    )
    found = ask(capsys, path)
    assert found["vehicle"] is None
    assert found["systems"] == []
    assert found["fields"]["joints"][-2:] == ["position[elbow]", "position[wrist]"]
    assert "y[2]" in found["fields"]["arm/sample"]
    assert found["messages"]["arm/sample"]["rate_hz"] == pytest.approx(100.0)
    assert "arm/sample: header.stamp.sec, header.stamp.nanosec, u[0], y[0]" in told(capsys, path)


def test_a_recorded_session_tells_its_monitor_and_alarms(
    arm_profile: Profile, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = tmp_path / "session"
    session.mkdir()
    run = simulate_arm(SCENARIOS["case2"], 12.0, 100.0, "tracking")
    record = session / "arm-20260101T000000Z-000001.mcap"
    play(arm_profile, arm_messages(run, START), record=record)
    found = ask(capsys, session)
    assert found["recorded"]["vehicle"] == "arm"
    assert [event["channel"] for event in found["alarms"]] == ["motor"]
    text = told(capsys, session)
    assert "recorded by a monitor of arm" in text
    assert "1 alarm recorded:" in text
    assert "arm/motor: " in text


def test_a_recorded_alarm_that_was_unshelved_is_told_once() -> None:
    said = [{"id": "1", "state": "raised", "seq": k} for k in range(2)]
    assert first_raised([*said, {"id": "2", "state": "cleared"}, {"state": "raised"}]) == [
        said[0],
        {"state": "raised"},
    ]


def test_damage_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "flight.tlog"
    path.write_bytes(b"".join(_packets()))
    path.write_bytes(path.read_bytes()[:-3])
    found = ask(capsys, path)
    assert found["damage"] == [{"file": "flight.tlog", "found": ["breaks off at its end"], "stopped_at": None}]
    assert "damaged: flight.tlog: breaks off at its end" in told(capsys, path)


def _packets() -> list[bytes]:
    from adapters.logs.tlog import TlogReader

    return [(time_ns // 1000).to_bytes(8) + packet for time_ns, packet in TlogReader(FLIGHT).packets()]


def test_heartbeats_that_were_written_late_count_no_time_twice(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    heartbeat = next(packet for packet in _packets() if packet[8 + 7 : 8 + 10] == bytes(3))
    times_s = (0.0, 1.0, 2.0, 0.6, 3.0, 4.0, 2.6, 5.0)
    stamps = ((START // 1000 + round(1e6 * time_s)).to_bytes(8) for time_s in times_s)
    (tmp_path / "late.tlog").write_bytes(b"".join(stamp + heartbeat[8:] for stamp in stamps))
    assert ask(capsys, tmp_path / "late.tlog")["systems"][0]["armed_s"] == pytest.approx(5.0)


def test_a_recording_of_nothing_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with MessageLogWriter(tmp_path / "empty.mcap"):
        pass
    found = ask(capsys, tmp_path / "empty.mcap")
    assert (found["count"], found["start_ns"], found["duration_s"]) == (0, None, 0.0)
    assert "no messages" in told(capsys, tmp_path / "empty.mcap")


@pytest.mark.parametrize(
    "fields",
    [
        {"type": {"a": 1}, "autopilot": [3], "base_mode": [128]},
        {"time_boot_ms": 10**400, "base_mode": "x"},
        {"servo1_raw": 10**400, "port": 0, "time_usec": -(10**300)},
    ],
)
@pytest.mark.parametrize("name", ["HEARTBEAT", "SERVO_OUTPUT_RAW"])
def test_fields_of_any_type_and_size_are_told(
    fields: dict[str, Any], name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with MessageLogWriter(tmp_path / "odd.mcap") as log:
        for number, message in enumerate(islice(read_recording(FLIGHT), 400)):
            odd = message.name == name and number % 3
            log.write(replace(message, fields={**message.fields, **fields}) if odd else message)
    assert ask(capsys, tmp_path / "odd.mcap")["count"] == 400
    assert "odd.mcap" in told(capsys, tmp_path / "odd.mcap")


def test_a_profile_tells_observers_bounds_and_alarms(
    arm_profile: Profile, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = profile_folder(arm_profile, tmp_path / "arm")
    found = ask(capsys, folder)
    assert (found["kind"], found["name"], found["messages"]) == ("profile", "arm", ["DEBUG_FLOAT_ARRAY"])
    arm = found["observers"]["arm"]
    assert (arm["rate_hz"], arm["certified"], arm["faults"]) == (100.0, True, ["motor", "encoder"])
    assert arm["sqrt_mu"] > 0.0
    [rule] = [rule for rule in arm_profile.observers[0].alarms if rule.channel == "motor"]
    assert arm["alarms"]["motor"]["threshold"] == rule.threshold
    bounds = arm_profile.observers[0].gains[0].report["error_bounds"]
    assert arm["alarms"]["motor"]["at_most"] == bounds["motor"]["at_most"] > 0.0
    assert ask(capsys, folder / "profile.toml")["digest"] == found["digest"]
    text = told(capsys, folder)
    assert "certificate holds" in text
    assert "motor    from" in text
    assert "in the model's worst case" in text


def test_a_model_tells_its_names_and_whether_it_can_be_estimated(capsys: pytest.CaptureFixture[str]) -> None:
    found = ask(capsys, "arm")
    assert (found["kind"], len(found["states"]), found["estimable"]) == ("model", 4, True)
    assert "check: arm: 2 faults, 3 outputs: all can be estimated together" in told(capsys, "arm")
    free = Path(__file__).parent / "data" / "arm_free.toml"
    assert ask(capsys, free)["parameters"] == ["stiffness", "ratio", "gain"]
    assert "free parameters: stiffness, ratio, gain" in told(capsys, free)


def test_gains_tell_what_they_estimate_and_their_bound(
    arm_profile: Profile, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "gains.json"
    path.write_bytes(arm_profile.files["arm.gains.json"])
    found = ask(capsys, path)
    assert (found["kind"], found["rate_hz"], found["certified"]) == ("gains", 100.0, True)
    assert [fault["name"] for fault in found["faults"]] == ["motor", "encoder"]
    assert "certificate holds" in told(capsys, path)


@pytest.mark.parametrize(
    ("name", "content"), [("a.toml", b"x ="), ("a.json", b"{}"), ("a.txt", b""), ("a.mcap", b"no"), ("a.tlog", b"no")]
)
def test_anything_else_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, content: bytes
) -> None:
    (tmp_path / name).write_bytes(content)
    assert fauio.main(["info", str(tmp_path / name)]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert name in said.err


def test_an_alarm_id_in_a_foreign_recording_may_be_anything() -> None:
    from replay.inspection.log_info import first_raised

    events = [{"state": "raised", "id": ["a"]}, {"state": "raised", "id": ["a"]}, {"state": "raised", "id": {}}]
    assert first_raised(events) == [events[0], events[2]]


def log_of(path: Path, messages: Iterable[Message]) -> Path:
    with MessageLogWriter(path) as log:
        for message in messages:
            log.write(message)
    return path


def px4_link(*imus: str) -> Iterator[Message]:
    """Yield two seconds of a PX4 that sends attitude and some IMU messages, armed from the first heartbeat on."""
    heartbeat = {"type": 2, "autopilot": 12, "base_mode": 129, "custom_mode": 0, "system_status": 4}
    values = dict.fromkeys(("xacc", "yacc", "zacc", "xgyro", "ygyro", "zgyro", "xmag", "ymag", "zmag"), 1)
    angles = dict.fromkeys(("roll", "pitch", "yaw", "rollspeed", "pitchspeed", "yawspeed"), 0.1)
    for step in range(1, 101):
        clocks = {"time_boot_ms": 20 * step}, {"time_usec": 20_000 * step}
        yield Message(MAVLINK, "ATTITUDE", START + 20_000_000 * step, clocks[0] | angles, 1, 1)
        if step % 50 == 1:
            yield Message(MAVLINK, "HEARTBEAT", START + 20_000_000 * step, heartbeat | {"mavlink_version": 3}, 1, 1)
        for imu in imus:
            yield Message(MAVLINK, imu, START + 20_000_000 * step, clocks[imu == "HIGHRES_IMU"] | values, 1, 1)


def test_what_a_corrected_imu_hides_is_said_and_a_raw_one_preferred(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = log_of(tmp_path / "corrected.mcap", px4_link("HIGHRES_IMU"))
    inertial = ask(capsys, path)["vehicle"]["fits"]["inertial"]
    assert inertial["channels"]["xgyro"] == "HIGHRES_IMU.xgyro"
    assert inertial["hides"].startswith("HIGHRES_IMU: the autopilot subtracts the bias")
    text = told(capsys, path)
    assert "hides some: HIGHRES_IMU: the autopilot subtracts" in text
    assert "SCALED_IMU is raw" in " ".join(text.split())
    raw = log_of(tmp_path / "raw.mcap", px4_link("HIGHRES_IMU", "SCALED_IMU"))
    inertial = ask(capsys, raw)["vehicle"]["fits"]["inertial"]
    assert inertial["channels"]["xgyro"] == "SCALED_IMU.xgyro"
    assert inertial["hides"] is None


def test_a_vehicle_that_was_never_armed_is_told_what_a_flight_would_allow(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    disarmed = (
        replace(message, fields={**message.fields, "base_mode": 1}) if message.name == "HEARTBEAT" else message
        for message in px4_link("HIGHRES_IMU")
    )
    path = log_of(tmp_path / "still.mcap", disarmed)
    found = ask(capsys, path)
    assert found["vehicle"]["never_armed"]
    assert found["vehicle"]["fits"]["inertial"]["possible"]
    text = told(capsys, path)
    assert "quadrotor of px4, 202 messages, never armed" in text
    assert "nothing to fit: the vehicle is never armed; record a flight." in text


def test_an_onboard_log_says_its_inputs_frame_and_the_kind_of_its_sensors(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = UlogWriter(start_us=1_000_000)
    for name, value in (("CA_ROTOR_COUNT", 4), ("MAV_TYPE", 2)):
        log.parameter(name, value)
    for k, (x, y) in enumerate(((1.0, 1.0), (-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0))):
        for axis, place in (("X", x), ("Y", y)):
            log.parameter(f"CA_ROTOR{k}_P{axis}", place)
    topics = {
        "vehicle_status": "uint64_t timestamp;uint8_t arming_state;uint8_t nav_state;uint8_t system_type",
        "vehicle_angular_velocity": "uint64_t timestamp;float[3] xyz",
        "vehicle_attitude": "uint64_t timestamp;float[4] q",
        "sensor_combined": "uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2",
        "actuator_motors": "uint64_t timestamp;float[12] control",
        "vehicle_magnetometer": "uint64_t timestamp;float[3] magnetometer_ga",
        "vehicle_torque_setpoint": "uint64_t timestamp;float[3] xyz",
        "vehicle_thrust_setpoint": "uint64_t timestamp;float[3] xyz",
    }
    for name, fields in topics.items():
        log.define(name, fields)
    numbers = {name: log.subscribe(name) for name in topics}
    for step in range(200):
        values: dict[str, dict[str, Any]] = {
            "vehicle_status": {"arming_state": 2, "nav_state": 4, "system_type": 2},
            "vehicle_attitude": {"q": [1.0, 0.0, 0.0, 0.0]},
            "vehicle_magnetometer": {"magnetometer_ga": [0.2, 0.0, 0.4]},
            "actuator_motors": {"control": [0.5 + 0.01 * ((step + k) % 9) for k in range(4)] + [float("nan")] * 8},
        }
        for name in topics:
            if step % {"actuator_motors": 5, "vehicle_magnetometer": 25}.get(name, 1) == 0:
                log.add(numbers[name], name, {"timestamp": 1_000_000 + 20_000 * step, **values.get(name, {})})
    found = ask(capsys, log.write(tmp_path / "a.ulg"))
    assert {name: round(one["rate_hz"]) for name, one in found["vehicle"]["inputs"].items()} == {
        "SERVO_OUTPUT_RAW": 10,
        "ACTUATOR_CONTROL_TARGET": 50,
    }
    assert found["vehicle"]["inputs"]["SERVO_OUTPUT_RAW"]["from"] == "actuator_motors"
    text = told(capsys, tmp_path / "a.ulg")
    made = found["count"] - found["records"]
    assert f"{found['records']} records, from which {made} messages were made" in text
    assert made == found["systems"][0]["messages"]
    assert "outputs to motors and servos: SERVO_OUTPUT_RAW at 10 Hz, from actuator_motors" in text
    # what a log says is no link, and gaps in it nothing that a link lost
    assert "lost by their stamps" not in text
    fits = found["vehicle"]["fits"]
    assert fits["multirotor"]["missing"][-1] == (
        "SERVO_OUTPUT_RAW at 50 Hz: it comes at 10 Hz; 100 Hz would show a motor's loss of 1.5 to 3 % within 1 s "
        "instead of 10 to 30 %"
    )
    assert fits["multirotor"]["watches"][:4] == ["motor1", "motor2", "motor3", "motor4"]
    assert fits["multirotor"]["facts"][0].startswith("frame: 4 rotors as the parameters place them")
    assert fits["multirotor"]["hides"].startswith("ATTITUDE: the autopilot subtracts the bias")
    assert fits["inertial"]["hides"] is None
    assert "vehicle_magnetometer at 10 Hz: it comes at 2 Hz" in fits["inertial"]["missing"][-1]
    assert found["systems"][0]["armed_s"] == pytest.approx(3.98, abs=0.05)
    assert [system["system"] for system in found["systems"]] == [1]


def test_a_log_whose_heartbeat_says_no_type_has_that_of_its_firmware_and_parameters(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = DataflashWriter()
    for name, codes, columns in (
        ("MSG", "QZ", "TimeUS,Message"),
        ("PARM", "QNf", "TimeUS,Name,Value"),
        ("ARM", "QBI", "TimeUS,ArmState,ArmChecks"),
    ):
        log.define(name, codes, columns)
    log.add("MSG", 1, "ArduCopter V4.5.1 (0123abcd)")
    log.add("PARM", 2, "FRAME_CLASS", 2.0)
    log.add("ARM", 1_000_000, 1, 0)
    log.add("ARM", 9_000_000, 0, 0)
    path = tmp_path / "a.bin"
    path.write_bytes(log.data)
    assert "system 1: hexarotor of ardupilotmega" in told(capsys, path)


def test_of_a_submarine_no_kind_but_its_sensors_is_offered(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "dive.mcap"
    with MessageLogWriter(path) as log:
        for message in read_recording(FLIGHT):
            is_own = message.name == "HEARTBEAT" and message.system == 1
            log.write(replace(message, fields={**message.fields, "type": 12}) if is_own else message)
    assert ask(capsys, path)["vehicle"]["likely"] == "inertial"
    text = told(capsys, path)
    assert "  multirotor" not in text and "  inertial at " in text
