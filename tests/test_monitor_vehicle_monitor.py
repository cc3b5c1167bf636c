"""One monitored vehicle that stands by: what it takes from another monitor, and what it says when it speaks again."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from loopback import START_NS, event

from adapters.batch import pack
from adapters.link_figures import LinkFigures
from adapters.logs.recordings import packed, read_recording
from adapters.message import Message, silence
from adapters.source import MAVLINK, OPERATOR, ZENOH
from monitor.bus.schemas import SCHEMAS
from monitor.estimate import Estimates
from monitor.event import AlarmEvent
from monitor.pipeline import Pipeline, handover_message, shelved_channels
from monitor.profile import Profile
from monitor.recording.journal import Journal
from monitor.service.health import Health, LinkHealth, ProcessHealth, problems
from monitor.service.vehicle_monitor import VehicleMonitor

SECOND_NS = 1_000_000_000


class Heard:
    """What a monitor said."""

    def __init__(self) -> None:
        self.events: list[AlarmEvent] = []

    def event(self, event: AlarmEvent) -> None:
        self.events.append(event)

    def estimates(self, estimates: Estimates) -> None:
        """Nobody asks."""

    def status(self, status: Mapping[str, Any]) -> None:
        """Nobody asks."""

    def close(self) -> None:
        """Nothing is open."""


@pytest.fixture
def monitor(arm_profile: Profile) -> VehicleMonitor:
    return VehicleMonitor(Pipeline(arm_profile, "copter-1"), (), None, lambda _: None, START_NS)


def said(monitor: VehicleMonitor, now_ns: int) -> list[AlarmEvent]:
    heard = Heard()
    monitor.activate(heard, now_ns)
    return heard.events


def alarm(seq: int, **changes: Any) -> AlarmEvent:
    return event(seq, "encoder", observer="arm", **changes)


def test_it_goes_on_from_what_it_heard_with_numbers_that_nobody_can_have_given(monitor: VehicleMonitor) -> None:
    monitor.on_peer_event(alarm(7))
    monitor.on_peer_event(alarm(8, state="acknowledged", acknowledged=True, message="acknowledged by test"))
    (updated,) = said(monitor, START_NS + SECOND_NS)
    assert (updated.id, updated.state, updated.acknowledged) == (alarm(7).id, "updated", True)
    assert updated.seq > 100
    assert updated.message == f"{alarm(7).message} (as before the monitor changed)"


def test_what_was_cleared_or_comes_late_from_the_past_does_not_stand(monitor: VehicleMonitor) -> None:
    monitor.on_peer_event(alarm(2, state="cleared"))
    monitor.on_peer_event(alarm(1))
    assert said(monitor, START_NS + SECOND_NS) == []


def test_events_of_another_vehicle_and_absurd_numbers_are_not_taken(monitor: VehicleMonitor) -> None:
    monitor.on_peer_event(alarm(1, vehicle="copter-2"))
    monitor.on_peer_event(alarm(1 << 60))
    monitor.on_peer_event(alarm(-1))
    assert said(monitor, START_NS + SECOND_NS) == []


def test_one_that_speaks_again_raises_nothing_a_second_time_and_says_its_sentence_once(monitor: VehicleMonitor) -> None:
    monitor.on_peer_event(alarm(1))
    (first,) = said(monitor, START_NS + SECOND_NS)
    monitor.deactivate()
    (again,) = said(monitor, START_NS + 2 * SECOND_NS)
    assert (again.id, again.state) == (first.id, "updated")
    assert again.seq > first.seq
    assert again.message == first.message


def test_one_that_is_heard_after_both_were_apart_counts_though_its_numbers_are_smaller(monitor: VehicleMonitor) -> None:
    monitor.on_peer_event(alarm(1))
    (mine,) = said(monitor, START_NS + SECOND_NS)
    monitor.deactivate()
    monitor.on_peer_event(alarm(2, state="acknowledged", acknowledged=True, time_ns=START_NS + 3 * SECOND_NS))
    (again,) = said(monitor, START_NS + 4 * SECOND_NS)
    assert again.acknowledged
    assert again.seq > mine.seq


def test_keys_without_end_do_not_fill_the_memory(arm_profile: Profile) -> None:
    pipeline = Pipeline(arm_profile)
    monitor = VehicleMonitor(pipeline, [], None, Heard().event, 1)
    for k in range(1000):
        monitor.process(pack([Message(ZENOH, f"arm/{k}", 1 + k, {})]))
    assert monitor.messages == 1000
    assert len(monitor._watch._received) <= len(frozenset().union(*pipeline.needs.values()))


def test_a_channel_shelved_without_an_alarm_is_shelved_after_a_restart(arm_profile: Profile, tmp_path: Path) -> None:
    until_ns = START_NS + 60 * SECOND_NS
    shelve = Message(OPERATOR, "shelve", START_NS + 1, {"channel": "arm/encoder", "until_ns": until_ns})
    with contextlib.closing(Journal(tmp_path / "journal.db")) as journal:
        first = VehicleMonitor(Pipeline(arm_profile, "copter-1"), (), journal, lambda _: None, START_NS)
        first.activate(Heard(), START_NS)
        first.process(pack([shelve]))
        assert journal.shelved("copter-1") == {"arm/encoder": until_ns}
        second = VehicleMonitor(Pipeline(arm_profile, "copter-1"), (), journal, lambda _: None, START_NS)
        later_ns = START_NS + 2 * SECOND_NS
        second.activate(Heard(), later_ns, shelved=journal.shelved("copter-1"))
        assert second.status(later_ns)["shelved"] == {"arm/encoder": until_ns}
        second.process(pack([Message(OPERATOR, "unshelve", later_ns, {"channel": "arm/encoder"})]))
        assert journal.shelved("copter-1") == {}


def test_nonsense_about_shelved_channels_is_left_out() -> None:
    shelved = {"arm/encoder": 5, "encoder": 6, "arm/torque": "soon", "arm/tip": True}
    assert shelved_channels({"shelved": shelved}) == {"arm/encoder": 5}
    assert shelved_channels({"shelved": ["arm/encoder"]}) == shelved_channels({}) == {}


def test_the_status_says_what_the_links_lost_of_all_and_of_this_vehicle(arm_profile: Profile) -> None:
    monitor = VehicleMonitor(Pipeline(arm_profile, "copter-1", 3), (), None, lambda _: None, START_NS)
    links = [
        LinkHealth(
            "udpin:127.0.0.1:14550",
            True,
            100,
            {"lost": 9, "damaged": 2},
            {3: 4, 7: 5},
            LinkFigures(0.012, 0.00456, 0.2),
        ),
        LinkHealth("arm/**", False, 0, {"dropped": 1}),
    ]
    status = monitor.status(START_NS + SECOND_NS, (), links)
    assert status["lost"] == 4
    unknown = {"delay_s": None, "jitter_s": None, "lost_share": None}
    assert status["links"] == {
        "udpin:127.0.0.1:14550": {
            "connected": True,
            "messages": 100,
            "losses": {"lost": 9, "damaged": 2},
            "delay_s": 0.012,
            "jitter_s": 0.0046,
            "lost_share": 0.2,
        },
        "arm/**": {"connected": False, "messages": 0, "losses": {"dropped": 1}, **unknown},
    }


def in_flight(profile: Profile, data: Path, lost: str, forged: Message | None = None) -> tuple[VehicleMonitor, int]:
    """Return a monitor after 30 s of a flight without a message from 20 s on, and the time then."""
    messages = list(read_recording(data / "copter_healthy_square.tlog.xz"))
    first_ns = messages[0].received_ns
    end_ns = first_ns + 30 * SECOND_NS
    kept = [
        m for m in messages if m.received_ns < end_ns and (m.name != lost or m.received_ns < first_ns + 20 * SECOND_NS)
    ]
    if forged is not None:
        kept += [replace(forged, received_ns=first_ns + SECOND_NS * at + 400_000_000) for at in range(20, 30)]
    monitor = VehicleMonitor(Pipeline(profile, "copter-1"), (), None, lambda _: None, first_ns)
    for batch in packed(sorted(kept, key=lambda message: message.received_ns)):
        monitor.process(batch)
    return monitor, end_ns


def test_a_flying_vehicle_without_gps_is_blind_and_no_monitor_says_that_it_is_well(
    quad_profile: Profile, data: Path
) -> None:
    monitor, now_ns = in_flight(quad_profile, data, "GPS_RAW_INT")
    status = monitor.status(now_ns)
    assert status["state"] == "blind"
    assert any("no GPS for 5 s" in reason for reason in status["reasons"])
    jsonschema.validate(status, SCHEMAS["status"])
    watching = status["watching"]["inertial"]
    assert watching["sensors"]["GPS"] < now_ns - 9 * SECOND_NS < watching["sensors"]["barometer"]
    health = monitor.health("blind", None, now_ns)
    [problem] = problems(Health(ProcessHealth(), (health,)))
    assert "no GPS for 5 s" in problem


def test_a_vehicle_whose_telemetry_ended_is_a_problem_in_flight_and_none_on_the_ground(
    quad_profile: Profile, data: Path
) -> None:
    monitor, end_ns = in_flight(quad_profile, data, "nothing")
    now_ns = end_ns + 3 * SECOND_NS
    monitor.process(pack([silence(now_ns)]))
    status = monitor.status(now_ns)
    assert (status["state"], status["reasons"]) == ("stale", ["telemetry ended in flight: nothing is watched"])
    [problem] = problems(Health(ProcessHealth(), (monitor.health("stale", None, now_ns),)))
    assert problem == "copter-1: telemetry ended in flight: nothing is watched"

    # Whether a vehicle flies that was silent since a restart is not known.
    again = VehicleMonitor(Pipeline(quad_profile, "copter-1"), (), None, lambda _: None, now_ns)
    told = event(9, "telemetry", observer="link", kind="stale", unit="s")
    again.process(pack([handover_message([told], 9, now_ns), silence(now_ns + SECOND_NS)]))
    assert (again.status(now_ns)["state"], again.status(now_ns)["reasons"]) == ("stale", [])
    assert problems(Health(ProcessHealth(), (again.health("stale", None, now_ns),))) == []

    landed = Message(MAVLINK, "HEARTBEAT", now_ns, {"type": 2, "autopilot": 3, "base_mode": 81}, 1, 1)
    down = [replace(landed, received_ns=now_ns + k * SECOND_NS) for k in range(5)]
    monitor.process(pack([*down, silence(now_ns + 8 * SECOND_NS)]))
    later_ns = now_ns + 8 * SECOND_NS
    assert monitor.status(later_ns)["state"] == "stale"
    assert problems(Health(ProcessHealth(), (monitor.health("stale", None, later_ns),))) == []


def test_a_watched_vehicle_says_how_much_it_was_watched(quad_profile: Profile, data: Path) -> None:
    monitor, now_ns = in_flight(quad_profile, data, "nothing")
    status = monitor.status(now_ns)
    assert (status["state"], status["reasons"]) == ("monitoring", [])
    assert {observer: one["why_not"] for observer, one in status["watching"].items()} == {
        "motors": None,
        "trim": None,
        "inertial": None,
    }
    assert problems(Health(ProcessHealth(), (monitor.health("monitoring", None, now_ns),))) == []


def test_a_second_sender_is_a_problem_of_the_watch(quad_profile: Profile, data: Path) -> None:
    forged = Message(MAVLINK, "HEARTBEAT", 0, {"type": 2, "autopilot": 3, "base_mode": 81}, 1, 1)
    monitor, now_ns = in_flight(quad_profile, data, "nothing", forged)
    status = monitor.status(now_ns)
    assert status["state"] == "degraded"
    assert any("HEARTBEAT" in reason for reason in status["reasons"])
    [problem] = problems(Health(ProcessHealth(), (monitor.health("degraded", None, now_ns),)))
    assert "second sender" in problem
