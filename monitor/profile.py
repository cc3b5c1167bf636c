"""A profile folder: all a vehicle needs to be monitored, as text that a person can read and edit.

PROFILE/profile.toml            vehicle, flight phases, and per observer: channels, isolation, alarm thresholds
PROFILE/<observer>.model.toml   the plant model the gains were designed for
PROFILE/<observer>.gains.json   the compiled gains; they know the hash of their model
"""

from __future__ import annotations

import hashlib
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adapters.channels import Channel, channel_table, parse_channel
from gains.errors import ModelError
from gains.gains_file import Gains, read_gains
from gains.model_file import model_hash, read_model
from monitor.alarm import AlarmRule
from monitor.errors import ProfileError
from monitor.gate import GateRule
from monitor.tables import Table

FORMAT = 1
PROFILE_FILE = "profile.toml"


@dataclass(frozen=True, slots=True)
class IsolationRule:
    """How joint estimates become evidence against channels.

    Parameters
    ----------
    method : str
        ``"single"`` (one channel responsible at a time) or ``"independent"``.
    smoothing_s : float
        Time constant of the smoothing, seconds.
    tolerance, score_floor, gain_penalty : float
        See :class:`monitor.isolation.SingleFaultIsolator`.
    covariance : NDArray[np.float64]
        Healthy covariance of the smoothed joint estimate (a, a), effect units.
    """

    method: str
    smoothing_s: float
    tolerance: float
    score_floor: float
    gain_penalty: float
    covariance: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ObserverProfile:
    """One observer of the profile: gains, where its channels come from, and its alarms."""

    name: str
    gains: Gains
    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    isolation: IsolationRule
    alarms: tuple[AlarmRule, ...]


@dataclass(frozen=True, slots=True)
class Profile:
    """A vehicle's profile.

    Parameters
    ----------
    name : str
        Default name of the vehicle in topics and events.
    vehicle : str
        Kind of vehicle, as given to ``fauio fit``.
    system : int
        MAVLink system id to monitor; 0 takes the first one that sends the profile's channels.
    gate : GateRule
        When samples count as evidence.
    stale_s : float
        Silence after which telemetry is stale, seconds.
    observers : tuple[ObserverProfile, ...]
        The observers.
    files : Mapping[str, bytes]
        Contents of the profile's files, by name, for recordings.
    digest : str
        SHA-256 over those files.
    """

    name: str
    vehicle: str
    system: int
    gate: GateRule
    stale_s: float
    observers: tuple[ObserverProfile, ...]
    files: Mapping[str, bytes]
    digest: str


def read_profile(folder: str | Path) -> Profile:
    """Read a profile folder.

    Raises
    ------
    ProfileError
        A file is missing, a key is wrong, or gains were designed for another model.
    """
    folder = Path(folder)
    path = folder / PROFILE_FILE
    if not path.is_file():
        raise ProfileError(f"{folder}: no {PROFILE_FILE} in this folder; make a profile with 'fauio fit'")
    content = path.read_bytes()
    try:
        root = Table(str(path), "", tomllib.loads(content.decode()))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ProfileError(f"{path}: not valid TOML: {error}") from error
    if root.integer("format") != FORMAT:
        raise ProfileError(f"{path}: 'format' is not {FORMAT}; this fauio reads format {FORMAT}")
    files = {PROFILE_FILE: content}
    gate_table = root.table("phase")
    gate = GateRule(
        require_armed=gate_table.boolean("require_armed", True),
        require_airborne=gate_table.boolean("require_airborne", True),
        settle_s=gate_table.number("settle_s", 1.0, at_least=0.0),
        airborne_command=gate_table.number("airborne_command", 0.0),
    )
    gate_table.done()
    observers = root.table("observers")
    if not observers.keys():
        raise ProfileError(f"{path}: 'observers' is empty; a profile needs at least one observer")
    profile_observers = tuple(
        _read_observer(folder, name, observers.table(name), files)
        for name in observers.keys()  # noqa: SIM118 - a Table is no dict
    )
    observers.done()
    profile = Profile(
        name=root.text("name"),
        vehicle=root.text("vehicle"),
        system=root.integer("system", 0),
        gate=gate,
        stale_s=root.number("stale_s", 2.0, at_least=0.05),
        observers=profile_observers,
        files=files,
        digest=_digest(files),
    )
    if not profile.name or set(profile.name) & set("/*$#? "):
        raise ProfileError(f"{path}: 'name' is '{profile.name}'; it becomes part of a topic: no / * $ # ? or blanks")
    root.done()
    return profile


