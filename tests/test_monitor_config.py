"""The daemon's configuration: everything that is wrong with a file at once, each with its line and its mend."""

from __future__ import annotations

import re
import tomllib
from dataclasses import FrozenInstanceError
from pathlib import Path
from typing import Any

import pytest
from config_page import config_page
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from adapters.errors import ConfigError
from monitor.configuration.config import Config, NewVehicles, Vehicle, entries, read_config
from monitor.profile import Profile

ROOT = Path(__file__).parent.parent
MAVLINK = 'mavlink = "udpin:127.0.0.1:14550"\n'
FINE = f'{MAVLINK}profile = "."\n'


def complaints(tmp_path: Path, text: str, **given: Any) -> list[str]:
    """Return the lines of the error, without the name of the file."""
    path = tmp_path / "run.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        read_config(path, given)
    return str(caught.value).replace(f"{path}:", "").splitlines()


def read(tmp_path: Path, text: str, **given: Any) -> Config:
    path = tmp_path / "run.toml"
    path.write_text(text)
    return read_config(path, given)


def test_flat_keys_override_the_defaults_one_by_one(tmp_path: Path) -> None:
    text = (
        FINE + 'zenoh = "arm/telemetry"\nvehicle = "copter-1"\nlisten = []\nrecord = "a.mcap"\nestimate_rate_hz = 5\n'
    )
    found = read(tmp_path, text)
    assert found == Config(
        mavlink=("udpin:127.0.0.1:14550",),
        zenoh=("arm/telemetry",),
        profile=tmp_path,
        vehicle=(Vehicle(name="copter-1"),),
        listen=(),
        record=tmp_path / "a.mcap",
        estimate_rate_hz=5.0,
    )
    assert found.vehicles == (Vehicle(name="copter-1", profile=tmp_path),)


def test_the_command_line_overrides_the_file_and_needs_none(tmp_path: Path) -> None:
    found = read(tmp_path, FINE + 'prefix = "a"\n', prefix="b/c", mavlink=(), zenoh="x/**", profile=Path())
    assert (found.prefix, found.mavlink, found.zenoh, found.profile) == ("b/c", (), ("x/**",), Path())
    assert read_config(None, {"mavlink": "tcp:host:5760", "profile": tmp_path}).vehicles == (Vehicle(profile=tmp_path),)


def test_keys_of_a_table_from_the_command_line_leave_its_others(tmp_path: Path) -> None:
    found = read(tmp_path, FINE + '[rerun]\nmode = "serve"\nmemory_mb = 64\n', rerun={"port": 9900})
    assert (found.rerun.mode, found.rerun.port, found.rerun.memory_mb) == ("serve", 9900, 64)
    with pytest.raises(ConfigError, match=r"command line: 'rerun\.port' is 0"):
        read(tmp_path, FINE, rerun={"port": 0})


