"""The live view reaches a real receiver, and neither a stalled nor a missing viewer holds up the monitor."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa  # type: ignore[import-untyped]
import pytest
from loopback import free_port, until
from synthetic_run import BOTH_THRESHOLDS, LAYOUT, STANDBY, THRESHOLDS, estimates, event

from adapters.batch import pack
from adapters.errors import UsageError
from adapters.logs.recordings import read_batches
from adapters.message import Message
from adapters.source import MAVLINK
from monitor.estimate import Estimates
from monitor.pipeline import Pipeline
from monitor.profile import Profile
from monitor.views.live_buffer import VehicleView

if TYPE_CHECKING:
    from rerun.chunk import RrdReader

    from monitor.views.live_view import LiveView, ViewMode

EVENTS = [event(1020, "raised"), event(1100, "updated", severity="critical"), event(1300, "cleared")]

FakeRerun = Callable[[str], Path]
ROOT = Path(__file__).parent.parent
SERVER = """
import sys, time
from monitor.views.live_view import RerunProcess
process = RerunProcess("serve", int(sys.argv[1]), 64)
print(process._process.pid, process._guard.pid, flush=True)
if sys.argv[2] == "close":
    process.close()
else:
    time.sleep(600)
"""


def live_view(mode: ViewMode, **options: int) -> LiveView:
    # Rerun's import takes 0.4 s of each process that collects tests
    from monitor.views.live_view import LiveView

    return LiveView(mode, **options)


def tables(path: Path, **selected: Any) -> dict[str, dict[str, list[Any]]]:
    """Return the columns of all entities by path, batches joined, times as whole nanoseconds."""
    found: dict[str, dict[str, list[Any]]] = {}
    for chunk in reader(path).stream(**selected):
        columns = found.setdefault(str(chunk.entity_path), {})
        batch = chunk.to_record_batch()
        for name, column in zip(batch.schema.names, batch.columns, strict=True):
            values = column.cast(pa.int64()) if pa.types.is_temporal(column.type) else column
            columns.setdefault(name, []).extend(values.to_pylist())
    return found


def reader(path: Path) -> RrdReader:
    with warnings.catch_warnings():
        # a stream that was not finished has no footer
        warnings.simplefilter("ignore")
        from rerun.chunk import RrdReader

        return RrdReader(path)


def blueprint_text(path: Path) -> str:
    blueprint = reader(path).blueprints()[-1]
    return " ".join(str(values) for columns in tables(path, store=blueprint).values() for values in columns.values())


def finished(path: Path) -> bool:
    """Return whether a receiver has come to the end of its input and has written its file with a footer."""
    from rerun.chunk import RrdReader

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            RrdReader(path)
        except (Warning, RuntimeError, ValueError):
            return False
    return True


@pytest.fixture
def receiver(fake_rerun: FakeRerun) -> Path:
    """Put Rerun that saves in the place of Rerun that shows; return its file, complete when the view was closed."""
    from monitor.views.live_view import rerun_binary

    return fake_rerun(f'exec {rerun_binary()} - --save "$out" --bind=127.0.0.1 --port={free_port()} 2> /dev/null')


@pytest.fixture
def fake_rerun(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeRerun:
    """Return what puts a shell line in the place of Rerun's executable; it writes to the returned file."""

    def install(line: str) -> Path:
        script, out = tmp_path / "rerun", tmp_path / "out.rrd"
        script.write_text(f'#!/bin/sh\nout={out}\necho "$@" > {tmp_path}/arguments\n{line}\n')
        script.chmod(0o755)
        monkeypatch.setenv("RERUN_CLI_PATH", str(script))
        return out

    return install


def fill(view: VehicleView, ticks: int = 200) -> Estimates:
    """Show a run, of which thinning keeps every fifth row."""
    run = estimates(range(ticks), np.random.default_rng(5))
    fields = {"time_boot_ms": 1, "roll": 0.5, "yaw": 2.0}
    view.estimates(run)
    view.batch(pack([Message(MAVLINK, "ATTITUDE", at_ns, fields) for at_ns in run.samples.time_ns.tolist()]))
    for alarm in EVENTS:
        view.event(alarm)
    return run


