"""What live vehicles cost one daemon: processor time with and without recording, samples lost, packet to alarm.

    python bench/live.py [--seconds 60] [--flight LOG --profile FOLDER] [--json]

Three runs of the whole daemon, each a process of its own that gets real datagrams and is measured from outside, as
:mod:`soak` does:

one vehicle
    A quadrotor with motors and inertial sensors monitored, 530 messages a second: the recorded flight, with messages
    that no observer needs added up to that rate, as real links bring them. Once without any recording, once with a
    recording, clips and journal.
sixteen vehicles
    The same flight under sixteen system ids, the daemon bound to one core: all samples have to be there.
four vehicles
    The flight with a fault of its own in each, recorded: from the sending of the packet that causes an alarm event to
    its arrival at a Zenoh client. The faults come and go, so that 40 s have some forty events; flights with one
    fault each have nine in that time.

Exit status 1 where a limit is broken. On a machine that does other work too the processor times grow by what the
caches lose; the lost samples and latencies then say little.
"""

from __future__ import annotations

import argparse
import json
import lzma
import os
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "tools"))

from packet_edit import packet_fields, with_fields
from soak import PROFILE, ROOT, Setup, set_up, show, soak

from adapters.logs.tlog import TlogReader
from adapters.mavlink.mavlink_message import mavlink_types, message_number, message_tables

FLIGHT = ROOT / "tests" / "data" / "copter_healthy_square.tlog.xz"
LIVE_STREAM = ROOT / "tests" / "data" / "copter_5s.tlog.xz"
"""Five seconds of all that an autopilot sends at the rates of a ground station: 530 messages a second."""
MESSAGES_PER_S = 530.0
MANY = 16
LIMITS = {"one vehicle": 5.0, "one vehicle, recorded": 5.0, "sixteen vehicles": 100.0, "alarm_latency_p99_ms": 40.0}
"""Percent of a core, milliseconds: what the project promises of a live vehicle."""
FAULTS: Mapping[str, Mapping[str, Mapping[str, float]]] = {
    "motor": {"SERVO_OUTPUT_RAW": {"servo1_raw": 40}},
    "gps": {"GPS_RAW_INT": {"lat": 2250}},
    "baro": {"HIGHRES_IMU": {"pressure_alt": 8.0, "abs_pressure": -0.96}},
    "gyro": {"HIGHRES_IMU": {"xgyro": 0.08}, "ATTITUDE": {"rollspeed": 0.08}},
}
"""What is added to fields of messages: a motor with 5 to 10 % less thrust than its command, a position 25 m off, a
barometer 8 m off, a gyro 0.08 rad/s off."""
FAULT_S, EVERY_S = 2.0, 4.0
"""How long a fault lasts, and the time from one to the next: an alarm is raised, updated after a second, cleared."""
FIRST_S = 8.0
"""When the first vehicle's fault begins, after take-off; each further vehicle's begins a second later."""


def as_live(flight: Path, path: Path) -> float:
    """Write a flight with further messages that observers do not need; return its messages a second.

    The kinds of message that the flight lacks are repeated from :data:`LIVE_STREAM`, until the rate is that of a real
    link.
    """
    number_of = message_number
    own = [(at, packet) for at, packet in TlogReader(flight).packets() if number_of(packet) in mavlink_types()]
    kinds = {number_of(packet) for _, packet in own}
    others = [(at, packet) for at, packet in TlogReader(LIVE_STREAM).packets() if number_of(packet) not in kinds]
    first_ns, last_ns = own[0][0], own[-1][0]
    seconds = (last_ns - first_ns) / 1e9
    missing = max(0, round(MESSAGES_PER_S * seconds) - len(own))
    step_ns = (last_ns - first_ns) / max(1, missing)
    added = [(first_ns + round(k * step_ns), others[k % len(others)][1]) for k in range(missing if others else 0)]
    records = sorted((*own, *added), key=lambda record: record[0])
    write(path, records)
    return len(records) / seconds


