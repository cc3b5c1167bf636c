"""A robot of ROS 2 is watched by its Imu and NavSatFix, or Odometry: info, fit, replay of bags, and live over Zenoh."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from daemons import DaemonProcess, free_ports
from loopback import publisher, until
from ros_robot import FIX, IMU, ODOMETRY, TYPES, Rows, bag, robot

import fauio
from adapters.channels import Channel, channel_table, parse_channel
from adapters.errors import TelemetryError
from adapters.logs.mcap_log import MessageLogWriter
from adapters.logs.mcap_reader import MessageLogReader
from adapters.logs.recordings import Recording
from adapters.zenoh.zenoh_session import open_session
from monitor.fitting.kept_flights import read_kept
from monitor.profile import read_profile
from monitor.vehicles.inertial.ros_signals import TYPES as READ
from monitor.vehicles.inertial.ros_signals import ros_channels

ON_S, OFF_S = 16.0, 28.0
LINK = {"telemetry"}
"""What becomes of a robot that falls silent."""


class Runs:
    """A folder with bags of healthy runs and of two faults, and with profiles, each made when it is first asked for."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._topics = cache(lambda run: RUNS[run]())

    def bag(self, kind: str, run: str) -> Path:
        """Return the bag of a run with fixes or odometry."""
        path = self._folder / f"{kind}_{run}.mcap"
        return path if path.exists() else bag(path, self._topics(run), IMU, {"fix": FIX, "odometry": ODOMETRY}[kind])

    @property
    def live(self) -> Path:
        """Tuesday with fixes, as `fauio record --zenoh` writes it: JSON under names without types."""
        path = self._folder / "live.mcap"
        if not path.exists():
            with MessageLogWriter(path) as writer:
                for message in Recording(self.bag("fix", "tuesday")):
                    writer.write(message)
        return path

    def fitted(self, kind: str) -> Path:
        """Return the profile fitted to two healthy bags with fixes or odometry."""
        if not (self._folder / kind).exists():
            tuesday = self.live if kind == "fix" else self.bag(kind, "tuesday")
            healthy = [str(path) for path in (self.bag(kind, "monday"), tuesday)]
            assert fauio.main(["fit", "--vehicle", "inertial", *healthy, "-o", str(self._folder / kind)]) == 0
        return self._folder / kind


RUNS: dict[str, Callable[[], dict[str, Rows]]] = {
    "monday": lambda: robot(50.0, 1),
    "tuesday": lambda: robot(50.0, 2),
    "wednesday": lambda: robot(30.0, 5),
    "jump": lambda: robot(36.0, 3, north_m=lambda t: 5.0 * (ON_S < t < OFF_S)),
    "gyro": lambda: robot(36.0, 4, gyro_x=lambda t: 0.1 * (ON_S < t < OFF_S)),
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Runs:
    return Runs(tmp_path_factory.mktemp("ros"))


@pytest.mark.parametrize("kind", ["fix", "odometry"])
def test_info_says_what_could_be_watched(runs: Runs, capsys: pytest.CaptureFixture[str], kind: str) -> None:
    assert fauio.main(["info", str(runs.bag(kind, "wednesday")), "--json"]) == 0
    vehicle = json.loads(capsys.readouterr().out)["vehicle"]
    assert (vehicle["system"], list(vehicle["fits"])) == (None, ["inertial"])
    fit = vehicle["fits"]["inertial"]
    assert fit["possible"]
    assert {"gyro_x", "gyro_y", "gyro_z", "gps_north", "gps_east"} <= set(fit["watches"])
    assert ("gps_velocity_north" in fit["watches"]) is (kind == "odometry")
    assert fit["channels"]["xacc"] == f"{IMU}.linear_acceleration.x"
    assert fauio.main(["info", str(runs.bag(kind, "wednesday"))]) == 0
    assert "what fauio fit could make of these topics:\n    inertial at 50 Hz" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("kind", "name", "channel"),
    [
        ("fix", "wednesday", None),
        ("fix", "jump", "gps_north"),
        ("fix", "gyro", "gyro_x"),
        pytest.param("odometry", "wednesday", None, marks=pytest.mark.long),
        pytest.param("odometry", "jump", "gps_north", marks=pytest.mark.long),
    ],
)
def test_a_bag_raises_the_alarm_of_its_fault_alone(runs: Runs, kind: str, name: str, channel: str | None) -> None:
    found = fauio.replay(runs.fitted(kind), runs.bag(kind, name))
    assert {event.channel for event in found.events} == ({channel} if channel else set())
    raised = [event for event in found.events if event.state == "raised"]
    if raised:
        start_ms = min(fields["header"]["stamp"]["sec"] for _, fields in robot(0.1, 1)[IMU]) * 1000
        assert ON_S * 1e3 < raised[0].vehicle_time_ms - start_ms < (ON_S + 3.0) * 1e3
    # of at least 30 s; observers settle within 12
    assert found.watched_s > 18.0


