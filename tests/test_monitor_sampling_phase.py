"""Armed and landed state as the autopilot reports it."""

from __future__ import annotations

from typing import Any

import pytest

from adapters.message import Message
from adapters.source import MAVLINK, ZENOH
from monitor.sampling.phase import FlightPhase


def mavlink(name: str, **fields: Any) -> Message:
    return Message(MAVLINK, name, 0, fields, 1, 1)


def test_nothing_is_known_before_the_first_message() -> None:
    phase = FlightPhase()
    assert (phase.armed, phase.landed) == (None, None)


def test_the_autopilot_says_whether_it_is_armed() -> None:
    phase = FlightPhase()
    phase.feed(mavlink("HEARTBEAT", type=2, autopilot=3, base_mode=81))
    assert phase.armed is False
    phase.feed(mavlink("HEARTBEAT", type=2, autopilot=3, base_mode=209))
    assert phase.armed is True


@pytest.mark.parametrize("other", [{"type": 6, "autopilot": 3}, {"type": 26, "autopilot": 8}])
def test_heartbeats_of_ground_stations_and_payloads_are_ignored(other: dict[str, int]) -> None:
    phase = FlightPhase()
    phase.feed(mavlink("HEARTBEAT", type=2, autopilot=3, base_mode=209))
    phase.feed(mavlink("HEARTBEAT", base_mode=0, **other))
    assert phase.armed is True


@pytest.mark.parametrize(
    ("state", "meaning"),
    [(0, None), (1, "ground"), (2, "air"), (3, "takeoff"), (4, "landing"), (9, None), ([], None)],
)
def test_the_landed_state_is_named(state: Any, meaning: str | None) -> None:
    phase = FlightPhase()
    phase.feed(mavlink("EXTENDED_SYS_STATE", landed_state=state))
    assert phase.landed == meaning


def test_other_messages_change_nothing() -> None:
    phase = FlightPhase()
    phase.feed(mavlink("ATTITUDE", base_mode=209, landed_state=2))
    phase.feed(Message(ZENOH, "HEARTBEAT", 0, {"base_mode": 209}))
    phase.feed(mavlink("HEARTBEAT"))
    assert (phase.armed, phase.landed) == (None, None)