def write(path: Path, records: Sequence[tuple[int, bytes]]) -> None:
    with lzma.open(path, "wb", preset=0) as out:
        for at, packet in records:
            out.write((at // 1000).to_bytes(8) + packet)


def with_faults(flight: Path, fault: Mapping[str, Mapping[str, float]], begin_s: float, path: Path) -> None:
    """Write a flight with a fault of :data:`FAULTS` that comes and goes from a time after its first packet on."""
    edits = {message_tables()[name].id: fields for name, fields in fault.items()}
    records = list(TlogReader(flight).packets())
    altered = []
    for at, packet in records:
        since_s = (at - records[0][0]) / 1e9 - begin_s
        added = edits.get(message_number(packet), {}) if since_s >= 0.0 and since_s % EVERY_S < FAULT_S else {}
        fields = packet_fields(packet) if added else {}
        altered.append((at, with_fields(packet, {name: fields[name] + more for name, more in added.items()})))
    write(path, altered)


def measured(setup: Setup, seconds: float) -> dict[str, Any]:
    """Run a daemon for a while; return what matters here of the soak's report."""
    report = soak(setup, seconds / 60.0)
    vehicles = report["vehicles"].values()
    return {
        "vehicles": len(vehicles),
        "messages_per_s": round(sum(one["packets_per_s"] for one in vehicles), 1),
        "samples": sum(one["samples"] for one in vehicles),
        "samples_lost": sum(one["samples_expected"] - one["samples"] for one in vehicles),
        "cpu_percent": round(report["cpu_percent_per_vehicle"] * len(vehicles), 2),
        "latency_p99_ms": report["daemon_latency_p99_ms"],
        "alarm_latency_ms": report["alarm_latency_ms"],
        "alarm_latency_events": report["alarm_latency_events"],
        "sender_held_up_s": report["sender_held_up_s"],
        "losses": report["losses"],
        "daemon_exit": report["daemon_exit"],
    }


def broken(runs: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return a sentence for each limit that a run broke."""
    found = []
    for name, run in runs.items():
        limit = LIMITS.get(name)
        if limit is not None and run["cpu_percent"] > limit:
            found.append(f"{name}: {run['cpu_percent']:.1f} % of a core, limit {limit:g} %")
        if run["samples_lost"]:
            found.append(f"{name}: {run['samples_lost']} samples lost")
        if run["daemon_exit"]:
            found.append(f"{name}: the daemon ended with status {run['daemon_exit']}")
    p99 = runs["four vehicles"]["alarm_latency_ms"].get("p99") if "four vehicles" in runs else 0.0
    if p99 is None or p99 > LIMITS["alarm_latency_p99_ms"]:
        found.append(f"packet to alarm: p99 {p99} ms, limit {LIMITS['alarm_latency_p99_ms']:g} ms")
    return found


def text(runs: Mapping[str, Mapping[str, Any]], limits: Sequence[str]) -> str:
    lines = [
        "| run | messages a second | samples lost | percent of a core | packet to alarm p50, p99, largest, ms | events "
        "| longest pause of the sender, s |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, run in runs.items():
        alarm = ", ".join(f"{ms:.1f}" for ms in run["alarm_latency_ms"].values())
        lines.append(
            f"| {name} | {run['messages_per_s']:.0f} | {run['samples_lost']} of {run['samples']} | "
            f"{run['cpu_percent']:.1f} | {alarm} | {run['alarm_latency_events']} | {run['sender_held_up_s']:.2f} |"
        )
    return "\n".join([*lines, "", *(f"BROKEN {one}" for one in limits), "" if limits else "all limits kept"])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0, help="length of each run (default 60)")
    parser.add_argument("--flight", type=Path, default=FLIGHT, help="telemetry log of a healthy flight")
    parser.add_argument("--profile", type=Path, default=PROFILE, help="profile of its vehicle")
    parser.add_argument("--only", choices=("one", "many", "four"), help="run only this part")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    arguments = parser.parse_args()
    runs: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as name:
        live = Path(name) / "live.tlog.xz"
        as_live(arguments.flight, live)

        def run(title: str, logs: Sequence[Path], **options: Any) -> None:
            folder = Path(name) / title.replace(" ", "-").replace(",", "")
            folder.mkdir()
            show(title)
            runs[title] = measured(set_up(folder, arguments.profile, logs, **options), arguments.seconds)

        if arguments.only in (None, "one"):
            run("one vehicle", [live], recorded=False)
            run("one vehicle, recorded", [live])
        if arguments.only in (None, "many"):
            run("sixteen vehicles", [live] * MANY, recorded=False, core=min(os.sched_getaffinity(0)))
        if arguments.only in (None, "four"):
            flights = [Path(name) / f"{fault}.tlog.xz" for fault in FAULTS]
            for k, (fault, path) in enumerate(zip(FAULTS.values(), flights, strict=True)):
                with_faults(arguments.flight, fault, FIRST_S + k, path)
            run("four vehicles", flights)
    show("")
    limits = broken(runs)
    sys.stdout.write(json.dumps({"runs": runs, "broken": limits}, indent=1) if arguments.json else text(runs, limits))
    sys.stdout.write("\n")
    return int(bool(limits))


if __name__ == "__main__":
    sys.exit(main())
