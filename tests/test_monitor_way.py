"""The way of a flight: where GPS says it went, where it went by the estimates, and how the vehicle was turned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loopback import START_NS
from synthetic_run import LAYOUT, trace

from adapters.batch import pack
from adapters.message import Message
from adapters.source import MAVLINK
from monitor.views.way import Way, way_of

SECOND = 1_000_000_000


def message(name: str, second: float, **fields: float) -> Message:
    return Message(MAVLINK, name, START_NS + round(second * SECOND), dict(fields), 1, 1)


@pytest.fixture
def way() -> Way:
    fixes = [message("GPS_RAW_INT", k, lat=470_000_000 + 90 * k, lon=80_000_000, alt=400_000) for k in range(15)]
    turns = [message("ATTITUDE", k, roll=0.0, pitch=0.0, yaw=np.pi / 2) for k in range(15)]
    lost = message("GPS_RAW_INT", 0.0, lat=-350_000_000, lon=1_470_000_000, alt=0, fix_type=1)
    found = way_of([pack([message("GPS_RAW_INT", 0.0, lat=0, lon=0, alt=0), lost]), pack(fixes), pack(turns)])
    assert found is not None
    return found


def test_it_goes_north_in_metres_and_has_no_place_without_a_fix(way: Way) -> None:
    metres = way.metres(way.places)
    np.testing.assert_allclose(metres[-1], [0.0, 14 * 90 * 0.0111319, 0.0], atol=0.01)
    assert len(way.places) == 15


def test_what_gps_is_pulled_by_is_taken_off(way: Way) -> None:
    run = trace()
    layout = replace(LAYOUT, faults=("gps_north", "gps_east", "a", "b"))
    isolated = np.zeros_like(run.isolated)
    isolated[run.unix_ns >= START_NS + 10 * SECOND, :2] = [3.0, -2.0]
    real = way.metres(way.real([run, replace(run, layout=layout, isolated=isolated)])) - way.metres(way.places)
    np.testing.assert_allclose(real[:9], 0.0, atol=1e-6)
    np.testing.assert_allclose(real[11:14], [[2.0, -3.0, 0.0]] * 3, atol=1e-3)


def test_a_vehicle_that_heads_east_points_there(way: Way) -> None:
    ahead, right, down = way.rotations()[0].T
    np.testing.assert_allclose([ahead, right, down], [[1, 0, 0], [0, -1, 0], [0, 0, -1]], atol=1e-12)


def test_a_recording_without_places_has_none() -> None:
    assert way_of([pack([message("ATTITUDE", 0.0, roll=0.0, pitch=0.0, yaw=0.0)])]) is None
