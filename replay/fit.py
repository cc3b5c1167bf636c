"""Fit a profile: healthy recordings -> identified models -> designed gains -> calibrated alarms, written as text."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tomli_w

from adapters.errors import InfeasibleError, ModelError, TelemetryError, UsageError
from adapters.output_file import write_file
from monitor.fitting.fit_report import draw_comparison
from monitor.fitting.fitted import BatchSource, FitRequest, Fitted
from monitor.fitting.survey import Survey, survey
from monitor.profile import PROFILE_FILE, Profile, profile_table
from monitor.sampling.gate import GateRule
from monitor.sampling.slow_telemetry import slow_messages, slow_text
from monitor.vehicles.base import VehicleKind, load
from monitor.vehicles.inertial.fit import fit_inertial
from monitor.vehicles.kinds import kind_named
from replay.sensitivity.capability import measure_capability

_NEVER_S = 1e6
"""Silence after which telemetry would be stale while faults are tried: recordings have gaps that say nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class FitReport:
    """What ``fauio fit`` found.

    Parameters
    ----------
    vehicle : str
        Kind of vehicle.
    observers : tuple[Fitted, ...]
        The fitted observers.
    notes : tuple[str, ...]
        What could not be fitted, and why.
    warnings : tuple[str, ...]
        What makes the profile worse than it could be.
    set_aside : Path | None
        Where the profile.toml went that stood in the folder before, with what a person may have edited in it.
    """

    vehicle: str
    observers: tuple[Fitted, ...]
    notes: tuple[str, ...]
    warnings: tuple[str, ...] = ()
    set_aside: Path | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the report as a JSON object."""
        return {
            "vehicle": self.vehicle,
            "observers": {fitted.name: fitted.report() for fitted in self.observers},
            "notes": list(self.notes),
            **({"warnings": list(self.warnings)} if self.warnings else {}),
            **({"set_aside": str(self.set_aside)} if self.set_aside is not None else {}),
        }

    def text(self, details: bool = False) -> list[str]:
        """Return the report as lines for people."""
        lines = [line for fitted in self.observers for line in fitted.text(details)]
        return [*lines, *(f"not fitted: {note}" for note in self.notes), *(self.warnings if details else ())]


def fit_profile(
    kind: str, logs: Sequence[BatchSource], folder: Path, name: str, model: Path | None = None
) -> FitReport:
    """Write a profile.

    Parameters
    ----------
    kind : str
        Name of one of :data:`monitor.vehicles.kinds.KINDS`.
    logs : Sequence[BatchSource]
        Healthy recordings; each call of a log goes through it once from the start.
    folder : Path
        The profile's folder; made where it does not exist.
    name : str
        Name of the vehicle and its models.
    model : Path | None
        Model file of a custom vehicle.

    Raises
    ------
    TelemetryError, ModelError, InfeasibleError
        The recordings do not hold what is needed, do not excite an axis, or allow no certified design.
    """
    vehicle = kind_named(kind)
    if vehicle.needs_model != (model is not None):
        raise UsageError(f"--vehicle {kind}: {'needs' if model is None else 'takes no'} --model MODEL.toml")
    surveys = () if vehicle.needs_model else tuple(survey(log()) for log in logs)
    request = FitRequest(name, logs, surveys, model)
    vehicle_types = frozenset[str]().union(*(found.vehicle_types for found in surveys))
    own, gate = load(vehicle.fit)(request)
    observers: list[Fitted] = [own]
    notes: list[str] = []
    if vehicle.inertial_too:
        try:
            observers.append(fit_inertial(request, gate))
        except (TelemetryError, ModelError, InfeasibleError) as error:
            notes.append(f"inertial: {error}")
    warnings = (*_slow(vehicle, surveys, observers), *_of_several(vehicle_types)) if surveys else ()
    measured = tuple(_measured(fitted, request, kind, gate) for fitted in observers)
    report = FitReport(kind, measured, tuple(notes), warnings)
    [vehicle_type] = vehicle_types if len(vehicle_types) == 1 else ("",)
    return replace(report, set_aside=write_profile(folder, name, kind, gate, report, vehicle_type))


def write_profile(
    folder: Path, name: str, kind: str, gate: GateRule, report: FitReport, vehicle_type: str = ""
) -> Path | None:
    """Write what was fitted as a profile folder; return where another profile.toml went that stood there."""
    folder.mkdir(parents=True, exist_ok=True)
    for fitted in report.observers:
        fitted.write(folder)
    tables = {fitted.name: fitted.table() for fitted in report.observers}
    known = {found.rule.channel for fitted in report.observers for found in fitted.alarms}
    rules = (rule for fitted in report.observers for rule in fitted.excuses)
    excuses = [rule for rule in rules if known.issuperset((*rule.channels, *rule.by))]
    content = profile_table(
        name=name, vehicle=kind, vehicle_type=vehicle_type, gate=gate, observers=tables, excuses=excuses
    )
    set_aside = replace_kept(folder / PROFILE_FILE, tomli_w.dumps(content, multiline_strings=False))
    write_file(folder / "fit.json", json.dumps(report.to_json(), indent=1) + "\n")
    write_file(folder / "fit.txt", "\n".join([f"{name} ({kind})", *report.text(details=True)]) + "\n")
    drawn = {fitted.name: fitted.comparison for fitted in report.observers if fitted.comparison is not None}
    for observer, comparison in drawn.items():
        file = "fit.png" if len(drawn) == 1 else f"fit.{observer}.png"
        draw_comparison(folder / file, comparison, f"{name}, {observer}: {comparison.about}")
    return set_aside


def replace_kept(path: Path, text: str) -> Path | None:
    """Write a file; return where it went if it was there and said something else."""
    before = path.with_name(f"{path.name}.before") if path.is_file() and path.read_bytes() != text.encode() else None
    if before is not None:
        write_file(before, path.read_bytes())
    write_file(path, text)
    return before


def _slow(kind: VehicleKind, surveys: Sequence[Survey], observers: Sequence[Fitted]) -> tuple[str, ...]:
    messages = {channel.message for fitted in observers for channel in fitted.source.channels}
    slow = slow_messages([found.rate_hz for found in surveys], messages, kind.wanted_hz)
    return (slow_text(slow, kind.wanted_hz),) if slow else ()


def _of_several(vehicle_types: frozenset[str]) -> tuple[str, ...]:
    if len(vehicle_types) < 2:
        return ()
    told = ", ".join(sorted(vehicle_types))
    return (f"recordings of different vehicles ({told}): a profile is of one; fit each from its own recordings",)


def _measured(fitted: Fitted, request: FitRequest, kind: str, gate: GateRule) -> Fitted:
    """Return the observer with what it will detect, where its kind asks for it."""
    if not fitted.measured:
        return fitted
    observer = replace(fitted.profile(), model=fitted.plant)
    profile = Profile(
        name=request.name,
        vehicle=kind,
        system=0,
        gate=gate,
        stale_s=_NEVER_S,
        observers=(observer,),
        excuses=(),
        files={},
        digest="",
    )
    return replace(fitted, capability=measure_capability(profile, request.logs))
