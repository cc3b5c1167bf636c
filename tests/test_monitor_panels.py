"""Channels with an alarm or a known truth get a panel each, quiet ones of many share one; the ground sets no scale."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic_run import BOTH_THRESHOLDS, LAYOUT, STANDBY, THRESHOLDS, trace

from monitor.trace import TraceBuilder
from monitor.views.panels import Panels, choose_panels, fault_limits, same_scale

ALL = (0, 1, 2, 3)


def test_few_channels_get_a_panel_each() -> None:
    assert choose_panels([LAYOUT], {("motors", "motor1")}, (), THRESHOLDS) == (Panels(ALL, ()),)
    assert choose_panels([], (), (), {}) == ()


def test_of_many_those_with_an_alarm_of_their_own_observer_get_a_panel() -> None:
    layouts = [replace(LAYOUT, observer="first"), STANDBY]
    thresholds = BOTH_THRESHOLDS | {("first", name): 0.1 for name in LAYOUT.faults}
    alarmed = {("standby", "motor2"), ("standby", "unexplained"), ("telemetry", "motor1")}
    assert choose_panels(layouts, alarmed, (), thresholds) == (Panels((), ALL), Panels((1,), (0, 2, 3)))


def test_a_known_truth_is_shown_by_every_observer_that_estimates_it() -> None:
    first, second = choose_panels([LAYOUT, STANDBY], (), {"motor3"}, BOTH_THRESHOLDS)
    assert second == Panels((2,), (0, 1, 3))
    assert first.alone == (2, 3)


@pytest.mark.parametrize("threshold", [None, 0.0])
def test_a_channel_that_cannot_be_measured_in_thresholds_stands_alone(threshold: float | None) -> None:
    thresholds = dict(BOTH_THRESHOLDS)
    del thresholds["standby", "motor1"]
    if threshold is not None:
        thresholds["standby", "motor1"] = threshold
    assert choose_panels([LAYOUT, STANDBY], (), (), thresholds)[1] == Panels((0,), (1, 2, 3))


def test_few_channels_of_one_unit_share_their_scale_and_an_alarm_among_many_has_its_own() -> None:
    mixed = replace(LAYOUT, fault_units=("m", "rad", "m", "m"))
    assert same_scale(mixed, Panels(ALL, ()), 2) == (0, 2, 3)
    assert same_scale(mixed, Panels((0, 2), (1, 3)), 2) == (2,)


def test_what_happens_while_alarms_are_not_armed_sets_no_scale() -> None:
    run = trace()
    before = fault_limits(run, ALL, THRESHOLDS, {})
    run.isolated[:100] = 30.0
    assert fault_limits(run, ALL, THRESHOLDS, {}) == before
    run.armed[:] = False
    assert fault_limits(run, ALL, THRESHOLDS, {})[1] > 30.0


def test_thresholds_and_truth_are_inside_the_scale() -> None:
    run = trace()
    low, high = fault_limits(run, [1], {("motors", "motor2"): 4.0, ("standby", "motor2"): 50.0}, {})
    assert -5.0 < low < -4.0 < 4.0 < high < 5.0
    low, high = fault_limits(run, [1], THRESHOLDS, {"motor2": (np.arange(3.0), np.array([0.0, 9.0, np.nan]))})
    assert 8.9 < high < 10.0


def test_a_run_without_samples_has_a_scale() -> None:
    empty = TraceBuilder(replace(LAYOUT, inputs=(), fault_units=("m",) * 4)).build()
    low, high = fault_limits(empty, ALL, {}, {})
    assert low < 0.0 < high
