"""The Rerun recording holds what the run held, with a blueprint, and its writer ends by itself."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from rerun.chunk import RrdReader
from synthetic_run import LAYOUT, THRESHOLDS, event, trace

from monitor.rerun_view import write_rrd
from monitor.trace import TraceBuilder

EVENTS = [event(1020, "raised"), event(1100, "updated", severity="critical"), event(1300, "cleared")]


def table(chunk: Any) -> dict[str, Any]:
    """Return a chunk's columns by name, times as whole nanoseconds."""
    batch = chunk.to_record_batch()
    return {
        name: (column.cast(pa.int64()) if pa.types.is_temporal(column.type) else column).to_pylist()
        for name, column in zip(batch.schema.names, batch.columns, strict=True)
    }


def columns(path: Path, entity: str) -> dict[str, Any]:
    """Return an entity's columns, static ones beside those over time."""
    found: dict[str, Any] = {}
    for chunk in RrdReader(path).stream():
        if chunk.entity_path == entity:
            found |= table(chunk)
    return found


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rerun") / "run.rrd"
    run = trace()
    truth = {"motor1": (run.vehicle_ns / 1e9, np.where(run.vehicle_ns >= 10_000_000_000, -0.03, 0.0))}
    write_rrd(path, [run], EVENTS, THRESHOLDS, truth)
    return path


def test_every_series_is_there_by_name_on_both_time_lines(written: Path) -> None:
    run = trace()
    fault = columns(written, "/motors/fault")
    isolated = columns(written, "/motors/isolated")
    for found in (fault, isolated):
        assert found["SeriesLines:names"] == [[f"{name} (fraction of full command)" for name in LAYOUT.faults]]
    np.testing.assert_array_equal(isolated["Scalars:scalars"], run.isolated)
    np.testing.assert_array_equal(fault["Scalars:scalars"], run.fault)
    assert fault["vehicle_time"] == run.vehicle_ns.tolist()
    assert fault["unix_time"] == run.unix_ns.tolist()
    for entity, names, values in (
        ("residual", LAYOUT.outputs, run.residual),
        ("state", LAYOUT.states, run.x),
        ("input", LAYOUT.inputs, run.u),
        ("output", LAYOUT.outputs, run.y),
    ):
        found = columns(written, f"/motors/{entity}")
        assert found["SeriesLines:names"] == [list(names)]
        np.testing.assert_array_equal(found["Scalars:scalars"], values)


def test_thresholds_are_lines_above_and_below_zero(written: Path) -> None:
    shared = columns(written, "/motors/threshold/0.015")
    assert shared["Scalars:scalars"] == [[0.015, -0.015]] * 2
    assert shared["SeriesLines:names"] == [["threshold of motor1, motor2"] * 2]
    assert columns(written, "/motors/threshold/0.02")["Scalars:scalars"] == [[0.02, -0.02]] * 2


def test_truth_is_there_where_it_is_known(written: Path) -> None:
    truth = np.ravel(columns(written, "/motors/truth/motor1")["Scalars:scalars"])
    assert set(truth) == {0.0, -0.03}
    assert columns(written, "/motors/truth/motor2") == {}


def test_alarms_are_states_that_end_and_lines_of_text(written: Path) -> None:
    states = columns(written, "/alarms/motors/motor1")
    assert states["StateChange:state"] == [["warning"], ["critical"], [""]]
    assert states["vehicle_time"] == [10_200_000_000, 11_000_000_000, 13_000_000_000]
    assert states["StateConfiguration:values"] == [["warning", "critical"]]
    log = columns(written, "/log")
    assert log["TextLog:level"] == [["WARN"], ["CRITICAL"], ["INFO"]]
    assert log["TextLog:text"][0] == ["motor1 raised: motor1 delivers 6 % less than commanded"]


def test_a_blueprint_is_inside(written: Path) -> None:
    [blueprint] = RrdReader(written).blueprints()
    assert blueprint.application_id == "fauio"
    text = " ".join(
        str(value)
        for chunk in RrdReader(written).stream(store=blueprint)
        for column in table(chunk).values()
        for value in column
    )
    for part in ("StateTimeline", "TextLog", "TimeSeries", "faults", "residuals", "/motors/threshold/**"):
        assert part in text


def test_a_run_without_samples_events_or_observers_is_written_too(tmp_path: Path) -> None:
    write_rrd(tmp_path / "empty.rrd", [TraceBuilder(LAYOUT).build()], [], THRESHOLDS, {})
    write_rrd(tmp_path / "nothing.rrd", [], EVENTS, {})
    assert RrdReader(tmp_path / "empty.rrd").blueprints() != []
    assert columns(tmp_path / "nothing.rrd", "/log")["TextLog:level"] != []


def test_the_writer_needs_no_viewer_and_its_process_ends(tmp_path: Path) -> None:
    program = """
import sys
sys.path.insert(0, sys.argv[2])
from synthetic_run import THRESHOLDS, event, trace
from monitor.rerun_view import write_rrd
write_rrd(sys.argv[1], [trace(50)], [event(10, "raised")], THRESHOLDS)
"""
    command = [sys.executable, "-W", "error", "-c", program, tmp_path / "run.rrd", Path(__file__).parent]
    subprocess.run(command, check=True, timeout=60)
    assert columns(tmp_path / "run.rrd", "/motors/fault")
