"""What is in a file of fauio's: a recording, a profile, a model or gains, as one JSON object."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from adapters.errors import InfeasibleError, ModelError, TelemetryError
from adapters.toml_tables import read_toml
from gains.analysis.check import check_plant, check_text
from gains.identification.free_model import read_free_model
from gains.plants.model_file import BUILTIN_MODELS, load_model
from gains.plants.plant import Plant
from gains.synthesis.gains_file import Gains, read_gains
from monitor.profile import PROFILE_FILE, ObserverProfile, read_profile
from replay.inspection.log_info import log_info
from replay.player import interests


def info(path: Path) -> dict[str, Any]:
    """Return what is in a file or folder; ``kind`` says what it is.

    Raises
    ------
    TelemetryError, ProfileError, ModelError
        It is none of these, or cannot be read.
    """
    if path.name == PROFILE_FILE and path.is_file():
        return profile_info(path.parent)
    if (path / PROFILE_FILE).is_file():
        return profile_info(path)
    if path.suffix == ".toml" or (str(path) in BUILTIN_MODELS and not path.exists()):
        return model_info(path)
    if not path.exists():
        raise TelemetryError(f"{path}: no such file; give a recording, a profile, a model or gains")
    if path.suffix == ".json":
        return gains_info(path)
    return log_info(path)


def profile_info(folder: Path) -> dict[str, Any]:
    """Return what a profile watches, with which certified bound, from which sizes on."""
    profile = read_profile(folder)
    said = tomllib.loads(profile.files[PROFILE_FILE].decode())["observers"]
    return {
        "file": str(folder),
        "kind": "profile",
        "name": profile.name,
        "vehicle": profile.vehicle,
        "system": profile.system,
        "stale_s": profile.stale_s,
        "phase": {
            "require_armed": profile.gate.require_armed,
            "require_airborne": profile.gate.require_airborne,
            "settle_s": profile.gate.settle_s,
        },
        "messages": sorted(
            interests(profile) & {name for observer in profile.observers for name in _messages(observer)}
        ),
        "observers": {
            observer.name: _observer(observer, said[observer.name]["alarms"]) for observer in profile.observers
        },
        "digest": profile.digest,
    }


def _messages(observer: ObserverProfile) -> set[str]:
    return {channel.message for channel in observer.source.channels}


def _observer(observer: ObserverProfile, said: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    gains = observer.gains
    return {
        "rate_hz": observer.rate_hz,
        "hypotheses": len(gains),
        **_names(gains[0]),
        "faults": [fault.name for fault in observer.faults],
        "messages": sorted(_messages(observer)),
        **_bounds(gains),
        "alarms": {
            rule.channel: {
                "kind": rule.kind,
                "threshold": rule.threshold,
                "usual_command": observer.usual_commands.get(rule.channel),
                "critical": rule.critical,
                "unit": rule.unit,
                "raise_s": rule.raise_s,
                "sees": said[rule.channel].get("sees"),
            }
            for rule in observer.alarms
        },
    }


def _names(of: Gains | Plant) -> dict[str, list[str]]:
    return {"inputs": list(of.inputs), "outputs": list(of.outputs), "states": list(of.states)}


def _bounds(gains: Sequence[Gains]) -> dict[str, Any]:
    """Return the worst certified bound, the worst norm, and whether every certificate holds."""
    certificates = [gain.report.get("certificate") for gain in gains]
    return {
        "sqrt_mu": _worst(gains, "sqrt_mu"),
        "norm": _worst(gains, "norm"),
        "certified": all(
            isinstance(certificate, Mapping) and certificate.get("holds") is True for certificate in certificates
        ),
    }


def _worst(gains: Sequence[Gains], key: str) -> float | None:
    bounds = [gain.report.get(key) for gain in gains]
    known = [value for value in bounds if isinstance(value, int | float)]
    return max(known) if len(known) == len(bounds) else None


def gains_info(path: Path) -> dict[str, Any]:
    """Return what gains estimate, for which model, and what they are worth."""
    gains = read_gains(path)
    return {
        "file": str(path),
        "kind": "gains",
        "model": gains.model,
        "model_hash": gains.model_hash,
        "method": gains.method,
        "domain": gains.domain,
        "rate_hz": gains.rate_hz,
        **_names(gains),
        "faults": [
            {"name": name, "kind": kind, "unit": unit}
            for name, kind, unit in zip(gains.faults, gains.fault_kinds, gains.fault_units, strict=True)
        ],
        "nonlinearities": len(gains.nonlinearities),
        "matrix": list(gains.step_matrix.shape),
        **_bounds([gains]),
    }


def model_info(path: Path) -> dict[str, Any]:
    """Return a model's names and sizes, and whether its faults can be estimated."""
    free = None
    if str(path) not in BUILTIN_MODELS and read_toml(path, ModelError).root.has("parameters"):
        free = read_free_model(path)
    plant = load_model(path) if free is None else free.example
    estimable, verdict = _checked(plant)
    return {
        "file": str(path),
        "kind": "model",
        "name": plant.name,
        "description": plant.description,
        "domain": plant.domain,
        "rate_hz": plant.rate_hz,
        **_names(plant),
        "faults": [{"name": fault.name, "kind": fault.kind, "unit": fault.unit} for fault in plant.faults],
        "disturbances": [signal.name for signal in plant.disturbances],
        "noises": [signal.name for signal in plant.noises],
        "nonlinearities": [nonlinearity.expression for nonlinearity in plant.nonlinearities],
        "parameters": None if free is None else [parameter.name for parameter in free.parameters],
        "estimable": estimable,
        "check": verdict,
    }


def _checked(plant: Plant) -> tuple[bool | None, str]:
    """Return whether all faults can be estimated together, and the findings in a line."""
    try:
        check = check_plant(plant)
    except (ModelError, InfeasibleError) as error:
        return None, str(error)
    return check.estimable, check_text(check).splitlines()[0]
