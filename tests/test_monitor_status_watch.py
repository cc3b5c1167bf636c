"""What is taken from status topics: states and reasons, whatever else comes."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from loopback import Endpoint, put, until

from adapters.zenoh.zenoh_session import open_session
from monitor.bus.publisher import Publisher
from monitor.bus.status_watch import MAX_VEHICLES, StatusWatch, VehicleStatus, valid_status

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=400),
    lambda inner: st.lists(inner, max_size=12) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=20,
)


@given(VALUES, VALUES)
def test_any_payload_is_a_short_status_or_none(state: Any, reasons: Any) -> None:
    for payload in (state, {"state": state, "reasons": reasons}, {"state": "degraded", "reasons": reasons}):
        status = valid_status("copter-1", payload)
        assert status is None or len(status.line()) < 3200


@pytest.mark.parametrize(
    ("status", "well", "line"),
    [
        (VehicleStatus("a"), True, "a is starting"),
        (VehicleStatus("a", "monitoring"), True, "a is monitoring"),
        (VehicleStatus("a", "stale"), False, "a is stale"),
        (VehicleStatus("a", "starting", ("no X",)), False, "a is starting: no X"),
        (VehicleStatus("a", "degraded", ("no X", "2.5 s behind")), False, "a is degraded: no X; 2.5 s behind"),
    ],
)
def test_a_status_is_said_in_a_line(status: VehicleStatus, well: bool, line: str) -> None:
    assert (status.well, status.line()) == (well, line)


def test_a_status_whose_figures_alone_change_is_of_the_same_kind() -> None:
    first, second = (VehicleStatus("a", "degraded", (f"{size} s behind",)) for size in ("1.5", "12"))
    assert first.kind == second.kind != VehicleStatus("a", "degraded", ("no X",)).kind


def test_the_latest_status_of_each_vehicle_is_kept_and_no_more_than_so_many() -> None:
    endpoint = Endpoint()
    with open_session(connect=[endpoint.address]) as client:
        watch = StatusWatch(client)
        publisher, other = (Publisher(endpoint.session, f"copter-{k}", []) for k in (1, 2))
        other.status({"state": "monitoring", "reasons": []})

        def latest() -> list[VehicleStatus]:
            publisher.status({"state": "degraded", "reasons": ["no ATTITUDE"]})
            return watch.latest()

        until(lambda: VehicleStatus("copter-1", "degraded", ("no ATTITUDE",)) in latest())
        for k in range(MAX_VEHICLES + 50):
            put(endpoint.session, f"fauio/x{k}/status", '{"state": "monitoring"}')
        until(lambda: len(watch.latest()) == MAX_VEHICLES)
        watch.close()
    endpoint.close()
