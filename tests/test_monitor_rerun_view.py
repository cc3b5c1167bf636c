"""The Rerun recording holds what the run held, with a blueprint, and its writer ends by itself."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pytest
from synthetic_run import BOTH_THRESHOLDS, LAYOUT, STANDBY, THRESHOLDS, event, trace

from monitor.trace import TraceBuilder
from monitor.views.panels import RunView
from monitor.views.way import Way

if TYPE_CHECKING:
    from rerun.chunk import RrdReader

EVENTS = [event(1020, "raised"), event(1100, "updated", severity="critical"), event(1300, "cleared")]


def table(chunk: Any) -> dict[str, Any]:
    """Return a chunk's columns by name, times as whole nanoseconds."""
    batch = chunk.to_record_batch()
    return {
        name: (column.cast(pa.int64()) if pa.types.is_temporal(column.type) else column).to_pylist()
        for name, column in zip(batch.schema.names, batch.columns, strict=True)
    }


def write_rrd(path: Path, run: RunView) -> None:
    # Rerun's import takes 0.4 s of each process that collects tests
    from monitor.views.rerun_view import write_rrd

    write_rrd(path, run)


def reader(path: Path) -> RrdReader:
    from rerun.chunk import RrdReader

    return RrdReader(path)


def columns(path: Path, entity: str) -> dict[str, Any]:
    """Return an entity's columns, static ones beside those over time."""
    found: dict[str, Any] = {}
    for chunk in reader(path).stream():
        if chunk.entity_path == entity:
            found |= table(chunk)
    return found


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rerun") / "run.rrd"
    run = trace()
    truth = {"motor1": (run.vehicle_ns / 1e9, np.where(run.vehicle_ns >= 10_000_000_000, -0.03, 0.0))}
    write_rrd(path, RunView([run], EVENTS, THRESHOLDS, truth))
    return path


@pytest.fixture(scope="module")
def two_observers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rerun") / "two.rrd"
    run = trace()
    write_rrd(path, RunView([run, replace(run, layout=STANDBY)], EVENTS, BOTH_THRESHOLDS))
    return path


def test_every_series_is_there_by_name_on_both_time_lines(written: Path) -> None:
    import rerun as rr

    run = trace()
    fault = columns(written, "/motors/fault")
    assert fault["SeriesLines:names"] == [[f"{name} (% of full thrust)" for name in LAYOUT.faults]]
    np.testing.assert_array_equal(fault["Scalars:scalars"], 100.0 * run.fault)
    assert fault["vehicle_time"] == run.vehicle_ns.tolist()
    assert fault["unix_time"] == run.unix_ns.tolist()
    for place, name in enumerate(LAYOUT.faults):
        isolated = columns(written, f"/motors/isolated/{rr.escape_entity_path_part(name)}")
        assert isolated["SeriesLines:names"] == [[f"{name} (% of full thrust)"]]
        np.testing.assert_array_equal(np.ravel(isolated["Scalars:scalars"]), 100.0 * run.isolated[:, place])
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
    for name, level in (("motor1", 1.5), ("motor2", 1.5), ("motor3", 2.0)):
        threshold = columns(written, f"/motors/threshold/{name}")
        assert threshold["Scalars:scalars"] == [[level, -level]] * 2
        assert threshold["SeriesLines:names"] == [[f"threshold of {name}"] * 2]


def test_observers_with_channels_of_one_name_keep_their_own_thresholds(two_observers: Path) -> None:
    own, other = (columns(two_observers, f"/{name}/threshold/motor1") for name in ("motors", "standby"))
    assert own["Scalars:scalars"] == [[1.5, -1.5]] * 2
    assert other["Scalars:scalars"] == [[50.0, -50.0]] * 2


def test_quiet_channels_of_many_stand_in_units_of_their_thresholds(two_observers: Path) -> None:
    run = trace()
    quiet = columns(two_observers, "/motors/quiet/estimate")
    assert quiet["SeriesLines:names"] == [["motor2", "motor3"]]
    np.testing.assert_allclose(quiet["Scalars:scalars"], run.isolated[:, 1:3] / [0.015, 0.02], rtol=1e-12)
    assert columns(two_observers, "/motors/quiet/threshold")["Scalars:scalars"] == [[1.0, -1.0]] * 2
    assert columns(two_observers, "/standby/quiet/estimate")["SeriesLines:names"] == [list(STANDBY.faults)]


def test_a_threshold_is_thick_and_coloured_while_its_alarm_stands(written: Path) -> None:
    span = columns(written, "/motors/span/motor1/critical")
    assert span["Scalars:scalars"][:2] == [[1.5, -1.5]] * 2
    assert np.isnan(span["Scalars:scalars"][2]).all()
    assert span["vehicle_time"] == [10_200_000_000, 13_000_000_000, 13_000_000_001]
    assert span["SeriesLines:widths"][0][0] > 2.0
    assert columns(written, "/motors/span/motor2/critical") == {}


def test_an_alarm_that_stands_at_the_end_is_shown_to_the_end(tmp_path: Path) -> None:
    run = trace()
    write_rrd(tmp_path / "run.rrd", RunView([run], EVENTS[:1], THRESHOLDS))
    span = columns(tmp_path / "run.rrd", "/motors/span/motor1/warning")
    assert span["vehicle_time"][1] == run.vehicle_ns[-1]
    assert span["unix_time"][1] == run.unix_ns[-1]


