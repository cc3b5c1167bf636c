"""Recorded flights and the truth beside them: what was injected when, what should be named, what the autopilot said.

A flight is NAME.tlog (plain or .xz / .gz) or NAME.mcap with NAME.json. The JSON gives ``vehicle``, ``model``,
``healthy``, ``t0_takeoff``, ``touchdown``, ``faults`` with ``on`` and ``off`` on the autopilot's clock, and
``statustext``. Kinds of faults that are not known here have no expected channel: any alarm counts as seeing them.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adapters.message import Message
from monitor.fitting.survey import of_one_vehicle

LOUD = 4
"""Largest MAVLink severity that is an announcement: warning."""

KIND_OF_VEHICLE = {"copter": "multirotor", "plane": "plane", "rover": "rover"}

_RECORDINGS = (".tlog.xz", ".tlog.gz", ".tlog", ".mcap", ".100hz.tlog.xz")
_ACTUATORS = {
    "plane": {1: "aileron", 2: "elevator", 3: "throttle", 4: "rudder"},
    "rover": {1: "steering", 3: "throttle"},
}
"""ArduPilot's default servo functions."""

_NOT_ITS_OWN = ("Injected:", "Cleared:", "SIM ")
"""How texts begin that tell of an injection or of the simulator, and that no autopilot would say of a vehicle."""
_NEUTRAL = {"motor": 1000, "throttle": 1000}
_NEUTRAL_SURFACE = 1500
_COMPASS_POINTS = {"north": ("north", 1), "south": ("north", -1), "east": ("east", 1), "west": ("east", -1)}
_HEIGHTS = {"down": ("down", 1), "up": ("down", -1), "altitude": ("down", -1)}
_BODY = {"roll": "x", "pitch": "y", "yaw": "z", "x": "x", "y": "y", "z": "z"}
_NUMBER = r"[-+]?\d+(?:\.\d+)?"


