"""How sessions open: where they listen, what they say about what they cannot do, what a configuration file changes."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import zenoh
from loopback import free_port, until

from adapters.batch import messages as each
from adapters.errors import TelemetryError
from adapters.zenoh.zenoh_link import ZenohLink
from adapters.zenoh.zenoh_session import endpoints, open_session

ROOT = Path(__file__).parent.parent


@pytest.fixture
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


def test_a_session_waits_in_the_background_for_what_it_cannot_reach_yet(endpoint: str) -> None:
    with open_session(connect=[endpoint]) as early:
        made = early.declare_publisher("t")
        for _ in range(2):
            with open_session(listen=[endpoint]) as late, ZenohLink(late, "t") as link:
                until(lambda: bool(made.matching_status.matching))
                made.put(b"{}")
                until(lambda link=link: bool([*each(link.receive(0.2))]))  # type: ignore[misc]
            until(lambda: not made.matching_status.matching)


LISTENING = """
import os, sys
from pathlib import Path
from adapters.zenoh.zenoh_session import open_session
with open_session(connect=sys.argv[1:2], listen=sys.argv[2:]):
    handles = [Path("/proc/self/fd", fd) for fd in os.listdir("/proc/self/fd")]
    sockets = {os.readlink(handle) for handle in handles if handle.is_symlink()}
    for table in ("tcp", "tcp6", "udp", "udp6"):
        for row in Path("/proc/net", table).read_text().splitlines()[1:]:
            columns = row.split()
            if f"socket:[{columns[9]}]" in sockets and columns[3] in ("07", "0A"):
                print(columns[1])
"""


def test_sessions_listen_nowhere_but_where_told(endpoint: str) -> None:
    def listening(*listen: str) -> list[str]:
        command = [sys.executable, "-c", LISTENING, endpoint, *listen]
        return subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT).stdout.split()

    other = f"tcp/127.0.0.1:{free_port()}"
    assert listening(other) == [f"0100007F:{int(other.rpartition(':')[2]):04X}"]
    assert listening() == []


@pytest.mark.parametrize(
    ("where", "said"),
    [
        ({"listen": ["foo"]}, "Zenoh endpoint foo: not understood; write it like tcp/127.0.0.1:7447"),
        ({"connect": ["tcp"]}, "Zenoh endpoint tcp: not understood"),
        (
            {"listen": ["tcp/1.2.3.4:7447"]},
            "Zenoh cannot listen on tcp/1.2.3.4:7447: 1.2.3.4:7447: Cannot assign",
        ),
        (
            {"listen": ["tcp/127.0.0.1:99999"]},
            "Zenoh cannot listen on tcp/127.0.0.1:99999: invalid port value",
        ),
    ],
)
def test_an_endpoint_that_cannot_be_used_is_reported_in_one_line(where: dict[str, list[str]], said: str) -> None:
    with pytest.raises(TelemetryError) as caught:
        open_session(**where)
    assert str(caught.value).startswith(said)
    assert "\n" not in str(caught.value)
    assert ".rs" not in str(caught.value)


def test_a_taken_port_is_reported(endpoint: str) -> None:
    with (
        open_session(listen=[endpoint]),
        pytest.raises(TelemetryError, match="the port is taken; is another monitor running"),
    ):
        open_session(listen=[endpoint])


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Return the list that the configurations of sessions go to instead of being opened."""
    configurations: list[Any] = []
    monkeypatch.setattr(zenoh, "open", configurations.append)
    return configurations


SAFE = {
    "mode": "peer",
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "listen/endpoints": ["tcp/127.0.0.1:1"],
    "connect/endpoints": ["tcp/127.0.0.1:2"],
    "connect/exit_on_failure": False,
    "connect/timeout_ms": -1,
    "timestamping/enabled": True,
    "transport/shared_memory/enabled": False,
    "transport/link/tx/lease": 1000,
    "transport/link/rx/max_message_size": 1 << 24,
}


