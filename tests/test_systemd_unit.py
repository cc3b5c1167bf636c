"""The systemd unit: what the daemon relies on is in it, and systemd understands it."""

import configparser
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from fauio import build_parser

UNIT = Path(__file__).parent.parent / "systemd/fauio@.service"


def service() -> configparser.SectionProxy:
    parser = configparser.ConfigParser(interpolation=None, strict=False)
    parser.optionxform = str  # type: ignore[assignment, method-assign]
    parser.read_string(UNIT.read_text())
    assert parser.sections() == ["Unit", "Service", "Install"]
    return parser["Service"]


def test_the_unit_waits_for_readiness_feeds_on_the_watchdog_and_starts_again() -> None:
    unit = service()
    assert (unit["Type"], unit["NotifyAccess"]) == ("notify", "main")
    assert 5 <= int(unit["WatchdogSec"]) <= 60
    assert unit["Restart"] == "on-failure"
    assert unit["ExecReload"] == "/bin/kill -HUP $MAINPID"


def test_the_command_line_understands_what_the_unit_starts() -> None:
    words = shlex.split(service()["ExecStart"].replace("%i", "copter"))
    args = build_parser().parse_args(words[1:])
    assert args.command == "run"


def test_the_unit_gives_the_daemon_no_more_than_it_needs() -> None:
    unit = service()
    for name in ("DynamicUser", "NoNewPrivileges", "PrivateTmp", "ProtectHome", "RestrictNamespaces"):
        assert unit[name] == "yes"
    assert unit["ProtectSystem"] == "strict"
    assert unit["StateDirectory"] == "fauio/%i"
    assert unit["CapabilityBoundingSet"] == ""
    assert set(unit["RestrictAddressFamilies"].split()) == {"AF_UNIX", "AF_INET", "AF_INET6", "AF_NETLINK"}


@pytest.fixture
def unit(tmp_path: Path) -> Path:
    """Write the unit with a program that is there: fauio is not installed where the tests run."""
    program = shlex.split(service()["ExecStart"])[0]
    installed = tmp_path / UNIT.name
    installed.write_text(UNIT.read_text().replace(program, shutil.which("true") or "/bin/true"))
    return installed


@pytest.mark.system
def test_systemd_finds_no_fault_with_the_unit(unit: Path) -> None:
    done = subprocess.run(["systemd-analyze", "verify", str(unit)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.system
def test_systemd_calls_the_service_hardly_exposed(unit: Path) -> None:
    judge = ["systemd-analyze", "security", "--offline=true", "--threshold=20", str(unit)]
    done = subprocess.run(judge, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"more than 2.0 of 10:\n{done.stdout}"
