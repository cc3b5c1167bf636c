"""``fauio doctor``: each check finds what is wrong and says what to do; versions are those that are installed."""

from __future__ import annotations

import json
import socket
import time
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace

import pytest
from daemons import free_ports
from loopback import Endpoint, free_port

import fauio
from monitor.bus.publisher import Publisher
from monitor.diagnosis.doctor import DoctorCheck, checks_text, profile_check, version_checks, worst
from monitor.diagnosis.doctor_machine import buffer_check, clock_checks, disk_check, folder_check, serial_checks
from monitor.diagnosis.doctor_network import mavlink_check, metrics_check, round_trip_check, zenoh_port_check
from monitor.diagnosis.versions import Library

QUAD = Path(__file__).parent.parent / "replay" / "data" / "quad"


def test_a_machine_on_which_all_is_well_ends_with_0(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    free = [f"--listen=tcp/127.0.0.1:{free_port()}", "--mavlink=udpin:127.0.0.1:0", f"--folder={tmp_path}"]
    assert fauio.main(["doctor", "--json", *free]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["status"] in ("ok", "warning")
    names = {check["name"] for check in said["checks"]}
    assert {"version", "libraries", "zenoh port", "mavlink link", "zenoh", "folder", "disk", "udp buffer"} <= names
    assert {"clock", "serial device"} <= names
    assert all(check["advice"] for check in said["checks"] if check["verdict"] != "ok")


def test_a_failed_check_ends_with_2_and_says_what_to_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as stranger:
        endpoint = f"tcp/127.0.0.1:{stranger.getsockname()[1]}"
        options = ["--listen", endpoint, "--mavlink", "udpin:127.0.0.1:0", "--folder", str(tmp_path)]
        assert fauio.main(["doctor", *options]) == 2
    said = capsys.readouterr().out
    assert f"failed   zenoh port     {endpoint} is taken by something that is not Zenoh" in said
    assert "-> stop it" in said
    assert "1 failed" in said


def test_it_checks_what_a_configuration_needs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = tmp_path / "fauio.toml"
    device = tmp_path / "ttyUSB9"
    port, metrics = free_ports(2)
    text = f"""
profile = "{QUAD}"
listen = "tcp/127.0.0.1:{port}"
mavlink = "serial:{device}:57600"
[recording]
folder = "{tmp_path}/flights"
[metrics]
listen = "127.0.0.1:{metrics}"
"""
    config.write_text(text)
    assert fauio.main(["doctor", "--config", str(config), "--json"]) == 2
    checks = json.loads(capsys.readouterr().out)["checks"]
    assert [check["found"] for check in checks if check["verdict"] == "failed"] == [f"{device} does not exist"]
    found = " ".join(check["found"] for check in checks)
    assert "7447" not in found
    assert f":{port} is free" in found
    assert f":{metrics} is free" in found
    assert f"{tmp_path}/flights can be made in {tmp_path}" in found


def test_the_profile_may_be_named_on_the_command_line_as_for_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "fauio.toml"
    port, udp = free_ports(2)
    top = f'vehicle = "copter-1"\nlisten = "tcp/127.0.0.1:{port}"\nmavlink = "udpin:127.0.0.1:{udp}"\n'
    config.write_text(f'{top}[journal]\npath = "{tmp_path}/new/journal.db"\n')
    assert fauio.main(["doctor", "--config", str(config)]) == 2
    assert "has no profile; name the folder that 'fauio fit' made" in capsys.readouterr().err
    assert fauio.main(["doctor", str(QUAD), "--config", str(config), "--json"]) == 0
    found = [check["found"] for check in json.loads(capsys.readouterr().out)["checks"]]
    assert f"{QUAD} can be used" in found
    assert f"{tmp_path}/new can be made in {tmp_path}" in found


def test_it_opens_what_the_zenoh_configuration_of_a_daemon_says(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    port, udp = free_ports(2)
    (tmp_path / "zenoh.json5").write_text(f'{{listen: {{endpoints: ["tcp/127.0.0.1:{port}"]}}}}')
    config = tmp_path / "fauio.toml"
    config.write_text(f'mavlink = "udpin:127.0.0.1:{udp}"\nzenoh_config = "zenoh.json5"\n')
    assert fauio.main(["doctor", str(QUAD), "--config", str(config), "--json"]) == 0
    [found] = [one["found"] for one in json.loads(capsys.readouterr().out)["checks"] if one["name"] == "zenoh port"]
    assert found.startswith(f"tcp/127.0.0.1:{port}: free")


def test_a_profile_that_cannot_be_used_fails(tmp_path: Path) -> None:
    found = profile_check(tmp_path)
    assert (found.verdict, "profile.toml" in found.found) == ("failed", True)
    assert profile_check(QUAD).verdict == "ok"


def test_a_port_tells_a_monitor_from_another_zenoh_program() -> None:
    endpoint = Endpoint()
    try:
        other = zenoh_port_check(endpoint.address)
        publisher = Publisher(endpoint.session, "copter-1", ())
        monitor = zenoh_port_check(endpoint.address)
        publisher.close()
    finally:
        endpoint.close()
    assert (other.verdict, "no monitor" in other.found) == ("warning", True)
    assert (monitor.verdict, "copter-1" in monitor.found) == ("ok", True)
    assert zenoh_port_check(endpoint.address).verdict == "ok"
    assert zenoh_port_check("nonsense").verdict == "failed"


def test_a_mavlink_port_that_is_taken_is_told() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        station.bind(("127.0.0.1", 0))
        found = mavlink_check(f"udpin:127.0.0.1:{station.getsockname()[1]}")
    assert (found.verdict, "taken" in found.found) == ("warning", True)
    assert mavlink_check("carrier-pigeon:1").verdict == "failed"


def test_a_metrics_port_that_is_taken_is_told() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        found = metrics_check(f"127.0.0.1:{server.getsockname()[1]}")
    assert (found.verdict, "in use" in found.found) == ("warning", True)
    assert metrics_check("nowhere").verdict == "failed"


def test_zenoh_goes_round_on_loopback() -> None:
    found = round_trip_check()
    assert found.verdict in ("ok", "warning")
    assert "put and get on loopback work" in found.found


def test_a_folder_that_cannot_be_written_fails(tmp_path: Path) -> None:
    assert folder_check(tmp_path).verdict == "ok"
    (tmp_path / "file").touch()
    assert folder_check(tmp_path / "file" / "below").verdict == "failed"
    # nobody, not even root, makes files there
    assert folder_check(Path("/proc/self")).verdict == "failed"
    assert disk_check(tmp_path / "not" / "yet").found.endswith("not/yet")


def test_serial_devices_are_found_and_those_of_links_have_to_be_there(tmp_path: Path) -> None:
    assert [check.found for check in serial_checks([], tmp_path)] == ["none connected"]
    (tmp_path / "ttyACM0").touch()
    assert [check.verdict for check in serial_checks([], tmp_path)] == ["ok"]
    assert [check.verdict for check in serial_checks([f"serial:{tmp_path}/ttyUSB0:57600"], tmp_path)] == ["failed"]


def test_a_receive_buffer_that_is_too_small_is_told(tmp_path: Path) -> None:
    limit = tmp_path / "rmem_max"
    limit.write_text("212992\n")
    found = buffer_check(limit)
    assert found.verdict == "warning"
    assert found.advice == "sudo sysctl -w net.core.rmem_max=4194304"
    limit.write_text("8388608\n")
    assert buffer_check(limit).verdict == "ok"
    assert buffer_check(tmp_path / "none").verdict == "ok"


def test_a_clock_that_was_never_set_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    assert [check.name for check in clock_checks()] == ["clock", "ntp"]
    clock = SimpleNamespace(**vars(time) | {"time": lambda: 0.0})
    monkeypatch.setattr("monitor.diagnosis.doctor_machine.time", clock)
    [found] = clock_checks()
    assert (found.verdict, found.found) == ("failed", "it shows 1970-01-01")


def test_libraries_that_are_missing_or_too_old_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not Library("numpy", "", "2.0", "1.26.4").will_do
    assert Library("numpy", "", "2.0", "2.0.0").will_do
    assert Library("numpy", "", "2.9", "2.10.1").will_do
    found = [
        Library("numpy", "", "2.0", "1.26.4"),
        Library("mcap", "", "1.6", None),
        Library("pyarrow", "parquet", "", None),
    ]
    monkeypatch.setattr("monitor.diagnosis.versions.libraries", lambda: found)
    failed = [check for check in version_checks() if check.verdict == "failed"]
    assert [check.found for check in failed] == ["numpy 1.26.4 is too old", "mcap is not installed"]
    assert failed[0].advice == "pip install 'numpy>=2.0'"
    assert any("pip install 'fauio[parquet]'" in check.found for check in version_checks() if check.name == "extra")


def test_the_worst_check_counts() -> None:
    ok, warning = DoctorCheck("a", "ok", "fine"), DoctorCheck("long name", "warning", "odd", "look")
    assert (worst([]), worst([ok, warning])) == ("ok", "warning")
    assert checks_text([ok, warning]) == (
        "ok       a          fine\nwarning  long name  odd\n                    -> look\n1 ok, 1 to look at, 0 failed\n"
    )


def test_the_version_names_python_and_libraries(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        fauio.main(["--version"])
    assert ended.value.code == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(f"fauio {version('fauio')} (Python 3.")
    assert any(line.split() == ["numpy", version("numpy")] for line in lines)
