"""What systemd hears over a real socket, and that nothing happens where there is none."""

import os
import socket
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from monitor.service.systemd import Notifier


@pytest.fixture(params=["path", "abstract"])
def manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[socket.socket, str]]:
    """Return a socket like systemd's, and its address as the environment names it."""
    name = str(tmp_path / "notify") if request.param == "path" else f"@fauio-test-{os.getpid()}-{time.monotonic_ns()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as server:
        server.bind("\0" + name[1:] if name.startswith("@") else name)
        server.settimeout(10)
        yield server, name


def test_each_state_of_the_daemon_is_one_datagram(manager: tuple[socket.socket, str]) -> None:
    server, name = manager
    with closing(Notifier({"NOTIFY_SOCKET": name})) as notifier:
        notifier.ready("monitoring 2 vehicles")
        assert server.recv(4096) == b"READY=1\nSTATUS=monitoring 2 vehicles"
        notifier.ready("copter-1: stale\nREADY=0")
        assert server.recv(4096) == b"READY=1\nSTATUS=copter-1: stale READY=0"
        before = time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000
        notifier.reloading()
        first, second = server.recv(4096).decode().splitlines()
        assert first == "RELOADING=1"
        assert before <= int(second.removeprefix("MONOTONIC_USEC=")) <= time.clock_gettime_ns(1) // 1000
        notifier.ready()
        assert server.recv(4096) == b"READY=1"
        notifier.stopping()
        assert server.recv(4096) == b"STOPPING=1"
        assert notifier.failed == 0


def test_the_watchdog_is_fed_in_time_and_only_while_all_answer(manager: tuple[socket.socket, str]) -> None:
    server, name = manager
    with closing(Notifier({"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "3000000"})) as notifier:
        assert notifier.watchdog_ns == 3_000_000_000
        fed = [notifier.feed(alive, now * 100_000_000) for now, alive in enumerate([True] * 21 + [False] * 20)]
        assert [index for index, sent in enumerate(fed) if sent] == [0, 10, 20]
        assert [server.recv(4096) for _ in range(3)] == [b"WATCHDOG=1"] * 3


@pytest.mark.parametrize(
    "environment",
    [
        {},
        {"WATCHDOG_USEC": "0"},
        {"WATCHDOG_USEC": "soon"},
        {"WATCHDOG_USEC": "3000000", "WATCHDOG_PID": "1"},
    ],
)
def test_a_watchdog_that_watches_somebody_else_is_not_fed(
    manager: tuple[socket.socket, str], environment: dict[str, str]
) -> None:
    with closing(Notifier({"NOTIFY_SOCKET": manager[1], **environment})) as notifier:
        assert notifier.watchdog_ns is None
        assert not notifier.feed(alive=True)


@pytest.mark.parametrize("address", [None, "", "vsock:2:1234", "relative"])
def test_without_a_service_manager_nothing_is_sent(address: str | None) -> None:
    environment = {"WATCHDOG_USEC": "1000000"} | ({} if address is None else {"NOTIFY_SOCKET": address})
    with closing(Notifier(environment)) as notifier:
        notifier.ready("ready")
        notifier.stopping()
        assert not notifier.feed(alive=True)
        assert notifier.failed == 0


def test_a_service_manager_that_is_gone_or_reads_nothing_stops_nobody(tmp_path: Path) -> None:
    name = str(tmp_path / "notify")
    with closing(Notifier({"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "1"})) as notifier:
        notifier.ready()
        assert notifier.failed == 1
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as deaf:
            deaf.bind(name)
            while notifier.failed == 1:
                notifier.ready("still here")
        notifier.close()
        notifier.ready()
