"""Vehicles as live UDP into one daemon for a long time: what is lost, how late it is, what it costs.

    python bench/soak.py [--minutes 30] [--vehicles 4] [--flights FOLDER --profile FOLDER] [--json]

Everything is measured from outside the daemon: samples against what an offline pipeline makes of the very packets that
were sent, alarms by a plain Zenoh client in a process of its own against the time of sending of the packet that caused
them, memory and processor time from /proc. What the daemon says of itself stands beside it. Exit status 1 where a limit
is broken.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "tools"))

from fleet_sender import SentFlight, read_flight
from soak_expected import Expected, expected

from monitor.profile import read_profile

ROOT = Path(__file__).parent.parent
PROFILE = ROOT / "replay" / "data" / "quad"
FLIGHTS = (
    ROOT / "replay" / "data" / "copter_motor1.tlog.xz",
    *(ROOT / "tests" / "data" / f"copter_{name}.tlog.xz" for name in ("gps_step25m", "baro_glitch", "gyro1_bias")),
)
VEHICLES = 4
START_S = 60.0
SETTLE_S = 15.0
SAMPLE_S = 1.0
HELD_UP_S = 0.2
# Memory of a process that has just started grows: shorter runs say nothing about a leak.
MEMORY_MINUTES = 10.0
LIMITS = {"memory_percent": 2.0, "alarm_latency_p99_ms": 40.0, "cpu_percent_per_vehicle": 25.0}


@dataclass(frozen=True, slots=True)
class Reading:
    """The daemon's process at one moment: seconds since the begin, resident megabytes, seconds of processor time."""

    at_s: float
    resident_mb: float
    cpu_s: float


@dataclass(frozen=True, slots=True)
class Setup:
    """Where everything of one run is, whether the daemon records, and the core it is bound to, if any."""

    folder: Path
    profile: Path
    logs: Sequence[Path]
    udp: str
    zenoh: str
    metrics: str
    recorded: bool = True
    core: int | None = None

    @property
    def heard(self) -> Path:
        """What the listener writes."""
        return self.folder / "heard.jsonl"

    @property
    def times(self) -> Path:
        """When the sender sent what."""
        return self.folder / "times"

    def config(self) -> Path:
        """Write the daemon's configuration."""
        lines = [
            f'mavlink = "udpin:{self.udp}"',
            f'listen = ["{self.zenoh}"]',
            'log_format = "json"',
            f'metrics = {{ listen = "{self.metrics}" }}',
        ]
        if self.recorded:
            lines += [
                'recording = { folder = "recordings", file_mb = 20, budget_mb = 60 }',
                'black_box = { folder = "clips", budget_mb = 60 }',
                'journal = { path = "journal.db" }',
            ]
        for system in range(1, len(self.logs) + 1):
            lines += ["[[vehicle]]", f'name = "{name_of(system)}"', f'profile = "{self.profile}"', f"system = {system}"]
        path = self.folder / "soak.toml"
        path.write_text("\n".join(lines) + "\n")
        return path


def name_of(system: int) -> str:
    return f"copter-{system}"


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def set_up(folder: Path, profile: Path, logs: Sequence[Path], **options: Any) -> Setup:
    return Setup(
        folder=folder,
        profile=profile.resolve(),
        logs=logs,
        udp=f"127.0.0.1:{free_port(socket.SOCK_DGRAM)}",
        zenoh=f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}",
        metrics=f"127.0.0.1:{free_port(socket.SOCK_STREAM)}",
        **options,
    )


@contextmanager
def running(command: Sequence[str], error: Path, **options: Any) -> Iterator[subprocess.Popen[str]]:
    """Run a process that ends with the block at the latest."""
    with error.open("w") as stderr:
        process = subprocess.Popen(  # noqa: S603 - our own commands
            [sys.executable, *command], cwd=ROOT, stderr=stderr, text=True, **options
        )
        try:
            yield process
        finally:
            process.kill()
            process.wait()


def lines_of(path: Path) -> list[dict[str, Any]]:
    text = path.read_text() if path.exists() else ""
    return [json.loads(line) for line in text.splitlines(keepends=True) if line.endswith("\n")]


