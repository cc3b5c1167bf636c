"""One profile serves the arm over Zenoh and its recordings by others: ROS 2 bags, JSON, protobuf."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from math import inf, sin
from pathlib import Path
from typing import Any

import pytest
import tomli_w
from foreign_logs import (
    ARM_DEFINITION,
    ARM_FIELDS,
    ARM_TOPIC,
    ARM_TYPE,
    arm_rows,
    json_log,
    protobuf_log,
    ros2_bag,
    tracked,
    write_foreign_profile,
)
from mcap_ros2._dynamic import serialize_dynamic

import fauio
from adapters.logs.mcap_reader import MessageLogReader
from adapters.message import Message
from adapters.simulation.arm import ArmFault, ArmRun, ArmScenario, simulate_arm
from adapters.source import ZENOH
from adapters.zenoh.zenoh_payload import PayloadDecoder
from monitor.profile import Profile, read_profile
from replay.player import play


@pytest.fixture(scope="module")
def folder(arm_profile: Profile, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the arm's profile with channels from its ROS 2 topic."""
    return write_foreign_profile(arm_profile, tmp_path_factory.mktemp("ros") / "arm")


@pytest.fixture(scope="module")
def expected(folder: Path) -> list[dict[str, Any]]:
    """Return the alarm events of the run as a subscription over Zenoh delivers it."""
    messages = [Message(ZENOH, "arm/sample", time_ns, fields) for time_ns, fields in arm_rows(tracked())]
    events = play(read_profile(folder), messages).events
    assert (events[0].channel, events[0].state) == ("motor", "raised")
    return [event.to_json() for event in events]


def replayed(folder: Path, log: Path, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    assert fauio.main(["replay", str(folder), str(log), "--json"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def bag(path: Path, compression: str) -> Path:
    return ros2_bag(path, {ARM_TOPIC: (ARM_TYPE, ARM_DEFINITION, arm_rows(tracked()))}, compression)


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
@pytest.mark.parametrize(
    "write",
    [
        bag,
        lambda path, how: json_log(path, ARM_TOPIC, arm_rows(tracked()), how),
        lambda path, how: protobuf_log(path, arm_rows(tracked()), how),
    ],
    ids=["ros2", "json", "protobuf"],
)
def test_recordings_of_others_replay_to_the_alarms_of_the_live_robot(
    folder: Path,
    expected: list[dict[str, Any]],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    write: Callable[[Path, str], Path],
    compression: str,
) -> None:
    found = replayed(folder, write(tmp_path / "run.mcap", compression), capsys)
    assert found["alarms"] == expected
    assert found["damage"] == []


def test_a_converted_bag_replays_to_the_same_alarms(
    folder: Path, expected: list[dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = bag(tmp_path / "bag.mcap", "lz4"), tmp_path / "out.mcap"
    assert fauio.main(["convert", str(path), "-o", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["messages"] == len(tracked().t)
    assert replayed(folder, out, capsys)["alarms"] == expected


def test_a_bag_names_its_messages_as_ros_2_over_zenoh_does(tmp_path: Path) -> None:
    message = next(iter(MessageLogReader(bag(tmp_path / "bag.mcap", "none"))))
    (tmp_path / "ArmSample.msg").write_text(ARM_DEFINITION.partition("=")[0])
    _, fields = next(arm_rows(tracked()))
    payload = bytes(serialize_dynamic(ARM_TYPE, ARM_DEFINITION)[ARM_TYPE](fields))
    decoder = PayloadDecoder(definitions=[tmp_path])
    key = "0/arm/sample/arm_msgs::msg::dds_::ArmSample_/RIHS01_ab12"
    assert decoder.decode(key, "", payload) == (message.name, message.fields)


def excited(phase: float) -> ArmRun:
    """Simulate the arm under a torque of three frequencies that it is told."""

    def torque(t: float) -> float:
        return 0.25 * sin(1.3 * t + phase) + 0.2 * sin(4.1 * t + 1.0 + phase) + 0.2 * sin(9.0 * t + 3 * phase)

    run = simulate_arm(ArmScenario((ArmFault("f_a", 0.0, inf, torque),)), 25.0, 100.0)
    return replace(run, u=run.f_a, f_a=0.0 * run.f_a)


@pytest.mark.long
def test_a_profile_is_fitted_to_bags_and_watches_bags(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    logs = [
        ros2_bag(tmp_path / f"{day}.mcap", {ARM_TOPIC: (ARM_TYPE, ARM_DEFINITION, arm_rows(excited(phase)))})
        for day, phase in (("monday", 0.0), ("tuesday", 2.0))
    ]
    model = (Path(__file__).parent / "data" / "arm_free.toml").read_text().partition("[channels]")[0]
    channels = {name: {"message": ARM_TOPIC, "field": field} for name, field in ARM_FIELDS.items()}
    (tmp_path / "arm.toml").write_text(model + tomli_w.dumps({"channels": channels}))
    command = ["fit", "--vehicle", "custom", "--model", str(tmp_path / "arm.toml"), *map(str, logs)]
    assert fauio.main([*command, "-o", str(tmp_path / "arm"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["damage"] == []
    assert found["observers"]["arm"]["parameters"]["stiffness"]["value"] == pytest.approx(48.6, abs=0.3)
    alarms = replayed(tmp_path / "arm", bag(tmp_path / "case2.mcap", "zstd"), capsys)["alarms"]
    assert (alarms[0]["channel"], alarms[0]["state"]) == ("motor", "raised")


def test_a_replay_says_what_of_a_recording_is_missing(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = bag(tmp_path / "bag.mcap", "zstd")
    path.write_bytes(path.read_bytes()[:-5000])
    assert fauio.main(["replay", str(folder), str(path), "--json"]) == 0
    said = capsys.readouterr()
    [damage] = json.loads(said.out)["damage"]
    assert damage["stopped_at"] > 0
    assert said.err.splitlines() == [
        f"fauio: bag.mcap: cannot be read from byte {damage['stopped_at']} on; all else was read"
    ]
