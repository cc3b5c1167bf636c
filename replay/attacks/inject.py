"""``fauio inject``: write a recording with one more fault or attack in it, and the truth about that beside it."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adapters.errors import StorageError, TelemetryError, UsageError
from adapters.logs.mcap_log import MessageLogWriter
from adapters.logs.mcap_reader import read_mcap_metadata
from adapters.logs.recordings import read_recording, recording_kind
from adapters.message import SECOND_NS, Message
from adapters.output_file import check_suffix, json_text, write_file
from monitor.profile import read_profile
from monitor.trace import Trace
from replay.attacks.attack import Attack
from replay.attacks.injector import Injector, Plan, Senders, inject, plan, profile_clocks, survey_senders

TRUTH = "truth"

AttackTrack = Callable[[Iterable[Message], str], Iterable[Message]]


@dataclass(frozen=True, slots=True)
class Order:
    """Request of a user; seconds count from the first stamp of the vehicle in the recording."""

    attack: Attack  # the attack, without its times
    start_s: float | None = None  # begin; None if ``at_ms`` gives it
    at_ms: int | None = None  # begin, milliseconds on the vehicle's clock
    end_s: float | None = None  # end; None: ``duration_s`` after the begin, or the recording's end
    duration_s: float | None = None  # duration
    source_s: float | None = None  # begin of the segment that is replayed
    system: int = 0  # the vehicle's MAVLink system; 0: the profile's, or the first one that sends the channel


def inject_recording(
    log: Path, out: Path, order: Order, profile: Path | None = None, track: AttackTrack = lambda messages, _: messages
) -> dict[str, Any]:
    """Write a recording with a fault or attack to MCAP, and the truth to ``OUT.truth.json`` and into its metadata.

    Faults injected earlier are kept in the truth. Faults of actuators need a profile's folder. Return the written
    truth.

    Raises
    ------
    UsageError
        The attack does not make sense or would alter nothing.
    TelemetryError
        The recording cannot be read, or the file not be written.
    """
    kind = recording_kind(log)
    if out.resolve() == log.resolve():
        raise StorageError(f"{out}: is the recording itself; write to another file")
    check_suffix(out, ".mcap")
    # before all messages that are replayed
    draft = replace(order.attack, start_ns=0, end_ns=1 << 63, source_ns=None if order.source_s is None else -1)
    draft.check()
    known = read_profile(profile) if profile is not None else None
    if known is not None and not order.system:
        order = replace(order, system=known.system)
    clocks = profile_clocks(known)
    earlier = _earlier(log) if kind == "mcap" else []
    senders = survey_senders(track(read_recording(log), f"surveying {log.name}"), clocks)
    names = {name for sender in senders.values() for name in sender.names}
    system = choose_system(senders, plan(draft, names, known), order, log)
    attack = _timed(order, senders[system], log)
    injector = Injector(attack, plan(attack, names, known), system, clocks)
    try:
        with MessageLogWriter(out) as writer:
            for message in inject(track(read_recording(log), f"writing {out.name}"), injector):
                writer.write(message)
            truth = _truth(log, senders[system], [*earlier, injector.truth()])
            writer.add_metadata("fauio", {"fauio": version("fauio"), "converted_from": log.name})
            writer.add_metadata(TRUTH, {"json": json.dumps(truth)})
    except KeyboardInterrupt:
        out.unlink(missing_ok=True)
        raise
    if not injector.altered:
        out.unlink()
        raise UsageError(
            f"{log}: --kind {attack.kind} altered nothing on {attack.channel}; give a larger --size or another time"
        )
    write_file(truth_path(out), json_text(truth))
    return truth


def truth_path(out: Path) -> Path:
    """Return the file that holds the truth about an injected recording."""
    return out.with_suffix(".truth.json")


def choose_system(senders: Mapping[int, Senders], made: Plan, order: Order, log: Path) -> int:
    """Return the vehicle to attack: the requested one, else the first that sends the attacked channel.

    Raises UsageError if no vehicle sends it.
    """
    wanted = sorted(made.messages)
    able = [number for number, sender in senders.items() if sender.names & made.messages]
    if order.system:
        able = [number for number in able if number == order.system]
    if not able:
        whose = f" of system {order.system}" if order.system else ""
        raise UsageError(f"{log}: --channel {order.attack.channel} needs {' or '.join(wanted)}{whose}, not in this log")
    if senders[able[0]].first_ns is None:
        raise UsageError(f"{log}: no message of the vehicle has a time stamp; --start cannot be counted")
    return able[0]


def _timed(order: Order, sender: Senders, log: Path) -> Attack:
    """Return the attack with its times on the vehicle's clock."""
    first_ns, last_ns = sender.first_ns or 0, sender.last_ns or 0

    def from_first(seconds: float) -> int:
        return first_ns + round(seconds * SECOND_NS)

    start_ns = from_first(order.start_s or 0.0) if order.at_ms is None else order.at_ms * 1_000_000
    end_ns = last_ns + 1
    if order.end_s is not None:
        end_ns = from_first(order.end_s)
    elif order.duration_s is not None:
        end_ns = start_ns + round(order.duration_s * SECOND_NS)
    if not first_ns <= start_ns <= last_ns:
        raise UsageError(
            f"{log}: the attack would begin outside the log, which is {(last_ns - first_ns) / SECOND_NS:.1f} s long, "
            f"{first_ns // 1_000_000} to {last_ns // 1_000_000} ms of the vehicle's clock"
        )
    source_ns = None if order.source_s is None else from_first(order.source_s)
    attack = replace(order.attack, start_ns=start_ns, end_ns=end_ns, source_ns=source_ns)
    attack.check()
    return attack


