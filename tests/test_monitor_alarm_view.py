"""The live table as a terminal shows it: a process on a pseudo-terminal against a monitor's real session."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import re
import signal
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from loopback import START_NS, Endpoint, event, shown_from_now_on
from rich.console import Console

from monitor.bus.operators import Operators
from monitor.bus.publisher import Publisher
from monitor.bus.status_watch import VehicleStatus
from monitor.console.alarm_table import AlarmTable
from monitor.console.alarm_view import draw

ROOT = Path(__file__).parent.parent
HOUR_NS = 3600 * 1_000_000_000


class Monitors:
    """What the header needs of a subscriber."""

    live = frozenset({"copter-1"})
    lost = invalid = 0


class Screen:
    """``fauio alarms`` on a terminal of its own."""

    def __init__(self, endpoint: Endpoint, columns: int = 140, lines: int = 24, term: str = "xterm-256color") -> None:
        self._master, slave = pty.openpty()
        fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", lines, columns, 0, 0))
        command = [sys.executable, "-W", "error", "-m", "fauio", "alarms", "--connect", endpoint.address]
        env = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES", "NO_COLOR")}
        self.process = subprocess.Popen(
            command, stdin=slave, stdout=slave, stderr=subprocess.PIPE, text=True, cwd=ROOT, env=env | {"TERM": term}
        )
        os.close(slave)
        self.raw = ""

    def until(self, pattern: str) -> str:
        """Read until the last picture has a text; return the picture without colours."""
        while not re.search(pattern, self.picture()):
            self.raw += os.read(self._master, 65536).decode()
        return self.picture()

    def picture(self) -> str:
        """Return what was drawn last: from the header on."""
        plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", self.raw).replace("\r", "")
        return plain[max(plain.rfind("active   "), 0) :] if "Ctrl-C" not in plain else _last_picture(plain)

    def press(self, keys: str) -> None:
        os.write(self._master, keys.encode())

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()
        os.close(self._master)


def _last_picture(plain: str) -> str:
    """Return the last picture that was drawn to its end."""
    end = plain.rfind("Ctrl-C ends")
    start = plain.rfind(" active   ", 0, end)
    return plain[plain.rfind("\n", 0, start) + 1 : end]


@pytest.fixture
def screen(endpoint: Endpoint) -> Iterator[Screen]:
    found = Screen(endpoint)
    yield found
    found.close()


def test_the_table_follows_the_alarms_until_ctrl_c(endpoint: Endpoint, screen: Screen) -> None:
    publisher = Publisher(endpoint.session, "copter-1", [])
    assert "no alarm is active" in screen.until("monitored: copter-1")
    publisher.event(event(1, relative=-0.05))
    publisher.event(event(2, "motor2", severity="critical"))
    picture = screen.until("motor2.*\n.*motor1")
    assert "2 active" in picture
    assert re.search(r"critical +copter-1 +motors/motor2 .* raised +motor1 delivers less", picture)
    assert "-5 % of the command" in picture
    publisher.event(event(3, "motor2", severity="critical", state="acknowledged", acknowledged=True))
    screen.until("motor2.*acknowledged")
    publisher.event(event(4, state="shelved", shelved_until_ns=time.time_ns() + HOUR_NS))
    screen.until(r"1 active[\s\S]*motor2[\s\S]*motor1.*shelved until")
    publisher.event(event(5, "motor2", state="cleared"))
    screen.until(r"0 active[\s\S]*motor2.*cleared")
    screen.process.send_signal(signal.SIGINT)
    assert screen.process.wait() == 130
    assert screen.process.stderr is not None
    assert screen.process.stderr.read() == ""


def test_it_says_that_no_monitor_is_there_or_that_it_went(endpoint: Endpoint, screen: Screen) -> None:
    screen.until("no monitor at tcp/127")
    publisher = Publisher(endpoint.session, "copter-1", [])
    other = Publisher(endpoint.session, "copter-2", [])
    publisher.event(event(1))
    screen.until("monitored: copter-1, copter-2[\\s\\S]*motor1")
    publisher.close()
    screen.until("monitored: copter-2   monitor gone: copter-1")
    other.close()


def test_what_came_over_the_network_neither_drives_the_terminal_nor_is_markup(
    endpoint: Endpoint, screen: Screen
) -> None:
    publisher = Publisher(endpoint.session, "copter-1", [])
    publisher.event(event(1, message="\x1b]0;owned\x07\x1b[2J[red]stop[/red]"))
    assert "?]0;owned??[2J[red]stop[/red]" in screen.until("stop")
    assert "\x1b[2J" not in screen.raw
    assert "\x1b]0" not in screen.raw


def test_a_small_terminal_shows_the_worst_and_counts_the_rest(endpoint: Endpoint) -> None:
    screen = Screen(endpoint, columns=80, lines=12)
    publisher = Publisher(endpoint.session, "copter-1", [])
    for k in range(30):
        publisher.event(event(k + 1, f"motor{k}", severity="critical" if k == 7 else "warning"))
    picture = screen.until("30 active[\\s\\S]*and 25 more")
    assert re.search(r"critical +copter-1 +motors/motor7", picture)
    assert all(len(line) <= 80 for line in picture.splitlines())
    screen.close()


@pytest.mark.parametrize("width", [50, 62, 80, 110, 160])
def test_what_and_in_which_state_is_never_cut_while_there_is_room_for_it(width: int) -> None:
    table = AlarmTable()
    table.take(event(1, relative=-0.05, unit="fraction of full command"), START_NS)
    table.take(event(2, "gps_north", observer="inertial"), START_NS)
    console = Console(width=width, color_system=None)
    with console.capture() as capture:
        console.print(draw(table.rows(START_NS), Monitors(), ["tcp/here"], width, 24))
    drawn = capture.get()
    assert all(part in drawn for part in ("copter-1", "inertial/gps_north", "-5 %", "raised"))
    assert ("severity" in drawn) == (width >= 62)
    assert ("message" in drawn) == (width >= 110)
    # of the first one below the table, where its column has no room
    assert ("inertial/gps_north: motor1 delivers less" in drawn) == (width < 110)


def test_a_vehicle_that_is_not_watched_stands_above_the_alarms(endpoint: Endpoint, screen: Screen) -> None:
    publisher = Publisher(endpoint.session, "copter-1", [])
    screen.until("monitored: copter-1")
    shown_from_now_on(endpoint)
    publisher.status({"state": "degraded", "reasons": ["motors watches nothing: no HIGHRES_IMU\x1b[2J"]})
    screen.until(r"copter-1 is degraded: motors watches nothing: no HIGHRES_IMU\?\[2J\s+no alarm is active")
    publisher.status({"state": "monitoring", "reasons": []})
    screen.until(r"monitored: copter-1\s+no alarm is active")


def test_keys_acknowledge_the_alarm_that_is_chosen_and_its_text_stays(endpoint: Endpoint, screen: Screen) -> None:
    publisher = Publisher(endpoint.session, "copter-1", [])
    operators = Operators(endpoint.session, "fauio/copter-1", ["ack"], 60.0, 480.0)
    publisher.event(event(1))
    publisher.event(event(2, "motor2"))
    screen.until("motor1.*\\n.*motor2")
    screen.press("a")
    screen.until("ack which alarm")
    screen.press("\x1b[B")
    screen.press("a")
    while not (commands := operators.pending()):
        time.sleep(0.01)
    assert commands[0].fields["id"] == event(1).id
    done = event(3, state="acknowledged", acknowledged=True, message="motor1 delivers less (acknowledged by Ann)")
    publisher.event(done)
    operators.accept(commands[0], done)
    screen.until("motor1.*acknowledged +motor1 delivers less[\\s\\S]*ack motors/motor1 of copter-1: done")
    screen.press("s")
    screen.until("shelve: .*not allowed here")
    screen.press("q")
    assert screen.process.wait() == 0
    operators.close()


def test_sizes_and_rates_are_of_now(endpoint: Endpoint, screen: Screen) -> None:
    publisher = Publisher(endpoint.session, "copter-1", [])
    publisher.event(event(1, estimate=-0.02, relative=-0.05, unit="fraction of full command"))
    screen.until("monitored: copter-1")
    shown_from_now_on(endpoint)
    publisher.status({"state": "monitoring", "reasons": [], "messages_per_s": 230.4})
    screen.until(r"copter-1 \(230 messages/s\)[\s\S]*-5 % of thrust")
    endpoint.session.put("fauio/copter-1/estimate/motors", json.dumps({"isolated": {"motor1": -0.04, "motor2": 0.0}}))
    screen.until("-10 % of thrust")


def test_many_vehicles_that_are_not_watched_leave_room_for_alarms() -> None:
    table = AlarmTable()
    table.take(event(1), START_NS)
    unwell = [VehicleStatus("copter-1", "stale")] * 9
    console = Console(width=80, color_system=None)
    with console.capture() as capture:
        console.print(draw(table.rows(START_NS), Monitors(), ["tcp/here"], 80, 12, unwell))
    drawn = capture.get()
    assert drawn.count("copter-1 is stale") == 3
    assert "and 6 more vehicles are not watched as they should be" in drawn
    assert "motors/motor1" in drawn


def test_a_terminal_that_cannot_redraw_gets_a_line_for_each_event(endpoint: Endpoint) -> None:
    screen = Screen(endpoint, term="dumb")
    publisher = Publisher(endpoint.session, "copter-1", [])
    publisher.event(event(1))
    assert "copter-1  motors/motor1  raised" in screen.until("delivers less")
    assert "\x1b" not in screen.raw
    screen.close()