def test_all_mistakes_are_told_at_once_in_the_order_of_the_file(tmp_path: Path) -> None:
    text = """\
mavlnk = "udpin:127.0.0.1:14550"
estimate_rate_hz = -1
connect = ["tcp/192.168.1.2:7447", 4, "nonsense"]
log_format = "yaml"
[[vehicle]]
profile = "nowhere"
system = 300
[[vehicle]]
name = "a"
profile = "."
system = 7
[[vehicle]]
name = "a"
profile = "."
system = 7
component = 0
[recording]
file_mb = 100
budget_mb = 10
inbox = 3
[send.rates]
ATTITUD = 10
HEARTBEAT = "fast"
"""
    assert complaints(tmp_path, text) == [
        "1: 'mavlnk' is not a key of this table; did you mean 'mavlink'?",
        "2: 'estimate_rate_hz' is -1; it must be at least 0",
        "3: 'connect[1]' is 4, which is not text in quotes; write it as one",
        "3: 'connect[2]' is 'nonsense', which is no Zenoh endpoint; write it like tcp/127.0.0.1:7447",
        "4: 'log_format' is \"yaml\"; it must be 'auto', 'json' or 'text'",
        f"6: 'vehicle[0].profile' is {tmp_path}/nowhere: no such folder; name the one that 'fauio fit' made",
        "7: 'vehicle[0].system' is 300; it must be at most 255",
        "13: 'vehicle[2].name' is 'a', as is vehicle[1]'s; each needs a name of its own",
        "15: 'vehicle[2].system' is 7, as is vehicle[1]'s, so that both want system 7 (component 1); "
        "give each a system id of its own",
        "19: 'recording.budget_mb' is 10, less than two files of 100; it must be at least that",
        "20: 'recording.inbox' is not a key of this table, but one of the top level; move it above the first [table]",
        "22: 'send.rates.ATTITUD' is no MAVLink message; did you mean ATTITUDE?",
        "23: 'send.rates.HEARTBEAT' is \"fast\", which is not a number; write it as one",
    ]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("prefix = ", "1: not valid TOML at end of file: Invalid value"),
        ("a = 1\nb = \n", "2: not valid TOML at column 5: Invalid value"),
        ('a = """', "1: not valid TOML at end of file: Unterminated string"),
        ("speed = 1", "1: 'speed' is not a key of this table; known here: allow_public, batch_ms"),
        ("folder = 'x'", "1: 'folder' is not a key of this table; it belongs into [recording] or [black_box]"),
        ("listen = 3", "1: 'listen' is 3, which is not a list; write for example listen = [\"tcp/127.0.0.1:7447\"]"),
        ("inbox = true", "1: 'inbox' is true, which is not a whole number"),
        ("inbox = 1.5", "1: 'inbox' is 1.5, which is not a whole number"),
        ("estimate_rate_hz = nan", "1: 'estimate_rate_hz' is nan, which is not a finite number"),
        ("allow_public = 1", "1: 'allow_public' is 1, which is not true or false"),
        ("[vehicle]\nname = 'a'", "1: 'vehicle' is a single table; write [[vehicle]]"),
        ("vehicle = [3]", "1: 'vehicle[0]' is 3, which is not a table"),
        ("vehicle = 'a b'", "1: 'vehicle' is 'a b', which cannot be part of a Zenoh key"),
        ("send = 3", "1: 'send' is 3, which is not a table"),
        ("record = ''", "1: 'record' is no path; leave the key out for none"),
        ("mavlink = 'carrier-pigeon:1'", "1: 'mavlink' is 'carrier-pigeon:1', an unknown kind of link; use udpin:"),
        ("mavlink = 'udpin:127.0.0.1:99999'", "'udpin:127.0.0.1:99999', without HOST:PORT in it; use udpin:"),
        ("zenoh = 'a//b'", "1: 'zenoh' is 'a//b', which is no Zenoh key expression"),
        ("[zenoh_types]\n'a/b' = 'Imu?'", "2: 'zenoh_types.\"a/b\"' is 'Imu?', which is no type; write json or one"),
        ("[new_vehicles]\nname = 'copter'", "2: 'new_vehicles.name' is 'copter', which is the same for all"),
        ("[commands]\nallow = ['destroy']", "2: 'commands.allow[0]' is \"destroy\"; it must be 'ack', 'shelve'"),
        ("[[vehicle]]\nlatched = ['compass']", "2: 'vehicle[0].latched[0]' is 'compass', which is no channel"),
        ("[metrics]\nlisten = 'localhost'", "2: 'metrics.listen' is 'localhost', without HOST:PORT in it"),
    ],
)
def test_a_mistake_is_named_with_its_line_and_its_mend(tmp_path: Path, text: str, complaint: str) -> None:
    found = complaints(tmp_path, text)
    assert any(complaint in line for line in found), found


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("profile = '.'", "'mavlink' is missing: no telemetry to listen to; give --mavlink URL"),
        (MAVLINK, "'profile' is missing: no vehicle to monitor; name a profile folder"),
        (MAVLINK + "[[vehicle]]\nname = 'a'", "2: 'vehicle[0]' has no profile; name the folder"),
        (
            "profile = '.'\n[[vehicle]]\nzenoh = 'a/b'\n[[vehicle]]\nname = 'b'",
            "4: 'vehicle[1]' has no telemetry to listen to; give it 'zenoh', or set 'mavlink'",
        ),
        (FINE + "[[vehicle]]\nsystem = 1\n[[vehicle]]\nsystem = 2", "5: 'vehicle[1].name' is missing: the profile's"),
        (FINE + "[[vehicle]]\nname = 'a'\n[[vehicle]]\nname = 'b'", "'vehicle[1].system' is 0, as is vehicle[0]'s"),
        (
            FINE + "[[vehicle]]\nlatched = ['a/b']\nout_of_service = ['a/b']",
            "4: 'vehicle[0].latched' names a/b, which is out of service",
        ),
        (FINE + "listen = ['tcp/0.0.0.0:7447']", "3: 'listen[0]' is 'tcp/0.0.0.0:7447', which other machines reach"),
        (FINE + "listen = ['tls/[::]:1#a=b']", "3: 'listen[0]' is 'tls/[::]:1#a=b', which other machines reach"),
        (FINE + "[metrics]\nlisten = '10.0.0.1:9464'", "4: 'metrics.listen' is '10.0.0.1:9464', which other machines"),
        ("profile = '.'\nmavlink = 'udpin:0.0.0.0:1'", "2: 'mavlink' is 'udpin:0.0.0.0:1', which other machines"),
        ("profile = '.'\nmavlink = 'udpout:127.0.0.1:1'", "2: 'mavlink' is 'udpout:127.0.0.1:1', where nothing comes"),
        (FINE + "[signing]\nrequire = true", "4: 'signing.require' is true without a key; name it with key_file"),
        (
            FINE + "[standby]\nenabled = true",
            "4: 'standby.enabled' is true without a key, so that anybody on the network",
        ),
        (FINE + "[signing]\nkey_file = 'key'", "key: no such file; paths are relative to the configuration file"),
        (FINE + "[send.rates]\nATTITUDE = 1", "3: 'send.rates' are to be requested, but nothing may be sent"),
        (FINE + "[commands]\nmax_shelve_minutes = 5", "'commands.default_shelve_minutes' is 60; it must be at most"),
        (FINE + "record = 'a'\n[recording]\nfolder = 'b'", "3: 'record' is set beside 'recording.folder'"),
        (
            "profile = '.'\nzenoh = 'a/b'\n[new_vehicles]\nprofile = '.'",
            "4: 'new_vehicles.profile' is set, but vehicles are told apart by their MAVLink ids",
        ),
    ],
)
def test_what_contradicts_itself_is_named(tmp_path: Path, text: str, complaint: str) -> None:
    found = complaints(tmp_path, text)
    assert len(found) == 1
    assert complaint in found[0]