def test_a_viewer_that_connects_sees_everything(tmp_path: Path) -> None:
    port, path = free_port(), tmp_path / "seen.rrd"
    live = live_view("serve", port=port, memory_mb=64)
    view = live.vehicle("copter-1", [LAYOUT], THRESHOLDS, {"ATTITUDE"})
    run = fill(view)
    from monitor.views.live_view import rerun_binary

    command = [rerun_binary(), live.url, "--save", str(path), "--bind=127.0.0.1", f"--port={free_port()}"]
    until(lambda: live.batches > 0 and listening(port))
    viewer = subprocess.Popen(command, env=os.environ | {"CI": "1"}, stderr=subprocess.DEVNULL)
    try:
        until(lambda: path.exists() and "/copter-1/log" in entities(path))
    finally:
        viewer.send_signal(signal.SIGINT)
        viewer.wait()
        live.close()
    found = tables(path)
    residual = found["/copter-1/motors/residual"]
    np.testing.assert_array_equal(residual["Scalars:scalars"], run.residual[::5])
    assert residual["unix_time"] == run.samples.time_ns[::5].tolist()
    assert "TimeSeries" in blueprint_text(path)


def entities(path: Path) -> set[str]:
    try:
        return set(tables(path))
    except (RuntimeError, ValueError, OSError):
        return set()


