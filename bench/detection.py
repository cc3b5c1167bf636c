"""What is detected on a folder of recorded flights, how fast and how well, beside the autopilot's own announcements.

    python bench/detection.py FLIGHTS

FLIGHTS holds NAME.tlog.xz and NAME.json; the JSON gives ``model``, ``healthy``, ``faults`` with ``on`` and ``off`` on
the autopilot's clock, and ``statustext``. A profile is fitted on the healthy flights of each model and noise
level, never on a faulty one; flights the motors observer does not speak about are listed for their false alarms only.
Prints a Markdown table.
"""

from __future__ import annotations

import json
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from adapters.recordings import read_recording
from monitor.profile import Profile, read_profile
from replay.fit import fit
from replay.player import Replay, interests, play
from replay.survey import FIT_MESSAGES, of_one_vehicle

LOUD = 4
QUIET_START_MS = 1_000


def kind(flight: dict[str, Any]) -> str:
    """Return what flights have to share to share a profile: frame and noise level."""
    return f"{flight['model']}{', noisy' if '_noisy_' in flight['name'] else ''}"


def announced(flight: dict[str, Any]) -> str:
    """Return what the autopilot said first while the fault was on, and how long after its onset."""
    fault = flight["faults"][0]
    on, off = fault["on"]["time_boot_ms"], fault["off"]["time_boot_ms"]
    loud = [text for text in flight["statustext"] if text["severity"] <= LOUD and on <= text["time_boot_ms"] <= off]
    return f"{loud[0]['text']}, {(loud[0]['time_boot_ms'] - on) / 1000:.1f} s" if loud else "nothing"


def row(flight: dict[str, Any], found: Replay) -> list[str]:
    """Return one line of the table."""
    raised = [event for event in found.events if event.state == "raised" and event.kind != "stale"]
    hours = f"{found.evidence / 100 / 60:.1f} min"
    if not flight["faults"]:
        return [flight["name"], "none", "", "", "", f"{len(raised)} in {hours}"]
    fault = flight["faults"][0]
    on, off = fault["on"]["time_boot_ms"], fault["off"]["time_boot_ms"]
    target = re.search(r"\[(\d+)\]", fault["target"] or "")
    channel = f"motor{target.group(1)}" if target and fault["kind"].startswith("actuator") else None
    right = [event for event in raised if event.channel == channel and on <= event.vehicle_time_ms <= off + 500]
    delay = f"{(right[0].vehicle_time_ms - on) / 1000:.2f} s" if right else "" if channel is None else "MISSED"
    reading = ""
    if channel is not None:
        (trace,) = found.traces
        index, now = trace.layout.faults.index(channel), trace.vehicle_ns // 1_000_000
        during = (now > on + QUIET_START_MS) & (now < off) & trace.armed
        reading = f"{-100 * np.mean(trace.isolated[during, index] / trace.u[during, index]):.1f} %"
    size = str(fault["magnitude"])
    return [
        flight["name"],
        f"{channel or fault['kind']} {size}",
        announced(flight),
        delay,
        reading,
        f"{len(raised) - len(right[:1])} in {hours}",
    ]


def fitted(name: str, healthy: list[Path], folder: Path) -> Profile:
    """Return a profile fitted on healthy flights."""
    logs = [lambda path=path: of_one_vehicle(read_recording(path, FIT_MESSAGES)) for path in healthy]
    fit("multirotor", logs, folder, "quad")
    print(f"fitted on {', '.join(path.name.split('.')[0] for path in healthy)} ({name})", file=sys.stderr)
    return read_profile(folder)


def main(folder: Path) -> None:
    flights = [json.loads(path.read_text()) for path in sorted(folder.glob("copter_*.json"))]
    print("| flight | fault | the autopilot said | raised after | read | other alarms in watched flight |")
    print("|---|---|---|---|---|---|")
    for name in sorted({kind(flight) for flight in flights}):
        group = [flight for flight in flights if kind(flight) == name]
        healthy = [
            folder / f"{flight['name']}.tlog.xz" for flight in group if flight["healthy"] and not flight["faults"]
        ]
        with tempfile.TemporaryDirectory() as profile_folder:
            profile = fitted(name, healthy, Path(profile_folder))
        for flight in group:
            messages = read_recording(folder / f"{flight['name']}.tlog.xz", interests(profile))
            print("|", " | ".join(row(flight, play(profile, messages, keep_traces=True))), "|", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
