"""Messages to people: once for each occasion, through a real HTTP server and a real program, in nobody's way."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest
from loopback import event, until

import fauio
from adapters.errors import UsageError
from monitor.event import AlarmEvent
from monitor.notify import messenger
from monitor.notify.messenger import Messenger
from monitor.notify.notices import OCCASIONS, Notice, Notices, Occasion, summary
from monitor.notify.outlets import DeliveryError, ExecOutlet, make_outlets


def occasions(*events: AlarmEvent, wanted: Sequence[Occasion] = OCCASIONS) -> list[str]:
    notices = Notices(wanted)
    return [found.occasion for one in events if (found := notices.take(one)) is not None]


CRITICAL = {"severity": "critical"}
LIFE = (
    event(1),
    event(2, state="updated"),
    event(3, state="acknowledged", acknowledged=True),
    event(4, state="updated", **CRITICAL),
    event(5, state="updated", **CRITICAL),
    event(6, state="cleared", **CRITICAL),
)


def test_an_alarm_is_told_of_once_per_occasion() -> None:
    assert occasions(*LIFE) == ["raised", "critical", "cleared"]
    assert occasions(*LIFE, wanted=["critical"]) == ["critical"]
    assert occasions(*LIFE, wanted=["raised"]) == ["raised"]
    assert occasions(event(1, **CRITICAL), wanted=["raised"]) == ["raised"]
    assert occasions(event(1, kind="blind"), event(2, kind="blind", state="cleared")) == ["blind", "cleared"]


def test_what_is_shelved_and_what_was_known_before_a_restart_is_not_told() -> None:
    assert occasions(event(1, state="shelved"), event(2, state="cleared")) == []
    before = "motor1 delivers less (as before the monitor changed)"
    assert occasions(event(1, state="updated", message=before, **CRITICAL), LIFE[4], LIFE[5]) == ["cleared"]


def test_a_flood_is_one_summary_with_what_is_critical_first() -> None:
    flood = [Notice("raised", event(k, f"c{k}", vehicle=f"copter-{k % 4}")) for k in range(30)]
    title, body = summary([*flood, Notice("critical", event(99, "motor9", **CRITICAL))])
    assert title == "4 vehicles: 31 messages, 1 critical"
    assert body.splitlines()[0].startswith("copter-1: motor9 critical")
    assert body.splitlines()[-1] == "and 21 more"
    assert "\x1b" not in summary([Notice("raised", event(1, message="\x1b[2J"))])[1]


class Service:
    """A web hook; ``failing`` requests are answered with 503."""

    def __init__(self) -> None:
        self.bodies: list[dict[str, Any]] = []
        self.failing = 0
        service = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
                fails, service.failing = service.failing > 0, service.failing - 1
                if not fails:
                    service.bodies.append(body)
                self.send_response(503 if fails else 200)
                self.end_headers()

            def log_message(self, *_: Any) -> None: ...

        self._server = HTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"json://127.0.0.1:{self._server.server_port}/token-of-mine"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()


@pytest.fixture
def service() -> Iterator[Service]:
    found = Service()
    yield found
    found.close()


@pytest.fixture
def urls(tmp_path: Path, service: Service) -> Path:
    path = tmp_path / "notify.urls"
    path.write_text(f"# the office\n{service.url}\n")
    path.chmod(0o600)
    return path


def test_a_web_hook_gets_an_alarm_again_after_it_was_away_and_a_flood_as_one(
    service: Service, urls: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(messenger, "FIRST_RETRY_S", 0.05)
    failures: list[tuple[str, str | None]] = []
    service.failing = 2
    notifier = Messenger(make_outlets(urls, (), 10.0), per_minute=600.0, on_failure=lambda *one: failures.append(one))
    notifier.event(event(1))
    until(lambda: service.bodies)
    assert service.bodies[0]["title"] == "copter-1: motor1 warning"
    assert service.bodies[0]["message"].startswith("motor1 delivers less (motors/motor1, ")
    until(lambda: len(failures) == 3)
    assert failures == [("json-2", "the service refused it")] * 2 + [("json-2", None)]
    for k in range(50):
        notifier.event(event(k, f"c{k}", id=f"01J{k}", **CRITICAL))
    until(lambda: len(service.bodies) == 2)
    assert service.bodies[1]["title"] == "copter-1: 50 messages, 50 critical"
    assert service.bodies[1]["type"] == "failure"
    notifier.close()
    [health] = notifier.health()
    assert (health.sent, health.failed, health.dropped, health.waiting) == (2, 2, 0, 0)


def test_what_nobody_takes_fills_no_memory_and_holds_nobody_up() -> None:
    class Stuck:
        name = "stuck"
        gate = threading.Event()

        def send(self, notices: Sequence[Notice]) -> None:
            self.gate.wait()
            raise DeliveryError("away")

    notifier = Messenger([Stuck()])
    started = time.monotonic()
    for k in range(5000):
        notifier.event(event(k, id=f"01J{k}"))
    assert time.monotonic() - started < 5.0
    [health] = notifier.health()
    assert health.waiting <= messenger.MAX_WAITING
    Stuck.gate.set()
    notifier.close()
    [health] = notifier.health()
    assert health.dropped + health.waiting == 5000


def test_a_program_gets_each_event_as_a_line_of_json_and_its_arguments_as_they_are(tmp_path: Path) -> None:
    out = tmp_path / "got"
    program = "import sys; open(sys.argv[1], 'w').write(sys.argv[2] + '\\n' + sys.stdin.read())"
    outlet = ExecOutlet([sys.executable, "-c", program, str(out), "$(id); *"], 30.0)
    outlet.send([Notice("raised", event(1)), Notice("cleared", event(2, state="cleared"))])
    argument, *lines = out.read_text().splitlines()
    assert argument == "$(id); *"
    assert [json.loads(line)["occasion"] for line in lines] == ["raised", "cleared"]
    assert json.loads(lines[0]).items() >= event(1).to_json().items()


@pytest.mark.parametrize(
    ("command", "part"),
    [
        ([sys.executable, "-c", "import sys; sys.exit('no modem')"], "ended with 1: no modem"),
        ([sys.executable, "-c", "import time; time.sleep(60)"], "took longer than 0.5 s"),
        (["/nowhere/at/all"], "No such file"),
    ],
)
def test_a_program_that_fails_or_hangs_is_named(command: list[str], part: str) -> None:
    with pytest.raises(DeliveryError, match=part):
        ExecOutlet(command, 0.5).send([Notice("raised", event(1))])


@pytest.mark.parametrize(
    ("text", "mode", "part"),
    [
        ("json://127.0.0.1:1/", 0o644, "chmod o-rwx"),
        ("# nothing\n", 0o600, "has 0 URLs"),
        ("nosuchservice://hunter2", 0o600, r"line 1 \(nosuchservice\) is no service"),
        ("hunter2", 0o600, r"line 1 \(no URL\)"),
    ],
)
def test_a_mistake_in_the_file_of_urls_is_named_without_its_secrets(
    tmp_path: Path, text: str, mode: int, part: str
) -> None:
    path = tmp_path / "notify.urls"
    path.write_text(text)
    path.chmod(mode)
    with pytest.raises(UsageError, match=part) as caught:
        make_outlets(path, (), 10.0)
    assert "hunter2" not in str(caught.value)


def test_without_apprise_one_line_says_what_to_install(urls: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "apprise", None)
    with pytest.raises(UsageError, match=r"pip install 'fauio\[notify\]'"):
        make_outlets(urls, (), 10.0)


def test_the_command_tries_everything_that_is_configured(
    service: Service, urls: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "run.toml"
    config.write_text('mavlink = "udpin:127.0.0.1:0"\n[notify]\nurls_file = "notify.urls"\nexec = ["/nowhere"]\n')
    assert fauio.main(["notify", "--config", str(config), "--test"]) == 2
    assert capsys.readouterr().out == "json-2: delivered\nexec: FAILED: /nowhere: No such file or directory\n"
    assert "a test of fauio's notifications" in service.bodies[0]["message"]
