"""A vehicle beside one that floods the same UDP port: samples that arrive, packet to alarm, what the status says.

    python bench/flood.py [--rate 50000] [--seconds 24] [--kind vehicle|stranger|junk] [--json]

The daemon watches two vehicles. The first flies a flight with a motor fault at its ordinary rate; from another socket
come so many datagrams a second: packets of the second vehicle's flight, of a system that nobody named, or of no packet
at all. Measured from outside, as :mod:`soak` does. Exit status 1 where the first vehicle's alarm does not come.
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from soak import FLIGHTS, PROFILE, START_S, last_statuses, lines_of, name_of, read_process, running, set_up, wait_for
from soak_expected import expected

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "tools"))

from fleet_sender import SentFlight, fleet_packets, read_flight, send_fleet

from monitor.profile import read_profile

ONSET_S = 112.594
"""When motor1 of the first of the flights loses its power, on the vehicle's clock and in the log."""
_STRANGER = 200
_TICK_S = 0.001


def flood(to: str, rate: float, kind: str) -> None:
    """Send datagrams at a rate until killed."""
    flight = read_flight(FLIGHTS[0], {"vehicle": 2}.get(kind, _STRANGER), 60.0, 90.0)
    packets = [packet for _, (_, packet) in fleet_packets([flight])][: 256 * 64]
    if kind == "junk":
        packets = [os.urandom(60) for _ in range(1000)]
    host, _, port = to.rpartition(":")
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sent, began = 0, time.monotonic()
    while True:
        due = int((time.monotonic() - began) * rate)
        # a sender that was held up goes on, without making up for it
        sent = max(sent, due - int(0.02 * rate))
        for k in range(sent, due):
            sender.sendto(packets[k % len(packets)], (host, int(port)))
        sent = max(sent, due)
        time.sleep(_TICK_S)


def measured(kind: str, rate: float, seconds: float, folder: Path) -> dict[str, Any]:
    """Return what becomes of the first vehicle beside a flood; none at a rate of 0."""
    setup = set_up(folder, PROFILE, [FLIGHTS[0], FLIGHTS[0]])
    flight = read_flight(FLIGHTS[0], 1, 0.0, seconds)
    due = expected_samples(flight)
    with (
        running(["-m", "fauio", "run", "--config", str(setup.config())], folder / "daemon.log") as daemon,
        running(["bench/soak_listener.py", setup.zenoh, str(setup.heard)], folder / "listener.log"),
    ):
        wait_for(lambda: len(last_statuses(lines_of(setup.heard))) == 2, daemon, START_S, "a status of each")
        flooder = [__file__, "--flood", setup.udp, "--rate", str(rate), "--kind", kind]
        with running(flooder if rate else ["-c", "pass"], folder / "flooder.log"):
            time.sleep(2.0)
            cpu_s = read_process(daemon.pid, 0.0).cpu_s
            sent = send_fleet(fleet_packets([flight]), f"udp:{setup.udp}")[1]
            cpu_s = read_process(daemon.pid, 0.0).cpu_s - cpu_s
            time.sleep(2.0)
            health = _health(setup.metrics)
    heard = lines_of(setup.heard)
    statuses = [line["payload"] for line in heard if line["key"] == f"fauio/{name_of(1)}/status"]
    raised = [
        line
        for line in heard
        if line["key"].startswith(f"fauio/{name_of(1)}/alarm/") and line["payload"]["channel"].startswith("motor")
    ]
    onset_ns = sent[0] + round((ONSET_S - _first_stamp_s()) * 1e9)
    after = [line["at_ns"] for line in raised if line["at_ns"] > onset_ns and line["payload"]["state"] == "raised"]
    last = last_statuses(heard)
    links = next(iter(last[name_of(1)]["links"].values()))
    return {
        "kind": kind,
        "rate": rate,
        "flooder_arrived_per_s": round(last[name_of(2)]["messages"] / (seconds + 4.0)),
        "sent": len(sent),
        "arrived_percent": round(100.0 * last[name_of(1)]["messages"] / len(sent), 2),
        "samples_percent": round(100.0 * last[name_of(1)]["samples"] / due, 2),
        "alarm_s": round((min(after) - onset_ns) / 1e9, 3) if after else None,
        "cpu_percent": round(100.0 * cpu_s / seconds, 1),
        "latency_p99_ms": max((status["latency_p99_ms"] for status in statuses), default=None),
        "link": links,
        "reasons": statuses[-1]["reasons"],
        "problems": health["problems"],
    }


def expected_samples(flight: SentFlight) -> int:
    """Return the samples of a flight that nothing is missing of."""
    return expected(read_profile(PROFILE), flight).first[-1]


def _health(metrics: str) -> dict[str, Any]:
    try:
        with urllib.request.urlopen(f"http://{metrics}/healthz") as answer:
            return dict(json.loads(answer.read()))
    except urllib.error.HTTPError as trouble:
        return dict(json.loads(trouble.read()))


def _first_stamp_s() -> float:
    """Return the vehicle's clock at the log's begin, seconds."""
    from adapters.logs.recordings import read_recording

    for message in read_recording(FLIGHTS[0]):
        if message.name == "ATTITUDE":
            return float(message.fields["time_boot_ms"]) / 1e3
    raise ValueError("no ATTITUDE")


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rate", type=float, default=50_000.0, help="datagrams a second of the flood (default 50000)")
    parser.add_argument("--seconds", type=float, default=24.0, help="of the first vehicle's flight (default 24)")
    parser.add_argument("--kind", choices=("vehicle", "stranger", "junk"), default="vehicle")
    parser.add_argument("--flood", metavar="HOST:PORT", help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    if args.flood is not None:
        flood(args.flood, args.rate, args.kind)
    with tempfile.TemporaryDirectory() as folder:
        report = measured(args.kind, args.rate, args.seconds, Path(folder))
    print(json.dumps(report, indent=2))
    return 0 if report["alarm_s"] is not None else 1


if __name__ == "__main__":
    sys.exit(main())
