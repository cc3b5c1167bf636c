"""Many logs on a Dask cluster of processes: the same as one by one."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from daemons import ENVIRONMENT, FAUIO, free_ports

import fauio

QUAD = Path(__file__).parent.parent / "replay" / "data" / "quad"
CLUSTER = """
import sys
from distributed import LocalCluster

if __name__ == "__main__":
    with LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
        print(cluster.scheduler_address, flush=True)
        sys.stdin.read()
"""


@pytest.fixture
def address(tmp_path: Path) -> Iterator[str]:
    """Start a cluster in another folder and return its scheduler's address."""
    script = tmp_path / "cluster.py"
    script.write_text(CLUSTER)
    with subprocess.Popen(
        [sys.executable, script],
        env=ENVIRONMENT,
        cwd=tmp_path,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as cluster:
        assert cluster.stdout is not None
        yield cluster.stdout.readline().strip()
        cluster.communicate("")


@pytest.mark.long
@pytest.mark.timeout(900)
def test_twenty_flights_give_the_same_one_by_one_in_two_processes_and_on_a_cluster(
    address: str, tmp_path: Path, data: Path
) -> None:
    flights = tmp_path / "flights"
    flights.mkdir()
    for log in data.glob("*.tlog.xz"):
        (flights / log.name).symlink_to(log)
    (flights / "garbage.tlog").write_bytes(b"no telemetry" * 100)
    (flights / "empty.mcap").touch()
    (flights / "cut.tlog.xz").write_bytes((data / "copter_motor2_080.tlog.xz").read_bytes()[:50_000])
    assert len(list(flights.iterdir())) == 20
    said = []
    for run, options in (("one", []), ("two", ["--jobs", "2"]), ("dask", ["--dask", address])):
        # relative paths: workers have another working directory
        command = [*FAUIO, "replay", str(QUAD), "flights", "--json", "--alarms", f"{run}.jsonl", *options]
        done = subprocess.run(command, env=ENVIRONMENT, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 2
        # how far a run is it says after ten seconds, which not every machine takes
        told = [line for line in done.stderr.splitlines() if not line.startswith("fauio: replaying: ")]
        said.append((done.stdout, told, (tmp_path / f"{run}.jsonl").read_text()))
    assert said[0] == said[1] == said[2]
    logs: list[dict[str, Any]] = [json.loads(line) for line in said[0][0].splitlines()]
    assert len(logs) == 20
    assert {"flights/garbage.tlog", "flights/empty.mcap"} <= {log["log"] for log in logs if "error" in log}
    assert sum(len(log["alarms"]) for log in logs) == said[0][2].count("\n") > 0


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:{free}", pytest.param("bogus://x:1", marks=pytest.mark.long)])
def test_an_address_where_nobody_is_gets_one_line(data: Path, address: str) -> None:
    address = address.format(free=free_ports(1)[0])
    command = ["replay", str(QUAD), str(data / "copter_5s.tlog.xz"), "--dask", address]
    code = f"""
import replay.runs.many_logs, sys, fauio
replay.runs.many_logs._CONNECT_S = 0.3
sys.exit(fauio.main({command!r}))
"""
    done = subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert f"--dask {address}: no cluster answers there" in done.stderr
    assert done.stderr.count("\n") == 1


def test_without_dask_one_line_names_the_extra(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], data: Path
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    log = str(data / "copter_5s.tlog.xz")
    assert fauio.main(["replay", str(QUAD), log, "--dask", "tcp://127.0.0.1:1"]) == 2
    assert capsys.readouterr().err == "fauio: --dask: Dask is not installed; run: pip install 'fauio[dask]'\n"
