"""The arm's telemetry: what a monitor samples from it is what was simulated, on every way."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from sampled import Row, feed

import adapters.commands
from adapters.batch import messages as each
from adapters.channels import Channel
from adapters.errors import TelemetryError, UsageError
from adapters.logs.recordings import read_recording
from adapters.mavlink.mavlink_link import MavlinkLink
from adapters.message import Message
from adapters.simulation.arm import SCENARIOS, ArmRun, ArmScenario, make_fault, simulate_arm
from adapters.simulation.arm_source import arm_messages, arm_packets, publish_arm, send_arm
from adapters.zenoh.zenoh_link import ZenohLink
from adapters.zenoh.zenoh_session import open_session
from monitor.core.sampling import VehicleClock
from monitor.sampling.phase import FlightPhase
from monitor.sampling.sampler import Sampler

UNIX = 1_795_251_917_000_000_000
ARRAY = "DEBUG_FLOAT_ARRAY"


@pytest.fixture(scope="module")
def run() -> ArmRun:
    scenario = ArmScenario((make_fault("f_a", "step", 0.5, 1.0, 2.0), make_fault("f_s", "step", 1.2, 1.5, 1.0)))
    return simulate_arm(scenario, 2.0, torque="tracking")


@pytest.fixture
def endpoint() -> Iterator[str]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    yield address


def mavlink_sampler() -> Sampler:
    data = [Channel(str(i), ARRAY, ("data", i), where=(("name", "arm"),)) for i in range(4)]
    return Sampler(data[:1], data[1:], 100.0, VehicleClock())


def zenoh_sampler(key: str) -> Sampler:
    return Sampler(
        [Channel("u", key, ("u", 0))],
        [Channel(f"y{i}", key, ("y", i)) for i in range(3)],
        100.0,
        VehicleClock(),
    )


def same_as(run: ArmRun, samples: list[Row], tolerance: float) -> bool:
    assert len(samples) >= len(run.t) - 1
    for sample in samples:
        assert sample.complete
        assert np.abs(sample.u - run.u[sample.index]).max() <= tolerance
        assert np.abs(sample.y - run.y[sample.index]).max() <= tolerance
    return True


def test_messages_carry_inputs_outputs_and_the_truth(run: ArmRun) -> None:
    messages = list(arm_messages(run, UNIX))
    arrays = [message for message in messages if message.name == ARRAY]
    assert len(arrays) == 200
    for k, message in enumerate(arrays):
        assert message.fields["name"] == "arm"
        assert message.fields["time_usec"] == k * 10_000
        assert message.received_ns == UNIX + k * 10_000_000
        truth = [*run.u[k], *run.y[k], *run.f_a[k], *run.f_s[k]]
        assert message.fields["data"][:6] == pytest.approx(truth, rel=1e-6, abs=1e-6)
        assert not any(message.fields["data"][6:])
    assert [message.received_ns for message in messages if message.name == "HEARTBEAT"] == [
        UNIX,
        UNIX + 10**9,
    ]


def test_sampled_messages_are_the_simulated_samples(run: ArmRun) -> None:
    samples = feed(mavlink_sampler(), [*arm_messages(run, UNIX)])
    # MAVLink has no stamp 0, so the very first sample is not there.
    assert [sample.index for sample in samples] == list(range(1, 200))
    assert same_as(run, samples, 1e-6)
    assert all(sample.time_ns == UNIX + sample.vehicle_time_ns for sample in samples)


def test_the_arm_says_that_it_is_armed(run: ArmRun) -> None:
    phase = FlightPhase()
    for message in arm_messages(run, UNIX):
        phase.feed(message)
    assert (phase.armed, phase.landed) == (True, None)


def test_a_live_link_receives_the_very_messages_of_the_recording(run: ArmRun, port: int) -> None:
    expected = [(message.name, dict(message.fields)) for message in arm_messages(run, UNIX)]
    with MavlinkLink(f"udpin:127.0.0.1:{port}") as link:
        sender = threading.Thread(target=send_arm, args=(run, f"udpout:127.0.0.1:{port}", 10.0))
        sender.start()
        received: list[Message] = []
        while len(received) < len(expected):
            received += [*each(link.receive(0.2))]
        sender.join()
        assert [(message.name, dict(message.fields)) for message in received] == expected
        assert link.statistics().lost == 0


def test_zenoh_telemetry_starts_with_the_subscriber_and_loses_nothing(run: ArmRun, endpoint: str) -> None:
    with open_session(listen=[endpoint]) as session, ZenohLink(session, "arm/*") as link:
        sender = threading.Thread(target=publish_arm, args=(run, "arm/telemetry", [endpoint], 10.0))
        sender.start()
        received: list[Message] = []
        while len(received) < len(run.t):
            received += [*each(link.receive(0.2))]
        sender.join()
    assert same_as(run, feed(zenoh_sampler("arm/telemetry"), received), 0.0)
    assert received[60].fields["f_a"] == [2.0]
    assert received[130].fields["f_s"] == [1.0]


def test_what_cannot_be_sent_to_is_reported(run: ArmRun) -> None:
    for url in ("tcp:127.0.0.1:1", "127.0.0.1:14550", "udpout:14550"):
        with pytest.raises(TelemetryError, match=f"^{url}: "):
            send_arm(run, url)
    with pytest.raises(UsageError, match="speed 0: has to be positive"):
        send_arm(run, "udpout:127.0.0.1:9", 0.0)
    with pytest.raises(TelemetryError, match="'arm//x' is not a Zenoh key"):
        publish_arm(run, "arm//x", [])


def command_line(*args: str) -> int:
    import argparse

    parser = argparse.ArgumentParser()
    adapters.commands.add_parsers(parser.add_subparsers())
    parsed = parser.parse_args(args)
    return int(parsed.handler(parsed))


def test_the_command_records_the_arm(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "arm.mcap"
    command = ["simulate", "arm", "-o", str(out), "--fault", "f_a:step:0.5:1:2", "--fault", "f_s:ramp:1:2:1"]
    assert command_line(*command, "--duration", "2", "--json") == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["scenario"], said["samples"], said["messages"], said["to"]) == (
        "healthy",
        200,
        202,
        str(out),
    )
    assert [fault["channel"] for fault in said["faults"]] == ["f_a", "f_s"]
    recorded = list(read_recording(out, {ARRAY}))
    scenario = ArmScenario((make_fault("f_a", "step", 0.5, 1.0, 2.0), make_fault("f_s", "ramp", 1.0, 2.0, 1.0)))
    expected = [m for m in arm_messages(simulate_arm(scenario, 2.0), UNIX) if m.name == ARRAY]
    assert [dict(message.fields) for message in recorded] == [dict(message.fields) for message in expected]


def test_the_command_sends_over_udp_and_prints_nothing_on_stdout(port: int, capsys: pytest.CaptureFixture[str]) -> None:
    with MavlinkLink(f"udpin:127.0.0.1:{port}") as link:
        url = f"udpout:127.0.0.1:{port}"
        assert command_line("simulate", "arm", "--mavlink", url, "--duration", "1", "--speed", "5") == 0
        received: list[Message] = []
        while len(received) < 101:
            received += [*each(link.receive(0.2))]
    assert capsys.readouterr().out == ""
    expected = [packet for _, packet in arm_packets(simulate_arm(SCENARIOS["case2"], 1.0))]
    assert len(received) == len(expected) == 101


def test_the_command_offers_every_scenario_and_refuses_what_does_not_fit() -> None:
    assert set(adapters.commands.SCENARIOS) == set(SCENARIOS)
    with pytest.raises(UsageError, match="--connect goes with --zenoh"):
        command_line("simulate", "arm", "--mavlink", "udpout:127.0.0.1:9", "--connect", "tcp/127.0.0.1:1")
    with pytest.raises(SystemExit):
        command_line("simulate", "arm")
