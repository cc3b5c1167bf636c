"""Two daemons that share a fleet, as the examples configure them: one router shows the vehicles of both."""

from __future__ import annotations

import json
import socket
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from daemons import ENVIRONMENT, FAUIO, DaemonProcess, Flight, Watcher, filled_in, free_ports
from loopback import until

from adapters.zenoh.zenoh_session import open_session
from monitor.profile import PROFILE_FILE, Profile
from monitor.recording.journal import Journal

TELEMETRY = "telemetry/shard-b/arm-1"


class Fleet:
    """A router, both shards, and an observer at the router."""

    def __init__(self, folder: Path, quad: Path, arm: Path) -> None:
        self.folder = folder
        (self.udp,) = free_ports(1, socket.SOCK_DGRAM)
        (port,) = free_ports(1)
        self.router = f"tcp/127.0.0.1:{port}"
        values = {"14550": str(self.udp), "7447": str(port)}
        values |= {'"quad/"': json.dumps(str(quad)), '"arm/"': json.dumps(str(arm))}
        configs = [filled_in(f"shard-{name}.toml", folder, values) for name in "ab"]
        with ExitStack() as stack:
            # before their router: they wait for it
            for config in configs:
                stack.enter_context(DaemonProcess(config))
            stack.callback(open_session(listen=[self.router], mode="router").close)
            self.watcher = Watcher([self.router])
            stack.callback(self.watcher.close)
            until(lambda: self.watcher.live("/live") == {"fauio/copter-1/live", "fauio/arm-1/live"})
            self._open = stack.pop_all()

    def journal(self, shard: str) -> set[str]:
        """Return the vehicles in a shard's journal."""
        journal = Journal(self.folder / f"shard-{shard}.db")
        try:
            return {event.vehicle for event in journal.events()}
        finally:
            journal.close()

    def close(self) -> None:
        self._open.close()


def arm_on_zenoh(profile: Profile, folder: Path) -> Path:
    """Write the arm's profile with its channels taken from Zenoh."""
    folder.mkdir()
    for name, content in profile.files.items():
        (folder / name).write_bytes(content)
    text = (folder / PROFILE_FILE).read_text().replace('"DEBUG_FLOAT_ARRAY"', json.dumps(TELEMETRY))
    for k, field in enumerate(("u[0]", "y[0]", "y[1]", "y[2]")):
        text = text.replace(f'"data[{k}]"', f'"{field}"')
    lines = [line for line in text.splitlines() if ".where]" not in line and 'name = "arm"' not in line]
    (folder / PROFILE_FILE).write_text("\n".join(['name = "arm"', *lines]))
    return folder


@pytest.fixture
def fleet(quad_folder: Path, arm_profile: Profile, tmp_path: Path) -> Iterator[Fleet]:
    one = Fleet(tmp_path, quad_folder, arm_on_zenoh(arm_profile, tmp_path / "arm"))
    yield one
    one.close()


@pytest.mark.long
def test_the_alarms_of_both_shards_are_seen_at_the_router_and_each_keeps_its_own(fleet: Fleet, data: Path) -> None:
    command = [*FAUIO, "alarms", "--json", "--connect", fleet.router]
    simulate = [*FAUIO, "simulate", "arm", "--zenoh", TELEMETRY, "--connect", fleet.router, "--speed", "8"]
    # by then the observer has forgotten where it was started
    simulate += ["--fault", "f_s:step:10:14:2", "--duration", "18"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=ENVIRONMENT) as alarms:
        try:
            assert alarms.stdout is not None
            flight = Flight(data / "copter_motor3_090.tlog.xz", [fleet.udp], start_s=3.0)
            subprocess.run(simulate, check=True, capture_output=True, env=ENVIRONMENT)
            raised: dict[tuple[str, str], dict[str, Any]] = {}
            while not {("copter-1", "motor3"), ("arm-1", "encoder")} <= raised.keys():
                event = json.loads(alarms.stdout.readline())
                if event["state"] == "raised":
                    raised[event["vehicle"], event["channel"]] = event
        finally:
            alarms.kill()
    flight.join()
    answers = fleet.watcher.ask("fauio/*/alarms")
    assert {alarm["channel"] for answer in answers for alarm in answer} >= {"motor3"}
    assert len(answers) == 2
    assert (fleet.journal("a"), fleet.journal("b")) == ({"copter-1"}, {"arm-1"})
    # telemetry stays with the shard that asked for it
    statuses = {one.said["vehicle"]: one.said for one in fleet.watcher.seen("/status")}
    assert {vehicle: status["foreign_messages"] for vehicle, status in statuses.items()} == {"copter-1": 0, "arm-1": 0}
