"""A profile learns further flights without the recordings of the first ones, and keeps what people edited."""

from __future__ import annotations

import contextlib
import io
import json
import re
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

import fauio
from adapters.batch import messages, pack
from adapters.errors import ProfileError
from adapters.logs.recordings import read_batches
from adapters.message import Message
from adapters.source import DATAFLASH, MAVLINK, ZENOH
from monitor.fitting.kept_flights import Extent, read_kept, with_edits, write_kept
from monitor.profile import read_profile

LOGS = "rover_healthy_manual.tlog.xz", "rover_healthy.tlog.xz"


def fitted(folder: Path, *arguments: str | Path) -> int:
    return fauio.main(["fit", *map(str, arguments), "-o", str(folder)])


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory, data: Path) -> Path:
    folder, said = tmp_path_factory.mktemp("update") / "rover", io.StringIO()
    with contextlib.redirect_stderr(said):
        assert fitted(folder, "--vehicle", "inertial", data / LOGS[0]) == 0
    (folder.parent / "said").write_text(said.getvalue())
    return folder


@pytest.fixture
def profile(first: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(first, tmp_path / "rover"))


def edit(folder: Path, pattern: str, text: str) -> None:
    path = folder / "profile.toml"
    changed, count = re.subn(pattern, text, path.read_text(), count=1, flags=re.MULTILINE)
    assert count == 1
    path.write_text(changed)


def test_an_update_is_the_fit_of_all_flights_in_any_order(profile: Path, data: Path, tmp_path: Path) -> None:
    assert fauio.main(["fit", "--update", str(profile), str(data / LOGS[1])]) == 0
    both = tmp_path / "both" / "rover"
    assert fitted(both, "--vehicle", "inertial", *(data / name for name in reversed(LOGS))) == 0  # in any order
    for path in both.iterdir():
        if path.suffix in (".toml", ".txt"):
            assert (profile / path.name).read_text() == path.read_text()
        elif path.suffix == ".json":
            updated, whole = (json.loads((where / path.name).read_text()) for where in (profile, both))
            # how long the design took
            for one in (updated, whole):
                one.get("report", {}).pop("total_s", None), one.get("report", {}).pop("solve_s", None)
                one.pop("set_aside", None)
            assert updated == whole
    assert [one.name for one in read_kept(profile).flights] == list(LOGS)


