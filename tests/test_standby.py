"""Two daemons on one flight, as the examples configure them: one is active, the other takes over when it is gone."""

from __future__ import annotations

import ctypes
import json
import os
import signal
import socket
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from daemons import DaemonProcess, Flight, Watcher, filled_in, free_ports
from loopback import event, until

from adapters.logs.recordings import read_recording
from monitor.event import AlarmEvent, event_from_json
from monitor.profile import Profile
from monitor.recording.journal import Journal
from replay.player import play

VEHICLE = "copter-1"
CHANNEL = "motors/motor2"
TAKEN_OVER_S = 2.0
HUNG_S = 2.0
"""After how long without a status the other one takes over."""
ONSET_S = 6.7
"""When motor 2 begins to fail in the flight, seconds after its first packet."""
UNDER_WAY_S = 0.2
"""How long an event that one subscriber has may be under way to another on a busy machine."""
OTHER = {"a": "b", "b": "a"}


class Pair:
    """The two daemons of the examples, on ports of their own, and somebody who is connected to both."""

    def __init__(self, folder: Path, profile: Path) -> None:
        self.folder = folder
        self.udp = free_ports(2, socket.SOCK_DGRAM)
        tcp = free_ports(2)
        values = {"14550": str(self.udp[0]), "14551": str(self.udp[1]), "7447": str(tcp[0]), "7448": str(tcp[1])}
        values['"quad/"'] = json.dumps(str(profile))
        key = folder / "standby.key"
        key.write_text("5a" * 32)
        key.chmod(0o600)
        self.configs = {name: filled_in(f"standby-{name}.toml", folder, values) for name in "ab"}
        self.running: dict[str, DaemonProcess] = {}
        for name in self.configs:
            self.start(name)
        self.watcher = Watcher([f"tcp/127.0.0.1:{port}" for port in tcp])

    @property
    def candidates(self) -> int:
        return len(self.watcher.live("/candidate/"))

    @property
    def voice(self) -> str | None:
        """Which session last said that it is active."""
        said = self.watcher.seen("/status")
        return said[-1].by if said else None

    @property
    def leader(self) -> str:
        """Which of the two logged last that it is active."""
        said = {name: [line["time_ns"] for line in one.log() if _activated(line)] for name, one in self.running.items()}
        return max((times[-1], name) for name, times in said.items() if times)[1]

    def start(self, name: str) -> None:
        self.running[name] = DaemonProcess(self.configs[name])

    def back(self, name: str) -> None:
        """Start one again and give it time to activate, if it would."""
        self.start(name)
        until(lambda: self.candidates == 2)
        since = time.monotonic()
        until(lambda: time.monotonic() > since + 1.5)

    def journal(self, name: str) -> list[AlarmEvent]:
        """Return the events in a daemon's journal by number: those from before its start may be written later."""
        journal = Journal(self.folder / f"standby-{name}.db")
        try:
            return sorted(journal.events(VEHICLE), key=lambda event: event.seq)
        finally:
            journal.close()

    def active(self) -> list[dict[str, Any]]:
        """Return the active alarms of the vehicle itself as the one who answers knows them."""
        (alarms,) = self.watcher.ask(f"fauio/{VEHICLE}/alarms")
        return [alarm for alarm in alarms if alarm["kind"] != "stale"]

    def command(self, verb: str, **fields: Any) -> Any:
        """Return the answer to an operator's command; there is one."""
        (answer,) = self.watcher.ask(f"fauio/{VEHICLE}/command/{verb}", fields)
        return answer

    def takes_over(self, since: float, former: str | None) -> None:
        """Wait until another than the former one is active, alive and answers; see that it did not last."""
        until(lambda: self.voice not in (None, former) and bool(self.watcher.live("/live")))
        until(lambda: len(self.watcher.ask(f"fauio/{VEHICLE}/alarms")) == 1)
        assert time.monotonic() - since < TAKEN_OVER_S

    def takes_over_from_hung(self, since: float, former: str | None) -> None:
        """Wait until another than the one that hangs is active and answers; see that it was in time."""
        until(lambda: self.voice not in (None, former))
        assert time.monotonic() - since < HUNG_S + TAKEN_OVER_S

    def voices(self, since: float, before: float) -> set[str]:
        """Return which sessions said anything below the vehicle's keys but that they resign."""
        said = self.watcher.seen(f"{VEHICLE}/", since)
        return {one.by for one in said if one.at < before and "/candidate/" not in one.key}

    def close(self) -> None:
        for daemon in self.running.values():
            daemon.kill()
        self.watcher.close()


