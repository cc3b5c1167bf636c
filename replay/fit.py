"""Fit a profile: healthy recordings -> identified models -> designed gains -> calibrated alarms, written as text."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from adapters.batch import Batch
from adapters.errors import InfeasibleError, ModelError, OtherVehicleError, TelemetryError, UntoldError, UsageError
from adapters.output_file import json_text, write_file
from adapters.toml_tables import toml_text
from monitor.fitting.fit_report import Comparison, draw_comparison
from monitor.fitting.fitted import BatchSource, FitRequest, Fitted, kept_logs
from monitor.fitting.flights import phase_reports
from monitor.fitting.kept_flights import (
    FOLDER,
    MODEL,
    Extent,
    KeptFit,
    extent_of,
    kept_model,
    read_kept,
    with_edits,
    write_kept,
)
from monitor.fitting.raw_streams import hidden
from monitor.fitting.survey import MOTOR_MESSAGE, Survey, of_one_vehicle, survey
from monitor.profile import PROFILE_FILE, Profile, profile_table, read_profile
from monitor.sampling.gate import GateRule
from monitor.sampling.identity import Identity, Reports, common_identity
from monitor.sampling.phase import FlightPhase
from monitor.sampling.slow_telemetry import slow_messages, slow_text, slowest_text
from monitor.sampling.supply import BATTERY_MESSAGE
from monitor.vehicles.base import VehicleKind, likely_kinds, load
from monitor.vehicles.inertial.fit import OBSERVER, fit_alone, fit_inertial
from monitor.vehicles.kinds import KINDS, kind_named
from replay.sensitivity.capability import measure_capability

_NEVER_S = 1e6
"""Silence after which telemetry is stale while faults are tried, seconds: longer than any gap of a recording, since a
gap tells nothing about the faults."""


@dataclass(frozen=True, slots=True, eq=False)
class FitReport:
    """Result of ``fauio fit``."""

    vehicle: str  # kind of vehicle
    observers: tuple[Fitted, ...]
    notes: tuple[str, ...]  # observers that could not be fitted, and why
    warnings: tuple[str, ...] = ()  # reasons why the profile is worse than it could be
    # file to which an earlier profile.toml of the folder was moved, which may hold a person's edits
    set_aside: Path | None = None
    edits: tuple[str, ...] = ()  # edits that an updated profile kept
    # flights that the profile no longer keeps, for lack of room: later updates do not fit them
    left_out: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return the report as a JSON object."""
        return {
            "vehicle": self.vehicle,
            "observers": {fitted.name: fitted.report() for fitted in self.observers},
            "notes": list(self.notes),
            **({"warnings": list(self.warnings)} if self.warnings else {}),
            **({"set_aside": str(self.set_aside)} if self.set_aside is not None else {}),
            **({"edits": list(self.edits)} if self.edits else {}),
            **({"left_out": list(self.left_out)} if self.left_out else {}),
        }

    def text(self, details: bool = False) -> list[str]:
        """Return the report as lines for people."""
        lines = [line for fitted in self.observers for line in fitted.text(details)]
        return [*lines, *(f"not fitted: {note}" for note in self.notes), *(self.warnings if details else ())]


