"""Killed at any moment during alarms, or on a full disk: what was reported is not lost, and alarms keep their ids."""

from __future__ import annotations

import json
import random
import resource
import time
from collections.abc import Sequence
from pathlib import Path

import chaos
import pytest
from chaos import Sufferer
from chaos_run import MOTOR1, QUAD, Monitor, monitoring, name_of, waits
from own_records import own_records

from adapters.logs.recordings import read_recording
from monitor.event import AlarmEvent
from monitor.profile import read_profile
from replay.player import play

SYSTEMS = (1, 2)


def recorded(monitor: Monitor, system: int) -> list[AlarmEvent]:
    """Return the events in all recordings of a vehicle, those of killed daemons too."""
    files = sorted((monitor.folder / "recordings" / name_of(system)).glob("*.mcap"))
    found = own_records(files).get("/fauio/alarm_json", [])
    return [AlarmEvent(**json.loads(data)) for data in found]


def places(events: Sequence[AlarmEvent]) -> set[tuple[str, int]]:
    return {(event.vehicle, event.seq) for event in events}


@pytest.mark.parametrize(("kills", "stop_s"), [(1, 22.0), pytest.param(3, 35.0, marks=pytest.mark.long)])
def test_a_killed_daemon_comes_back_with_its_alarms_and_has_lost_none(
    tmp_path: Path, kills: int, stop_s: float
) -> None:
    rng = random.Random(5)
    sufferers = [Sufferer(system, MOTOR1, "none", stop_s) for system in SYSTEMS]
    with monitoring(tmp_path, SYSTEMS) as monitor:
        sender = chaos.send(sufferers, f"udp:{monitor.udp}")
        try:
            waits(lambda: all(monitor.raised(system) for system in SYSTEMS), "both motors' alarms")
            first = {event.vehicle: event.id for event in monitor.hear() if event.channel == "motor1"}
            for _ in range(kills):
                time.sleep(rng.uniform(0.0, 0.7))
                monitor.process.kill()
                monitor.process.wait()
                monitor.restart()
                # Its Zenoh session is another one: the old token goes first, then the new ones come.
                said = len(monitor.hear())
                monitor.statuses.clear()
                waits(lambda: len(monitor.statuses) == len(SYSTEMS), "statuses after a restart")
                assert all(status["active_alarms"] >= 1 for status in monitor.statuses.values()), said
        finally:
            sender.kill()
            sender.communicate()
        time.sleep(1.0)
        heard = monitor.hear()
        assert {event.id for event in heard if event.channel == "motor1"} == set(first.values())
        raised = [event for event in heard if event.state == "raised" and event.channel == "motor1"]
        assert sorted(event.vehicle for event in raised) == [name_of(system) for system in SYSTEMS]
        assert monitor.stop() == 0
        heard = monitor.hear()
        journal = monitor.journal()
    assert places(journal) >= places(heard)
    for system in SYSTEMS:
        own = [event for event in heard if event.vehicle == name_of(system)]
        assert places(recorded(monitor, system)) >= places(own)
        assert len(places(own)) == len(own)


@pytest.mark.long
def test_a_full_disk_stops_nothing_and_is_told_of(tmp_path: Path) -> None:
    # Long enough that telemetry goes on until a busy machine has tried again what the disk refused: every RETRY_S.
    sufferers = [Sufferer(1, MOTOR1, "none", 60.0)]
    with monitoring(tmp_path, [1]) as monitor:
        sender = chaos.send(sufferers, f"udp:{monitor.udp}")
        try:
            waits(lambda: monitor.statuses.get(name_of(1), {}).get("samples", 0) > 100, "samples")
            # No file may grow any more: writing fails like on a full disk, for the journal and the recordings.
            resource.prlimit(monitor.process.pid, resource.RLIMIT_FSIZE, (4096, resource.RLIM_INFINITY))
            waits(lambda: monitor.raised(1), "the motor's alarm while the disk is full")
            waits(lambda: bool(monitor.statuses[name_of(1)]["reasons"]), "a reason in the status")
            assert monitor.statuses[name_of(1)]["state"] == "degraded"
            resource.prlimit(monitor.process.pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY,) * 2)
            waits(lambda: not monitor.statuses[name_of(1)]["reasons"], "all well again")
            time.sleep(2.0)
        finally:
            sender.kill()
            sender.communicate()
        heard = monitor.hear()
        assert [event.channel for event in monitor.raised(1)] == ["motor1"]
        assert monitor.stop() == 0
        assert places(monitor.journal()) >= places(heard)
        # Telemetry that no disk took is missing from the recording, which goes on in another file; no alarm is.
        assert sorted(places(recorded(monitor, 1))) == sorted(places(heard))
        assert len(recorded(monitor, 1)) == len(places(heard))
        assert len(list((tmp_path / "recordings" / name_of(1)).glob("*.mcap"))) == 2
        # The alarm's clip, begun on the full disk, has it, and what was said in its span is what a replay of it says.
        [raised] = monitor.raised(1)
        [clip] = (tmp_path / "clips").rglob(f"*{raised.id}.mcap")
        again = play(read_profile(QUAD), read_recording(clip), vehicle=name_of(1)).events
        own = [AlarmEvent(**json.loads(data)) for data in own_records([clip])["/fauio/alarm_json"]]
        said, found = (
            [(event.observer, event.channel) for event in events if event.state == "raised"] for events in (own, again)
        )
        assert said == found
        assert [place for place in said if place[0] != "link"] == [("motors", "motor1")]
