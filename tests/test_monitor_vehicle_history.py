"""What the console keeps of a vehicle's past: bounded, whatever comes, and each reader gets each row once."""

from __future__ import annotations

import base64
import json
from typing import Any

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st
from loopback import event

from monitor.bus.payload import to_json
from monitor.bus.status_watch import VehicleStatus
from monitor.console.fleet_view import flight_mode, vehicle_card
from monitor.console.vehicle_history import MAX_ENTRIES, MAX_OBSERVERS, ROWS, SLOT_NS, VehicleHistory

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)
KEYS = ("time_ns", "isolated", "sd", "residual", "armed", "facts", "links", "watching", "channels", "latency_ms")
FACTS = st.fixed_dictionaries({}, optional=dict.fromkeys(("heartbeat", "position", "gps", "texts"), JSON))
PAYLOADS = JSON | st.fixed_dictionaries({}, optional=dict.fromkeys((*KEYS, "commands"), JSON) | {"facts": FACTS | JSON})


def estimate(slot: int, *channels: str) -> dict[str, Any]:
    return {
        "time_ns": slot * SLOT_NS,
        "armed": True,
        "isolated": dict.fromkeys(channels, float(slot)),
        "sd": dict.fromkeys(channels, 0.5),
        "residual": {"y": 0.25},
    }


def times(news: dict[str, Any]) -> list[float]:
    return np.frombuffer(base64.b64decode(news["times"]), "<f8").tolist()


@given(PAYLOADS, PAYLOADS)
@example({"time_ns": 10**400, "isolated": {"motor1": 10**400}}, {"time_ns": 10**400})
def test_whatever_comes_is_kept_or_passed_over(first: Any, second: Any) -> None:
    history = VehicleHistory()
    for payload in (first, second):
        history.take_estimate("motors", payload)
        if isinstance(payload, dict):
            facts = payload.get("facts")
            beat = facts.get("heartbeat") if isinstance(facts, dict) else None
            mode = flight_mode(beat if isinstance(beat, dict) else {})
            history.take_status(payload, mode)
            json.loads(to_json(vehicle_card(VehicleStatus("quad"), payload, mode, 1)))
    json.loads(to_json(history.since({})))


def test_only_the_last_rows_are_kept_and_a_reader_gets_each_once() -> None:
    history, have = VehicleHistory(), {}
    for slot in range(ROWS + 10):
        history.take_estimate("motors", estimate(slot, "motor1"))
    first = history.since(have)["observers"]["motors"]
    assert (first["rows"], first["faults"], first["outputs"]) == (ROWS, ["motor1"], ["y"])
    assert times(first)[0] == 10 * SLOT_NS / 1e9
    assert history.since(have) == {}
    history.take_estimate("motors", estimate(ROWS + 10, "motor1"))
    history.take_estimate("motors", estimate(ROWS + 10, "motor1"))
    second = history.since(have)["observers"]["motors"]
    assert (second["rows"], "faults" in second) == (1, False)
    values = np.frombuffer(base64.b64decode(second["values"]), "<f8").tolist()
    assert values == [1.0, ROWS + 10, 0.5, 0.25]


def test_what_a_motor_lost_is_kept_as_a_share_of_its_command() -> None:
    history, have = VehicleHistory(), {}
    commanded = estimate(3, "motor1", "gyro_x") | {"commands": {"motor1": 0.5, "stranger": 0.5}}
    assert history.take_estimate("motors", commanded) == ({"motor1": 3.0, "gyro_x": 3.0}, {"motor1": 6.0})
    values = np.frombuffer(base64.b64decode(history.since(have)["observers"]["motors"]["values"]), "<f8").tolist()
    assert values == [1.0, 6.0, 3.0, 1.0, 0.5, 0.25]
    channel = {"threshold": 0.01, "unit": "fraction of full command", "usual_command": 0.5}
    card = vehicle_card(VehicleStatus("quad"), {"channels": {"motors": {"motor1": channel}}}, "", 1)
    assert card["channels"]["motors"]["motor1"] == [0.02, "% of thrust", 100.0]


def test_other_channels_begin_anew() -> None:
    history, have = VehicleHistory(), {}
    history.take_estimate("motors", estimate(1, "motor1"))
    history.since(have)
    history.take_estimate("motors", estimate(2, "motor1", "motor2"))
    news = history.since(have)["observers"]["motors"]
    assert (news["rows"], news["faults"]) == (1, ["motor1", "motor2"])


def test_names_and_entries_without_end_are_bounded() -> None:
    history = VehicleHistory()
    for k in range(3 * MAX_ENTRIES):
        history.take_estimate(f"observer {k}", estimate(k, "motor1"))
        history.take_event(event(k))
        history.take_status({"time_ns": k, "facts": {"texts": [{"time_ns": k, "text": str(k)}]}}, f"mode {k}")
    news = history.since({})
    assert len(news["observers"]) == MAX_OBSERVERS
    assert [len(news[name]) for name in ("modes", "texts", "events")] == [MAX_ENTRIES] * 3
    assert news["texts"][-1]["text"] == str(3 * MAX_ENTRIES - 1)


def test_modes_have_their_names() -> None:
    beat = {"type": 2, "base_mode": 209, "custom_mode": 5}
    assert flight_mode(beat | {"autopilot": 3}) == "LOITER"
    assert flight_mode(beat | {"autopilot": 3, "base_mode": 81}) == "LOITER, disarmed"
    assert flight_mode({"type": 2, "autopilot": 12, "base_mode": 209, "custom_mode": 3 << 16}) == "POSCTL"
    assert flight_mode(beat | {"autopilot": 0}) == "mode 5"
    assert flight_mode({}) == ""