@pytest.mark.parametrize(
    "text",
    [
        FINE + "listen = ['tcp/localhost:7447', 'tcp/[::1]:7447', 'unixsock-stream//run/fauio']",
        FINE + "allow_public = true\nlisten = ['tcp/[::]:7447']",
        "profile = '.'\nmavlink = ['tcp:10.0.0.1:5760', 'serial:/dev/ttyUSB0:57600', 'tcpin:127.0.0.2:1']",
        FINE + "[[vehicle]]\nname = 'a'\nsystem = 1\n[[vehicle]]\nname = 'b'\nsystem = 1\ncomponent = 2",
        FINE + "[[vehicle]]\nname = 'a'\n[[vehicle]]\nname = 'b'\nzenoh = 'b/**'",
        MAVLINK + "[new_vehicles]\nprofile = '.'",
        FINE + "[metrics]\nlisten = 'off'",
    ],
)
def test_what_is_right_is_read(tmp_path: Path, text: str) -> None:
    assert isinstance(read(tmp_path, text), Config)


def test_a_wrong_value_is_not_judged_again_by_its_default(tmp_path: Path) -> None:
    text = FINE + "[[vehicle]]\nname = 'a'\nsystem = 300\n[[vehicle]]\nname = 'b'\nsystem = 0\n"
    assert complaints(tmp_path, text) == ["5: 'vehicle[0].system' is 300; it must be at most 255"]


def test_a_mistake_on_the_command_line_has_no_line(tmp_path: Path) -> None:
    text = FINE + "inbox = 0\n"
    assert complaints(tmp_path, text, mavlink="pigeon:1", profile=Path("/nowhere")) == [
        "command line: 'mavlink' is 'pigeon:1', an unknown kind of link; use udpin:HOST:PORT, udpout:HOST:PORT, "
        "tcp:HOST:PORT, tcpin:HOST:PORT or serial:DEVICE:BAUD",
        "command line: 'profile' is /nowhere: no such folder; name the one that 'fauio fit' made",
        "3: 'inbox' is 0; it must be at least 1",
    ]


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.toml: no such file"):
        read_config(tmp_path / "none.toml")
    (tmp_path / "latin.toml").write_bytes(b'prefix = "\xe4"')
    with pytest.raises(ConfigError, match=r"latin\.toml: not valid TOML: byte 10 is no UTF-8"):
        read_config(tmp_path / "latin.toml")
    (tmp_path / "deep.toml").write_text(f"a = {'[' * 10_000}")
    with pytest.raises(ConfigError, match=r"deep\.toml: not valid TOML"):
        read_config(tmp_path / "deep.toml")


def test_control_characters_of_a_file_do_not_reach_the_terminal(tmp_path: Path) -> None:
    assert all(line.isprintable() for line in complaints(tmp_path, FINE + '"a\\u001b[2J" = 1\nprefix = "\\u0007"\n'))


def test_a_configuration_does_not_change() -> None:
    with pytest.raises(FrozenInstanceError):
        Config().inbox = 1  # type: ignore[misc]


def test_new_vehicles_are_named_after_their_system() -> None:
    found = NewVehicles(profile=Path("quad"), name="copter-{system}").vehicle(7)
    assert found == Vehicle(name="copter-7", profile=Path("quad"), system=7)