def last_statuses(heard: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    return {line["key"].split("/")[1]: line["payload"] for line in heard if line["key"].endswith("/status")}


def read_process(pid: int, begin: float) -> Reading:
    status = Path(f"/proc/{pid}/status").read_text()
    resident = next(line for line in status.splitlines() if line.startswith("VmRSS:")).split()[1]
    times = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    cpu_s = (int(times[11]) + int(times[12])) / os.sysconf("SC_CLK_TCK")
    return Reading(time.monotonic() - begin, int(resident) / 1024.0, cpu_s)


def wait_for(condition: Any, process: subprocess.Popen[str], limit_s: float, what: str) -> None:
    until = time.monotonic() + limit_s
    while not condition():
        if process.poll() is not None:
            raise RuntimeError(f"the daemon ended with status {process.returncode} while waiting for {what}")
        if time.monotonic() > until:
            raise RuntimeError(f"{what} did not come within {limit_s:g} s")
        time.sleep(0.1)


def memory_growth(readings: Sequence[Reading]) -> float:
    """Return the median resident memory of the last third against that of the first, percent."""
    end = readings[-1].at_s
    first = statistics.median(one.resident_mb for one in readings if one.at_s <= end / 3)
    last = statistics.median(one.resident_mb for one in readings if one.at_s >= 2 * end / 3)
    return 100.0 * (last / first - 1.0)


def outside_latencies(
    heard: Sequence[Mapping[str, Any]], expectations: Sequence[Expected], sent: Sequence[NDArray[np.int64]]
) -> tuple[list[float], int]:
    """Return the milliseconds from the sending of the packet that caused an event to its arrival, and events apart.

    Apart are those that no packet caused: silence of the telemetry before the first and behind the last one.
    """
    found, apart = [], 0
    for line in heard:
        if "/alarm/" not in line["key"]:
            continue
        event = line["payload"]
        system = int(event["vehicle"].rpartition("-")[2])
        one, times = expectations[system - 1], sent[system - 1]
        cause = one.causes.get((event["observer"], event["vehicle_time_ms"]))
        if cause is None:
            apart += 1
            continue
        of_each_turn = times[cause :: one.packets]
        place = int(np.searchsorted(of_each_turn, line["at_ns"])) - 1
        if place >= 0:
            found.append((line["at_ns"] - int(of_each_turn[place])) / 1e6)
    return found, apart


def drops(metrics: str) -> dict[str, float]:
    """Return the counters of the daemon's metrics that tell of anything lost, those that are not zero."""
    found = {}
    for line in metrics.splitlines():
        name, _, value = line.rpartition(" ")
        if ("lost" in name or "loss" in name or "dropped" in name) and not name.startswith("#") and float(value):
            found[name] = float(value)
    return found


def quantiles(values: Sequence[float]) -> dict[str, float]:
    if not values:
        return {}
    p50, p99, most = np.quantile(values, [0.5, 0.99, 1.0])
    return {"p50": round(float(p50), 3), "p99": round(float(p99), 3), "max": round(float(most), 3)}


def show(text: str) -> None:
    if sys.stderr.isatty():
        print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)


