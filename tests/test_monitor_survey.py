"""How often a message comes, without the times in which nothing was recorded."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from monitor.fitting.survey import FlightRate

S = 1_000_000_000


def rate(*stamps_s: list[float]) -> float | None:
    found = FlightRate()
    for part in stamps_s:
        found.add(np.rint(np.array(part) * 1e9).astype(np.int64))
    return found.hz


def steps(start_s: float, count: int, hz: float) -> list[float]:
    return [start_s + k / hz for k in range(count)]


def test_minutes_between_two_flights_do_not_count() -> None:
    assert rate([*steps(10.0, 1000, 50.0), *steps(400.0, 3000, 50.0)]) == pytest.approx(50.0)


def test_what_a_bad_link_loses_does() -> None:
    times = [k / 50.0 for k in range(2000) if k % 100 < 50]
    assert rate(times) == pytest.approx(25.0, rel=0.05)


def test_a_message_every_half_minute_is_not_all_gaps() -> None:
    assert rate(steps(5.0, 20, 1 / 30.0)) == pytest.approx(1 / 30.0)


def test_a_measurement_that_is_sent_twice_is_one() -> None:
    assert rate([t for t in steps(5.0, 100, 5.0) for _ in range(2)]) == pytest.approx(5.0)


def test_messages_that_overtake_each_other_and_a_reboot_change_nothing() -> None:
    times = steps(5.0, 1001, 100.0)
    swapped = [times[k ^ 1] if k < 1000 else times[k] for k in range(1001)]
    assert rate(swapped) == pytest.approx(100.0, rel=2e-3)
    assert rate([*times, *times]) == pytest.approx(100.0)


def test_one_message_has_no_rate() -> None:
    assert rate([]) is None
    assert rate([4.0]) is None
    assert rate([4.0, 4.0]) is None


@given(cuts=st.lists(st.integers(0, 400), max_size=5))
def test_it_does_not_matter_how_the_recording_is_cut(cuts: list[int]) -> None:
    times = [*steps(1.0, 300, 20.0), *steps(90.0, 100, 20.0)]
    places = [0, *sorted(cuts), len(times)]
    parts = [times[a:b] for a, b in pairwise(places)]
    assert rate(*parts) == pytest.approx(rate(times), rel=1e-12)