def test_the_worked_example_is_right_and_shows_every_key(tmp_path: Path) -> None:
    text = (ROOT / "docs/config-example.toml").read_text()
    for folder in ("quad", "rover", "px4_msgs"):
        (tmp_path / folder).mkdir()
    for file in ("zenoh.json5", "signing.key", "standby.key", "notify.urls"):
        (tmp_path / file).touch()
    found = read(tmp_path, text)
    assert [vehicle.name for vehicle in found.vehicles] == ["copter-1", "copter-2", "rover"]
    assert found.send.rates == {"ATTITUDE": 100.0, "HIGHRES_IMU": 100.0, "SERVO_OUTPUT_RAW": 50.0}
    content = tomllib.loads(text)
    for name, (_, entry) in entries(Config).items():
        if entry.table is not None and name != "vehicle":
            assert content[name].keys() == entries(entry.table).keys()
    # the others exclude something that is shown
    assert entries(Config).keys() - content.keys() == {"zenoh", "record"}
    assert {key for vehicle in content["vehicle"] for key in vehicle} == entries(Vehicle).keys()


def test_the_reference_page_is_up_to_date() -> None:
    assert (ROOT / "docs/config.md").read_text() == config_page(), (
        "run python docs/hooks/config_page.py > docs/config.md"
    )


def test_every_key_has_a_description_and_an_example_that_is_right(tmp_path: Path) -> None:
    page = config_page()
    examples = re.findall(r"^\| `(\w+)` \|.* \| (.+?) \| `(.+)` \|$", page, re.MULTILINE)
    assert len(examples) == len(re.findall(r"^\| `", page, re.MULTILINE))
    for name, description, text in examples:
        assert description.endswith((".", "..."))
        assert tomllib.loads(text).keys() == {name}
    for part in page.split("\n## ")[1:]:
        header = re.match(r"`(\[.+\])`", part)
        keys = "\n".join(re.findall(r"`(\w+ = .+)` \|$", part, re.MULTILINE))
        path = tmp_path / "run.toml"
        path.write_text(f"{header[1] if header else ''}\n{keys}\n")
        with pytest.raises(ConfigError) as caught:
            read_config(path)
        # nothing but files and what belongs beside them is missing
        assert all(
            re.search(
                r"no such (file|folder)|is missing|other machines|MAVLink ids|without a key|to be requested", line
            )
            for line in str(caught.value).splitlines()
        ), str(caught.value)


VALUES = st.recursive(
    st.one_of(st.integers(), st.booleans(), st.text(max_size=5), st.floats()),
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.sampled_from(["name", "system", "x"]), inner),
    max_leaves=5,
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.dictionaries(st.sampled_from([*entries(Config), "unknown"]), VALUES, max_size=6))
def test_any_content_is_read_or_every_line_of_the_error_names_a_key(tmp_path: Path, content: dict[str, Any]) -> None:
    import tomli_w

    path = tmp_path / "run.toml"
    path.write_text(tomli_w.dumps(content))
    try:
        read_config(path)
    except ConfigError as error:
        assert all(re.match(rf"{path}(:\d+)?: '[^']+", line) for line in str(error).splitlines())


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a = " + "[" * 60 + "]" * 60, "nested more than 32 levels deep"),
        ("a" + ".a" * 1500 + " = 1", "nested more than 32 levels deep"),
        ("a = " + "[" * 5000, "not valid TOML: nested too deeply"),
        ("a = " + "9" * 5000, "not valid TOML: a number in it is too long"),
    ],
    ids=["lists", "tables", "too deep to parse", "number"],
)
def test_absurd_toml_is_refused_in_one_line(tmp_path: Path, text: str, said: str) -> None:
    (line,) = complaints(tmp_path, text)
    assert said in line


def test_channels_that_the_profile_does_not_have_are_told_with_those_it_has(
    tmp_path: Path, arm_profile: Profile
) -> None:
    (tmp_path / "arm").mkdir()
    for name, content in arm_profile.files.items():
        (tmp_path / "arm" / name).write_bytes(content)
    text = (
        MAVLINK
        + 'profile = "arm"\n[[vehicle]]\nname = "a"\nlatched = [\n  "arm/encoder",\n  "arm/encoders",\n]\n'
        + 'out_of_service = ["link/telemetry", "monitor/flood", "motors/motor1"]\n'
    )
    latched, out_of_service = complaints(tmp_path, text)
    known = (
        "arm/encoder, arm/motor, link/command, link/impostor, link/link, link/signing, link/telemetry, monitor/blind, "
        "monitor/flood"
    )
    wrong = f"which is no channel of {tmp_path / 'arm'}; its channels are {known}"
    assert latched == f"5: 'vehicle[0].latched[1]' is 'arm/encoders', {wrong}"
    assert out_of_service == f"9: 'vehicle[0].out_of_service[2]' is 'motors/motor1', {wrong}"
    assert read(tmp_path, text.replace("encoders", "motor").replace("motors/motor1", "link/link")).vehicle
