"""The console over HTTP: who gets in, what is streamed, what is commanded, and how it ends."""

from __future__ import annotations

import contextlib
import http.client
import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fleet_publisher import SimulatedMonitor
from loopback import Endpoint, free_port, shown_from_now_on, until

import fauio
from adapters.errors import UsageError
from monitor.console.web_server import ConsoleOptions, ConsoleServer

ROOT = Path(__file__).parent.parent
TOKEN = "0123456789abcdef"  # noqa: S105 - of no console but this one


@pytest.fixture
def monitor(endpoint: Endpoint) -> Iterator[SimulatedMonitor]:
    made = SimulatedMonitor(endpoint.session, "quad-1", allow=("ack",))
    yield made
    made.close()


class Site:
    """A console with some options, and requests to it."""

    def __init__(self, endpoint: Endpoint, **options: Any) -> None:
        self.server = ConsoleServer(endpoint.client(), ConsoleOptions(listen="127.0.0.1:0", **options))
        self.address = self.server.url.removeprefix("http://").rstrip("/")

    def ask(
        self, path: str, body: object = None, headers: dict[str, str] | None = None
    ) -> tuple[int, dict[str, str], bytes]:
        connection = http.client.HTTPConnection(self.address, timeout=10)
        sent = {"Content-Type": "application/json"} if body is not None else {}
        data = None if body is None else json.dumps(body)
        connection.request("GET" if body is None else "POST", path, data, sent | (headers or {}))
        with contextlib.closing(connection), connection.getresponse() as answer:
            said = b"" if path.startswith("/stream") and answer.status == 200 else answer.read()
            return answer.status, {name.lower(): value for name, value in answer.getheaders()}, said

    def news(self, count: int, path: str = "/stream") -> Iterator[tuple[str, Any]]:
        """Yield the first events of a stream."""
        connection = http.client.HTTPConnection(self.address, timeout=10)
        connection.request("GET", path)
        name = ""
        with contextlib.closing(connection), connection.getresponse() as answer:
            while count:
                line = answer.readline().decode().rstrip("\n")
                if line.startswith("event: "):
                    name = line.removeprefix("event: ")
                elif line.startswith("data: "):
                    count -= 1
                    yield name, json.loads(line.removeprefix("data: "))


@pytest.fixture
def site(endpoint: Endpoint) -> Iterator[Any]:
    made: list[Site] = []

    def make(**options: Any) -> Site:
        made.append(Site(endpoint, **options))
        return made[-1]

    yield make
    for one in made:
        one.server.close()


def test_a_page_may_load_nothing_from_elsewhere_and_run_nothing_inline(site: Any) -> None:
    console = site()
    for path in ("/", "/page/console.js", "/uplot/uPlot.iife.min.js", "/stream?vehicle=x", "/nothing"):
        headers = console.ask(path)[1]
        policy = headers["content-security-policy"]
        assert policy.startswith("default-src 'none'; script-src 'self'; style-src 'self'")
        assert "unsafe" not in policy
        assert headers["x-content-type-options"] == "nosniff"
    page = console.ask("/")[2].decode()
    assert "style=" not in page
    assert "<script>" not in page
    assert "http" not in page


@pytest.mark.parametrize(
    ("host", "status"),
    [("evil.example", 421), ("127.0.0.1.evil.example:80", 421), ("", 421), ("localhost", 200), ("192.168.1.2:1", 200),
     ("[::1]:8600", 200), ("Ground.example:8600", 200)],
)  # fmt: skip
def test_a_name_that_was_not_given_is_refused(site: Any, host: str, status: int) -> None:
    assert site(hosts=("ground.example",)).ask("/", headers={"Host": host})[0] == status


def test_what_is_active_comes_at_once_and_changes_follow(site: Any, monitor: SimulatedMonitor) -> None:
    monitor.alarm("motor1", -0.02, "motor1 delivers less")
    console = site()
    until(lambda: bool(console.server.fleet.news({}).get("alarms")))
    stream = console.news(4)
    assert next(stream) == ("hello", {"version": "0.1.0", "commands": False, "clips": False})
    _, first = next(stream)
    assert [alarm["channel"] for alarm in first["alarms"]] == ["motor1"]
    assert first["counts"] == {"critical": 0, "warning": 1}
    assert first["names"] == ["quad-1"]
    monitor.alarm("baro", 9.0, "baro is off", severity="critical")
    _, second = next(stream)
    assert [alarm["channel"] for alarm in second["alarms"]] == ["baro", "motor1"]


def test_a_vehicles_past_comes_whole_and_then_what_is_new(
    endpoint: Endpoint, site: Any, monitor: SimulatedMonitor
) -> None:
    console = site()
    start = time.time()
    fleet = console.server.fleet
    shown_from_now_on(endpoint)
    monitor.text(start, "hello <b>")
    for k in range(3):
        monitor.estimates(start + k)
    monitor.status(start)
    have: dict[str, int] = {}
    past: dict[str, Any] = {"observers": {}}

    def complete() -> bool:
        news = fleet.news(have, "quad-1").get("past", {})
        for name, observer in news.pop("observers", {}).items():
            past["observers"][name] = observer | past["observers"].get(name, {})
        past.update(news)
        return len(past) == 4 and len(past["observers"]) == 2

    until(complete)
    assert past["observers"]["motors"]["faults"] == [f"motor{k}" for k in range(1, 5)]
    assert past["texts"][0]["text"] == "hello <b>"
    assert past["modes"][0]["mode"] in ("LOITER", "AUTO")
    assert "past" not in fleet.news(have, "quad-1")
    assert "past" not in fleet.news({}, "quad-2")