def _activated(line: dict[str, Any]) -> bool:
    return line["event"] == "log" and line["message"].startswith("active for")


@pytest.fixture
def pair(quad_folder: Path, tmp_path: Path) -> Iterator[Pair]:
    two = Pair(tmp_path, quad_folder)
    try:
        until(lambda: two.candidates == 2 and two.voice is not None)
        yield two
    finally:
        two.close()


def assert_one_history(pair: Pair) -> None:
    """No event came twice, none has a number that another has, no alarm was raised twice; the active one says so."""
    events = pair.watcher.events()
    numbers = [event["seq"] for event in events]
    assert numbers == sorted(set(numbers))
    raised = Counter(event["id"] for event in events if event["state"] == "raised")
    assert set(raised.values()) == {1}
    assert {one.said["role"] for one in pair.watcher.seen("/status")} == {"active"}


def test_an_alarm_lives_on_under_its_id_whoever_is_killed_and_when(
    pair: Pair, data: Path, quad_profile: Profile
) -> None:
    """One is killed as the alarm is raised, one after it was acknowledged, and one stopped after it was shelved."""
    watcher, first = pair.watcher, pair.leader
    second = OTHER[first]
    flight = Flight(data / "copter_motor2_080.tlog.xz", pair.udp, start_s=3.0)
    until(lambda: bool(watcher.events(CHANNEL)))
    # what is still in the leader's queue to the standby dies with the leader: the standby would raise a new alarm
    time.sleep(UNDER_WAY_S)
    pair.running[first].kill()
    killed, voice = time.monotonic(), pair.voice
    assert len(pair.voices(0.0, killed)) == 1
    pair.takes_over(killed, voice)
    (standing,) = pair.active()
    (raised,) = (event for event in watcher.events(CHANNEL) if event["state"] == "raised")
    assert standing["id"] == raised["id"]
    # an alarm that becomes critical is no longer acknowledged
    until(lambda: watcher.events(CHANNEL)[-1]["severity"] == "critical")
    assert pair.command("ack", channel=CHANNEL, by="test")["event"]["acknowledged"]

    pair.back(first)
    assert len(pair.voices(killed, time.monotonic())) == 1
    assert pair.leader == second
    pair.running[second].kill()
    killed, voice = time.monotonic(), pair.voice
    pair.takes_over(killed, voice)
    assert pair.leader == first
    (standing,) = pair.active()
    assert (standing["id"], standing["acknowledged"]) == (raised["id"], True)
    assert "acknowledged" not in standing["message"]
    until_ns = pair.command("shelve", channel=CHANNEL, minutes=5)["event"]["shelved_until_ns"]

    pair.back(second)
    flight.join()
    stopped, voice = time.monotonic(), pair.voice
    assert pair.running[first].terminate() == 0
    pair.takes_over(stopped, voice)
    (standing,) = pair.active()
    assert (standing["id"], standing["acknowledged"]) == (raised["id"], True)
    assert (standing["state"], standing["shelved_until_ns"]) == ("shelved", until_ns)

    assert_one_history(pair)
    assert len({one.by for one in watcher.seen("/alarm/")}) == 4
    assert {event["id"] for event in watcher.events(CHANNEL)} == {raised["id"]}
    assert pair.running[second].terminate() == 0
    said = [event_from_json(event) for event in watcher.events()]
    assert pair.journal(second) == said
    # the first was stopped before the last takeover
    earlier = pair.journal(first)
    assert earlier == said[: len(earlier)]
    assert until_ns in {event.shelved_until_ns for event in earlier}
    recording = max((pair.folder / f"recordings-{second}" / VEHICLE).iterdir())
    replayed = play(quad_profile, read_recording(recording), vehicle=VEHICLE).events
    assert said[-1] in replayed