def test_no_colour_is_lost_on_a_dark_or_a_light_ground(written: Path) -> None:
    for chunk in reader(written).stream():
        colours = table(chunk).get("SeriesLines:colors") or [[]]
        for colour in colours[0] or ():
            red, green, blue = colour >> 24, colour >> 16 & 255, colour >> 8 & 255
            assert 40 < 0.2126 * red + 0.7152 * green + 0.0722 * blue < 215


def test_truth_is_there_where_it_is_known(written: Path) -> None:
    truth = np.ravel(columns(written, "/motors/truth/motor1")["Scalars:scalars"])
    assert set(truth) == {0.0, -3.0}
    assert columns(written, "/motors/truth/motor2") == {}


def test_alarms_are_states_that_end_and_lines_of_text(written: Path) -> None:
    states = columns(written, "/alarms/motors/motor1")
    assert states["StateChange:state"] == [["warning"], ["critical"], [""]]
    assert states["vehicle_time"] == [10_200_000_000, 11_000_000_000, 13_000_000_000]
    assert states["StateConfiguration:values"] == [["warning", "critical", "shelved"]]
    log = columns(written, "/log")
    assert log["TextLog:level"] == [["WARN"], ["CRITICAL"], ["INFO"]]
    assert log["TextLog:text"][0] == ["motor1 raised: motor1 delivers 6 % less than commanded"]


def blueprint_text(path: Path) -> str:
    [blueprint] = reader(path).blueprints()
    assert blueprint.application_id == "fauio"
    return " ".join(
        str(value)
        for chunk in reader(path).stream(store=blueprint)
        for column in table(chunk).values()
        for value in column
    )


def test_a_blueprint_is_inside(written: Path) -> None:
    text = blueprint_text(written)
    for part in ("StateTimeline", "TextLog", "TimeSeries", "faults", "residuals", "/motors/threshold/motor1/**"):
        assert part in text
    assert "quiet" not in text


def test_the_blueprint_has_a_view_for_each_alarm_and_one_for_the_quiet_channels(two_observers: Path) -> None:
    text = blueprint_text(two_observers)
    for view in ("motors / motor1", "motors / quiet", "standby / quiet", "standby / residuals"):
        assert view in text
    assert "standby / motor1" not in text
    assert "motors / motor2" not in text


def test_the_tab_of_the_first_alarm_is_open_and_observers_without_samples_have_none(tmp_path: Path) -> None:
    run = trace()
    both = [replace(run, layout=STANDBY), run, TraceBuilder(replace(LAYOUT, observer="blind")).build()]
    write_rrd(tmp_path / "run.rrd", RunView(both, EVENTS, BOTH_THRESHOLDS))
    recording = reader(tmp_path / "run.rrd")
    [blueprint] = recording.blueprints()
    containers = [(chunk.entity_path, table(chunk)) for chunk in recording.stream(store=blueprint)]
    names = {path: found.get("ContainerBlueprint:display_name") for path, found in containers}
    [active] = [found["ContainerBlueprint:active_tab"] for _, found in containers if _active(found)]
    assert names[f"/{active[0][0].strip('/')}"] == [["motors"]]
    assert "blind" not in blueprint_text(tmp_path / "run.rrd")


def _active(found: dict[str, Any]) -> bool:
    return bool((found.get("ContainerBlueprint:active_tab") or [None])[0])


def test_a_run_without_samples_events_or_observers_is_written_too(tmp_path: Path) -> None:
    write_rrd(tmp_path / "empty.rrd", RunView([TraceBuilder(LAYOUT).build()], [], THRESHOLDS))
    write_rrd(tmp_path / "nothing.rrd", RunView([], EVENTS, {}))
    assert reader(tmp_path / "empty.rrd").blueprints() != []
    assert columns(tmp_path / "nothing.rrd", "/log")["TextLog:level"] != []


def test_the_writer_needs_no_viewer_and_its_process_ends(tmp_path: Path) -> None:
    program = """
import sys
sys.path.insert(0, sys.argv[2])
from synthetic_run import THRESHOLDS, event, trace
from monitor.views.panels import RunView
from monitor.views.rerun_view import write_rrd
from monitor.views.way import Way
write_rrd(sys.argv[1], RunView([trace(50)], [event(10, "raised")], THRESHOLDS))
"""
    command = [sys.executable, "-W", "error", "-c", program, tmp_path / "run.rrd", Path(__file__).parent]
    subprocess.run(command, check=True, timeout=60)
    assert columns(tmp_path / "run.rrd", "/motors/fault")


def test_a_way_is_a_map_and_a_pose_on_the_vehicles_time(tmp_path: Path) -> None:
    run = trace()
    places = np.column_stack([np.linspace(47.0, 47.001, 20), np.full(20, 8.0), np.full(20, 400.0)])
    times = np.linspace(run.unix_ns[0], run.unix_ns[-1], 20).astype(np.int64)
    way = Way(times, places, times, np.zeros((20, 3)))
    write_rrd(tmp_path / "run.rrd", RunView([run], EVENTS, THRESHOLDS, way=way))
    now = columns(tmp_path / "run.rrd", "/map/gps/now")
    np.testing.assert_allclose(np.squeeze(now["GeoPoints:positions"]), places[:, :2])
    assert now["vehicle_time"][0] == run.vehicle_ns[0]
    pose = columns(tmp_path / "run.rrd", "/space/vehicle")
    assert pose["Transform3D:translation"][-1][0][1] == pytest.approx(111.3, abs=0.1)
    assert "Map" in blueprint_text(tmp_path / "run.rrd")