def test_topics_are_found_by_their_type_and_nothing_else_is_decoded(runs: Runs) -> None:
    path = runs.bag("odometry", "wednesday")
    assert {message.name for message in Recording(path, ["other"], types=READ)} == {IMU, ODOMETRY}
    assert {message.name for message in Recording(path, ["other"], types=["sensor_msgs/Imu"])} == {IMU}
    assert not list(Recording(path, ["other"]))


def test_a_recording_of_the_topics_over_zenoh_fits_too(runs: Runs) -> None:
    assert {message.name for message in Recording(runs.live, ["other"], types=READ)} == {IMU, FIX}
    assert read_profile(runs.fitted("fix")).observers[0].rate_hz == 25.0
    assert [flight.name for flight in read_kept(runs.fitted("fix")).flights] == ["fix_monday.mcap", "live.mcap"]


def test_an_imu_without_orientation_takes_that_of_the_odometry_or_is_refused() -> None:
    topics = robot(1.0, 1, oriented=False)
    examples = {name: rows[0][1] for name, rows in topics.items()}
    channels, parameters, seldom = ros_channels(examples, {}) or ((), {}, ())
    assert {channel.name: channel.message for channel in channels if channel.angle} == dict.fromkeys(
        ("roll", "pitch", "yaw"), ODOMETRY
    )
    assert (parameters["gps"], seldom) == (2.0, (FIX,))
    with pytest.raises(TelemetryError, match=f"{IMU} holds no orientation"):
        ros_channels({IMU: examples[IMU], FIX: examples[FIX]}, {})
    assert ros_channels({FIX: examples[FIX]}, {}) is None


def test_axes_are_those_of_the_transform() -> None:
    """What REP 103 writes is taken back to ahead, right, down and north, east, down."""
    import strapdown_truth as truth

    raw = truth.signals(1.0, start_s=50.0)
    fields = {name: rows[0][1] for name, rows in robot(1.0, 1).items()}
    found = ros_channels({IMU: fields[IMU], ODOMETRY: fields[ODOMETRY]}, {})
    assert found is not None
    values = {channel.name: channel.value(fields[channel.message]) for channel in found[0]}
    assert [values[name] for name in ("xacc", "yacc", "zacc")] == pytest.approx(raw[0, :3], abs=0.3)
    assert [values[name] for name in ("xgyro", "ygyro", "zgyro")] == pytest.approx(raw[0, 3:6], abs=0.02)
    assert [values[name] for name in ("roll", "pitch")] == pytest.approx(raw[0, 6:8], abs=0.01)
    assert np.cos(values["yaw"] - raw[0, 8]) == pytest.approx(1.0, abs=1e-4)
    north = truth.metres_per_degree(0.0)[0] * values["lat"]
    assert north == pytest.approx(truth.position(np.array([50.0]))[0][0], abs=0.2)


@pytest.mark.parametrize("angle", ["roll", "pitch", "yaw"])
def test_a_channel_reads_an_angle_of_a_quaternion_and_is_written_as_it_is_read(angle: str) -> None:
    channel = parse_channel("a", {"message": "imu", "field": "orientation", "angle": angle}, "here")
    assert parse_channel("a", channel_table(channel), "there") == channel
    half = 0.3
    turn = {"roll": "x", "pitch": "y", "yaw": "z"}[angle]
    turned = {**dict.fromkeys("xyz", 0.0), "w": 2.0 * np.cos(half), turn: 2.0 * np.sin(half)}
    assert channel.value({"orientation": {key: float(value) for key, value in turned.items()}}) == pytest.approx(0.6)


@pytest.mark.parametrize(
    "value",
    [
        None,
        1.0,
        {},
        dict.fromkeys("xyzw", 0.0),
        {**dict.fromkeys("xyz", 0.0), "w": float("nan")},
        {"x": 1.0},
        [1.0] * 4,
    ],
)
def test_what_is_no_quaternion_is_no_measurement(value: object) -> None:
    assert Channel("a", "imu", ("orientation",), angle="yaw").value({"orientation": value}) is None


def test_the_robot_is_watched_live_over_zenoh_in_cdr(runs: Runs, tmp_path: Path) -> None:
    [tcp] = free_ports(1)
    config, profile = tmp_path / "fauio.toml", runs.fitted("fix")
    config.write_text(
        f'profile = "{profile}"\nvehicle = "robot"\nzenoh = "robot/**"\nlisten = ["tcp/127.0.0.1:{tcp}"]\n'
    )
    records = list(MessageLogReader(runs.bag("fix", "gyro")).records())[:1300]
    with DaemonProcess(config) as daemon:
        until(lambda: any(line["event"] == "monitoring" for line in daemon.log()), 0.05)
        with open_session([f"tcp/127.0.0.1:{tcp}"], ()) as session:
            out = {name: publisher(session, name) for name in (IMU, FIX)}
            for number, record in enumerate(records):
                name = record.topic.removeprefix("/")
                out[name].put(record.data, encoding=f"application/cdr;{TYPES[name]}")
                # ten times real time
                if number % 11 == 0:
                    time.sleep(0.02)
            said = until(
                lambda: {line["alarm"]["channel"] for line in daemon.log() if line["event"] == "alarm"} - LINK, 0.05
            )
    assert said == {"gyro_x"}
