"""Each example does what its first lines say; those of configurations stand with what they configure."""

from __future__ import annotations

import ast
import json
import math
import queue
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import run
import simulate
from arm_controller import Compensation, Limits
from closed_loop import ACTUATOR, SENSOR, Plant, Run, alone, close_loop, in_process
from daemons import ENVIRONMENT, EXAMPLES
from hypothesis import given
from hypothesis import strategies as st
from live_loop import Loop
from loopback import Endpoint, event, until

import fauio
from adapters.simulation.arm import SCENARIOS, ArmScenario, make_fault
from adapters.zenoh.zenoh_link import ZenohLink
from monitor.bus.publisher import Publisher
from monitor.event import AlarmEvent
from monitor.pipeline import Pipeline
from monitor.profile import read_profile

CART = EXAMPLES / "ros2" / "cart"


def rms_after(loop: Run, start_s: float) -> float:
    return run.rms(loop.error[loop.t >= start_s])


@pytest.mark.parametrize(
    ("case", "start_s", "stop_s", "factor"),
    [("case2", 10.0, 14.0, 20.0), pytest.param("case3", 15.0, 18.0, 20.0, marks=pytest.mark.long)],
)
def test_the_published_fault_taken_out_keeps_the_arm_on_its_track(
    case: str, start_s: float, stop_s: float, factor: float
) -> None:
    plant = Plant(SCENARIOS[case], stop_s)
    without = close_loop(plant, alone(run.controller(run.WITHOUT)))
    taken_out = close_loop(plant, in_process(run.controller(run.BOTH)))
    assert factor * rms_after(taken_out, start_s) < rms_after(without, start_s)


def test_the_motors_fault_alone_needs_the_command_alone_to_be_corrected() -> None:
    plant = Plant(ArmScenario((make_fault("f_a", "step", 9.0, 12.0, 2.0),)), 12.0)
    without = close_loop(plant, alone(run.controller(run.WITHOUT)))
    taken_out = close_loop(plant, in_process(run.controller(run.MOTOR_ONLY)))
    assert 10.0 * rms_after(taken_out, 9.0) < rms_after(without, 9.0)


@pytest.mark.long
def test_over_zenoh_with_the_daemon_the_loop_does_the_same_to_the_bit(tmp_path: Path) -> None:
    faults = (make_fault("f_a", "step", 8.6, 9.5, 2.0), make_fault("f_s", "step", 9.0, 9.5, 1.0))
    plant = Plant(ArmScenario(faults), 9.5)
    expected = close_loop(plant, in_process(run.controller(run.BOTH)))
    with Loop(run.controller(run.BOTH), tmp_path) as loop:
        found = close_loop(plant, loop.exchange)
    assert loop.late == 0
    assert np.max(np.abs(np.diff(expected.torque))) > 0.5
    assert np.array_equal(found.torque, expected.torque)
    assert np.array_equal(found.link, expected.link)


@pytest.mark.long
def test_the_example_prints_its_figures_and_draws_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    plot = tmp_path / "loop.png"
    monkeypatch.setattr(sys, "argv", ["run.py", "--fast", "--case", "case2", "--duration", "10.4", "--plot", str(plot)])
    assert run.main() == 0
    row = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("case2"))
    healthy, nothing, _, _, both = map(float, row.split()[1:])
    assert healthy <= both < nothing / 3
    assert plot.stat().st_size > 10_000
    assert plot.with_stem("loop-dark").stat().st_size > 10_000


NUMBERS = st.none() | st.floats()


@given(
    steps=st.lists(
        st.none()
        | st.fixed_dictionaries(
            {
                "vehicle_time_ms": st.integers(0, 2000),
                "armed": st.booleans(),
                "coasted_s": st.sampled_from([0.0, 0.02]),
                "fault": st.fixed_dictionaries({ACTUATOR: NUMBERS}),
                "sd": st.fixed_dictionaries({ACTUATOR: NUMBERS}),
            }
        ),
        max_size=20,
    )
)
def test_whatever_is_published_the_compensation_stays_within_size_and_rate(steps: list[dict[str, Any] | None]) -> None:
    guard = Compensation(ACTUATOR, Limits(size=3.0, rate=100.0, sd=0.5))
    before = 0.0
    for k, estimate in enumerate(steps):
        now = guard.update(estimate, 0.01 * k, 0.01)
        assert math.isfinite(now)
        assert abs(now) <= 3.0
        assert abs(now - before) <= 1.0 + 1e-12
        before = now


@pytest.mark.parametrize(
    "doubt",
    [
        {"armed": False},
        {"coasted_s": 0.01},
        {"vehicle_time_ms": 890},
        {"sd": {SENSOR: 0.6}},
        {"sd": {SENSOR: None}},
        {"fault": {SENSOR: None}},
    ],
)
def test_a_doubtful_estimate_is_let_go_of(doubt: dict[str, Any]) -> None:
    sure = {"vehicle_time_ms": 1000, "armed": True, "coasted_s": 0.0, "fault": {SENSOR: 2.0}, "sd": {SENSOR: 0.1}}
    guard = Compensation(SENSOR, Limits(size=3.0, rate=1000.0, sd=0.5))
    assert guard.update(sure, 1.0, 0.01) == 2.0
    assert guard.update(sure | doubt, 1.0, 0.01) == 0.0


