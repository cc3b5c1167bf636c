"""A fit over a profile that exists: nothing that a person edited is lost."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path

import pytest
from conftest import plain_fits

import fauio
from adapters.logs.recordings import packed, read_batches, read_recording
from monitor.profile import read_profile
from monitor.vehicles.kinds import fit_messages
from replay.fit import fit_profile, name_by_folder, replace_kept


@pytest.mark.long
def test_a_profile_that_is_fitted_again_is_kept_as_it_was_edited(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "rover"
    folder.mkdir()
    (folder / "profile.toml").write_text("# edited\n")
    log = data / "rover_healthy_manual.tlog.xz"
    assert fauio.main(["fit", "--vehicle", "rover", str(log), "-o", str(folder)]) == 0
    assert (folder / "profile.toml.before").read_text() == "# edited\n"
    said = f"{folder}/profile.toml is written anew; what stood there, edited or not, is {folder}/profile.toml.before"
    assert f"fauio: {said}\n" in capsys.readouterr().err
    assert read_profile(folder).name == "rover"


def test_a_profile_that_is_fitted_to_the_same_is_not_set_aside(tmp_path: Path) -> None:
    path = tmp_path / "profile.toml"
    assert replace_kept(path, "a = 1\n") is None
    assert replace_kept(path, "a = 1\n") is None
    assert replace_kept(path, "a = 2\n") == tmp_path / "profile.toml.before"
    assert [one.read_text() for one in sorted(tmp_path.iterdir())] == ["a = 2\n", "a = 1\n"]


@pytest.mark.long
def test_where_nothing_tells_what_the_motors_do_the_sensors_are_watched(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands = count()
    slow = [
        message
        for message in read_recording(data / "copter_healthy_vel_gusty.tlog.xz", fit_messages())
        if message.name != "SERVO_OUTPUT_RAW" or next(commands) % 50 == 0
    ]
    monkeypatch.setattr("monitor.vehicles.multirotor.fit.choose_frame", lambda *_: None)
    still = {"SERVO_OUTPUT_RAW": {f"servo{n}_raw": 1000 for n in range(1, 5)}}
    ground = [replace(m, fields={**m.fields, **still.get(m.name, {})}) for m in slow]
    # another flight, as it is later, and without motor commands
    silent = [replace(m, received_ns=m.received_ns + 10**9) for m in slow if m.name != "SERVO_OUTPUT_RAW"]
    logs = [lambda: packed(slow), lambda: packed(ground), lambda: packed(silent)]
    with plain_fits():
        report = fit_profile("multirotor", logs, tmp_path / "quad", "quad", log_names=("flight", "ground", "silent"))
    assert report.warnings[:2] == (
        "left out, as no motor or servo moves as in flight while armed: ground",
        "left out, as it lacks what the others hold: silent: no motor commands; record SERVO_OUTPUT_RAW at 50 Hz or "
        "more",
    )
    assert [one.name for one in read_profile(tmp_path / "quad").observers] == ["inertial"]
    (line,) = (line for line in report.text() if line.startswith("not fitted: "))
    assert line.startswith("not fitted: each motor, three gyros: which way its 4 motors turn the vehicle is not known")


def test_where_no_surface_can_be_learned_the_sensors_are_watched(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gains.identification.axes._EXCITED_T", 1e9)
    log = partial(read_batches, data / "plane_healthy.tlog.xz", fit_messages())
    with plain_fits():
        report = fit_profile("plane", [log], tmp_path / "plane", "plane")
    assert [one.name for one in read_profile(tmp_path / "plane").observers] == ["inertial"]
    (line,) = (line for line in report.text() if line.startswith("not fitted: "))
    assert line.startswith("not fitted: aileron, elevator, rudder, throttle, airspeed: no actuator can be learned: ")


@pytest.mark.parametrize(
    ("folder", "name"),
    [
        ("quad", "quad"),
        ("my quad.v2+x", "my-quad-v2-x"),
        ("2024_flight.ulg", "vehicle-2024_flight-ulg"),
        ("q" * 99, "q" * 64),
    ],
)
def test_a_vehicle_is_called_after_its_folder_as_far_as_a_name_can_be(folder: str, name: str, tmp_path: Path) -> None:
    assert name_by_folder(tmp_path / folder) == name
