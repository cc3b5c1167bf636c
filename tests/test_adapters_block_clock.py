"""The clock over a stretch of messages does what it does message by message."""

from __future__ import annotations

import numpy as np
from blocks import clock_state
from hypothesis import given, settings
from hypothesis import strategies as st

from monitor.sampling.block_clock import LineChange, observe_block, unix_times, unwrapped
from monitor.sampling.clock import TURNS_NS, Line, Point, VehicleClock

MS = 1_000_000
SECOND = 1_000 * MS
UNIX = 1_795_251_917 * SECOND


@given(
    st.lists(st.tuples(st.integers(-300, 900), st.integers(0, 10**9)), max_size=300),
    st.sampled_from([1, 1_000, 60_000, 6_000_000]),
    st.lists(st.integers(0, 300), max_size=4),
    st.integers(0, 1 << 40),
)
@settings(deadline=None)
def test_stamps_taken_together_leave_the_same_clock(
    arrivals: list[tuple[int, int]], spread_us: int, cuts: list[int], start_ns: int
) -> None:
    one, other = VehicleClock(), VehicleClock()
    for clock in (one, other):
        clock.observe(start_ns + SECOND, UNIX + start_ns)
    stamps, received, believed = [], [], []
    for step_ms, delay in arrivals:
        stamps.append(max(0, one.newest_ns + step_ms * MS))
        received.append(UNIX + stamps[-1] + delay * spread_us * 1_000 // 10**9 - (6 * SECOND if delay % 50 == 1 else 0))
        believed.append(one.observe(stamps[-1], received[-1]))
    assert all(believed)
    lines = []
    for start, stop in zip([0, *sorted(cuts)], [*sorted(cuts), len(stamps)], strict=True):
        rows = slice(start, stop)
        place = np.arange(len(stamps[rows])) * 2
        changes = observe_block(other, place, np.array(stamps[rows], np.int64), np.array(received[rows], np.int64))
        lines += [change.line for change in changes]
    assert clock_state(other) == clock_state(one)
    assert one.line == (lines or [one.line])[-1]


@given(st.lists(st.tuples(st.integers(0, TURNS_NS[1]), st.integers(-3, 3), st.booleans()), min_size=1, max_size=50))
def test_counters_that_turned_over_are_continued_alike(cases: list[tuple[int, int, bool]]) -> None:
    stamps, newest = [], []
    for newest_ns, away, second in cases:
        turn_ns = TURNS_NS[second]
        stamps.append(max(0, newest_ns + away * SECOND // 2) % turn_ns)
        newest.append(newest_ns)
    expected = []
    for stamp_ns, newest_ns in zip(stamps, newest, strict=True):
        clock = VehicleClock()
        clock.observe(newest_ns, UNIX)
        expected.append(stamp_ns if stamp_ns >= newest_ns - SECOND else clock.unwrap(stamp_ns))
    assert unwrapped(np.array(stamps), np.array(newest)).tolist() == expected


@given(
    st.lists(st.tuples(st.integers(0, 60), st.integers(-900 * MS, 900 * MS)), max_size=60),
    st.integers(-(1 << 31), 1 << 31),
    st.integers(1, 1 << 40),
    st.none() | st.integers(-1_500 * MS, 1_500 * MS),
)
def test_unix_times_never_stand_still_by_the_samplers_rule(
    ticks: list[tuple[int, int]], rise_ns: int, run_ns: int, before: int | None
) -> None:
    changes, ticks_ns, place, at = [LineChange(-1, Line(Point(0, UNIX)))], [], [], 5 * SECOND
    for number, (step, jump) in enumerate(ticks):
        at += 1 + step * MS
        if jump % 4 == 0:
            changes.append(LineChange(number, Line(Point(at - SECOND, UNIX + jump), rise_ns, run_ns)))
        ticks_ns.append(at)
        place.append(number - jump % 2)
    place = sorted(place)
    last = None if before is None else (5 * SECOND, UNIX + 5 * SECOND + before)
    known, expected = last, []
    for tick_ns, where in zip(ticks_ns, place, strict=True):
        line = [change.line for change in changes if change.place <= where][-1]
        unix_ns = tick_ns + line.at(tick_ns)
        if known is not None and 0 < (least_ns := known[1] + (tick_ns - known[0]) // 2) - unix_ns < SECOND:
            unix_ns = least_ns
        known = tick_ns, unix_ns
        expected.append(unix_ns)
    found = unix_times(changes, np.array(place, np.int64), np.array(ticks_ns, np.int64), last)
    assert found.tolist() == expected