class Lines(threading.Thread):
    """Lines of another process, as they come."""

    def __init__(self, command: list[str]) -> None:
        super().__init__(daemon=True)
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=ENVIRONMENT)
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        self.start()

    def run(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._lines.put(line.strip())

    def close(self) -> None:
        self.process.kill()
        self.process.wait(10)
        self.join()
        assert self.process.stdout is not None
        self.process.stdout.close()

    def next(self) -> str:
        return self._lines.get(timeout=30)


@pytest.fixture
def subscriber_of() -> Iterator[Any]:
    started: list[Lines] = []

    def start(address: str) -> Lines:
        started.append(Lines([sys.executable, str(EXAMPLES / "subscribe.py"), "--connect", address]))
        return started[-1]

    yield start
    for lines in started:
        lines.close()


def test_a_plain_subscriber_gets_what_stands_then_what_changes_and_comes_back(subscriber_of: Any) -> None:
    endpoint = Endpoint()
    publisher = Publisher(endpoint.session, "copter-1", [])
    publisher.event(event(1, "motor1"))
    lines = subscriber_of(endpoint.address)
    assert lines.next() == "copter-1: monitor is there, alarms that stand: 1"
    assert lines.next() == "copter-1: raised warning motor1: motor1 delivers less"
    publisher.event(event(2, "motor2", message="motor2 too"))
    assert lines.next() == "copter-1: raised warning motor2: motor2 too"
    endpoint.close()
    assert lines.next() == "copter-1: monitor is gone"
    again = Endpoint(endpoint.address)
    publisher = Publisher(again.session, "copter-1", [])
    assert lines.next() == "copter-1: monitor is there, alarms that stand: 0"
    until(lambda: bool(list(again.session.info.peers_zid())))
    publisher.event(event(3, "motor1", state="cleared", message="motor1 is back to normal"))
    assert lines.next() == "copter-1: cleared warning motor1: motor1 is back to normal"
    again.close()


def test_the_plain_subscriber_needs_nothing_but_zenoh() -> None:
    tree = ast.parse((EXAMPLES / "subscribe.py").read_text())
    named = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    named |= {name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names}
    assert {str(name).partition(".")[0] for name in named} - set(sys.stdlib_module_names) == {"zenoh"}


def test_the_motors_faults_can_be_estimated_and_its_gains_designed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, gains = str(EXAMPLES / "plants" / "dc-motor.toml"), tmp_path / "gains.json"
    assert fauio.main(["check", model]) == 0
    assert fauio.main(["design", model, "--rate", "200", "-o", str(gains)]) == 0
    assert "certificate         holds" in capsys.readouterr().out
    assert gains.exists()


def test_the_cart_is_refused_until_it_has_the_sensor_that_its_comment_names(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (EXAMPLES / "plants" / "cart.toml").read_text()
    assert fauio.main(["check", str(EXAMPLES / "plants" / "cart.toml")]) == 3
    assert "one more sensor, of position" in capsys.readouterr().out
    wanted, line = 'outputs = ["encoder", "laser"]', "laser = { position = 1.0 }"
    assert wanted in text
    assert line in text
    mended = tmp_path / "cart.toml"
    mended.write_text(text.replace('\noutputs = ["encoder"]', f"\n{wanted}").replace("\n[C]\n", f"\n[C]\n{line}\n"))
    assert fauio.main(["check", str(mended)]) == 0
    assert "seen late     motor" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("fault", "channel", "within_s"), [("none", None, 0.0), ("drive", "drive", 3.5), ("gps", "gps_north", 1.5)]
)
def test_a_bag_of_ros_2_topics_replays_to_the_alarm_of_its_fault(
    fault: str, channel: str | None, within_s: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = tmp_path / f"{fault}.mcap"
    assert simulate.write_bag(bag, 15.0, fault) == 15 * 210
    assert fauio.main(["replay", str(CART), str(bag), "--json"]) == 0
    alarms = json.loads(capsys.readouterr().out)["alarms"]
    raised = [one for one in alarms if one["state"] == "raised"]
    assert [one["channel"] for one in raised] == ([channel] if channel else [])
    for one in raised:
        onset_ns = simulate.START_NS + simulate.FAULT_S[0] * 1e9
        assert 0.0 < one["time_ns"] - onset_ns < within_s * 1e9


@pytest.mark.long
def test_cdr_on_the_keys_of_rmw_zenoh_raises_the_same_alarm_live() -> None:
    endpoint = Endpoint()
    pipeline = Pipeline(read_profile(CART), "cart")
    with ZenohLink(endpoint.session, "0/**") as link:
        sender = threading.Thread(target=simulate.publish, args=(endpoint.address, 12.0, "gps", 10.0))
        sender.start()
        raised: list[AlarmEvent] = []
        while not raised and (sender.is_alive() or link.statistics().messages < 12 * 210):
            raised += [one for one in pipeline.run(link.receive(0.1)) if isinstance(one, AlarmEvent)]
        sender.join()
        assert (link.statistics().malformed, link.statistics().undefined) == (0, 0)
    endpoint.close()
    assert [(one.channel, one.state) for one in raised[:1]] == [("gps_north", "raised")]


def test_the_readme_names_every_example() -> None:
    text = (EXAMPLES / "README.md").read_text()
    files = [path for path in EXAMPLES.iterdir() if path.name != "README.md" and not path.name.startswith((".", "__"))]
    assert [path.name for path in files if path.name not in text] == []
