"""Charts of a page: what a reader has to see of a run is in their data, in people's units, and small."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from synthetic_run import LAYOUT, THRESHOLDS, event, trace

from monitor.trace import Trace, TraceBuilder
from monitor.views.panels import RunView
from replay.reports.charts import BINS, Charts, observer_charts, origin_ns, unwatched

EVENTS = [event(1020, "raised"), event(1300, "cleared"), event(1400, "raised", id="02J", severity="critical")]


def content(run: RunView, shown: Trace, channel: str) -> dict[str, Any]:
    charts = Charts(run)
    assert 'data-chart="0"' in charts.add_fault(shown.layout.observer, channel)
    [found] = json.loads(charts.to_json())
    assert isinstance(found, dict)
    return found


def series(found: dict[str, Any], name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    [values] = [one["y"] for one in found["series"] if one["name"] == name]
    return np.array([np.nan if value is None else value for value in values])


def test_a_fault_s_chart_has_its_estimate_threshold_truth_and_alarms() -> None:
    run = trace()
    truth = {"motor1": (run.vehicle_ns / 1e9, np.where(run.vehicle_ns >= 10_000_000_000, -0.06, 0.0))}
    found = content(RunView([run], EVENTS, THRESHOLDS, truth), run, "motor1")
    after = np.array(found["x"]) > 12.0
    assert found["unit"] == "% of full thrust"
    assert np.nanmedian(series(found, "estimate")[after]) == pytest.approx(-6.0, abs=0.5)
    assert np.nanmax(series(found, "truth")[after]) == pytest.approx(-6.0)
    assert np.nanmedian((series(found, "high") - series(found, "low"))[after]) == pytest.approx(0.8)
    assert found["threshold"] == pytest.approx(1.5)
    assert [(one["severity"], one["to"] is None) for one in found["spans"]] == [("warning", False), ("critical", True)]
    assert found["spans"][0]["from"] == pytest.approx(10.2, abs=0.1)
    assert found["unwatched"][0] == [0.0, 1.0]


def test_a_motor_s_chart_has_the_size_of_its_alarm() -> None:
    run = trace()
    layout = replace(LAYOUT, inputs=LAYOUT.faults, usual_commands=(0.5, 0.5, 0.5, None))
    run = replace(run, layout=layout, u=np.where(np.arange(len(run.u)) < 700, 0.4, 0.8)[:, None] * np.ones(4))
    run.u[300, 1] = np.nan
    truth = {"motor1": (run.vehicle_ns / 1e9, -0.05 * run.u[:, 0])}
    found = content(RunView([run], EVENTS, THRESHOLDS, truth), run, "motor1")
    assert (found["unit"], found["threshold"]) == ("% of thrust", pytest.approx(3.0))
    np.testing.assert_allclose(series(found, "truth")[np.array(found["x"]) != 7.0], -5.0)
    after = np.array(found["x"]) > 12.0
    assert np.nanmedian(series(found, "estimate")[after]) == pytest.approx(-6.0 / 0.8, abs=0.5)
    assert np.isfinite(series(content(RunView([run], [], THRESHOLDS), run, "motor2"), "estimate")[-10:]).all()
    assert content(RunView([run], [], THRESHOLDS), run, "motor 4")["unit"] == "% of full thrust"


def test_an_input_that_never_moves_is_drawn_in_the_middle_of_its_lane() -> None:
    run = trace()
    still = replace(run, u=np.full_like(run.u, 3.0))
    inputs = next(chart for chart in observer_charts(RunView([still], [], {}), still) if chart.title == "inputs")
    assert {value for one in inputs.content["series"] for value in one["y"] if value is not None} == {0.5}


def test_lines_break_where_the_observer_restarted() -> None:
    run = trace()
    found = content(RunView([run], [], {}), run, "motor2")
    broken = np.flatnonzero(np.isnan(series(found, "estimate")))
    assert [found["x"][place] for place in broken] == [7.0]


def test_a_long_run_is_thinned_without_losing_a_peak() -> None:
    run = trace(60_000)
    run.isolated[40_000, 0] = -0.9
    found = content(RunView([run], [], THRESHOLDS), run, "motor1")
    assert len(found["x"]) < 3 * BINS
    assert np.nanmin(series(found, "estimate")) == pytest.approx(-90.0)
    assert found["x"] == sorted(found["x"])


def test_an_observer_s_charts_show_all_of_it_on_one_axis_of_time() -> None:
    run, later = trace(), trace()
    later = replace(later, vehicle_ns=later.vehicle_ns + 5_000_000_000, layout=replace(LAYOUT, observer="other"))
    view = RunView([run, later], EVENTS, THRESHOLDS)
    charts = Charts(view)
    assert len(list(charts.add_observer("other"))) == 2  # none of its channels has a threshold
    assert len(list(charts.add_observer("motors"))) == 3
    residuals, inputs, channels, *_ = json.loads(charts.to_json())
    assert residuals["x"][0] == inputs["x"][0] == 5.0
    assert [one["name"] for one in channels["series"]] == ["motor1", "motor2", "motor3"]
    assert np.nanmedian(series(channels, "motor1")[-100:]) == pytest.approx(-4.0, abs=0.5)
    assert origin_ns(view.traces) == 0


def test_a_run_without_a_sample_has_no_beginning() -> None:
    assert origin_ns([TraceBuilder(LAYOUT).build()]) == 0


def test_no_name_ends_the_data() -> None:
    run = trace(200)
    hostile = replace(run, layout=replace(LAYOUT, inputs=("</script><script>alert(1)</script>", "b", "c", "d")))
    charts = Charts(RunView([hostile], [], {}))
    list(charts.add_observer("motors"))
    text = charts.to_json()
    assert "<" not in text
    assert json.loads(text)[1]["series"][0]["name"] == "</script><script>alert(1)</script>"


def test_where_there_are_no_samples_nothing_was_watched() -> None:
    assert unwatched(trace(), 0, 20.0) == [
        pytest.approx((0.0, 1.0)),
        pytest.approx((5.99, 7.0)),
        pytest.approx((14.99, 20.0)),
    ]
    never = trace()
    never.armed[:] = False
    assert unwatched(never, 0, 20.0) == [(0.0, 20.0)]
