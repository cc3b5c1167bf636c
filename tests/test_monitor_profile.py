"""Profiles read back as written; every mistake in one is one line that names file and key."""

import re
import shlex
import shutil
from itertools import combinations
from pathlib import Path

import pytest

import fauio
from adapters.errors import ProfileError
from monitor.estimation.isolation_rule import BankRule
from monitor.profile import read_profile, seen_sooner


@pytest.fixture
def folder(quad_folder: Path, tmp_path: Path) -> Path:
    copy = tmp_path / "quad"
    shutil.copytree(quad_folder, copy)
    return copy


def edit(path: Path, pattern: str, replacement: str) -> None:
    text = path.read_text()
    changed = re.sub(pattern, replacement, text, count=1, flags=re.MULTILINE)
    assert changed != text
    path.write_text(changed)


def test_a_profile_holds_what_the_fit_wrote(folder: Path) -> None:
    profile = read_profile(folder)
    observer, trim, inertial = profile.observers
    assert (trim.name, trim.rate_hz) == ("trim", 1.0)
    assert inertial.name == "inertial"
    assert inertial.source.transform is not None
    assert (profile.name, profile.vehicle, observer.name) == ("quad", "multirotor", "motors")
    assert [channel.name for channel in observer.source.inputs] == ["motor1", "motor2", "motor3", "motor4"]
    assert [rule.channel for rule in observer.alarms] == [*(channel.name for channel in observer.faults), "unexplained"]
    channels = ["motor1", "motor2", "motor3", "motor4", "gyro_x", "gyro_y", "gyro_z"]
    assert isinstance(observer.isolation, BankRule)
    # two opposite motors come last: only calm flight can show them
    opposite = (("motor1", "motor2"), ("motor3", "motor4"))
    pairs = (*(pair for pair in combinations(channels[:4], 2) if pair not in opposite), *opposite)
    assert observer.isolation.hypotheses == (*((channel,) for channel in channels), *pairs)
    names = [*channels, *("+".join(pair) for pair in pairs)]
    gains = [f"motors.{name}.gains.json" for name in names]
    motion, speed = "motion_north+motion_east", "gps_velocity_north+gps_velocity_east"
    culprits = (f"accel_z+{motion}", f"{motion}+baro", f"{motion}+gps_down", f"{speed}+baro")
    gains += [f"inertial.{name}.gains.json" for name in culprits]
    # commands once a second do not show a loss of two opposite motors
    apart = [*channels, *("+".join(pair) for pair in pairs if pair not in opposite)]
    gains += [f"trim.{name}.gains.json" for name in apart if "gyro" not in name]
    models = [f"{name}.model.toml" for name in ("motors", "trim", "inertial")]
    assert set(profile.files) == {"profile.toml", *models, *gains}


def test_the_digest_follows_every_edit(folder: Path) -> None:
    before = read_profile(folder).digest
    edit(folder / "profile.toml", r"^threshold = .*", "threshold = 0.5")
    profile = read_profile(folder)
    assert profile.digest != before
    assert profile.observers[0].alarms[0].threshold == 0.5


