"""Pacing: nothing before its time, order kept, no drift."""

from __future__ import annotations

import time

import pytest

from adapters.errors import UsageError
from adapters.simulation.pacing import paced


def test_items_come_in_order_and_none_before_its_time() -> None:
    start = time.monotonic_ns()
    items = [(1_000_000_000 + k * 20_000_000, k) for k in range(6)]
    for k in paced(items, 2.0):
        assert time.monotonic_ns() - start >= k * 10_000_000
    assert list(paced(items, 1e6)) == list(range(6))


def test_an_item_that_is_late_does_not_delay_those_behind_it() -> None:
    start = time.monotonic()
    for k in paced([(k * 50_000_000, k) for k in range(5)], 1.0):
        if k == 0:
            time.sleep(0.2)
    late = time.monotonic() - start
    assert late >= 0.2
    assert list(paced([(5, "a"), (3, "b"), (4, "c")], 1.0)) == ["a", "b", "c"]


def test_the_schedule_moves_where_too_much_time_was_lost() -> None:
    start = time.monotonic()
    for k in paced([(k * 50_000_000, k) for k in range(5)], 1.0, catch_up_s=0.05):
        if k == 0:
            time.sleep(0.2)
    assert time.monotonic() - start >= 0.2 + 3 * 0.05


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan")])
def test_a_speed_has_to_be_positive(speed: float) -> None:
    with pytest.raises(UsageError, match="has to be positive"):
        list(paced([], speed))