def soak(setup: Setup, minutes: float) -> dict[str, Any]:
    """Run it and return the report."""
    seconds = 60.0 * minutes
    show("replaying offline, to know what to expect")
    profile = read_profile(setup.profile)
    flights: list[SentFlight] = [read_flight(log, system) for system, log in enumerate(setup.logs, 1)]
    # What comes of a flight does not depend on its system id.
    of_log = {
        log: expected(profile, flight, seconds) for log, flight in dict(zip(setup.logs, flights, strict=True)).items()
    }
    expectations = [of_log[log] for log in setup.logs]
    names = [name_of(flight.system) for flight in flights]
    folder = setup.folder
    with (
        running(["-m", "fauio", "run", "--config", str(setup.config())], folder / "daemon.log") as daemon,
        running(["bench/soak_listener.py", setup.zenoh, str(setup.heard)], folder / "listener.log") as listener,
    ):
        if setup.core is not None:
            os.sched_setaffinity(daemon.pid, {setup.core})
        show("waiting for the daemon")
        wait_for(lambda: set(last_statuses(lines_of(setup.heard))) == set(names), daemon, START_S, "a status of each")
        send = [str(ROOT / "tests" / "tools" / "fleet_sender.py"), f"udp:{setup.udp}", "--seconds", str(seconds)]
        send += ["--times", str(setup.times), *(f"{system}={log}" for system, log in enumerate(setup.logs, 1))]
        begin = time.monotonic()
        with running(send, folder / "sender.log", stdout=subprocess.PIPE) as sender:
            readings = [read_process(daemon.pid, begin)]
            while sender.poll() is None:
                time.sleep(SAMPLE_S)
                if daemon.poll() is not None:
                    raise RuntimeError(
                        f"the daemon ended with status {daemon.returncode} after {readings[-1].at_s:.0f} s"
                    )
                readings.append(read_process(daemon.pid, begin))
                show(f"{readings[-1].at_s:.0f} of {seconds:.0f} s, {readings[-1].resident_mb:.0f} MB")
            assert sender.stdout is not None
            counts = {int(system): count for system, count in json.loads(sender.stdout.read()).items()}
        due = {name_of(one.system): e.samples(counts[one.system]) for one, e in zip(flights, expectations, strict=True)}

        def all_there() -> bool:
            return all(last_statuses(lines_of(setup.heard))[name]["samples"] >= due[name] for name in names)

        until = time.monotonic() + SETTLE_S
        while not all_there() and time.monotonic() < until:
            time.sleep(0.5)
        # a second more: what comes twice would show
        time.sleep(2.0)
        with urllib.request.urlopen(f"http://{setup.metrics}/metrics") as answer:
            metrics = answer.read().decode()
        listener.send_signal(signal.SIGTERM)
        listener.wait(10)
        daemon.send_signal(signal.SIGTERM)
        ended = daemon.wait(30)
    heard = lines_of(setup.heard)
    statuses = last_statuses(heard)
    spoken = [line["payload"] for line in heard if line["key"].endswith("/status")]
    sent = [np.fromfile(setup.times / f"{flight.system}.sent", dtype=np.int64) for flight in flights]
    latencies, apart = outside_latencies(heard, expectations, sent)
    steady = [one for one in readings if one.at_s >= min(5.0, readings[-1].at_s / 4)]
    elapsed_s = steady[-1].at_s - steady[0].at_s
    share = 100.0 * (steady[-1].cpu_s - steady[0].cpu_s) / elapsed_s / len(names)
    own = [status["alarm_latency_p99_ms"] for status in statuses.values()]
    report: dict[str, Any] = {
        "minutes": minutes,
        "vehicles": {
            name: {
                "flight": log.name,
                "packets_sent": counts[system],
                "packets_per_s": round(counts[system] / seconds, 1),
                "samples_expected": due[name],
                "samples": statuses[name]["samples"],
                "events": sum(1 for line in heard if line["key"].startswith(f"fauio/{name}/alarm/")),
            }
            for system, (name, log) in enumerate(zip(names, setup.logs, strict=True), 1)
        },
        "losses": drops(metrics),
        "resident_mb": [round(one.resident_mb, 1) for one in readings[:: max(1, len(readings) // 60)]],
        "memory_percent": round(memory_growth(readings), 2),
        "sender_held_up_s": round(max(float(np.diff(times).max(initial=0)) for times in sent) / 1e9, 3),
        "alarm_latency_ms": quantiles(latencies),
        "alarm_latency_events": len(latencies),
        "events_without_packet": apart,
        "daemon_alarm_latency_p99_ms": max(own),
        "daemon_latency_p99_ms": quantiles([one["latency_p99_ms"] for one in spoken if one["samples_per_s"]]),
        "states": dict(Counter(one["state"] for one in spoken)),
        "cpu_percent_per_vehicle": round(share, 2),
        "daemon_exit": ended,
    }
    report["broken"] = broken(report)
    return report


def broken(report: Mapping[str, Any]) -> list[str]:
    """Return a sentence for each limit that a run broke."""
    found = [
        f"{name}: {one['samples']} samples instead of {one['samples_expected']}"
        for name, one in report["vehicles"].items()
        if one["samples"] != one["samples_expected"]
    ]
    if report["minutes"] >= MEMORY_MINUTES and report["memory_percent"] > LIMITS["memory_percent"]:
        found.append(f"memory: {report['memory_percent']:+.2f} % from the first third to the last")
    latency = report["alarm_latency_ms"].get("p99")
    if latency is None:
        found.append("no alarm event was heard")
    elif latency >= LIMITS["alarm_latency_p99_ms"]:
        found.append(f"alarm latency: p99 {latency:.1f} ms")
    if report["cpu_percent_per_vehicle"] >= LIMITS["cpu_percent_per_vehicle"]:
        found.append(f"processor: {report['cpu_percent_per_vehicle']:.1f} % of a core for each vehicle")
    if report["daemon_exit"] != 0:
        found.append(f"the daemon ended with status {report['daemon_exit']}")
    return found


def page(report: Mapping[str, Any]) -> str:
    """Return the report as text."""
    lines = [f"{report['minutes']:g} minutes, {len(report['vehicles'])} vehicles"]
    for name, one in report["vehicles"].items():
        lines.append(
            f"  {name}: {one['packets_sent']} packets ({one['packets_per_s']:.0f}/s) of {one['flight']}: "
            f"{one['samples']} samples of {one['samples_expected']} expected, {one['events']} alarm events"
        )
    latency = report["alarm_latency_ms"]
    memory = report["resident_mb"]
    lines += [
        f"  longest pause of the sender: {report['sender_held_up_s']:.2f} s"
        + ("" if report["sender_held_up_s"] < HELD_UP_S else ": this machine was busy or stood still, measure again"),
        f"  lost, as the daemon counts: {report['losses'] or 'nothing'}",
        f"  packet to alarm, from outside: {latency} ms over {report['alarm_latency_events']} events; "
        f"the daemon's own p99: {report['daemon_alarm_latency_p99_ms']:.1f} ms",
        f"  any packet, the daemon's own: p99 of each second {report['daemon_latency_p99_ms']} ms",
        f"  memory: {memory[0]:.0f} to {memory[-1]:.0f} MB, {report['memory_percent']:+.2f} % from first third to last"
        + ("" if report["minutes"] >= MEMORY_MINUTES else " (too short a run to judge)"),
        f"  processor: {report['cpu_percent_per_vehicle']:.1f} % of a core for each vehicle",
        "all limits kept" if not report["broken"] else "\n".join(f"BROKEN {one}" for one in report["broken"]),
    ]
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=30.0, help="how long (default 30)")
    parser.add_argument("--vehicles", type=int, default=VEHICLES, help=f"how many (default {VEHICLES})")
    parser.add_argument("--flights", type=Path, help="folder of telemetry logs instead of the excerpts kept here")
    parser.add_argument("--profile", type=Path, default=PROFILE, help="profile folder that fits them")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="leave everything there: recordings, journal, logs")
    parser.add_argument("--json", action="store_true", help="print the report as JSON")
    args = parser.parse_args(argv)
    found = sorted(args.flights.glob("*.tlog*")) if args.flights else list(FLIGHTS)
    if not found:
        print(f"soak: {args.flights}: holds no telemetry log", file=sys.stderr)
        return 2
    logs = list(islice(cycle(found), args.vehicles))
    with tempfile.TemporaryDirectory() as folder:
        kept = Path(folder) if args.keep is None else args.keep.resolve()
        kept.mkdir(parents=True, exist_ok=True)
        try:
            report = soak(set_up(kept, args.profile, [log.resolve() for log in logs]), args.minutes)
        except (RuntimeError, ValueError) as error:
            said = (kept / "daemon.log").read_text().splitlines() if (kept / "daemon.log").exists() else []
            print("\n".join((*said[-5:], f"soak: {error}")), file=sys.stderr)
            return 1
    show("")
    print(json.dumps(report, indent=2) if args.json else page(report))
    return 1 if report["broken"] else 0


if __name__ == "__main__":
    sys.exit(main())