@pytest.mark.parametrize(
    ("pattern", "replacement", "complaint"),
    [
        (r"^format = 1", "format = 7", "'format' is not 1"),
        (r"^format = 1", "format = 1\ncolour = 3", "'colour' is not a key"),
        (r"^name = .*", 'name = "a/b"', "'name' is 'a/b'"),
        (r"^system = 0", 'system = "one"', "profile.toml:6: 'system' is \"one\", which is not a whole number"),
        (r"^settle_s = .*", "settle_s = -1.0", "'phase.settle_s' is -1"),
        (r"^require_armed = true", "require_armed = 1", "'phase.require_armed' is 1, which is not true or false"),
        (r"^threshold = .*", "threshold = nan", "threshold' is nan, which is not a finite number"),
        (r"^clear = .*", "clear = 9.0", "is above 'threshold'"),
        (r"^method = .*", 'method = "guess"', "is \"guess\"; it must be 'independent' or 'bank'"),
        (r"^message = .*", "message = 3", "message' is 3, which is not text in quotes"),
        (r"^edge = true", "edge = 1", "hypotheses[4].edge' is 1, which is not true or false"),
        (r"^score_floor = .*", "score_floor = -1.0", "score_floor' is -1"),
        (r'^faults = \["motor1"\]$', "faults = []", "an entry without 'faults'"),
        (r'^faults = \["motor1"\]$', 'faults = ["motor2"]', "the same faults twice"),
        (r"^slow = .*", "slow = -1.0", "slow' is -1; it must be at least"),
        (r"alarms\.motor1\]", "alarms.motor9]", "no such fault; the model has motor1"),
        (
            r"^(\[observers\.\w+\.fitted_hz\])",
            r"[observers.motors.lift]\nby = 'air'\n\1",
            "lift.by' is \"air\"; it must be 'rotors' or 'wings'",
        ),
        (r"^SERVO_OUTPUT_RAW = .*", "SERVO_OUTPUT_RAW = 0.0", "fitted_hz.SERVO_OUTPUT_RAW' is 0; it must be more than"),
        (r"^format = 1", "format = = 1", "not valid TOML"),
    ],
)
def test_a_mistake_is_named_with_file_and_key(folder: Path, pattern: str, replacement: str, complaint: str) -> None:
    edit(folder / "profile.toml", pattern, replacement)
    with pytest.raises(ValueError, match=re.escape(complaint)) as caught:
        read_profile(folder)
    assert "profile.toml" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert getattr(caught.value, "exit_status", None) == 2


def test_all_mistakes_are_told_at_once_each_with_its_line(folder: Path) -> None:
    path = folder / "profile.toml"
    for pattern, replacement in (
        (r"^stale_s = .*", 'stale_s = "long"'),
        (r"^require_armed = .*", "require_armed = 1"),
        (r"^threshold = .*", "treshold = 1"),
    ):
        edit(path, pattern, replacement)
    lines = path.read_text().splitlines()
    with pytest.raises(ProfileError) as caught:
        read_profile(folder)
    stale, armed, unknown, missing = str(caught.value).splitlines()
    number = lines.index('stale_s = "long"') + 1
    assert stale == f"{path}:{number}: 'stale_s' is \"long\", which is not a number; write it as one"
    assert armed.startswith(f"{path}:{lines.index('require_armed = 1') + 1}: 'phase.require_armed' is 1")
    assert {unknown.split(" ", 1)[1], missing.split(" ", 1)[1]} == {
        "'observers.motors.alarms.motor1.treshold' is not a key of this table; did you mean 'threshold'?",
        "'observers.motors.alarms.motor1.threshold' is missing",
    }


def test_gains_of_another_model_are_refused_with_the_command_that_mends_it(folder: Path) -> None:
    edit(folder / "motors.model.toml", r"^rate_hz = .*", "rate_hz = 50.0")
    with pytest.raises(ProfileError, match=r"another version of motors.model.toml; run 'fauio design "):
        read_profile(folder)


def test_designing_the_edited_model_again_mends_the_profile(folder: Path) -> None:
    each = read_profile(folder).observers[1].gains
    edit(folder / "trim.model.toml", r"^name = .*", 'name = "quad-b"')
    for _ in each:
        with pytest.raises(ProfileError, match="run 'fauio design") as caught:
            read_profile(folder)
        command = str(caught.value).split("'fauio ")[1].rstrip("'")
        assert fauio.main(shlex.split(command)) == 0
    assert read_profile(folder).observers[1].gains[0].model == "quad-b"


def test_a_missing_file_is_named(folder: Path) -> None:
    (folder / "motors.motor2.gains.json").unlink()
    with pytest.raises(ProfileError, match=r"motors\.motor2\.gains\.json: file is missing"):
        read_profile(folder)
    with pytest.raises(ProfileError, match=r"has no profile\.toml; name the profile folder"):
        read_profile(folder.parent)


def test_an_observer_is_sooner_where_it_watches_all_faults_of_a_later_one() -> None:
    faults = {"motors": ("motor1", "motor2", "gyro_x"), "trim": ("motor1", "motor2"), "inertial": ("gyro_x", "baro")}
    assert seen_sooner(faults) == {"motors": [], "trim": ["motors"], "inertial": []}