def test_edits_of_people_stay_and_are_named(profile: Path, data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    edit(profile, r"^threshold = .*", "threshold = 5.0")
    edit(profile, r"^stale_s = .*", "stale_s = 7.5")
    assert fauio.main(["fit", "--update", str(profile), str(data / LOGS[1])]) == 0
    said = capsys.readouterr().err
    found = read_profile(profile)
    channel = found.observers[0].alarms[0].channel
    assert (found.stale_s, found.observers[0].alarms[0].threshold) == (7.5, 5.0)
    assert f"is written anew but for stale_s, observers.inertial.alarms.{channel}.threshold; what" in said
    # and are known as edits the next time
    assert read_kept(profile).written["stale_s"] == 2.0


def test_an_updated_profile_may_go_elsewhere_and_can_be_updated_there(
    profile: Path, data: Path, tmp_path: Path
) -> None:
    other = tmp_path / "other"
    before = {path: path.read_bytes() for path in profile.rglob("*") if path.is_file()}
    assert fitted(other, "--update", profile, data / LOGS[1]) == 0
    assert {path: path.read_bytes() for path in profile.rglob("*") if path.is_file()} == before
    assert len(read_kept(other).flights) == 2
    assert read_profile(other).name == read_profile(profile).name


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ((LOGS[0],), f"{LOGS[0]}: is fitted already, as {LOGS[0]}; leave it out"),
        (("--vehicle", "rover", LOGS[1]), "--vehicle rover: {profile} is the profile of kind inertial"),
        (("plane_healthy.tlog.xz",), f"says it is a fixed wing, {LOGS[0]} that it is a ground rover"),
    ],
)
def test_what_cannot_be_added_is_refused_and_leaves_the_profile_as_it_is(
    profile: Path, data: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], says: str
) -> None:
    before = {path: path.read_bytes() for path in profile.rglob("*") if path.is_file()}
    given = [str(data / one) if one.endswith(".xz") else one for one in arguments]
    assert fauio.main(["fit", "--update", str(profile), *given]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert says.format(profile=profile) in line
    assert {path: path.read_bytes() for path in profile.rglob("*") if path.is_file()} == before


def test_a_profile_that_keeps_no_flights_is_not_updated(
    profile: Path, data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.rmtree(profile / "flights")
    assert fauio.main(["fit", "--update", str(profile), str(data / LOGS[1])]) == 2
    assert "keeps no flights of its fit; fit it anew to all its logs" in capsys.readouterr().err


@pytest.mark.parametrize("damage", [b"", b"PK\x03\x04 no archive", b"\x80\x04."])
def test_a_damaged_flight_is_named(
    profile: Path, data: Path, capsys: pytest.CaptureFixture[str], damage: bytes
) -> None:
    path = profile / "flights" / "0001.npz"
    path.write_bytes(damage)
    assert fauio.main(["fit", "--update", str(profile), str(data / LOGS[1])]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert f"{path}: was damaged or changed after the fit; fit the profile anew to all its logs" in line


# in the middle of the flight's span "e" makes a number of more than a float holds
@example(cut=161, byte=ord("e"))
@given(cut=st.integers(0, 400), byte=st.integers(0, 255))
def test_a_list_of_flights_that_is_damaged_is_one_line_or_none(first: Path, cut: int, byte: int) -> None:
    path = first / "flights" / "fit.json"
    whole = path.read_bytes()
    try:
        path.write_bytes(whole[:cut] + bytes([byte]) + whole[cut + 1 :])
        for flight in read_kept(first).flights:
            list(flight.batches(first))
    except ProfileError as error:
        assert "\n" not in str(error)
    finally:
        path.write_bytes(whole)


def test_a_flight_that_is_given_twice_is_refused(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = str(data / LOGS[0])
    assert fitted(tmp_path / "p", "--vehicle", "inertial", log, log) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert f"{LOGS[0]}: is fitted already, as {LOGS[0]}; leave it out" in line


def test_a_kept_flight_is_the_flight(first: Path, data: Path) -> None:
    [flight] = read_kept(first).flights
    kept = [message for batch in flight.batches(first) for message in messages(batch)]
    names = {message.name for message in kept}
    assert {"ATTITUDE", "HIGHRES_IMU", "HEARTBEAT"} <= names
    whole = [
        message
        for batch in read_batches(data / LOGS[0])
        for message in messages(batch)
        if message.name in names and message.system == 1
    ]
    assert kept == whole[len(whole) - len(kept) :]


FIELDS = st.dictionaries(
    st.sampled_from("abc"), st.integers(0, 9) | st.text(max_size=3) | st.lists(st.floats()), max_size=3
)


@given(
    held=st.lists(
        st.builds(
            lambda source, name, at, fields: Message(source, name, at, fields, 1 if source is MAVLINK else 0),
            st.sampled_from([MAVLINK, DATAFLASH, ZENOH]),
            st.sampled_from(["X", "Y/z"]),
            st.integers(0, 1 << 60),
            FIELDS,
        ),
        max_size=12,
    )
)
def test_whatever_a_flight_holds_is_kept(tmp_path_factory: pytest.TempPathFactory, held: list[Message]) -> None:
    folder = tmp_path_factory.mktemp("kept")
    write_kept(folder, {"name": "a"}, None, (), [("flight", Extent(0, 1, 2), lambda: [pack(held)])], {"X", "Y/z"})
    [flight] = read_kept(folder).flights
    found = [message for batch in flight.batches(folder) for message in messages(batch)]
    assert repr(found) == repr(held)
    with np.load(folder / "flights" / flight.file, allow_pickle=False) as arrays:
        assert all(arrays[name].dtype.kind != "O" for name in arrays.files)


def test_the_oldest_flights_go_where_there_is_no_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    message = Message(MAVLINK, "X", 0, {"a": 1}, 1, 1)
    for number in range(5):
        known = read_kept(tmp_path).flights if number else ()
        if number == 3:
            monkeypatch.setattr("monitor.fitting.kept_flights._MOST_BYTES", 2 * known[0].flight_bytes + 100)
        out = write_kept(
            tmp_path, {}, None, known, [(f"f{number}", Extent(number, 1, 1), lambda: [pack([message])])], {"X"}
        )
        assert out == {3: ("f0", "f1"), 4: ("f2",)}.get(number, ())
    assert [one.name for one in read_kept(tmp_path).flights] == ["f3", "f4"]
    assert sorted(path.name for path in (tmp_path / "flights").glob("*.npz")) == ["0004.npz", "0005.npz"]


def test_a_list_of_flights_of_another_version_is_refused(profile: Path) -> None:
    path = profile / "flights" / "fit.json"
    path.write_text(path.read_text().replace('"format": 1', '"format": 2'))
    with pytest.raises(ProfileError, match="'format' is not 1"):
        read_kept(profile)


def test_edits_are_merged_key_by_key() -> None:
    written = {
        "a": 1,
        "alarms": {"x": {"threshold": 1.0, "clear": 0.5}, "y": {"threshold": 2.0}},
        "isolation": {"s": 1},
    }
    edited = {
        "a": 1,
        "b": True,
        "alarms": {"x": {"threshold": 0.3, "clear": 0.5, "latch_s": 9.0}},
        "isolation": {"s": 5},
    }
    new = {"a": 2, "alarms": {"x": {"threshold": 1.5, "clear": 0.75}, "y": {"threshold": 2.5}}, "isolation": {"s": 3}}
    found, edits = with_edits(new, written, edited)
    assert found == {
        "a": 2,
        "b": True,
        "alarms": {"x": {"threshold": 0.3, "clear": 0.15, "latch_s": 9.0}},
        "isolation": {"s": 3},
    }
    assert edits == ["alarms.x.threshold", "alarms.x.latch_s", "alarms.y", "b"]


def test_only_a_part_of_each_log_is_fitted(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = data / LOGS[0]
    arguments = ["--vehicle", "inertial", "--start", "4", "--end", "44", log]
    assert fitted(tmp_path / "part", *arguments) == 0
    span = read_kept(tmp_path / "part").flights[0].span
    first_ns = min(int(c.received_ns[0]) for batch in read_batches(log) for c in batch.columns)
    assert span.last_ns - first_ns == pytest.approx(44e9, abs=1e8)
    report = json.loads((tmp_path / "part" / "fit.json").read_text())
    assert report["observers"]["inertial"]["flight_s"] == pytest.approx(34.0, abs=7.0)
    capsys.readouterr()
    assert fitted(tmp_path / "none", "--vehicle", "inertial", "--start", "5000", log) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert re.search(r"lasts \d+ s and holds nothing from --start 5000 s on$", line)


def test_the_rate_may_be_asked_for_up_to_that_of_the_messages(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert fitted(tmp_path / "slow", "--vehicle", "inertial", "--rate", "10", data / LOGS[0]) == 0
    assert read_profile(tmp_path / "slow").observers[0].rate_hz == pytest.approx(10.0)
    assert read_kept(tmp_path / "slow").rate_hz == 10.0
    capsys.readouterr()
    assert fitted(tmp_path / "fast", "--vehicle", "inertial", "--rate", "400", data / LOGS[0]) == 2
    assert "--rate 400: the recordings allow " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["LOG"], "--vehicle is missing: one of multirotor, plane, rover, inertial, custom"),
        (["--vehicle", "rover", "LOG"], "-o PROFILE is missing: the folder to write"),
        (["--vehicle", "rover", "LOG", "-o", "x", "--start", "9", "--end", "3"], "--start and --end are seconds"),
        (["--vehicle", "rover", "LOG", "-o", "x", "--start", "-1"], "--start and --end are seconds"),
        (["--vehicle", "rover", "LOG", "-o", "x", "--rate", "0"], "--rate 0: has to be above 0"),
    ],
)
def test_options_that_make_no_sense_are_refused_in_a_line(
    data: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], says: str
) -> None:
    assert fauio.main(["fit", *(str(data / LOGS[0]) if one == "LOG" else one for one in arguments)]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith(f"fauio: {says}")


def test_a_pipe_gets_a_line_for_each_stage(first: Path, data: Path) -> None:
    said = [re.sub(r"\d+ s", "N s", line) for line in (first.parent / "said").read_text().splitlines()]
    assert said[:3] == [
        f"fauio: N s: read {data / LOGS[0]} (1 of 1)",
        "fauio: N s: identified, designed and calibrated inertial",
        "fauio: N s: measured what will be detected",
    ]


def test_the_library_updates_too(profile: Path, data: Path) -> None:
    report = fauio.fit("inertial", [data / LOGS[1]], profile, update=True, end_s=90.0)
    assert [fitted.name for fitted in report.observers] == ["inertial"]
    assert len(read_kept(profile).flights) == 2
    assert tomllib.loads((profile / "profile.toml").read_text())["name"] == "rover"
