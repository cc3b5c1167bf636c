"""What breaks and who attacks, five vehicles at once on one port: only the failing motor is found, nothing is lost."""

from pathlib import Path

import pytest
from chaos import Sufferer
from chaos_run import (
    MOTOR1,
    MOTOR1_ONSET_MS,
    Run,
    assert_live_equals_replay,
    assert_nothing_reported_is_lost,
    name_of,
    suffer,
)

STOP_S = 21.0
SYSTEMS = {"reboot": 12, "bits": 13, "noise": 14, "poison": 15, "forgery": 16}


pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    sufferers = [Sufferer(system, MOTOR1, what, STOP_S) for what, system in SYSTEMS.items()]
    return suffer(tmp_path_factory.mktemp("hostile"), sufferers)


def test_the_daemon_lives_and_ends_when_told(run: Run) -> None:
    assert run.exit_status == 0
    assert "Traceback" not in (run.monitor.folder / "daemon.log").read_text()


@pytest.mark.parametrize("system", SYSTEMS.values(), ids=SYSTEMS)
def test_the_failing_motor_is_found_and_nothing_else(run: Run, system: int) -> None:
    raised = run.monitor.raised(system)
    assert [event.channel for event in raised] == ["motor1"]
    assert raised[0].relative == pytest.approx(-0.05, abs=0.04)
    assert run.monitor.settled_size(raised[0]) == pytest.approx(-0.05, abs=0.02)
    onset_s = 0.5 + 8.59 - 5.0 if system == SYSTEMS["reboot"] else MOTOR1_ONSET_MS / 1e3
    assert raised[0].vehicle_time_ms / 1e3 >= onset_s


def test_the_forger_is_told_of_and_believed_in_nothing(run: Run) -> None:
    security = [event for event in run.monitor.events if event.kind == "security"]
    assert {event.vehicle for event in security} == {name_of(SYSTEMS["forgery"])}
    assert security[0].state == "raised"
    assert security[0].severity == "critical"


def test_statuses_say_what_was_lost(run: Run) -> None:
    observers = {what: run.monitor.statuses[name_of(system)]["observers"] for what, system in SYSTEMS.items()}
    motors = {what: found["motors"] for what, found in observers.items()}
    assert motors["reboot"]["clock_restarts"] == 1
    assert motors["poison"]["invalid"] > 50
    assert 0.03 < 1 - run.monitor.statuses[name_of(SYSTEMS["bits"])]["messages"] / run.sent[SYSTEMS["bits"]] < 0.07


@pytest.mark.parametrize("system", SYSTEMS.values(), ids=SYSTEMS)
def test_the_recording_replays_to_the_same_bits(run: Run, system: int, tmp_path: Path) -> None:
    assert_live_equals_replay(run, system, tmp_path)


def test_journal_and_recordings_hold_what_was_reported(run: Run) -> None:
    assert_nothing_reported_is_lost(run, list(SYSTEMS.values()))
