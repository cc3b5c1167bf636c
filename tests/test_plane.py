"""Recorded flights of a plane: fitted on a healthy one, the monitor names the aileron that lost a fifth, and its end.

The fault's times and size are those that the simulator injected; see tests/data/README.md.
"""

import contextlib
import io
import json
from pathlib import Path

import numpy as np
import pytest

import fauio
from adapters.logs.recordings import read_batches
from adapters.sample import Samples
from monitor.estimation.changes import ChangeRun, ChangeStage
from monitor.profile import Profile, read_profile
from replay.player import play_batches

ONSET_S, END_S = 91.199, 141.199


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory, data: Path) -> tuple[Path, str]:
    """Fit a profile with the command a user types; return its folder and what the command said."""
    folder = tmp_path_factory.mktemp("fit") / "plane"
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        assert fauio.main(["fit", "--vehicle", "plane", str(data / "plane_healthy.tlog.xz"), "-o", str(folder)]) == 0
    return folder, said.getvalue()


@pytest.fixture(scope="module")
def profile(fitted: tuple[Path, str]) -> Profile:
    return read_profile(fitted[0])


def test_the_aileron_and_only_it_is_named_soon_after_it_weakens(profile: Profile, data: Path) -> None:
    found = play_batches(profile, read_batches(data / "plane_aileron_080.tlog.xz"), keep_traces=True)
    assert {event.channel for event in found.events} == {"aileron"}
    raised = [event for event in found.events if event.state == "raised"]
    assert len(raised) == 1
    assert 0.0 < raised[0].vehicle_time_ms / 1000 - ONSET_S < 0.2
    assert raised[0].message.endswith(" of full deflection off its command")
    trace = found.traces[0]
    during = trace.vehicle_ns / 1e9 > ONSET_S + 1.0
    missing = trace.isolated[during, trace.layout.faults.index("aileron")]
    assert np.median(missing) == pytest.approx(-0.25, abs=0.05)


def cruise(profile: Profile, off: float, jump: float) -> ChangeRun:
    """Return what the test of sudden changes says of 4 s straight on; from 3 s on the aileron is off, or gyro x."""
    observer, rng = profile.observers[0], np.random.default_rng(1)
    plant, count = observer.model, round(4.0 * observer.rate_hz)
    assert plant is not None and observer.changes is not None
    u, y = np.zeros((count, len(plant.inputs))), np.zeros((count, len(plant.outputs)))
    u[:, plant.inputs.index("pressure")] = 1.0
    aileron, onset = plant.faults[0].column, round(3.0 * observer.rate_hz)
    x = np.linalg.solve(np.eye(len(y[0])) - plant.A, plant.B @ u[0] + plant.c)
    for k in range(count):
        y[k] = x
        x = plant.A @ x + plant.B @ u[k] + plant.c + 1e-4 * rng.normal(size=len(x))
        x += aileron * (off if k >= onset else 0.0)
    y[onset:, plant.outputs.index("roll_rate")] += jump
    times = np.arange(count, dtype=np.int64) * round(1e9 / observer.rate_hz)
    always, first = np.ones(count, np.bool_), np.arange(count) == 0
    nothing = np.zeros((count, u.shape[1] + y.shape[1]), np.bool_)
    samples = Samples(np.arange(count), times, times, u, y, first, always, times, always, nothing)
    inputs = {channel.name: channel.input for channel in observer.faults}
    stage = ChangeStage(plant, observer.rate_hz, inputs, observer.changes)
    return stage.run(samples, times >= 10**9, np.zeros((count, len(inputs))))


@pytest.mark.parametrize("off", [-0.2, -0.05, 0.1])
def test_a_surface_that_is_off_to_either_side_is_named_within_three_samples(profile: Profile, off: float) -> None:
    run, rule = cruise(profile, off, 0.0), profile.observers[0].alarms[0]
    rows = np.flatnonzero((run.nats >= rule.nats) & (np.abs(run.size) >= rule.least))
    assert 151 <= rows[0] <= 153
    assert set(run.named[rows].tolist()) == {0}
    assert (np.abs(run.size[rows] - off) < 3.0 * run.sd[rows]).all()
    np.testing.assert_allclose(run.size[rows[-1]], off, rtol=0.05)


def test_a_gyro_that_jumps_is_no_surface(profile: Profile) -> None:
    assert not (cruise(profile, 0.0, 0.3).nats >= profile.observers[0].alarms[0].nats).any()


def test_its_end_clears_the_alarm(profile: Profile, data: Path) -> None:
    found = play_batches(profile, read_batches(data / "plane_aileron_080_end.tlog.xz")).events
    assert [event.state for event in found if event.state != "updated"] == ["raised", "cleared"]
    assert 0.0 < found[-1].vehicle_time_ms / 1000 - END_S < 5.0


def test_healthy_flight_raises_no_alarm(profile: Profile, data: Path) -> None:
    found = play_batches(profile, read_batches(data / "plane_healthy.tlog.xz"))
    assert found.events == ()
    assert found.evidence > 1000


def test_a_surface_that_could_not_be_learned_is_not_watched_and_said_to_be(
    fitted: tuple[Path, str], profile: Profile
) -> None:
    folder, said = fitted
    assert "note: rudder is not watched: " in said
    assert "yaw left and right with the rudder alone" in said
    assert [rule.channel for rule in profile.observers[0].alarms] == ["aileron", "elevator", "throttle"]
    report = json.loads((folder / "fit.json").read_text())["observers"]["surfaces"]
    assert list(report["advice"]) == ["rudder"]


def test_the_profile_scales_surfaces_with_the_speed_of_these_flights(profile: Profile) -> None:
    observer = profile.observers[0]
    transform = observer.source.transform
    assert transform is not None
    assert (transform.kind, transform.rate_hz, observer.rate_hz) == ("surfaces", 100.0, 50.0)
    assert transform.parameters["reference_speed"] == pytest.approx(22.0, abs=1.0)
    assert transform.parameters["minimum_speed"] == pytest.approx(transform.parameters["reference_speed"] / 2)
    assert {name: rule.full for name, rule in observer.effectiveness.items()} == {
        "aileron": "pressure",
        "elevator": "pressure",
        "throttle": None,
    }


def test_a_flight_without_airspeed_is_refused_with_what_to_record(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = str(data / "copter_wind_step.tlog.xz")
    assert fauio.main(["fit", "--vehicle", "plane", log, "-o", str(tmp_path / "p"), "--force"]) == 2
    said = capsys.readouterr().err
    assert "VFR_HUD" in said
    assert said.count("\n") == 1


def test_the_fit_shows_what_it_is_worth_on_data_kept_back(fitted: tuple[Path, str]) -> None:
    folder, _ = fitted
    assert "on data kept back:" in (folder / "fit.txt").read_text()
    assert (folder / "fit.png").read_bytes().startswith(b"\x89PNG")
