"""Hostile and helpless Zenoh clients, a router that goes and comes back: monitoring goes on, no alarm is missed."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import chaos
import pytest
from chaos import Sufferer
from chaos_run import MOTOR1, Monitor, monitoring, name_of, waits
from loopback import free_port

from adapters.zenoh.zenoh_session import open_session
from monitor.bus.subscriber import AlarmSubscriber

pytestmark = pytest.mark.long

TEN_MB = 10_000_000
STALLED = """
import sys, time
from adapters.zenoh.zenoh_session import open_session
session = open_session(connect=[sys.argv[1]])
def stall(sample):
    print("stalled", flush=True)
    time.sleep(3600)
subscriber = session.declare_subscriber("**", stall)
time.sleep(3600)
"""
ROUTER = """
import sys, time
from adapters.zenoh.zenoh_session import open_session
session = open_session(listen=[sys.argv[1]], mode="router")
print("routing", flush=True)
time.sleep(3600)
"""


@contextmanager
def client(code: str, endpoint: str, word: str) -> Iterator[subprocess.Popen[str]]:
    """Run a Zenoh client in a process of its own, from when it says a word."""
    process = subprocess.Popen([sys.executable, "-c", code, endpoint], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert process.stdout.readline().strip() == word
        yield process
    finally:
        process.kill()
        process.communicate()


@contextmanager
def sending(monitor: Monitor, sufferers: Sequence[Sufferer]) -> Iterator[subprocess.Popen[str]]:
    sender = chaos.send(sufferers, f"udp:{monitor.udp}")
    try:
        yield sender
    finally:
        sender.kill()
        sender.communicate()


def test_neither_huge_payloads_nor_a_stalled_subscriber_disturb_the_monitor(tmp_path: Path) -> None:
    systems = (1, 2)
    more = 'zenoh = "junk/**"\ncommands.allow = ["ack", "shelve", "unshelve", "reset"]'
    with monitoring(tmp_path, systems, more) as monitor:
        session = open_session(connect=[monitor.endpoint])
        try:
            with (
                client(STALLED, monitor.endpoint, "stalled"),
                sending(monitor, [Sufferer(system, MOTOR1, "none", 16.0) for system in systems]) as sender,
            ):
                waits(lambda: all(one["samples"] > 100 for one in monitor.statuses.values()), "samples")
                for payload in (b"\xff" * TEN_MB, b"[" * TEN_MB, b'{"a":' * (TEN_MB // 5)):
                    session.put("junk/telemetry", payload)
                    session.put(f"fauio/{name_of(1)}/alarm/motors/motor1", payload)
                    for verb in ("ack", "shelve", "fly"):
                        replies = session.get(f"fauio/{name_of(1)}/command/{verb}", payload=payload, timeout=5.0)
                        assert all(reply.ok is None for reply in replies)
                sent = json.loads(sender.communicate(timeout=60)[0])
                waits(lambda: all(one["state"] == "stale" for one in monitor.statuses.values()), "the telemetry's end")
                for system in systems:
                    assert [event.channel for event in monitor.raised(system)] == ["motor1"]
                    assert 0 <= monitor.statuses[name_of(system)]["messages"] - sent[str(system)] < 20
        finally:
            session.close()
        assert monitor.stop() == 0


def test_a_client_behind_a_router_that_was_gone_learns_of_the_alarm_raised_meanwhile(tmp_path: Path) -> None:
    router = f"tcp/127.0.0.1:{free_port()}"
    more = f'connect = ["{router}"]\nzenoh_mode = "router"'
    with monitoring(tmp_path, [1], more) as monitor:
        session = open_session(connect=[router])
        try:
            behind = AlarmSubscriber(session)
            with client(ROUTER, router, "routing"):
                waits(lambda: behind.live == {name_of(1)}, "the token behind the router")
            waits(lambda: not behind.live, "the token's end")
            with sending(monitor, [Sufferer(1, MOTOR1, "none", 16.0)]) as sender:
                waits(lambda: bool(monitor.raised(1)), "the alarm")
                with client(ROUTER, router, "routing"):
                    heard = behind.receive(20.0)
                    assert heard is not None
                    assert (heard.id, heard.channel) == (monitor.raised(1)[0].id, "motor1")
                    sender.wait()
        finally:
            session.close()
        assert monitor.stop() == 0