def test_nothing_is_commanded_unless_that_was_asked_for(site: Any, monitor: SimulatedMonitor) -> None:
    event = monitor.alarm("motor1", -0.02, "motor1 delivers less")
    status, _, body = site().ask("/command", {"vehicle": "quad-1", "verb": "ack", "id": event.id})
    assert (status, b"read-only" in body) == (403, True)


@pytest.mark.parametrize(
    ("headers", "body", "status"),
    [
        ({"Origin": "http://evil.example"}, {"vehicle": "quad-1", "verb": "ack"}, 403),
        ({"Sec-Fetch-Site": "cross-site"}, {"vehicle": "quad-1", "verb": "ack"}, 403),
        ({"Content-Type": "text/plain"}, {"vehicle": "quad-1", "verb": "ack"}, 400),
        ({}, ["ack"], 400),
        ({}, {"vehicle": "quad-1", "verb": "explode"}, 400),
        ({}, {"vehicle": "quad-9", "verb": "ack"}, 400),
        ({}, {"vehicle": "quad-1", "verb": ["ack"]}, 400),
        ({}, {"reason": "x" * 5000}, 400),
    ],
)
def test_what_is_no_command_of_this_page_is_refused(
    site: Any, monitor: SimulatedMonitor, headers: dict[str, str], body: object, status: int
) -> None:
    console = site(commands=True)
    until(lambda: monitor.name in console.server.fleet.subscriber.live)
    assert console.ask("/command", body, headers)[0] == status


def test_with_a_token_nothing_is_shown_without_it(site: Any) -> None:
    console = site(token=TOKEN)
    assert console.ask("/")[:2][0] == 303
    assert [console.ask(path)[0] for path in ("/stream", "/history", "/clips", "/page/console.js")] == [401] * 4
    assert console.ask("/clips", headers={"Authorization": f"Bearer {TOKEN}"})[0] == 200
    assert console.ask("/clips", headers={"Authorization": "Bearer no"})[0] == 401
    assert console.ask("/login", {"token": "no"})[0] == 403
    status, headers, _ = console.ask("/login", {"token": TOKEN})
    assert status == 200
    assert "HttpOnly" in headers["set-cookie"]
    assert TOKEN not in headers["set-cookie"]
    cookie = headers["set-cookie"].partition(";")[0]
    assert console.ask("/clips", headers={"Cookie": cookie})[0] == 200


def test_only_clips_of_the_folder_itself_are_given(site: Any, tmp_path: Path) -> None:
    folder = tmp_path / "clips"
    folder.mkdir()
    (folder / "quad-1").mkdir()
    (folder / "quad-1" / "quad-1-X.mcap").write_bytes(b"clip")
    (folder / "secret.txt").write_text("no")
    (tmp_path / "outside.mcap").write_bytes(b"no")
    (folder / "link.mcap").symlink_to(tmp_path / "outside.mcap")
    console = site(clips=folder)
    assert [clip["name"] for clip in json.loads(console.ask("/clips")[2])["clips"]] == ["quad-1-X.mcap"]
    status, headers, body = console.ask("/clips/quad-1-X.mcap")
    assert (status, body, "attachment" in headers["content-disposition"]) == (200, b"clip", True)
    for name in ("link.mcap", "secret.txt", "..%2Foutside.mcap", "%2e%2e/outside.mcap"):
        assert console.ask(f"/clips/{name}")[0] == 404


def test_a_port_that_is_taken_is_said(endpoint: Endpoint, site: Any) -> None:
    console = site()
    with pytest.raises(UsageError, match="cannot listen there"):
        ConsoleServer(endpoint.session, ConsoleOptions(listen=console.address))
    with pytest.raises(UsageError, match="HOST:PORT"):
        ConsoleServer(endpoint.session, ConsoleOptions(listen="nowhere"))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--listen", "0.0.0.0:0"], "--token-file"),
        (["--token-file", "short"], "openssl rand"),
        (["--token-file", "missing"], "missing"),
        (["--clips", "missing"], "no folder"),
        (["--prefix", "a b"], "prefix"),
    ],
)
def test_a_mistake_is_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    options: list[str],
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("short").write_text("abc\n")
    assert fauio.main(["console", "--connect", "tcp/127.0.0.1:1", *options]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert words in said


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 0)])
def test_it_ends_cleanly_while_a_page_is_open(endpoint: Endpoint, number: int, status: int) -> None:
    port = free_port()
    command = [sys.executable, "-W", "error", "-m", "fauio", "console"]
    command += ["--connect", endpoint.address, "--listen", f"127.0.0.1:{port}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stdout is not None
        assert f"http://127.0.0.1:{port}/" in process.stdout.readline()
        connection = http.client.HTTPConnection(f"127.0.0.1:{port}", timeout=10)
        connection.request("GET", "/stream")
        with contextlib.closing(connection), connection.getresponse() as answer:
            answer.readline()
            process.send_signal(number)
            _, said = process.communicate(timeout=20)
            assert (process.returncode, said) == (status, "")