def fit_profile(
    kind: str,
    logs: Sequence[BatchSource],
    folder: Path,
    name: str,
    model: Path | None = None,
    *,
    log_names: Sequence[str] = (),
    force: bool = False,
    rate_hz: float | None = None,
    stage: Callable[[str], None] = lambda _: None,
    update: Path | None = None,
    capability: bool = True,
) -> FitReport:
    """Write a profile.

    The function has the options of :func:`replay.api.fit`. Each call of a log reads it once from the start. ``update``
    is a profile whose flights are fitted again and whose edits are kept; ``kind`` may then be empty, for that profile's
    kind. Empty ``log_names``: names are numbers. ``stage`` is called after each stage; ``capability`` tells whether to
    measure which faults will be detected how fast, for the profile's readers.

    Raises
    ------
    OtherVehicleError
        A recording reports another vehicle, and ``force`` is not set.
    UsageError, ProfileError
        The rate is higher than the messages allow; the profile to update is of another kind, keeps none of its
        flights, or keeps one of the recordings already.
    TelemetryError, ModelError, InfeasibleError
        The recordings lack a needed message, do not excite an axis, or allow no certified design.
    """
    before = None if update is None else _Before(update, read_profile(update), read_kept(update))
    if before is not None:
        if kind not in ("", before.profile.vehicle):
            raise UsageError(f"--vehicle {kind}: {before.folder} is the profile of kind {before.profile.vehicle}")
        kind, model, rate_hz = before.profile.vehicle, model or before.model, rate_hz or before.kept.rate_hz
    vehicle = kind_named(kind)
    if vehicle.needs_model != (model is not None):
        raise UsageError(f"--vehicle {kind}: {'needs' if model is None else 'takes no'} --model MODEL.toml")
    read = _read(vehicle, logs, log_names or FitRequest(name, logs).names, before, force, stage)
    surveys = tuple(flight.survey for flight in read.surveyed)
    request = FitRequest(name, read.logs, surveys, model, read.names, rate_hz)
    own = _own_observer(vehicle, request, read.surveyed)
    stage(f"identified, designed and calibrated {own.fitted.name}")
    further, refused = ((), own.refused) if own.refused else _further_observers(vehicle, own.request, own.gate, stage)
    observers = (own.fitted, *further)
    measured = observers
    if capability:
        measured = tuple(_measured(observer, own.request, kind, own.gate) for observer in observers)
        stage("measured what will be detected")
    report = FitReport(kind, measured, refused, _warnings(vehicle, own, observers, read.idle))
    content = profile_content(
        name, kind, own.gate, report, common_identity(flight.identity for flight in read.surveyed)
    )
    merged, edits = (content, []) if before is None else with_edits(content, before.kept.written, before.edited)
    set_aside = write_profile(folder, name, report, merged)
    wanted = {channel.message for observer in observers for channel in observer.source.channels} | FlightPhase.interests
    wanted |= {BATTERY_MESSAGE} if any(observer.supply is not None for observer in observers) else set()
    kept = () if before is None else before.kept.flights
    added = [flight for flight in read.added if flight[0] not in own.lacking]
    left_out = write_kept(folder, content, rate_hz, kept, added, wanted, update)
    if model is not None:
        write_file(folder / FOLDER / MODEL, model.read_bytes())
    return replace(report, set_aside=set_aside, edits=tuple(edits), left_out=left_out)


class _Before(NamedTuple):
    """The profile before its update."""

    folder: Path
    profile: Profile
    kept: KeptFit

    @property
    def model(self) -> Path | None:
        """The model file of a custom vehicle."""
        return kept_model(self.folder)

    @property
    def edited(self) -> dict[str, Any]:
        """The current table of the profile, with its edits."""
        return tomllib.loads(self.profile.files[PROFILE_FILE].decode())


class _ReadLogs(NamedTuple):
    """The recordings of a fit, the kept ones first, with their surveys, and the new ones among them."""

    logs: Sequence[BatchSource]
    names: Sequence[str]
    surveyed: Sequence[SurveyedLog]
    added: Sequence[tuple[str, Extent, BatchSource]]
    idle: Sequence[str]  # names of the recordings that were left out because they show no flight


def _read(
    kind: VehicleKind,
    logs: Sequence[BatchSource],
    log_names: Sequence[str],
    before: _Before | None,
    force: bool,
    stage: Callable[[str], None],
) -> _ReadLogs:
    """Read each recording once; refuse recordings of another vehicle and recordings that are given twice."""
    flights = () if before is None else before.kept.flights
    stored = [] if before is None else [partial(flight.batches, before.folder) for flight in flights]
    sources = kept_logs([*stored, *logs])
    names = (*(flight.name for flight in flights), *log_names)
    added: list[tuple[str, Extent]] = []
    surveyed: list[SurveyedLog] = []
    for number, (log, log_name) in enumerate(zip(sources, names, strict=True)):
        if number >= len(flights):
            added.append((Path(log_name).name, extent_of(log)))
            _check_new(added[-1], [*((flight.name, flight.span) for flight in flights), *added[:-1]])
        if not kind.needs_model:
            surveyed.append(survey_log(log_name, log, None if before is None else before.profile.identity))
            if not force:
                check_vehicle(kind, surveyed)
        stage(f"read {log_name} ({number + 1} of {len(names)})")
    if not kind.needs_model:
        sources = [partial(_of_one_vehicle, log) for log in sources]
    files = [Path(name).name for name in names]
    idle = [number for number, flight in enumerate(surveyed) if flight.survey.idle]
    # in one order, however they are given: what is kept back for a check, and the scatter of sums, follow the order
    extents = [*((flight.span, flight.name) for flight in flights), *((extent, name) for name, extent in added)]
    in_order = sorted(range(len(files)), key=extents.__getitem__)
    flown = [number for number in in_order if number not in idle] or in_order
    return _ReadLogs(
        logs=[sources[number] for number in flown],
        names=[files[number] for number in flown],
        surveyed=[surveyed[number] for number in flown] if surveyed else (),
        added=[(*added[at - len(flights)], sources[at]) for at in flown if at >= len(flights)],
        idle=[files[number] for number in idle if number not in flown],
    )


class _OwnObserver(NamedTuple):
    """A vehicle's own observer, its gate, the flights that agree, and why the kind's observer could not be fitted."""

    fitted: Fitted
    gate: GateRule
    request: FitRequest
    refused: tuple[str, ...] = ()
    # names of the recordings that were left out because they hold too little, and what they lack
    lacking: Mapping[str, str] = MappingProxyType({})