def listening(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def test_nothing_but_loopback_is_listened_on() -> None:
    port = free_port()
    live = live_view("serve", port=port)
    until(lambda: listening(port))
    tables = [Path("/proc/net/tcp"), Path("/proc/net/tcp6")]
    rows = [line.split() for table in tables if table.exists() for line in table.read_text().splitlines()[1:]]
    assert {row[1] for row in rows if row[3] == "0A" and row[1].endswith(f":{port:04X}")} == {f"0100007F:{port:04X}"}
    live.close()
    assert not listening(port)


def test_values_thresholds_alarms_and_telemetry_of_all_vehicles_are_sent(receiver: Path) -> None:
    live = live_view("spawn", memory_mb=99)
    run = fill(live.vehicle("a", [LAYOUT, STANDBY], BOTH_THRESHOLDS, {"ATTITUDE"}))
    fill(live.vehicle("b", [LAYOUT], THRESHOLDS, ()))
    until(lambda: live.batches > 0)
    live.close()
    until(lambda: finished(receiver))
    found = tables(receiver)
    units = [THRESHOLDS["motors", name] for name in LAYOUT.faults[:3]]
    quiet = found["/a/motors/quiet/estimate"]
    np.testing.assert_allclose(quiet["Scalars:scalars"], run.isolated[::5, :3] / units, rtol=1e-12)
    assert quiet["vehicle_time"] == run.samples.vehicle_time_ns[::5].tolist()
    assert found["/a/motors/quiet/threshold"]["Scalars:scalars"][0] == [1.0, -1.0]
    assert found["/b/motors/threshold/motor1"]["Scalars:scalars"][0] == [1.5, -1.5]
    assert found["/b/alarms/motors/motor1"]["StateChange:state"] == [["warning"], ["critical"], [""]]
    assert found["/a/log"]["TextLog:level"] == [["WARN"], ["CRITICAL"], ["INFO"]]
    raw = found["/a/raw/ATTITUDE"]
    assert raw["SeriesLines:names"] == [["roll", "yaw"]]
    assert raw["Scalars:scalars"] == [[0.5, 2.0]] * 40
    assert raw["unix_time"] == run.samples.time_ns[::5].tolist()
    assert not any("raw" in entity for entity in found if entity.startswith("/b/"))
    text = blueprint_text(receiver)
    for part in ("motors / residuals", "standby / quiet", "raw channels", "/b/alarms/**", "StateTimeline", "unix_time"):
        assert part in text
    arguments = (receiver.parent / "arguments").read_text().split()
    assert {"-", "--bind=127.0.0.1", "--memory-limit=99MB"} <= set(arguments)


def test_a_shelved_alarm_is_shown_as_such(receiver: Path) -> None:
    live = live_view("spawn")
    view = live.vehicle("a", [LAYOUT], THRESHOLDS, ())
    for alarm in (EVENTS[0], replace(EVENTS[1], state="shelved", shelved_until_ns=2**60), EVENTS[2]):
        view.event(alarm)
    until(lambda: live.batches > 0)
    live.close()
    until(lambda: finished(receiver))
    assert tables(receiver)["/a/alarms/motors/motor1"]["StateChange:state"] == [["warning"], ["shelved"], [""]]


def test_a_viewer_that_never_reads_stalls_nobody_and_ends_with_the_view(fake_rerun: FakeRerun) -> None:
    fake_rerun("exec sleep 1000")
    live = live_view("spawn")
    view = live.vehicle("a", [LAYOUT], THRESHOLDS, {"ATTITUDE"})
    tick = 0

    def feed() -> bool:
        nonlocal tick
        view.estimates(estimates(range(tick, tick + 5000), np.random.default_rng(5)))
        for _ in range(1000):
            tick += 5
            view.event(event(tick, "raised", message="x" * 1000))
        return live.dropped > 10_000

    until(feed)
    assert len(view) <= 1100
    live.close()


def test_a_viewer_that_is_closed_costs_nothing(fake_rerun: FakeRerun) -> None:
    fake_rerun("exit 0")
    live = live_view("spawn")
    view = live.vehicle("a", [LAYOUT], THRESHOLDS, ())
    until(lambda: live.failures == 1)
    fill(view)
    live.close()
    live.close()


def test_a_port_that_is_taken_and_a_missing_executable_are_said_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        with pytest.raises(UsageError, match=r"cannot listen on 127.0.0.1:[0-9]+: .*; choose another port"):
            live_view("serve", port=other.getsockname()[1])
    monkeypatch.setenv("RERUN_CLI_PATH", "/nowhere/rerun")
    with pytest.raises(UsageError, match="/nowhere/rerun: Rerun's executable is missing"):
        live_view("spawn")


def test_a_process_with_a_view_that_nobody_looks_at_ends_by_itself() -> None:
    program = f"""
from monitor.views.live_view import LiveView
live = LiveView("serve", port={free_port()})
live.vehicle("a", (), {{}}, ())
live.close()
"""
    subprocess.run([sys.executable, "-W", "error", "-c", program], check=True, timeout=30)


def test_a_flight_with_a_motor_fault_shows_its_thresholds_and_its_alarm(
    receiver: Path, quad_profile: Profile, data: Path
) -> None:
    pipeline = Pipeline(quad_profile)
    live = live_view("spawn")
    needed = frozenset[str]().union(*pipeline.needs.values())
    view = live.vehicle(pipeline.vehicle, pipeline.layouts, pipeline.thresholds, needed)
    said = []
    for batch in read_batches(data / "copter_motor2_080.tlog.xz", count=500):
        view.batch(batch)
        for output in pipeline.run(batch):
            if isinstance(output, Estimates):
                view.estimates(output)
            else:
                view.event(output)
                said.append(output)
        until(lambda: len(view) < 400)
    live.close()
    until(lambda: finished(receiver))
    assert live.dropped == 0
    found = tables(receiver)
    import rerun as rr

    root = f"/{rr.escape_entity_path_part(pipeline.vehicle)}"
    assert [text for [text] in found[f"{root}/log"]["TextLog:text"]] == [
        f"{alarm.channel} {alarm.state}: {alarm.message}" for alarm in said
    ]
    assert f"{root}/alarms/motors/motor2" in found
    assert found[f"{root}/motors/quiet/threshold"]["Scalars:scalars"][0] == [1.0, -1.0]
    assert found[f"{root}/motors/quiet/estimate"]["SeriesLines:names"][0] == list(pipeline.layouts[0].faults)
    worst = np.abs(np.array(found[f"{root}/motors/quiet/estimate"]["Scalars:scalars"])).max(axis=0)
    assert worst.argmax() == pipeline.layouts[0].faults.index("motor2")
    assert set(needed) & {name.removeprefix(f"{root}/raw/") for name in found}


def lives(process: int) -> bool:
    """Return whether a process runs; one that has ended may wait to be noticed by its parent."""
    command = ["ps", "-o", "stat=", "-p", str(process)]
    state = subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
    return bool(state) and not state.startswith("Z")


def start_server(then: str) -> tuple[subprocess.Popen[str], list[int]]:
    """Start a process that serves; return it, and the ids of the server and of what watches over it."""
    command = [sys.executable, "-c", SERVER, str(free_port()), then]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    parent = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    assert parent.stdout is not None
    return parent, [int(word) for word in parent.stdout.readline().split()]


def test_a_server_does_not_outlive_a_killed_parent() -> None:
    parent, children = start_server("wait")
    with parent:
        assert all(map(lives, children))
        parent.send_signal(signal.SIGKILL)
    until(lambda: not any(map(lives, children)))


def test_a_server_that_is_closed_leaves_nobody_behind() -> None:
    parent, children = start_server("close")
    with parent:
        assert parent.wait() == 0
    assert not any(map(lives, children))
