"""What waits for the live view is bounded, thinned and counted, whatever telemetry looks like."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from loopback import START_NS
from synthetic_run import LAYOUT, THRESHOLDS, estimates, event

from adapters.batch import pack
from adapters.message import Message
from adapters.source import MAVLINK
from monitor.estimate import Estimates
from monitor.views.live_buffer import MAX_EVENTS, MAX_FIELDS, MAX_WAITING_ROWS, VehicleView

SAMPLE = estimates([0], np.random.default_rng(3))


def view() -> VehicleView:
    return VehicleView("copter-1", [LAYOUT], THRESHOLDS, {"ATTITUDE"})


def at(*ticks: int) -> Estimates:
    return estimates(ticks, np.random.default_rng(3))


def show(shown: VehicleView, *messages: Message) -> None:
    shown.batch(pack(messages))


def attitude(fields: dict[str, Any], after_ns: int = 0) -> Message:
    return Message(MAVLINK, "ATTITUDE", START_NS + after_ns, fields, 1, 1)


def test_estimates_are_thinned_to_twenty_a_second() -> None:
    shown = view()
    for start in range(0, 200, 4):
        shown.estimates(at(*range(start, start + 4)))
    [trace] = shown.drain().traces
    assert np.diff(trace.unix_ns).tolist() == [50_000_000] * 39


def test_ten_minutes_of_estimates_and_a_thousand_events_stay_bounded_and_are_counted() -> None:
    shown = view()
    shown.estimates(at(*range(60_000)))
    for seq in range(1000):
        shown.event(event(seq, "raised"))
    assert len(shown) == MAX_WAITING_ROWS + MAX_EVENTS
    assert shown.dropped == 12_000 - MAX_WAITING_ROWS + 1000 - MAX_EVENTS
    batch = shown.drain()
    assert batch.traces[0].unix_ns[-1] == START_NS + 59_995 * 10_000_000
    assert batch.events[-1].seq == 999
    assert len(shown) == 0


def test_time_that_jumps_back_is_shown_at_once() -> None:
    shown = view()
    shown.estimates(at(1000, 1, 2, 10))
    assert len(shown.drain().traces[0].unix_ns) == 3


def test_only_wanted_messages_and_their_numbers_are_shown() -> None:
    shown = view()
    show(shown, replace(attitude({"roll": 1.0}), name="PARAM_VALUE"))
    show(shown, attitude({"time_boot_ms": 5, "roll": 0.1, "name": "x", "ok": True, "q": [1.0, 2], "a": {"b": 3}}))
    show(shown, attitude({"roll": "text", "q": [4.0]}, 60_000_000))
    [raw] = shown.drain().raw
    assert raw.fields == ("roll", "q.0", "q.1", "a.b")
    np.testing.assert_array_equal(raw.values, [[0.1, 1.0, 2.0, 3.0], [math.nan, 4.0, math.nan, math.nan]])
    assert raw.unix_ns.tolist() == [START_NS, START_NS + 60_000_000]


def test_numbers_in_columns_are_thinned_by_sender() -> None:
    shown = view()
    messages = [attitude({"roll": float(k)}, k * 10_000_000) for k in range(10)]
    show(shown, *messages, *(replace(message, component=2) for message in messages))
    [raw] = shown.drain().raw
    assert raw.values[:, 0].tolist() == [0.0, 5.0] * 2


def test_a_hostile_message_costs_a_bounded_number_of_fields() -> None:
    shown = view()
    nested: Any = 1.0
    for _ in range(500):
        nested = {"deeper": nested}
    show(shown, attitude({"deep": nested, "huge": 10**400} | {f"f{k}": k for k in range(100_000)}))
    [raw] = shown.drain().raw
    assert raw.values.shape == (1, MAX_FIELDS)
    assert math.isnan(raw.values[0, 0])


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3) | st.binary(max_size=3),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=4),
    max_leaves=20,
)


@given(st.lists(st.dictionaries(st.text(max_size=3), values, max_size=5), max_size=4))
def test_fields_of_any_form_are_taken(messages: list[dict[str, Any]]) -> None:
    shown = view()
    for place, fields in enumerate(messages):
        show(shown, attitude(fields, place * 100_000_000))
    for raw in shown.drain().raw:
        assert raw.values.shape == (len(raw.unix_ns), len(raw.fields))


def test_other_observers_are_left_out_and_thresholds_can_change() -> None:
    shown = view()
    shown.estimates(replace(SAMPLE, observer="other"))
    assert len(shown) == 0
    shown.retune({("motors", "motor1"): 0.5})
    assert shown.thresholds == {("motors", "motor1"): 0.5}
    shown.flush()
    assert deque(shown.drain().traces) == deque()
