"""The example configurations of examples/zenoh as they are, on loopback, with certificates made for the occasion."""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, Any

import pytest
import trustme
import zenoh
from daemons import ENVIRONMENT, FAUIO
from loopback import event, free_port, publisher, put, until

import fauio
from adapters.batch import messages
from adapters.zenoh.zenoh_link import ZenohLink
from adapters.zenoh.zenoh_session import open_session
from monitor.bus.publisher import Publisher
from monitor.bus.subscriber import AlarmSubscriber
from monitor.diagnosis.doctor_network import zenoh_file_check

EXAMPLES = Path(__file__).parent.parent / "examples/zenoh"
ALARM = "fauio/copter-1/alarm/motors/motor1"
COMMAND = "fauio/copter-1/command/ack"


class Site:
    """A folder of certificates, and the examples with its paths and a free port filled in."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.port = free_port()
        authority = trustme.CA()
        authority.cert_pem.write_to_path(folder / "ca.pem")
        self.issue(authority, "daemon", "localhost")
        for name in ("client", "monitor", "operator", "viewer", "vehicle"):
            self.issue(authority, name, f"{name}.example.org")
        self.issue(trustme.CA(), "stranger", "operator.example.org", common_name="operator")
        (folder / "users.txt").write_bytes((EXAMPLES / "users.txt").read_bytes())

    def issue(self, authority: trustme.CA, name: str, host: str, common_name: str | None = None) -> None:
        made = authority.issue_cert(host, common_name=common_name or name)
        (self.folder / f"{name}.pem").write_bytes(b"".join(blob.bytes() for blob in made.cert_chain_pems))
        (self.folder / f"{name}.key").write_bytes(made.private_key_pem.bytes())

    def file(self, example: str, who: str = "client", **changes: str) -> Path:
        """Return an example, for the client whose certificate is called ``who``."""
        text = (EXAMPLES / example).read_text()
        for old, new in {
            ":7447": f":{self.port}",
            "/etc/fauio/client": f"{self.folder}/{who}",
            "/etc/fauio": str(self.folder),
            **changes,
        }.items():
            assert old in text or old not in changes
            text = text.replace(old, new)
        path = self.folder / f"{who}-{example}"
        path.write_text(text)
        return path

    def client(self, example: str, who: str = "client", **changes: str) -> zenoh.Session:
        return open_session(config_file=self.file(example, who, **changes))


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Site:
    return Site(tmp_path_factory.mktemp("site"))


@pytest.fixture
def site(certificates: Site) -> Site:
    certificates.port = free_port()
    return certificates


def nodes(session: zenoh.Session) -> int:
    return len(session.info.transports())


def receives(session: zenoh.Session, client: zenoh.Session) -> bool:
    """Return whether what a client puts arrives."""
    with ZenohLink(session, "telemetry/**") as link:
        publisher(client, "telemetry/a").put(b"{}")
        return link.receive(5.0).count > 0


@pytest.mark.parametrize("kind", ["tls", "mtls", "password"])
def test_the_daemons_example_lets_in_the_client_of_its_own_example(site: Site, kind: str) -> None:
    with (
        open_session(config_file=site.file(f"{kind}-daemon.json5")) as daemon,
        site.client(f"{kind}-client.json5") as client,
    ):
        until(lambda: nodes(client) == 1)
        assert receives(daemon, client)


@pytest.mark.parametrize("kind", ["tls", "mtls", "password"])
def test_a_plain_zenoh_client_needs_nothing_but_the_file(site: Site, kind: str) -> None:
    with (
        open_session(config_file=site.file(f"{kind}-daemon.json5")) as daemon,
        zenoh.open(zenoh.Config.from_file(str(site.file(f"{kind}-client.json5")))) as client,
    ):
        until(lambda: nodes(client) == 1)
        assert receives(daemon, client)


@contextmanager
def alarms(config: Path) -> Iterator[subprocess.Popen[str]]:
    command = [*FAUIO, "alarms", "--zenoh-config", str(config)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=ENVIRONMENT
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def line(stream: IO[str] | None) -> str:
    assert stream is not None
    return stream.readline()


@pytest.mark.parametrize("kind", ["mtls", "password"])
def test_alarms_shows_and_commands_a_secured_monitor(site: Site, kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    with open_session(config_file=site.file(f"{kind}-daemon.json5")) as daemon, ExitStack() as stack:
        publisher = Publisher(daemon, "copter-1", [])
        stack.callback(publisher.close)
        publisher.event(event(1))
        client = site.file(f"{kind}-client.json5")
        with alarms(client) as process:
            assert json.loads(line(process.stdout))["channel"] == "motor1"
        # that it is refused, and by whom, is an answer of the monitor
        for where in (
            ["--zenoh-config", str(client), "ack", "motor1"],
            ["ack", "motor1", "--zenoh-config", str(client)],
        ):
            assert fauio.main(["alarms", *where]) == 2
            assert "the monitor of 'copter-1' does not take 'ack'" in capsys.readouterr().err


def test_alarms_without_the_right_certificate_says_where_no_monitor_is_found(site: Site) -> None:
    with open_session(config_file=site.file("mtls-daemon.json5")) as daemon, ExitStack() as stack:
        stack.callback(Publisher(daemon, "copter-1", []).close)
        with alarms(site.file("mtls-client.json5", "stranger")) as process:
            assert line(process.stderr).startswith(f"fauio: no monitor at tls/localhost:{site.port} yet; waiting")


def test_a_file_that_is_missing_ends_alarms_with_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert fauio.main(["alarms", "--zenoh-config", str(tmp_path / "none.json5")]) == 2
    assert capsys.readouterr().err == f"fauio: {tmp_path / 'none.json5'}: cannot be read: No such file or directory\n"


def test_a_simulated_vehicle_reaches_a_secured_monitor(site: Site) -> None:
    with open_session(config_file=site.file("mtls-daemon.json5")) as daemon, ZenohLink(daemon, "arm/*") as link:
        client = site.file("mtls-client.json5")
        where = ["--zenoh", "arm/telemetry", "--zenoh-config", str(client)]
        assert fauio.main(["simulate", "arm", *where, "--duration", "0.1", "--speed", "10"]) == 0
        until(lambda: len(link._queue) == 10)


def test_doctor_opens_what_a_secured_monitor_listens_on(site: Site) -> None:
    file = site.file("mtls-daemon.json5")
    free = zenoh_file_check(file, [], ["tcp/127.0.0.1:7447"], "peer")
    assert (free.verdict, f"tls/localhost:{site.port}: free" in free.found) == ("ok", True)
    with open_session(config_file=file):
        taken = zenoh_file_check(file, [], [], "peer")
    assert (taken.verdict, "the port is taken" in taken.found) == ("warning", True)
    lacking = zenoh_file_check(site.file("mtls-daemon.json5", **{"daemon.pem": "nobody.pem"}), [], [], "peer")
    assert (lacking.verdict, "mend the file" in lacking.advice) == ("failed", True)


@pytest.mark.parametrize(
    ("daemon", "example", "who", "changes"),
    [
        ("tls", "tls-client.json5", "client", {"ca.pem": "stranger.pem"}),
        ("mtls", "tls-client.json5", "client", {}),
        ("mtls", "mtls-client.json5", "stranger", {}),
        ("password", "tls-client.json5", "client", {}),
        ("password", "password-client.json5", "client", {"change me": "guessed"}),
        ("password", "password-client.json5", "client", {"operator": "nobody"}),
    ],
    ids=["authority", "no certificate", "certificate of another", "no password", "wrong password", "unknown user"],
)
def test_who_is_not_who_they_should_be_stays_outside_and_can_see_it(
    site: Site, daemon: str, example: str, who: str, changes: dict[str, str]
) -> None:
    with (
        open_session(config_file=site.file(f"{daemon}-daemon.json5")) as session,
        site.client(example, who, **changes) as outside,
        ZenohLink(outside, "telemetry/**") as link,
        site.client(f"{daemon}-client.json5") as inside,
    ):
        until(lambda: nodes(inside) == 1)
        # by now the other, who has tried for longer, would be in as well
        time.sleep(0.3)
        assert link.statistics().connected == 0
        assert nodes(session) == 1


@contextmanager
def access_controlled(site: Site, mode: str) -> Iterator[tuple[zenoh.Session, dict[str, zenoh.Session]]]:
    """Open the daemon and its clients, connected to it or, as the daemon is then, to a router."""
    with ExitStack() as stack:
        control = site.file(
            "access-control.json5", "control", **{"access_control:": f'mode: "{mode}",\n  access_control:'}
        )
        daemon = front = stack.enter_context(open_session(config_file=control))
        if mode == "router":
            monitor = site.file("mtls-client.json5", "monitor", **{"connect:": 'mode: "router",\n  connect:'})
            daemon = stack.enter_context(open_session(config_file=monitor))
        clients = {
            name: stack.enter_context(site.client("mtls-client.json5", name))
            for name in ("operator", "viewer", "vehicle")
        }
        until(lambda: nodes(front) == len(clients) + (daemon is not front))
        yield daemon, clients


class Commands:
    """What arrives at a daemon: commands asked and put, and whatever is put on alarms."""

    def __init__(self, daemon: zenoh.Session) -> None:
        self.seen: list[tuple[str, bytes]] = []
        self._declared: list[Any] = [
            daemon.declare_queryable("fauio/copter-1/command/**", self._answer),
            daemon.declare_subscriber("fauio/copter-1/command/**", self._take),
            daemon.declare_subscriber("fauio/copter-1/alarm/**", self._take),
        ]

    def _take(self, sample: zenoh.Sample) -> None:
        self.seen.append((str(sample.key_expr), sample.payload.to_bytes()))

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            payload = b"" if query.payload is None else query.payload.to_bytes()
            self.seen.append((str(query.key_expr), payload))
            query.reply(query.key_expr, b"done")


@pytest.mark.parametrize("mode", ["peer", "router"])
def test_only_the_operator_commands_and_nobody_else_writes_alarms(site: Site, mode: str) -> None:
    with access_controlled(site, mode) as (daemon, clients):
        commands = Commands(daemon)
        operator = clients["operator"]

        def answered(client: zenoh.Session, timeout: float) -> bool:
            replies = client.get(COMMAND, payload=b"asked", timeout=timeout)
            return any(reply.ok is not None for reply in replies)

        until(lambda: answered(operator, 1.0))
        commands.seen.clear()
        for name in ("viewer", "vehicle"):
            assert not answered(clients[name], 0.3)
            put(clients[name], COMMAND, b"forbidden")
        for client in clients.values():
            put(client, ALARM, b"forged")
        put(operator, COMMAND, b"last")
        until(lambda: (COMMAND, b"last") in commands.seen)
        assert commands.seen == [(COMMAND, b"last")]
        # what follows is how a client can tell that nobody may hear it
        made = {name: client.declare_publisher(COMMAND) for name, client in clients.items()}
        until(lambda: bool(made["operator"].matching_status.matching))
        assert [name for name, command in made.items() if command.matching_status.matching] == ["operator"]
        assert not any(client.declare_publisher(ALARM).matching_status.matching for client in clients.values())


@pytest.mark.parametrize("mode", ["peer", "router"])
def test_viewers_get_alarms_as_without_access_control_and_vehicles_none(site: Site, mode: str) -> None:
    with access_controlled(site, mode) as (daemon, clients), ExitStack() as stack:
        publisher = Publisher(daemon, "copter-1", [])
        stack.callback(publisher.close)
        publisher.event(event(1))
        alarms = {name: AlarmSubscriber(client) for name, client in clients.items()}
        for subscriber in alarms.values():
            stack.callback(subscriber.close)
        for seq in (1, 2):
            if seq == 2:
                publisher.event(event(2, state="updated"))
            for name in ("viewer", "operator"):
                while (found := alarms[name].receive(0.2)) is None or found.seq != seq:
                    pass
        for name in ("viewer", "operator"):
            until(lambda name=name: alarms[name].live == {"copter-1"})
            (reply,) = (reply for reply in clients[name].get("fauio/copter-1/alarms", timeout=5.0) if reply.ok)
            assert reply.ok is not None
        assert alarms["vehicle"].receive(0.3) is None
        assert not [reply for reply in clients["vehicle"].get("fauio/copter-1/alarms", timeout=0.3) if reply.ok]


@pytest.mark.parametrize("mode", ["peer", "router"])
def test_vehicles_send_telemetry_and_nobody_else_does(site: Site, mode: str) -> None:
    with access_controlled(site, mode) as (daemon, clients), ZenohLink(daemon, "telemetry/**") as link:
        out = publisher(clients["vehicle"], "telemetry/copter-1/imu")
        for name in ("viewer", "operator"):
            put(clients[name], "telemetry/copter-1/imu", b'{"from": "' + name.encode() + b'"}')
        out.put(b'{"from": "vehicle"}')
        (message,) = messages(link.receive(5.0))
        assert message.fields == {"from": "vehicle"}
        assert link.receive(0.3).count == 0