@pytest.mark.parametrize(
    ("text", "changed"),
    [
        ("{}", {}),
        ("{listen: {exit_on_failure: true}} // scouting, listen, shared_memory, lease", {}),
        ("{/* shared_memory: {enabled: true} */}", {}),
        ("{mode: 'router'}", {"mode": "router"}),
        ("{mode: 'client'}", {"mode": "client", "connect/exit_on_failure": None, "connect/timeout_ms": None}),
        ("{scouting: {multicast: {enabled: true}}}", {"scouting/multicast/enabled": True}),
        ("{listen: {endpoints: ['tcp/127.0.0.1:3']}}", {"listen/endpoints": ["tcp/127.0.0.1:3"]}),
        ("{listen: {endpoints: []}}", {"listen/endpoints": []}),
        ("{connect: {endpoints: ['tcp/127.0.0.1:3']}}", {"connect/endpoints": ["tcp/127.0.0.1:3"]}),
        ("{timestamping: {enabled: false}}", {"timestamping/enabled": False}),
        ("{transport: {shared_memory: {enabled: true}}}", {"transport/shared_memory/enabled": True}),
        ("{transport: {link: {tx: {lease: 10000}}}}", {"transport/link/tx/lease": 10000}),
        (
            "{transport: {link: {rx: {max_message_size: 4096}}}}",
            {"transport/link/rx/max_message_size": 4096},
        ),
    ],
)
def test_what_a_file_says_counts_and_the_rest_stays_safe(
    tmp_path: Path, opened: list[Any], text: str, changed: dict[str, Any]
) -> None:
    (tmp_path / "zenoh.json5").write_text(text)
    open_session(["tcp/127.0.0.1:2"], ["tcp/127.0.0.1:1"], tmp_path / "zenoh.json5")
    (config,) = opened
    assert {key: json.loads(config.get_json(key)) for key in SAFE} == SAFE | changed


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("z.json5", None, "cannot be read: No such file or directory"),
        ("z.toml", "mode = 1", "not a Zenoh configuration: line 1, column 1: expected "),
        ("z.json5", "{\n mode: \n", "not a Zenoh configuration: line 3, column 1: expected "),
        ("z.json5", "{mod: 'peer'}", "not a Zenoh configuration: unknown field `mod`, expected one of"),
        ("z.json5", "{mode: 'pear'}", "not a Zenoh configuration: unknown variant `pear`, expected one of `router`"),
        ("z.json5", "{listen: {endpoints: ['tcp']}}", "not a Zenoh configuration: Endpoints must be of the form"),
        ("z.json5", "[1]", "not a Zenoh configuration: "),
        ("z.json5", "", "not a Zenoh configuration: "),
        ("z.json5", "\udcff", "not a Zenoh configuration: "),
    ],
)
def test_a_file_that_cannot_be_used_is_reported_in_one_line(
    tmp_path: Path, name: str, text: str | None, said: str
) -> None:
    if text is not None:
        (tmp_path / name).write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(TelemetryError) as caught:
        open_session(config_file=tmp_path / name)
    assert str(caught.value).startswith(f"{tmp_path / name}: {said}")
    assert "\n" not in str(caught.value)
    assert ".rs" not in str(caught.value)


def test_a_certificate_that_is_not_there_is_reported(tmp_path: Path) -> None:
    text = "{listen: {endpoints: ['tls/localhost:0']}, transport: {link: {tls: {listen_certificate: '/nowhere.pem'}}}}"
    (tmp_path / "zenoh.json5").write_text(text)
    with pytest.raises(TelemetryError, match=r"Zenoh cannot open a session as .*zenoh\.json5 says: ") as caught:
        open_session(config_file=tmp_path / "zenoh.json5")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        (None, ("tcp/a:1",)),
        ("{}", ("tcp/a:1",)),
        ("{listen: {endpoints: []}}", ()),
        ("{listen: {endpoints: ['tls/b:2', 'tcp/b:3']}}", ("tls/b:2", "tcp/b:3")),
        ("{listen: {endpoints: {router: ['tcp/b:2'], peer: ['tcp/b:3']}}}", ("tcp/b:2",)),
        ("{mode: 'peer', listen: {endpoints: {router: ['tcp/b:2'], peer: ['tcp/b:3']}}}", ("tcp/b:3",)),
        ("{listen: {endpoints: {peer: ['tcp/b:3']}}}", ()),
    ],
)
def test_what_a_session_listens_on_is_known_before_it_is_open(
    tmp_path: Path, text: str | None, found: tuple[str, ...]
) -> None:
    file = None if text is None else tmp_path / "zenoh.json5"
    if file is not None and text is not None:
        file.write_text(text)
    assert endpoints("listen", ["tcp/a:1"], file, "router") == found
