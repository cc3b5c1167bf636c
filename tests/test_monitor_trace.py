"""Series collected for plots: complete, bounded, and alarms as spans."""

from __future__ import annotations

from dataclasses import replace
from itertools import accumulate, pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from loopback import START_NS
from synthetic_run import LAYOUT, estimates, event

from monitor.estimate import Layout
from monitor.trace import FIRST_ROWS, TraceBuilder, alarm_spans


def test_every_vector_of_every_estimate_is_in_its_own_columns() -> None:
    given = estimates(range(10), np.random.default_rng(1))
    builder = TraceBuilder(LAYOUT)
    builder.extend(given)
    found = builder.build()
    assert found.layout == LAYOUT
    for name in ("x", "fault", "isolated", "residual", "sd", "armed"):
        np.testing.assert_array_equal(getattr(found, name), getattr(given, name))
    np.testing.assert_array_equal(found.u, given.samples.u)
    np.testing.assert_array_equal(found.y, given.samples.y)
    assert found.vehicle_ns.tolist() == given.samples.vehicle_time_ns.tolist()
    assert found.unix_ns.tolist() == given.samples.time_ns.tolist()
    assert found.restart.tolist() == [True] + [False] * 9


def test_a_trace_is_a_copy_that_later_samples_do_not_change() -> None:
    rng = np.random.default_rng(1)
    builder = TraceBuilder(LAYOUT, max_rows=4)
    builder.extend(estimates(range(4), rng))
    before = builder.build()
    kept = before.fault.copy()
    builder.extend(estimates(range(4, 9), rng))
    np.testing.assert_array_equal(before.fault, kept)


def test_nothing_collected_is_an_empty_trace() -> None:
    found = TraceBuilder(LAYOUT).build()
    assert found.fault.shape == (0, 4)
    assert found.x.shape == (0, 3)
    assert found.vehicle_ns.shape == (0,)


def test_room_grows_with_the_run() -> None:
    rng = np.random.default_rng(1)
    builder = TraceBuilder(LAYOUT)
    builder.extend(estimates(range(FIRST_ROWS + 1), rng))
    assert builder.build().vehicle_ns.tolist() == [tick * 10_000_000 for tick in range(FIRST_ROWS + 1)]


@pytest.mark.parametrize("ticks", [7, 8, 9, 15, 16, 17, 64, 100, 1000])
def test_a_long_run_is_thinned_evenly_from_end_to_end(ticks: int) -> None:
    rng = np.random.default_rng(1)
    builder = TraceBuilder(LAYOUT, max_rows=8)
    builder.extend(estimates(range(ticks), rng))
    kept = (builder.build().vehicle_ns // 10_000_000).tolist()
    steps = {b - a for a, b in pairwise(kept)}
    assert len(kept) <= 8
    assert len(steps) == 1
    assert kept[0] == 0
    assert ticks - kept[-1] <= max(steps)


@pytest.mark.parametrize("first", range(400, 417))
def test_thinning_keeps_a_restart_at_the_next_kept_sample(first: int) -> None:
    rng = np.random.default_rng(1)
    builder = TraceBuilder(LAYOUT, max_rows=16)
    builder.extend(estimates(range(first, 1000), rng))
    found = builder.build()
    ticks = found.vehicle_ns // 10_000_000
    [at] = ticks[found.restart]
    assert 700 <= at < 700 + ticks[1] - ticks[0]


def test_a_layout_without_channels_is_collected_too() -> None:
    layout = Layout("o", 1.0, (), (), (), (), ())
    given = estimates([0], np.random.default_rng(1))
    nothing = np.empty((1, 0))
    samples = replace(given.samples, u=nothing, y=nothing)
    builder = TraceBuilder(layout)
    vectors = dict.fromkeys(("x", "fault", "isolated", "residual", "sd"), nothing)
    builder.extend(replace(given, samples=samples, **vectors))
    assert builder.build().fault.shape == (1, 0)


def test_an_alarm_is_a_span_from_raised_to_cleared() -> None:
    events = [
        event(1020, "raised"),
        event(1030, "raised", id="02J", channel="motor2"),
        event(1100, "updated", severity="critical"),
        event(1200, "cleared"),
        event(1300, "raised", id="03J"),
    ]
    first, second, third = alarm_spans(events)
    assert (first.channel, first.severity) == ("motor1", "critical")
    assert (first.start_vehicle_ns, first.end_vehicle_ns) == (10_200_000_000, 12_000_000_000)
    assert (first.start_ns, first.end_ns) == (START_NS + 10_200_000_000, START_NS + 12_000_000_000)
    assert (second.channel, second.severity, second.end_ns) == ("motor2", "warning", None)
    assert (third.start_vehicle_ns, third.end_vehicle_ns) == (13_000_000_000, None)


def test_no_events_are_no_spans() -> None:
    assert alarm_spans([]) == []


@given(st.lists(st.integers(1, 40), min_size=1, max_size=8), st.sampled_from([4, 10, 64]), st.integers(0, 99))
def test_a_trace_does_not_depend_on_how_estimates_are_cut(lengths: list[int], room: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    run = estimates(range(sum(lengths)), rng)
    run.samples.restart[rng.choice(len(run), 3)] = True
    rows, parts = TraceBuilder(LAYOUT, room), TraceBuilder(LAYOUT, room)
    for row in range(len(run)):
        rows.extend(run.part(row, row + 1))
    for start, length in zip(accumulate([0, *lengths]), lengths, strict=False):
        parts.extend(run.part(start, start + length))
    a, b = rows.build(), parts.build()
    for name in ("vehicle_ns", "unix_ns", "u", "y", "x", "fault", "isolated", "residual", "sd", "armed", "restart"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
