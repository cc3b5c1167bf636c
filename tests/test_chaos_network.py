"""What networks and attackers do, five vehicles at once on one port: the failing motor is found and nothing lost."""

from pathlib import Path

import jsonschema
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

from monitor.bus.schemas import SCHEMAS

STOP_S = 15.0
SYSTEMS = {"none": 1, "loss": 2, "duplicates": 3, "own numbers": 4, "silence": 6}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    sufferers = [Sufferer(system, MOTOR1, what, STOP_S) for what, system in SYSTEMS.items()]
    return suffer(tmp_path_factory.mktemp("network"), sufferers)


def test_the_daemon_lives_and_ends_when_told(run: Run) -> None:
    assert run.exit_status == 0
    assert "Traceback" not in (run.monitor.folder / "daemon.log").read_text()


@pytest.mark.parametrize("system", SYSTEMS.values(), ids=SYSTEMS)
def test_the_failing_motor_is_found_and_nothing_else(run: Run, system: int) -> None:
    raised = run.monitor.raised(system)
    assert [event.channel for event in raised] == ["motor1"]
    assert raised[0].vehicle_time_ms >= MOTOR1_ONSET_MS
    assert raised[0].relative == pytest.approx(-0.05, abs=0.04)
    assert run.monitor.settled_size(raised[0]) == pytest.approx(-0.05, abs=0.02)


def test_only_silence_is_called_silence_while_it_lasts(run: Run) -> None:
    for what, system in SYSTEMS.items():
        own = [event for event in run.monitor.events if event.vehicle == name_of(system) and event.kind == "stale"]
        # every vehicle falls silent at the end
        assert [event.state for event in own] == ["raised", "cleared", "raised"][0 if what == "silence" else 2 :]


def test_statuses_are_as_published_and_say_what_was_lost(run: Run) -> None:
    for status in run.monitor.statuses.values():
        jsonschema.validate(status, SCHEMAS["status"])
    observers = {what: run.monitor.statuses[name_of(system)]["observers"] for what, system in SYSTEMS.items()}
    motors = {what: found["motors"] for what, found in observers.items()}
    assert motors["none"]["duplicates"] == motors["none"]["skipped"] == 0
    assert motors["duplicates"]["duplicates"] > 500
    assert motors["silence"]["restarts"] == 2
    assert motors["loss"]["incomplete"] > 500
    sent = {what: run.sent[system] for what, system in SYSTEMS.items()}
    taken = {what: run.monitor.statuses[name_of(system)]["messages"] for what, system in SYSTEMS.items()}
    lost = {what: run.monitor.statuses[name_of(system)]["lost"] for what, system in SYSTEMS.items()}
    assert lost["none"] == 0
    assert 0.25 < lost["loss"] / (lost["loss"] + sent["loss"]) < 0.35
    (link,) = run.monitor.statuses[name_of(SYSTEMS["none"])]["links"].values()
    assert link["losses"]["lost"] >= lost["loss"]
    # messages of the monitor's own come on top: rules at the start, time that passes in silence, a finding each second
    own = {what: 20 if what == "own numbers" else 5 for what in SYSTEMS}
    assert all(sent[what] <= taken[what] <= sent[what] + own[what] for what in SYSTEMS)


def test_only_who_bears_two_series_of_numbers_is_called_an_impostor(run: Run) -> None:
    found = [event for event in run.monitor.events if event.channel == "impostor" and event.state == "raised"]
    assert [event.vehicle for event in found] == [name_of(SYSTEMS["own numbers"])]


@pytest.mark.parametrize(
    "system",
    [
        pytest.param(system, id=what, marks=() if what in ("loss", "silence") else pytest.mark.long)
        for what, system in SYSTEMS.items()
    ],
)
def test_the_recording_replays_to_the_same_bits(run: Run, system: int, tmp_path: Path) -> None:
    assert_live_equals_replay(run, system, tmp_path)


def test_journal_and_recordings_hold_what_was_reported(run: Run) -> None:
    assert_nothing_reported_is_lost(run, list(SYSTEMS.values()))