@dataclass(frozen=True, slots=True)
class Truth:
    """What was injected, on the channel that should read it.

    Parameters
    ----------
    channel : str
        The channel.
    unit : str
        ``"share"`` of an actuator's command that is lost, or the sensor's SI unit.
    size : float
        Final size, signed for sensors.
    ramp_s : float
        Time from zero to that size; 0 for a step.
    """

    channel: str
    unit: str
    size: float
    ramp_s: float = 0.0

    def after(self, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the size at times since the onset (N,), while the fault is on."""
        if self.ramp_s <= 0.0:
            return np.full_like(seconds, self.size)
        return self.size * np.clip(seconds / self.ramp_s, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class Fault:
    """An injected fault.

    Parameters
    ----------
    kind, text : str
        Kind as the JSON has it, and target and magnitude for people.
    on_ms, off_ms : int
        Autopilot's clock.
    channels : frozenset[str]
        Alarm channels that name it; empty where unknown.
    truth : Truth | None
        Its size, where the JSON gives one that can be compared.
    """

    kind: str
    text: str
    on_ms: int
    off_ms: int
    channels: frozenset[str]
    truth: Truth | None


@dataclass(frozen=True, slots=True)
class Announcement:
    """Something the autopilot said."""

    time_ms: int
    text: str


@dataclass(frozen=True, slots=True)
class Flight:
    """A flight and its truth.

    Parameters
    ----------
    name : str
        Its name.
    log : Path
        Its recording.
    kind : str
        Kind of vehicle as ``fauio fit`` takes it, the JSON's own word where there is none.
    group : str
        What flights have to share to share a profile: vehicle, frame and noise level.
    healthy : bool
        Whether it may be fitted on: no fault and no disturbance was injected.
    faults : tuple[Fault, ...]
        Faults; disturbances are none.
    takeoff_ms, touchdown_ms : int | None
        What of the flight counts.
    said : tuple[Announcement, ...]
        The autopilot's announcements between take-off and touchdown.
    """

    name: str
    log: Path
    kind: str
    group: str
    healthy: bool
    faults: tuple[Fault, ...]
    takeoff_ms: int | None
    touchdown_ms: int | None
    said: tuple[Announcement, ...]

    def messages(self, only: frozenset[str]) -> Iterator[Message]:
        """Return the vehicle's messages of these names, up to touchdown."""
        from adapters.batch import messages
        from adapters.logs.recordings import read_batches

        own = of_one_vehicle(read_batches(self.log, only))
        return until((message for batch in own for message in messages(batch)), self.touchdown_ms)


def until(messages: Iterable[Message], end_ms: int | None) -> Iterator[Message]:
    """Yield messages up to the first that is stamped later on the autopilot's clock."""
    for message in messages:
        stamp = message.fields.get("time_boot_ms")
        if end_ms is not None and isinstance(stamp, int) and stamp > end_ms:
            return
        yield message


def read_flights(folder: Path, recordings: Sequence[str] = _RECORDINGS) -> list[Flight]:
    """Return the flights of a folder whose recording is there: what follows its name, the first that there is."""
    flights = []
    for path in sorted(folder.glob("*.json")):
        entry = json.loads(path.read_text(encoding="utf-8"))
        logs = (folder / f"{path.stem}{suffix}" for suffix in recordings)
        log = next((log for log in logs if log.is_file()), None)
        if log is not None and isinstance(entry, dict) and "vehicle" in entry:
            flights.append(flight(entry, path.stem, log))
    return flights


def flight(entry: Mapping[str, Any], name: str, log: Path) -> Flight:
    """Return the flight that a JSON object describes."""
    vehicle = str(entry["vehicle"])
    model = str(entry.get("model") or vehicle)
    injected = entry.get("faults") or []
    note = str(entry.get("note") or "")
    takeoff, touchdown = _time_ms(entry.get("t0_takeoff")), _time_ms(entry.get("touchdown"))
    frame = model if model != vehicle else ""
    noisy = "noisy sensors" if "noisy" in name.split("_") else ""
    said = [
        Announcement(text["time_boot_ms"], text["text"])
        for text in entry.get("statustext") or []
        if text.get("time_boot_ms") is not None
        and text.get("severity", LOUD) <= LOUD
        and (takeoff or 0) <= text["time_boot_ms"] <= (touchdown or text["time_boot_ms"])
        and not text["text"].startswith(_NOT_ITS_OWN)
        and "cleared" not in text["text"].lower()
    ]
    return Flight(
        name=name,
        log=log,
        kind=KIND_OF_VEHICLE.get(vehicle, vehicle),
        group=" ".join(part for part in (vehicle, frame, noisy) if part),
        healthy=bool(entry.get("healthy")) and not injected,
        faults=tuple(fault(one, vehicle, note) for one in injected if not is_disturbance(one)),
        takeoff_ms=takeoff,
        touchdown_ms=touchdown,
        said=tuple(said),
    )


def is_disturbance(entry: Mapping[str, Any]) -> bool:
    """Return whether what was injected is no fault of the vehicle."""
    return str(entry["kind"]).startswith("disturbance")


def fault(entry: Mapping[str, Any], vehicle: str, note: str = "") -> Fault:
    """Return the fault that an entry of ``faults`` describes."""
    on = _time_ms(entry["on"])
    off = _time_ms(entry.get("off"))
    if on is None:
        raise ValueError(f"fault {entry['kind']} has no 'time_boot_ms' of its onset")
    named = [str(entry[key]) for key in ("target", "magnitude") if entry.get(key) is not None]
    return Fault(
        kind=str(entry["kind"]),
        text=" ".join(named),
        on_ms=on,
        off_ms=2**62 if off is None else off,
        channels=expected_channels(entry, vehicle, note),
        truth=_truth(entry, vehicle, note),
    )


def expected_channels(entry: Mapping[str, Any], vehicle: str, note: str = "") -> frozenset[str]:
    """Return the alarm channels that name a fault rightly; none where the kind is not known."""
    kind = str(entry["kind"]).lower()
    words = _words(entry)
    if re.match("actuator|motor|servo|engine|esc|thrust|surface", kind):
        return frozenset(_actuators(entry, vehicle, note))
    if kind == "gps_loss":
        return frozenset({"blind"})
    if kind.startswith(("gps", "gnss")):
        directions = {**_COMPASS_POINTS, **_HEIGHTS}
        axes = {directions[word][0] for word in words if word in directions} or {"north", "east", "down"}
        # A velocity that is wrong drifts away from the position, and the other way round.
        return frozenset(f"{name}_{axis}" for name in ("gps", "gps_velocity") for axis in axes)
    for name in ("gyro", "accel"):
        if name in kind:
            axes = {_BODY[word] for word in words if word in _BODY} or set("xyz")
            return frozenset(f"{name}_{axis}" for axis in axes)
    for pattern, channel in (("baro", "baro"), ("compass|mag", "compass"), ("airspeed|pitot", "airspeed")):
        if re.search(pattern, kind):
            return frozenset({channel})
    return frozenset()


def _actuators(entry: Mapping[str, Any], vehicle: str, note: str) -> list[str]:
    """Return the names of the actuators that a fault's target, or else its kind, speaks of."""
    known = dict(_ACTUATORS.get(vehicle, {}))
    for number, name in re.findall(r"servo\s*(\d+)\s+([a-z]+)", note.lower()):
        if name in {actuator for names in _ACTUATORS.values() for actuator in names.values()}:
            known[int(number)] = name
    target = str(entry.get("target") or entry["kind"]).lower()
    named = [name for name in dict.fromkeys(known.values()) if name in target]
    if named:
        return named
    numbers = [int(number) for number in re.findall(r"\d+", target)]
    if vehicle in _ACTUATORS:
        return [known[number] for number in numbers if number in known]
    return [f"motor{number}" for number in numbers]


def _truth(entry: Mapping[str, Any], vehicle: str, note: str) -> Truth | None:
    kind, magnitude = str(entry["kind"]).lower(), str(entry.get("magnitude", ""))
    numbers = [float(number) for number in re.findall(_NUMBER, magnitude.replace("->", " "))]
    channels = expected_channels(entry, vehicle, note)
    ramp_s = float(entry.get("ramp_s") or 0.0)
    words = _words(entry)
    if not numbers or not channels:
        return None
    if kind.startswith("actuator"):
        (channel, *others) = sorted(channels)
        about = re.search(r"pwm\s*-\s*(\d+)", note)
        neutral = _NEUTRAL.get(channel.rstrip("0123456789"), _NEUTRAL_SURFACE)
        if others or (neutral if about is None else int(about.group(1))) != neutral:
            return None  # Not a loss alone: the neutral position moves with it.
        left = numbers[1] if "->" in magnitude and len(numbers) > 1 else numbers[0]
        return Truth(channel, "share", 1.0 - left, ramp_s)
    if kind.startswith("gps_offset"):
        signed = next(((axis, sign) for word, (axis, sign) in _COMPASS_POINTS.items() if word in words), None)
        metres = re.search(rf"({_NUMBER})\s*m(?![/\w])", magnitude)
        if signed is None or metres is None:
            return None
        return Truth(f"gps_{signed[0]}", "m", signed[1] * float(metres.group(1)), ramp_s)
    if kind.startswith("baro") and re.search(r"\dm\b|\d m\b", magnitude):
        return Truth("baro", "m", numbers[0], ramp_s)
    if kind.startswith("gyro") and len(channels) == 1:
        degrees = re.search(r"deg|°", magnitude) is not None
        return Truth(min(channels), "rad/s", float(np.radians(numbers[0])) if degrees else numbers[0], ramp_s)
    return None


def _words(entry: Mapping[str, Any]) -> set[str]:
    text = " ".join(str(entry.get(key) or "") for key in ("kind", "target", "magnitude"))
    return set(re.findall("[a-z]+", text.lower()))


def _time_ms(entry: Mapping[str, Any] | None) -> int | None:
    stamp = None if entry is None else entry.get("time_boot_ms")
    return None if stamp is None else int(stamp)
