"""Quantiles of an interval, whatever the latencies; intervals of their own; a histogram that adds up."""

import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from monitor.service.latency import ArrivalClock, Latencies, LatencyStatistics

LATENCIES = st.lists(st.integers(0, 1 << 39), min_size=1, max_size=60)


def filled(latencies: list[int]) -> Latencies:
    found = Latencies()
    found.add(latencies)
    return found


@given(LATENCIES)
def test_quantiles_are_latencies_that_as_many_do_not_exceed(latencies: list[int]) -> None:
    statistics = filled(latencies).statistics()
    ordered = sorted(latencies)
    assert statistics.max_s == ordered[-1] / 1e9
    for percent, found in ((50, statistics.p50_s), (99, statistics.p99_s)):
        assert found == ordered[-(-len(ordered) * percent // 100) - 1] / 1e9


@given(LATENCIES, LATENCIES)
def test_an_interval_knows_only_its_own_latencies(first: list[int], second: list[int]) -> None:
    found = filled(first)
    assert found.end_interval() == filled(first).statistics()
    found.add(second)
    assert found.interval == filled(first).statistics()
    assert found.end_interval() == found.interval == filled(second).statistics()
    assert found.end_interval() == LatencyStatistics()
    assert found.buckets() == filled(first + second).buckets()


@given(LATENCIES)
def test_the_exported_histogram_counts_what_is_below_each_bound(latencies: list[int]) -> None:
    buckets = filled(latencies).buckets()
    assert len(buckets.counts) == len(buckets.bounds_s) + 1
    for bound_s, count in zip(buckets.bounds_s, buckets.counts, strict=False):
        assert count == sum(latency / 1e9 < bound_s for latency in latencies)
    assert buckets.counts[-1] == len(latencies)
    assert abs(buckets.sum_s - sum(latencies) / 1e9) <= 1e-9 * buckets.sum_s


def test_latencies_that_cannot_be_count_at_the_ends() -> None:
    statistics = filled([-5, 1 << 80]).statistics()
    assert statistics.p50_s == 0.0
    assert 1000 < statistics.max_s < 1200


@pytest.mark.parametrize("step_s", [7200, -7200, 3])
def test_what_came_before_the_clock_was_set_is_as_old_as_it_is(monkeypatch: pytest.MonkeyPatch, step_s: int) -> None:
    real, steady, set_ns, gone_ns = time.time_ns, time.monotonic_ns, [0], [0]
    monkeypatch.setattr("time.time_ns", lambda: real() + set_ns[0] + gone_ns[0])
    monkeypatch.setattr("time.monotonic_ns", lambda: steady() + gone_ns[0])
    clock = ArrivalClock()
    came_ns = time.time_ns() - 2_000_000_000
    set_ns[0] = step_s * 1_000_000_000
    before, after = clock.ages_ns([came_ns, time.time_ns() - 1_000_000_000])
    assert 1.99 <= before / 1e9 < 2.9
    assert 0.99 <= after / 1e9 < 1.9
    gone_ns[0] = 61_000_000_000
    assert 4.99 <= clock.ages_ns([time.time_ns() - 5_000_000_000])[0] / 1e9 < 5.9
