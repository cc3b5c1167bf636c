"""Series collected for plots: complete, bounded, and alarms as spans."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from loopback import START_NS
from synthetic_run import LAYOUT, estimate, event

from adapters.sample import Sample, stacked
from monitor.estimate import Estimate, Estimates, Layout
from monitor.trace import FIRST_ROWS, TraceBuilder, alarm_spans


def test_every_vector_of_every_estimate_is_in_its_own_columns() -> None:
    estimates = [estimate(tick, np.random.default_rng(tick)) for tick in range(10)]
    builder = TraceBuilder(LAYOUT)
    for one in estimates:
        builder.add(one)
    found = builder.build()
    assert found.layout == LAYOUT
    for name in ("x", "fault", "isolated", "residual"):
        np.testing.assert_array_equal(getattr(found, name), [getattr(one, name) for one in estimates])
    np.testing.assert_array_equal(found.u, [one.sample.u for one in estimates])
    np.testing.assert_array_equal(found.y, [one.sample.y for one in estimates])
    assert found.vehicle_ns.tolist() == [one.sample.vehicle_time_ns for one in estimates]
    assert found.unix_ns.tolist() == [one.sample.time_ns for one in estimates]
    assert found.armed.tolist() == [one.armed for one in estimates]
    assert found.restart.tolist() == [True] + [False] * 9


def test_a_trace_is_a_copy_that_later_samples_do_not_change() -> None:
    rng = np.random.default_rng(1)
    builder = TraceBuilder(LAYOUT, max_rows=4)
    for tick in range(4):
        builder.add(estimate(tick, rng))
    before = builder.build()
    kept = before.fault.copy()
    for tick in range(4, 9):
        builder.add(estimate(tick, rng))
    np.testing.assert_array_equal(before.fault, kept)


def test_nothing_collected_is_an_empty_trace() -> None:
    found = TraceBuilder(LAYOUT).build()
    assert found.fault.shape == (0, 4)
    assert found.x.shape == (0, 3)
    assert found.vehicle_ns.shape == (0,)


def test_room_grows_with_the_run() -> None:
    rng = np.random.default_rng(1)
    builder = TraceBuilder(LAYOUT)
    for tick in range(FIRST_ROWS + 1):
        builder.add(estimate(tick, rng))
    assert builder.build().vehicle_ns.tolist() == [tick * 10_000_000 for tick in range(FIRST_ROWS + 1)]


@pytest.mark.parametrize("ticks", [7, 8, 9, 15, 16, 17, 64, 100, 1000])
def test_a_long_run_is_thinned_evenly_from_end_to_end(ticks: int) -> None:
    rng = np.random.default_rng(1)
    builder = TraceBuilder(LAYOUT, max_rows=8)
    for tick in range(ticks):
        builder.add(estimate(tick, rng))
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
    for tick in range(first, 1000):
        builder.add(estimate(tick, rng))
    found = builder.build()
    ticks = found.vehicle_ns // 10_000_000
    [at] = ticks[found.restart]
    assert 700 <= at < 700 + ticks[1] - ticks[0]


def test_a_layout_without_channels_is_collected_too() -> None:
    layout = Layout("o", 1.0, (), (), (), (), ())
    nothing = np.empty(0)
    sample = Sample(0, 0, START_NS, nothing, nothing, True, True)
    builder = TraceBuilder(layout)
    builder.add(Estimate("o", sample, nothing, nothing, nothing, nothing, False, nothing, 0.0))
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
def test_it_does_not_matter_in_which_stretches_estimates_come(lengths: list[int], room: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    estimates = [estimate(tick, rng) for tick in range(sum(lengths))]
    for one in rng.choice(len(estimates), 3):
        estimates[one] = replace(estimates[one], sample=replace(estimates[one].sample, restart=True))
    singly, together = TraceBuilder(LAYOUT, room), TraceBuilder(LAYOUT, room)
    for one in estimates:
        singly.add(one)
    start = 0
    for length in lengths:
        together.extend(in_one(estimates[start : start + length]))
        start += length
    a, b = singly.build(), together.build()
    for name in ("vehicle_ns", "unix_ns", "u", "y", "x", "fault", "isolated", "residual", "sd", "armed", "restart"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def in_one(estimates: list[Estimate]) -> Estimates:
    samples = [one.sample for one in estimates]
    return Estimates(
        observer=estimates[0].observer,
        samples=stacked(samples, len(samples[0].u), len(samples[0].y)),
        x=np.array([one.x for one in estimates]),
        fault=np.array([one.fault for one in estimates]),
        isolated=np.array([one.isolated for one in estimates]),
        residual=np.array([one.residual for one in estimates]),
        armed=np.array([one.armed for one in estimates]),
        sd=np.array([one.sd for one in estimates]),
        coasted_s=np.array([one.coasted_s for one in estimates]),
    )
