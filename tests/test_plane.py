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
from adapters.logs.recordings import read_recording
from monitor.profile import Profile, read_profile
from replay.player import play

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
    found = play(profile, read_recording(data / "plane_aileron_080.tlog.xz"), keep_traces=True)
    assert {event.channel for event in found.events} == {"aileron"}
    raised = [event for event in found.events if event.state == "raised"]
    assert len(raised) == 1
    assert 0.0 < raised[0].vehicle_time_ms / 1000 - ONSET_S < 1.0
    assert raised[0].message.startswith("aileron acts ")
    trace = found.traces[0]
    during = trace.vehicle_ns / 1e9 > ONSET_S + 1.0
    missing = trace.isolated[during, trace.layout.faults.index("aileron")]
    assert np.median(missing) == pytest.approx(-0.25, abs=0.05)


def test_its_end_clears_the_alarm(profile: Profile, data: Path) -> None:
    found = play(profile, read_recording(data / "plane_aileron_080_end.tlog.xz")).events
    assert [event.state for event in found if event.state != "updated"] == ["raised", "cleared"]
    assert 0.0 < found[-1].vehicle_time_ms / 1000 - END_S < 5.0


def test_healthy_flight_raises_no_alarm(profile: Profile, data: Path) -> None:
    found = play(profile, read_recording(data / "plane_healthy.tlog.xz"))
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