def _own_observer(kind: VehicleKind, request: FitRequest, surveyed: Sequence[SurveyedLog]) -> _OwnObserver:
    """Fit a vehicle's own observer, without flights that disagree; if that fails, the observer of the sensors.

    If recordings do not hold all that is needed, they are left out where others do.
    """
    try:
        fitted, gate = load(kind.fit)(request)
    except TelemetryError:
        lacking = _lacking(kind, request)
        if not 0 < len(lacking) < len(request.names):
            raise
        return _own_observer(kind, request.without(lacking), surveyed)._replace(lacking=lacking)
    except UntoldError as error:
        if any(_is_another(kind, flight.identity.vehicle_type) for flight in surveyed):
            raise
        # the recordings may still be good enough for the observer of the sensors
        try:
            return _OwnObserver(*fit_alone(replace(request, rate_hz=None)), request, (f"{kind.watches}: {error}",))
        except (TelemetryError, ModelError, InfeasibleError):
            raise error from None
    agreed, request = fitted.agreement, replace(request, agreed=True)
    if agreed is not None and (apart := agreed.left_out):
        request = request.without(apart)
        fitted, gate = load(kind.fit)(request)
        fitted = replace(fitted, agreement=agreed)
    return _OwnObserver(fitted, gate, request)


def _lacking(kind: VehicleKind, request: FitRequest) -> dict[str, str]:
    """Return the names of the recordings from which, by themselves, nothing could be fitted, and the reason."""
    reasons: dict[str, str] = {}
    for name, found in zip(request.names, request.surveys, strict=False):
        try:
            load(kind.preview)(found)
        except TelemetryError as error:
            reasons[name] = str(error)
    return reasons


def _further_observers(
    kind: VehicleKind, request: FitRequest, gate: GateRule, stage: Callable[[str], None]
) -> tuple[tuple[Fitted, ...], tuple[str, ...]]:
    """Fit a kind's further observers; return them, and the reasons why others could not be fitted."""
    further = {reference.partition(":fit_")[2]: load(reference) for reference in kind.further}
    if kind.inertial_too:
        further[OBSERVER] = fit_inertial
    observers: list[Fitted] = []
    refused: list[str] = []
    for observer, fit in further.items():
        try:
            if (fitted := fit(request, gate)) is not None:
                observers.append(fitted)
                stage(f"calibrated and designed {observer}")
        except (TelemetryError, ModelError, InfeasibleError) as error:
            refused.append(f"{observer}: {error}")
    return tuple(observers), tuple(refused)


def _of_one_vehicle(log: BatchSource) -> Iterable[Batch]:
    return of_one_vehicle(log())


def _check_new(added: tuple[str, Extent], others: Iterable[tuple[str, Extent]]) -> None:
    """Check that a recording is not one of the others: it would count twice."""
    name, span = added
    for other, extent in others:
        if extent == span:
            raise UsageError(f"{name}: is fitted already, as {other}; leave it out")


@dataclass(frozen=True, slots=True)
class SurveyedLog:
    """A recording's name, the result of its survey, and the vehicle that it reports."""

    name: str
    survey: Survey
    identity: Identity


_LONGEST_NAME = 64
"""Longest name, letters: as for a model (:mod:`gains.plants.plant`)."""


def name_by_folder(folder: Path) -> str:
    """Return a vehicle's name made from its profile's folder; hyphens replace letters that a name may not have."""
    name = re.sub(r"[^A-Za-z0-9_-]", "-", folder.resolve().name)
    return (name if name[:1].isalpha() else f"vehicle-{name}")[:_LONGEST_NAME]


def survey_log(name: str, log: BatchSource, known: Identity | None = None) -> SurveyedLog:
    """Read a recording once, for the vehicle whose messages are fitted; ``known`` is its known identity."""
    reports: dict[int, Reports] = {}
    systems: set[int] = set()

    def followed(batches: Iterable[Batch]) -> Iterator[Batch]:
        for batch in batches:
            for _, message in phase_reports(batch):
                reports[message.system] = reports.get(message.system, Reports()).after(message)
            yield batch

    def chosen(batches: Iterable[Batch]) -> Iterator[Batch]:
        for batch in batches:
            systems.update(entry.system for entry in batch.entries)
            yield batch

    found = survey(chosen(of_one_vehicle(followed(log()))))
    # the records of an onboard log have no system id
    said = reports.get(0, Reports()).joined(reports.get(max(systems, default=0), Reports()))
    identity = said.identity
    if known is not None and identity.difference(known) is None:
        identity = common_identity([identity, known])
    return SurveyedLog(name, found, identity)