def observer_table(
    *,
    inputs: Sequence[Channel],
    outputs: Sequence[Channel],
    isolation: IsolationRule,
    alarms: Sequence[AlarmRule],
) -> dict[str, Any]:
    """Return an observer's part of profile.toml, as :func:`read_profile` reads it back."""
    table: dict[str, Any] = {
        "inputs": {channel.name: channel_table(channel) for channel in inputs},
        "outputs": {channel.name: channel_table(channel) for channel in outputs},
        "isolation": {
            "method": isolation.method,
            "smoothing_s": isolation.smoothing_s,
        },
        "alarms": {
            rule.channel: {
                "threshold": rule.threshold,
                "clear": rule.clear,
                "critical": rule.critical,
                "raise_s": rule.raise_s,
                "clear_s": rule.clear_s,
            }
            for rule in alarms
        },
    }
    if isolation.method == "single":
        table["isolation"] |= {
            "tolerance": isolation.tolerance,
            "score_floor": isolation.score_floor,
            "gain_penalty": isolation.gain_penalty,
            "covariance": isolation.covariance.tolist(),
        }
    return table


def profile_table(
    *, name: str, vehicle: str, gate: GateRule, observers: Mapping[str, dict[str, Any]], system: int = 0
) -> dict[str, Any]:
    """Return the whole of profile.toml."""
    return {
        "format": FORMAT,
        "name": name,
        "vehicle": vehicle,
        "system": system,
        "stale_s": 2.0,
        "phase": asdict(gate),
        "observers": dict(observers),
    }


def _read_observer(folder: Path, name: str, table: Table, files: dict[str, bytes]) -> ObserverProfile:
    model_path, gains_path = folder / f"{name}.model.toml", folder / f"{name}.gains.json"
    for path in (model_path, gains_path):
        if not path.is_file():
            raise ProfileError(f"{path}: file is missing; the observer '{name}' needs it")
        files[path.name] = path.read_bytes()
    try:
        gains = read_gains(gains_path)
        found = model_hash(read_model(model_path))
    except ModelError as error:
        raise ProfileError(str(error)) from error
    if found != gains.model_hash:
        raise ProfileError(
            f"{gains_path}: designed for another version of {model_path.name}; "
            f"run 'fauio design {model_path} -o {gains_path}'"
        )
    observer = ObserverProfile(
        name=name,
        gains=gains,
        inputs=_channels(table.table("inputs"), gains.inputs),
        outputs=_channels(table.table("outputs"), gains.outputs),
        isolation=_isolation(table.table("isolation"), len(gains.faults)),
        alarms=_alarms(table.table("alarms"), name, gains),
    )
    table.done()
    return observer


def _channels(table: Table, names: Sequence[str]) -> tuple[Channel, ...]:
    channels = tuple(parse_channel(name, table.table(name).raw(), f"{table.where(name)}") for name in names)
    table.done()
    return channels


def _isolation(table: Table, count: int) -> IsolationRule:
    method = table.text("method")
    if method not in ("single", "independent"):
        raise ProfileError(f"{table.where('method')} is '{method}'; use 'single' or 'independent'")
    smoothing_s = table.number("smoothing_s", 0.05, at_least=0.0)
    covariance = np.eye(count)
    tolerance = score_floor = gain_penalty = 0.0
    if method == "single":
        covariance = table.matrix("covariance", count, count)
        tolerance = table.number("tolerance", 0.2, at_least=0.0)
        score_floor = table.number("score_floor", at_least=0.0)
        gain_penalty = table.number("gain_penalty", 25.0, at_least=0.0)
        if not np.allclose(covariance, covariance.T) or np.linalg.eigvalsh(covariance).min() <= 0.0:
            raise ProfileError(f"{table.where('covariance')} is not symmetric and positive definite")
    table.done()
    return IsolationRule(method, smoothing_s, tolerance, score_floor, gain_penalty, covariance)


def _alarms(table: Table, observer: str, gains: Gains) -> tuple[AlarmRule, ...]:
    rules = []
    for channel in table.keys():  # noqa: SIM118 - a Table is no dict
        if channel not in gains.faults:
            raise ProfileError(f"{table.where(channel)}: no such fault; the model has {', '.join(gains.faults)}")
        index = gains.faults.index(channel)
        entry = table.table(channel)
        threshold = entry.number("threshold", at_least=0.0)
        rule = AlarmRule(
            observer=observer,
            channel=channel,
            kind="actuator" if gains.fault_kinds[index] == "actuator" else "sensor",
            unit=gains.fault_units[index],
            threshold=threshold,
            clear=entry.number("clear", threshold / 2, at_least=0.0),
            critical=entry.number("critical", 5 * threshold, at_least=0.0),
            raise_s=entry.number("raise_s", 0.15, at_least=0.0),
            clear_s=entry.number("clear_s", 0.5, at_least=0.0),
        )
        entry.done()
        if rule.clear > rule.threshold:
            raise ProfileError(f"{entry.where('clear')} is above 'threshold'; an alarm must clear below it")
        rules.append(rule)
    return tuple(rules)


def _digest(files: Mapping[str, bytes]) -> str:
    digest = hashlib.sha256()
    for name in sorted(files):
        digest.update(name.encode() + b"\0" + hashlib.sha256(files[name]).digest())
    return digest.hexdigest()
