"""The slope of evidence: right for ramps, silent at first, never a growth where there is none."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from monitor.core.alarms import Trend

STEP_NS = 10_000_000


def trend_of(values: list[float]) -> Trend:
    trend = Trend()
    for value in values:
        trend.update(value, STEP_NS)
    return trend


@pytest.mark.parametrize("slope", [0.01, -0.03])
def test_a_ramp_is_continued(slope: float) -> None:
    trend = trend_of([slope * k / 100 for k in range(2000)])
    assert trend.size_in(5.0) == pytest.approx(abs(slope) * 25.0, rel=0.01)


def test_nothing_is_said_in_the_first_three_seconds() -> None:
    ramp = [0.1 * k for k in range(299)]
    assert trend_of(ramp).size_in(5.0) == 0.0
    assert trend_of([*ramp, 30.0, 30.1, 30.2]).size_in(5.0) > 30.0


def test_what_shrinks_or_stays_does_not_grow() -> None:
    assert trend_of([1.0] * 1000).size_in(5.0) == 0.0
    assert trend_of([10.0 - 0.005 * k for k in range(1000)]).size_in(5.0) == 0.0


def test_time_that_stands_still_changes_nothing() -> None:
    trend = trend_of([0.001 * k for k in range(1000)])
    before = trend.size_in(5.0)
    trend.update(1e9, 0)
    assert trend.size_in(5.0) == before


@given(st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=500), st.floats(0.0, 10.0))
def test_no_continuation_leaves_the_bounds_that_the_evidence_sets(values: list[float], seconds: float) -> None:
    # Means lie within the evidence, so the slope is at most its whole range within 1.5 s.
    assert 0.0 <= trend_of(values).size_in(seconds) <= 1.0 + 2.0 / 1.5 * (0.5 + seconds) + 1e-9
