"""What a vehicle says about itself, for pages that show it beside its alarms."""

from typing import Any

from loopback import START_NS

from adapters.batch import pack
from adapters.message import Message
from adapters.source import MAVLINK, ZENOH
from monitor.service.vehicle_facts import VehicleFacts


def facts(*messages: tuple[str, dict[str, Any]], source: Any = MAVLINK) -> dict[str, Any]:
    kept = VehicleFacts()
    for k, (name, fields) in enumerate(messages):
        kept.take(pack([Message(source, name, START_NS + k, fields, 1, 1)]))
    return kept.status()


def test_the_latest_place_and_mode_count() -> None:
    beat = {"type": 2, "autopilot": 3, "base_mode": 209, "custom_mode": 5}
    place = {"lat": 473977418, "lon": 85455939, "alt": 488_000}
    said = facts(
        ("HEARTBEAT", {**beat, "custom_mode": 0}),
        ("GLOBAL_POSITION_INT", place),
        ("GPS_RAW_INT", {**place, "lat": 473977500}),
        ("HEARTBEAT", beat),
    )
    assert said["heartbeat"] == beat
    assert said["position"] == [47.3977418, 8.5455939, 488.0]
    assert said["gps"] == [47.39775, 8.5455939, 488.0]


def test_what_is_no_autopilot_and_no_fix_changes_nothing() -> None:
    gimbal = {"type": 26, "autopilot": 8, "base_mode": 0, "custom_mode": 0}
    said = facts(("HEARTBEAT", gimbal), ("GPS_RAW_INT", {"lat": 0, "lon": 0, "alt": 0}), ("GPS_RAW_INT", {}))
    assert said == {"texts": []}
    place = {"lat": 473977418, "lon": 85455939, "alt": 488_000}
    assert "gps" not in facts(("GPS_RAW_INT", {**place, "fix_type": 1}))
    assert "gps" in facts(("GPS_RAW_INT", {**place, "fix_type": 3}))


def test_a_position_of_ros_is_one_too() -> None:
    place = {"latitude": 47.4, "longitude": 8.5, "altitude": 488.0}
    assert facts(("robot/fix", place), source=ZENOH)["gps"] == [47.4, 8.5, 488.0]


def test_a_message_in_pieces_is_one_and_only_the_last_ones_are_kept() -> None:
    said = facts(
        *(("STATUSTEXT", {"severity": 4, "text": f"old {k}"}) for k in range(40)),
        ("STATUSTEXT", {"severity": 2, "text": "a" * 50, "id": 7, "chunk_seq": 0}),
        ("STATUSTEXT", {"severity": 2, "text": "b\x1b\t", "id": 7, "chunk_seq": 1}),
        ("STATUSTEXT", {"severity": "?", "text": 3}),
    )
    assert len(said["texts"]) == 20
    assert said["texts"][-1]["text"] == "a" * 50 + "b?"