def _truth(log: Path, sender: Senders, faults: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "name": log.name.split(".")[0],
        "recording": log.name,
        "healthy": False,
        "first": {"time_boot_ms": (sender.first_ns or 0) // 1_000_000},
        "last": {"time_boot_ms": (sender.last_ns or 0) // 1_000_000},
        "faults": faults,
    }


def _earlier(log: Path) -> list[dict[str, Any]]:
    """Return the faults that an MCAP file holds already; raise TelemetryError if their entries are damaged."""
    text = read_mcap_metadata(log).get(TRUTH, {}).get("json")
    try:
        return list(json.loads(text)["faults"]) if text else []
    except (ValueError, KeyError, TypeError) as error:
        raise TelemetryError(f"{log}: its record of what was injected before is damaged: {error}") from error


Courses = dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]


def known_truth(log: Path, traces: Sequence[Trace]) -> Courses:
    """Return, by fault channel, times (s, vehicle's clock) and true sizes of the faults in an injected recording.

    Only the kinds whose size depends on time alone are known: bias, ramp, spoof, and the loss of an actuator, in units
    of its command. Several faults of one channel add up. The result is empty if the recording has no readable entries
    about faults. The observers' traces give the channels and the times.
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
        return [fault for fault in _earlier(log) if isinstance(fault, dict)]
    except TelemetryError:
        return []


def _course(fault: Mapping[str, Any], channel: str, trace: Trace) -> NDArray[np.float64] | None:
    """Return the size of a fault at a trace's samples (N,), None if the kind has none."""
    numbers = fault["numbers"]
    # the attack ends with the last altered message
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
    stamps_ns = trace.vehicle_ns.tolist()
    if attack.kind == "spoof" and "velocity" in channel:
        velocity = attack.spoof()[1]
        return np.array([velocity(stamp_ns) if attack.acts(stamp_ns) else 0.0 for stamp_ns in stamps_ns])
    sizes = attack.sizes(stamps_ns)
    if attack.kind != "loss" or sizes is None:
        return sizes
    if channel not in trace.layout.inputs:
        return None
    return np.asarray(-trace.u[:, trace.layout.inputs.index(channel)] * sizes)
