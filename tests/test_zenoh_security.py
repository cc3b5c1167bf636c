"""The example configurations of examples/zenoh as they are, on loopback, with certificates made for the occasion."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
import trustme
import zenoh
from loopback import event, free_port, until

from adapters.zenoh.zenoh_link import ZenohLink
from adapters.zenoh.zenoh_session import open_session
from monitor.bus.publisher import Publisher
from monitor.bus.subscriber import AlarmSubscriber

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
        out = client.declare_publisher("telemetry/a")
        until(lambda: bool(out.matching_status.matching))
        out.put(b"{}")
        return bool(link.receive(5.0))


@pytest.mark.parametrize("kind", ["tls", "mtls", "password"])
def test_the_daemons_example_lets_in_the_client_of_its_own_example(site: Site, kind: str) -> None:
    with (
        open_session(config_file=site.file(f"{kind}-daemon.json5")) as daemon,
        site.client(f"{kind}-client.json5") as client,
    ):
        until(lambda: nodes(client) == 1)
        assert receives(daemon, client)


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
            clients[name].put(COMMAND, b"forbidden")
        for client in clients.values():
            client.put(ALARM, b"forged")
        operator.put(COMMAND, b"last")
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
            assert alarms[name].live == {"copter-1"}
            (reply,) = (reply for reply in clients[name].get("fauio/copter-1/alarms", timeout=5.0) if reply.ok)
            assert reply.ok is not None
        assert alarms["vehicle"].receive(0.3) is None
        assert not [reply for reply in clients["vehicle"].get("fauio/copter-1/alarms", timeout=0.3) if reply.ok]


@pytest.mark.parametrize("mode", ["peer", "router"])
def test_vehicles_send_telemetry_and_nobody_else_does(site: Site, mode: str) -> None:
    with access_controlled(site, mode) as (daemon, clients), ZenohLink(daemon, "telemetry/**") as link:
        out = clients["vehicle"].declare_publisher("telemetry/copter-1/imu")
        until(lambda: bool(out.matching_status.matching))
        for name in ("viewer", "operator"):
            clients[name].put("telemetry/copter-1/imu", b'{"from": "' + name.encode() + b'"}')
        out.put(b'{"from": "vehicle"}')
        (message,) = link.receive(5.0)
        assert message.fields == {"from": "vehicle"}
        assert link.receive(0.3) == []