def test_what_somebody_without_the_key_says_silences_nobody_and_gets_into_no_journal(pair: Pair) -> None:
    watcher, stranger = pair.watcher, pair.watcher.session
    token = stranger.liveliness().declare_token(f"fauio/{VEHICLE}/candidate/{0:020d}-00000000")
    forged = event(9, "motor2", vehicle=VEHICLE, id="forged")
    for seq in (9, (1 << 53) - 1, 1 << 53):
        said = json.dumps(replace(forged, seq=seq).to_json())
        stranger.put(f"fauio/{VEHICLE}/alarm/motors/motor2", said, attachment=b"x" * 32)
    since = time.monotonic()
    until(lambda: time.monotonic() > since + 3.0)
    assert len(watcher.seen("/status", since)) >= 2
    token.undeclare()
    pair.running[pair.leader].kill()
    pair.takes_over(time.monotonic(), pair.voice)
    assert not pair.active()
    for name in "ab":
        pair.running[name].kill()
        assert "forged" not in {event.id for event in pair.journal(name)}


def test_a_fault_that_begins_before_the_other_takes_over_is_raised_once_and_standing_by_is_silent(
    pair: Pair, data: Path
) -> None:
    watcher, first = pair.watcher, pair.leader
    assert not pair.command("ack", channel=CHANNEL)["ok"]
    flight = Flight(data / "copter_motor2_080.tlog.xz", pair.udp, start_s=3.0)
    until(lambda: flight.at_s > ONSET_S - 0.3)
    assert not watcher.events()
    pair.running[first].kill()
    killed, voice = time.monotonic(), pair.voice
    assert pair.voices(0.0, killed) == {voice}
    pair.takes_over(killed, voice)
    until(lambda: bool(watcher.events(CHANNEL)))
    assert not pair.command("ack", channel="motors/motor1")["ok"]
    flight.join()
    assert_one_history(pair)
    assert len(pair.voices(0.0, time.monotonic())) == 2
    assert {event["channel"] for event in watcher.events() if event["kind"] != "stale"} == {"motor2"}


@contextmanager
def stopped_process(pid: int) -> Iterator[None]:
    """Stop a process for a while, all its threads."""
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


@contextmanager
def stopped_main_thread(pid: int) -> Iterator[None]:
    """Stop the main thread of a child for a while, as a debugger does; the others go on, and so do Zenoh's."""
    ptrace = ctypes.CDLL(None, use_errno=True).ptrace
    attach, detach, all_threads = 16, 17, 0x40000000
    assert ptrace(attach, pid, None, None) == 0, os.strerror(ctypes.get_errno())
    os.waitpid(pid, all_threads)
    try:
        yield
    finally:
        ptrace(detach, pid, None, None)


@pytest.mark.long
@pytest.mark.parametrize("stopped", [stopped_process, stopped_main_thread])
def test_the_other_takes_over_from_one_that_hangs_which_yields_when_it_goes_on(
    pair: Pair, data: Path, stopped: Callable[[int], AbstractContextManager[None]]
) -> None:
    watcher, first = pair.watcher, pair.leader
    flight = Flight(data / "copter_motor2_080.tlog.xz", pair.udp, start_s=1.0)
    until(lambda: flight.at_s > 1.5)
    voice = pair.voice
    with stopped(pair.running[first].process.pid):
        hung = time.monotonic()
        pair.takes_over_from_hung(hung, voice)
        until(lambda: bool(watcher.events(CHANNEL)))
    gone_on = time.monotonic()
    until(lambda: time.monotonic() > gone_on + 3.0)
    assert len(pair.voices(gone_on + 1.0, time.monotonic())) == 1
    assert voice not in pair.voices(gone_on + 1.0, time.monotonic())
    flight.join()
    assert_one_history(pair)