def _is_another(kind: VehicleKind, says: str) -> bool:
    """Return whether a vehicle that reports its type is of another kind."""
    return bool(says and kind.type_words) and kind not in likely_kinds(KINDS, says)


def check_vehicle(kind: VehicleKind, surveyed: Sequence[SurveyedLog]) -> None:
    """Raise an OtherVehicleError unless the last recording is of this kind, and of the same vehicle as the others."""
    last = surveyed[-1]
    # ArduPilot's VTOL planes report that they are planes.
    says = "vtol" if last.survey.is_vtol else last.identity.vehicle_type
    if _is_another(kind, says):
        mend = "".join(f"fit it with --vehicle {kind.name}, " for kind in likely_kinds(KINDS, says))
        raise OtherVehicleError(
            f"{last.name}: says it is a {says}, which is no {kind.name}; {mend}or go on with --force"
        )
    for other in surveyed[:-1]:
        if (unlike := last.identity.difference(other.identity)) is not None:
            raise OtherVehicleError(
                f"{last.name}: says it is {unlike[0]}, {other.name} that it is {unlike[1]}; a profile is of one "
                "vehicle: fit each from its own recordings, or go on with --force"
            )


def profile_content(name: str, kind: str, gate: GateRule, report: FitReport, identity: Identity) -> dict[str, Any]:
    """Return the content of profile.toml for what was fitted."""
    tables = {fitted.name: fitted.table() for fitted in report.observers}
    known = {alarm.rule.channel for fitted in report.observers for alarm in fitted.alarms}
    rules = (rule.among(known) for fitted in report.observers for rule in fitted.excuses)
    excuses = [rule for rule in rules if rule.channels and rule.by]
    return profile_table(name=name, vehicle=kind, identity=identity, gate=gate, observers=tables, excuses=excuses)


def write_profile(folder: Path, name: str, report: FitReport, content: Mapping[str, Any]) -> Path | None:
    """Write the fitted observers as a profile folder; return the file to which another profile.toml was moved."""
    folder.mkdir(parents=True, exist_ok=True)
    for fitted in report.observers:
        fitted.write(folder)
    set_aside = replace_kept(folder / PROFILE_FILE, toml_text(content))
    write_file(folder / "fit.json", json_text(report.to_json()))
    write_file(folder / "fit.txt", "\n".join([f"{name} ({report.vehicle})", *report.text(details=True)]) + "\n")
    for file, (observer, comparison) in drawings(report).items():
        draw_comparison(folder / file, comparison, f"{name}, {observer}: {comparison.about}")
    return set_aside


def drawings(report: FitReport) -> dict[str, tuple[str, Comparison]]:
    """Return the observers whose prediction is drawn beside the measurement, by the file of the drawing."""
    drawn = [(fitted.name, fitted.comparison) for fitted in report.observers if fitted.comparison is not None]
    return {"fit.png" if len(drawn) == 1 else f"fit.{name}.png": (name, comparison) for name, comparison in drawn}


def replace_kept(path: Path, text: str) -> Path | None:
    """Write a file; return the file to which a different earlier content was moved, None if there was none."""
    before = path.with_name(f"{path.name}.before") if path.is_file() and path.read_bytes() != text.encode() else None
    if before is not None:
        write_file(before, path.read_bytes())
    write_file(path, text)
    return before


def _warnings(
    kind: VehicleKind, own: _OwnObserver, observers: Sequence[Fitted], idle: Sequence[str]
) -> tuple[str, ...]:
    """Return warnings: recordings left out, messages that are too rare, and sensors that the messages hide."""
    surveys = own.request.surveys
    if not surveys:
        return ()
    inertial = (channel for fitted in observers if fitted.name == OBSERVER for channel in fitted.source.channels)
    unseen = hidden(surveys, inertial)
    channels = [channel for fitted in observers for channel in fitted.source.channels]
    slow = slow_messages([found.rate_hz for found in surveys], channels, kind.wanted_hz)
    onboard = all(found.onboard for found in surveys)
    commands_hz = slow.get(MOTOR_MESSAGE) if kind.name == "multirotor" else None
    said = slow_text(slow, kind.wanted_hz, onboard=onboard, commands_hz=commands_hz) if slow else None
    named = [(name, found.rate_hz) for name, found in zip(own.request.names, surveys, strict=True)]
    no_flight = f"left out, as no motor or servo moves as in flight while armed: {', '.join(idle)}" if idle else None
    lacking = [f"left out, as it lacks what the others hold: {name}: {reason}" for name, reason in own.lacking.items()]
    return tuple(filter(None, (no_flight, *lacking, said, slowest_text(named, slow), unseen)))


def _measured(fitted: Fitted, request: FitRequest, kind: str, gate: GateRule) -> Fitted:
    """Return the observer with the sizes that it will detect, if it is to be measured."""
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
