"""What a recording says was injected into it, as the courses that estimates should follow."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adapters.logs.mcap_reader import read_mcap_metadata
from adapters.logs.recordings import recording_kind
from monitor.trace import Trace
from replay.attacks.attack import Attack, AttackSignal
from replay.attacks.inject import TRUTH

Courses = dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]


def known_truth(log: Path, traces: Sequence[Trace]) -> Courses:
    """Return by fault channel times (s, vehicle's clock) and true sizes of what ``fauio inject`` put on a recording.

    Kinds whose size follows from time alone are known: bias, ramp, spoof, and the loss of an actuator, in units of its
    command. Several on one channel add up. A recording that says nothing readable of it has none.

    Parameters
    ----------
    log : Path
        The recording.
    traces : Sequence[Trace]
        The observers' samples: on which channels and at which times.
    """
    courses: Courses = {}
    for fault in _faults(log):
        channel = fault.get("target")
        for trace in traces if isinstance(channel, str) else ():
            if channel not in trace.layout.faults or not len(trace.vehicle_ns):
                continue
            try:
                sizes = _course(fault, channel, trace)
            except (KeyError, TypeError, ValueError):
                break
            if sizes is not None:
                times_s, before = courses.get(channel, (trace.vehicle_ns / 1e9, np.zeros(len(sizes))))
                courses[channel] = times_s, before + np.interp(times_s, trace.vehicle_ns / 1e9, sizes)
                break
    return courses


def _faults(log: Path) -> list[Mapping[str, Any]]:
    """Return the entries about faults in a recording's metadata."""
    if log.is_dir() or recording_kind(log) != "mcap":
        return []
    try:
        faults = json.loads(read_mcap_metadata(log)[TRUTH]["json"])["faults"]
    except (KeyError, TypeError, ValueError):
        return []
    return [fault for fault in faults if isinstance(fault, dict)] if isinstance(faults, list) else []


def _course(fault: Mapping[str, Any], channel: str, trace: Trace) -> NDArray[np.float64] | None:
    """Return the size of a fault at a trace's samples (N,), None where the kind has none."""
    numbers = fault["numbers"]
    # the last message that was altered stands at the end
    attack = Attack(
        channel,
        fault["kind"],
        1_000_000 * int(fault["on"]["time_boot_ms"]),
        1_000_000 * (int(fault["off"]["time_boot_ms"]) + 1),
        size=numbers["size"],
        rate=numbers["rate"],
        acceleration=numbers["acceleration"],
    )
    attack.check()
    signal: AttackSignal
    if attack.kind in ("bias", "ramp"):
        signal = attack.growth
    elif attack.kind == "spoof":
        position, velocity = attack.spoof()
        signal = velocity if "velocity" in channel else position
    elif attack.kind == "loss" and channel in trace.layout.inputs:
        command = trace.u[:, trace.layout.inputs.index(channel)]
        return np.asarray(-command * np.array([attack.growth(int(stamp_ns)) for stamp_ns in trace.vehicle_ns]))
    else:
        return None
    return np.array([signal(int(stamp_ns)) if attack.acts(int(stamp_ns)) else 0.0 for stamp_ns in trace.vehicle_ns])
