"""A profile folder: all a vehicle needs to be monitored, as text that a person can read and edit.

PROFILE/profile.toml            vehicle, flight phases, and per observer: channels, isolation, alarm thresholds
PROFILE/<observer>.model.toml   the plant model the gains were designed for
PROFILE/<observer>.gains.json   the compiled gains; they know the hash of their model. A bank has a file for each
                                hypothesis, <observer>.<faults>.gains.json
"""

import hashlib
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

from adapters.channels import Channel, channel_table, read_channel
from adapters.errors import ModelError, ProfileError, TelemetryError
from adapters.toml_tables import Table, parse_toml
from gains.plants.model_file import model_hash, read_model
from gains.plants.plant import Plant
from gains.synthesis.gains_file import Gains, read_gains
from monitor.alarms.alarm import LEAST, MEASURED, AlarmRule
from monitor.alarms.excuse import ExcuseRule, excuse_tables, read_excuses
from monitor.estimation.changes import ChangeRule, changes_table, read_changes
from monitor.estimation.effectiveness import EffectivenessRule, effectiveness_table, read_effectiveness
from monitor.estimation.envelope import Envelope, read_envelope
from monitor.estimation.excitation import ExcitationRule, excitation_table, read_excitation
from monitor.estimation.isolation_rule import (
    IsolationRule,
    gains_file_names,
    isolation_table,
    read_hypotheses,
    read_isolation,
)
from monitor.sampling.gate import GateRule, read_gate
from monitor.sampling.identity import Identity
from monitor.sampling.supply import SupplyRule, read_supply
from monitor.sampling.transform import LiftRule, SampleSource, TransformRule, make_transform


def read_source(table: Table, gains: Gains) -> SampleSource:
    """Return the source of an observer's samples from its table; mistakes are recorded in its file."""
    rates = table.table("fitted_hz") if table.has("fitted_hz") else None
    fitted_hz = {} if rates is None else {name: rates.number(name, above=0.0) for name in rates}
    lift = None
    if table.has("lift"):
        found = table.table("lift")
        lift = LiftRule(found.choice("by", ("rotors", "wings")), found.number("least_command", 0.0, at_least=0.0))
        found.done()
    return replace(_read_source(table, gains), fitted_hz=fitted_hz, lift=lift)


def _read_source(table: Table, gains: Gains) -> SampleSource:
    if not table.has("transform"):
        return SampleSource(
            _channels(table.table("inputs"), gains.inputs), _channels(table.table("outputs"), gains.outputs)
        )
    found = table.table("transform")
    kind, rate_hz = found.text("kind"), found.number("rate_hz", at_least=gains.rate_hz)
    rule = TransformRule(kind, rate_hz, {key: found.number(key) for key in found if key not in ("kind", "rate_hz")})
    if not found.good():
        return SampleSource(transform=rule)
    try:
        transform = make_transform(rule, gains.rate_hz)
    except TelemetryError as error:
        found.mistake("kind", f": {error}")
        return SampleSource(transform=rule)
    if (transform.inputs, transform.outputs) != (gains.inputs, gains.outputs):
        found.mistake("kind", ": gives other signals than the gains take; fit the profile again")
    return SampleSource(transform=rule, signals=_channels(table.table("signals"), transform.signals))


def source_table(source: SampleSource) -> dict[str, Any]:
    """Return the part of an observer's table that :func:`read_source` reads."""
    rates: dict[str, Any] = {"fitted_hz": dict(source.fitted_hz)} if source.fitted_hz else {}
    if source.lift is not None:
        rates["lift"] = asdict(source.lift)
    if source.transform is None:
        return rates | {
            "inputs": {channel.name: channel_table(channel) for channel in source.inputs},
            "outputs": {channel.name: channel_table(channel) for channel in source.outputs},
        }
    rule = source.transform
    return rates | {
        "transform": {"kind": rule.kind, "rate_hz": rule.rate_hz, **rule.parameters},
        "signals": {channel.name: channel_table(channel) for channel in source.signals},
    }


def _channels(table: Table, names: Sequence[str]) -> tuple[Channel, ...]:
    channels = tuple(read_channel(name, table.table(name)) for name in names)
    table.done()
    return channels


FORMAT = 1
"""Number of the layout: a reader refuses what it does not know."""
PROFILE_FILE = "profile.toml"
UNEXPLAINED = "unexplained"
"""Alarm channel of a bank for data that none of its hypotheses explains."""


class FaultChannel(NamedTuple):
    """A fault channel: its name, kind and unit, and the index of the input whose effect it scales, if any."""

    name: str
    kind: Literal["actuator", "sensor"]
    unit: str
    input: int | None


@dataclass(frozen=True, slots=True, eq=False)
class ObserverSetup:
    """The parts of an observer, as they are fitted and as a profile keeps them."""

    name: str  # the observer's name
    # its gains; if it is a bank, those of each hypothesis. All share inputs, outputs, states and rate
    gains: tuple[Gains, ...]
    source: SampleSource  # where u and y come from
    isolation: IsolationRule  # how estimates become evidence
    # wait before its samples are evidence, seconds, if it is longer than the gate's; 0: as long as its gains take to
    # forget a wrong start (:mod:`monitor.estimation.affine`)
    settle_s: float = 0.0
    # faults whose evidence is judged by the deflection at which it arises, by name
    effectiveness: Mapping[str, EffectivenessRule] = field(default_factory=dict)
    changes: ChangeRule | None = None  # how sudden changes are told from noise; None: they are not looked for
    # how the thresholds of actuators' alarms grow with what excites the model's errors; None: they do not
    excitation: ExcitationRule | None = None
    # range of its transform's raw signals in the fitted flights; None: not known
    envelope: Envelope | None = None
    # largest sizes of its inputs and outputs in those flights, by name, for faults that are judged by a deflection
    reached: Mapping[str, float] = field(default_factory=dict)
    # ratio of the estimates' standard deviation in healthy flight to that of the design, by name of the fault; 1 if it
    # is left out
    spread: Mapping[str, float] = field(default_factory=dict)
    # how far healthy flight moves a fault's estimate within its lag, as a multiple of that deviation, by name of the
    # fault; left out: as far as white noise does
    moves: Mapping[str, float] = field(default_factory=dict)
    # length of the straight lines between the measurements that show a fault, seconds, by its name, where no rule for
    # sudden changes has it; 0 if it is left out
    lines_s: Mapping[str, float] = field(default_factory=dict)
    # how commands act with the battery's voltage; None: not at all, or not known
    supply: SupplyRule | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ObserverProfile(ObserverSetup):
    """One observer of the profile: gains, the source of its channels, and its alarms."""

    faults: tuple[FaultChannel, ...]  # all fault channels, actuators first
    alarms: tuple[AlarmRule, ...]  # the rules that raise alarms
    # the model that the gains were designed for; without it the uncertainty of the estimates is not known
    model: Plant | None = None

    @property
    def rate_hz(self) -> float:
        """Samples per second."""
        return self.gains[0].rate_hz

    @property
    def periods_s(self) -> Mapping[str, float]:
        """Time from one measurement that shows a fault to the next, seconds, by the fault's name, where it is known."""
        return self.lines_s if self.changes is None else self.changes.lasts_s

    @property
    def usual_commands(self) -> dict[str, float]:
        """The command of each motor in hover, by the name of its fault, as far as it is known."""
        usual = {
            channel.name: channel.stopped_as
            for channel in self.source.channels
            if channel.stopped_as and channel.stopped_as > 0.0
        }
        # For motors that are not told apart, the command of the first.
        motors = ((fault.name, fault.name.partition("_or_")[0]) for fault in self.faults if fault.input is not None)
        return {name: usual[motor] for name, motor in motors if motor in usual}


@dataclass(frozen=True, slots=True)
class Profile:
    """A vehicle's profile."""

    name: str  # default name of the vehicle in topics and events
    vehicle: str  # kind of vehicle, as given to ``fauio fit``
    system: int  # MAVLink system id to monitor; 0 takes the first one that sends the profile's channels
    gate: GateRule  # when samples count as evidence
    stale_s: float  # silence after which telemetry is stale, seconds
    observers: tuple[ObserverProfile, ...]  # the observers
    excuses: tuple[ExcuseRule, ...]  # which alarms explain evidence on which other channels
    files: Mapping[str, bytes]  # contents of the profile's files, by name, for recordings
    digest: str  # SHA-256 over those files
    # the vehicle of the fitted recordings, as far as they describe it
    identity: Identity = field(default_factory=Identity)
    mass_kg: float = 0.0  # its mass in them; 0 if it is not known. Loads are then given as shares of the weight


def read_profile(folder: str | Path) -> Profile:
    """Read a profile folder.

    Raises
    ------
    ProfileError
        A file is missing, keys are wrong (a line for each), or gains were designed for another model.
    """
    folder = Path(folder)
    path = folder / PROFILE_FILE
    if not path.is_file():
        what = "has no " + PROFILE_FILE if folder.is_dir() else "is a file" if folder.exists() else "does not exist"
        raise ProfileError(f"{folder}: {what}; name the profile folder that 'fauio fit' made")
    content = path.read_bytes()
    file = parse_toml(str(path), content, ProfileError)
    root = file.root
    if root.integer("format") != FORMAT and root.good("format"):
        root.mistake("format", f"is not {FORMAT}; this fauio reads format {FORMAT}")
    file.check()
    files = {PROFILE_FILE: content}
    gate = read_gate(root.table("phase"), GateRule())
    tables = root.table("observers")
    observers = tuple(_read_observer(folder, name, tables.table(name), files) for name in tables)
    if not observers:
        root.mistake("observers", "is empty; a profile needs at least one observer")
    profile = Profile(
        name=root.text("name", check=_part_of_topic),
        vehicle=root.text("vehicle"),
        system=root.integer("system", 0),
        gate=gate,
        stale_s=root.number("stale_s", 2.0, at_least=0.05),
        observers=observers,
        excuses=read_excuses(
            root.tables("excuses"), [rule.channel for observer in observers for rule in observer.alarms]
        ),
        files=files,
        digest=_digest(files),
        identity=Identity(
            vehicle_type=root.text("vehicle_type", ""),
            autopilot=root.text("autopilot", ""),
            frame=root.text("frame", ""),
            motors=root.integer("motors", 0, at_least=0),
        ),
        mass_kg=root.number("mass_kg", 0.0, at_least=0.0),
    )
    root.done()
    file.check()
    return profile


def _part_of_topic(name: str) -> None:
    if not name or set(name) & set("/*$#? "):
        raise ValueError(f"is '{name}'; it becomes part of a topic: no / * $ # ? or blanks")


def _sizes(table: Table, names: Collection[str], what: str) -> dict[str, float]:
    for name in table:
        if name not in names:
            table.mistake(name, f"is no {what} of the observer; they are {', '.join(sorted(names))}")
    found = {name: table.number(name, above=0.0) for name in table}
    table.done()
    return found


def observer_table(observer: ObserverProfile, sees: Mapping[str, str] = MappingProxyType({})) -> dict[str, Any]:
    """Return an observer's part of profile.toml, as :func:`read_profile` reads it.

    ``sees`` describes by channel what its alarm detects: for people, no code reads it.
    """
    table: dict[str, Any] = {
        **({"settle_s": observer.settle_s} if observer.settle_s else {}),
        **source_table(observer.source),
        "isolation": isolation_table(observer.isolation),
        "alarms": {rule.channel: _alarm_table(rule, sees.get(rule.channel)) for rule in observer.alarms},
    }
    if observer.changes is not None:
        table["changes"] = changes_table(observer.changes)
    if observer.excitation is not None:
        table["excitation"] = excitation_table(observer.excitation)
    if observer.envelope is not None:
        table["envelope"] = asdict(observer.envelope)
    if observer.reached:
        table["reached"] = dict(observer.reached)
    if observer.supply is not None:
        table["supply"] = asdict(observer.supply)
    for key in ("spread", "moves", "lines_s"):
        if sizes := getattr(observer, key):
            table[key] = dict(sizes)
    if observer.effectiveness:
        table["effectiveness"] = {name: effectiveness_table(rule) for name, rule in observer.effectiveness.items()}
    return table


_PATHS = ("fast", "fast_s"), ("slow", "slow_s"), ("lasting", "lasting_s"), ("nats", "least")
"""Keys of each optional path of an alarm: its size (infinite: no such path) and the key that belongs to it."""


def _alarm_table(rule: AlarmRule, sees: str | None) -> dict[str, float | str]:
    keys = ["threshold", "clear", "critical", "raise_s", "clear_s"]
    keys += [key for path in _PATHS if getattr(rule, path[0]) < math.inf for key in path]
    keys += [key for key in ("smallest", "healthy", "latch_s") if getattr(rule, key)]
    keys += [key for key in MEASURED if getattr(rule, key) is not None]
    return {key: getattr(rule, key) for key in keys} | ({"sees": sees} if sees else {})


def profile_table(
    *,
    name: str,
    vehicle: str,
    gate: GateRule,
    observers: Mapping[str, dict[str, Any]],
    identity: Identity = Identity(),  # noqa: B008 - frozen
    excuses: Sequence[ExcuseRule] = (),
) -> dict[str, Any]:
    """Return the whole of profile.toml."""
    return {
        "format": FORMAT,
        "name": name,
        "vehicle": vehicle,
        **identity.table(),
        "system": 0,
        "stale_s": 2.0,
        "phase": asdict(gate),
        **({"excuses": excuse_tables(excuses)} if excuses else {}),
        "observers": dict(observers),
    }


def _read_observer(folder: Path, name: str, table: Table, files: dict[str, bytes]) -> ObserverProfile:
    isolation = table.table("isolation")
    bank = read_hypotheses(isolation)
    if not isolation.good():
        # hypotheses name the files with the gains, and the gains name the channels below
        table.file.check()
    hypotheses = bank or ((),)
    model = folder / f"{name}.model.toml"
    paths = [folder / file for file in gains_file_names(name, bank or ())]
    for path in (model, *paths):
        if not path.is_file():
            raise ProfileError(f"{path}: file is missing; the profile needs it")
        files[path.name] = path.read_bytes()
    try:
        plant = read_model(model)
        gains = tuple(_read_gains(path, model, plant, faults) for path, faults in zip(paths, hypotheses, strict=True))
    except ModelError as error:
        raise ProfileError(*error.args) from error
    shared = gains[0]
    for path, found in zip(paths, gains, strict=True):
        if _signals(found) != _signals(shared):
            raise ProfileError(f"{path}: has another rate or other signals than {paths[0].name}")
    faults = fault_channels(gains)
    observer = ObserverProfile(
        name=name,
        gains=gains,
        faults=faults,
        source=read_source(table, shared),
        isolation=read_isolation(isolation, len(shared.outputs)),
        alarms=_alarms(table.table("alarms"), name, faults),
        settle_s=table.number("settle_s", 0.0, at_least=0.0),
        effectiveness=read_effectiveness(
            table.table("effectiveness"), {f.name: f.input for f in faults}, shared.inputs, bank=len(gains) > 1
        ),
        changes=read_changes(table.table("changes"), shared.outputs) if table.has("changes") else None,
        excitation=read_excitation(table.table("excitation"), shared.outputs) if table.has("excitation") else None,
        envelope=read_envelope(table.table("envelope")) if table.has("envelope") else None,
        reached=_sizes(table.table("reached"), {*shared.inputs, *shared.outputs}, "input or output"),
        **{
            key: _sizes(table.table(key), {fault.name for fault in faults}, "fault")
            for key in ("spread", "moves", "lines_s")
        },
        supply=read_supply(table.table("supply")) if table.has("supply") else None,
        model=plant,
    )
    table.done()
    return observer


def _read_gains(path: Path, model_path: Path, plant: Plant, faults: Sequence[str]) -> Gains:
    """Read gains of the model beside them, for these faults if any are named."""
    gains = read_gains(path)
    if faults and set(gains.faults) != set(faults):
        raise ProfileError(f"{path}: estimates {', '.join(gains.faults)}, not {', '.join(faults)}")
    if model_hash(plant) != gains.model_hash:
        only = f" --faults {','.join(faults)}" if faults else ""
        mend = f"fauio design {model_path}{only} -o {path}"
        raise ProfileError(f"{path}: designed for another version of {model_path.name}; run '{mend}'")
    return gains


def _signals(gains: Gains) -> tuple[object, ...]:
    return gains.rate_hz, gains.inputs, gains.outputs, gains.states


def fault_channels(gains: Sequence[Gains]) -> tuple[FaultChannel, ...]:
    """Return the fault channels of all gains of a bank, actuators first."""
    found: dict[str, FaultChannel] = {}
    for gain in gains:
        for name, kind, unit, source in zip(
            gain.faults, gain.fault_kinds, gain.fault_units, gain.fault_inputs, strict=True
        ):
            found.setdefault(name, FaultChannel(name, "actuator" if kind == "actuator" else "sensor", unit, source))
    return tuple(sorted(found.values(), key=lambda channel: channel.kind != "actuator"))


def newly_watched(faults: Iterable[Iterable[str]]) -> list[frozenset[str]]:
    """Return for each observer the faults that no observer before it watches; ``faults`` are those of each observer."""
    watched: frozenset[str] = frozenset()
    new = []
    for names in faults:
        new.append(frozenset(names) - watched)
        watched |= new[-1]
    return new


def seen_sooner(faults: Mapping[str, Iterable[str]]) -> dict[str, list[str]]:
    """Return for each observer the observers before it that watch all of its faults; ``faults`` are those of each."""
    watched: dict[str, frozenset[str]] = {}
    sooner = {}
    for observer, names in faults.items():
        own = frozenset(names)
        sooner[observer] = [before for before, others in watched.items() if own <= others]
        watched[observer] = own
    return sooner


def _alarms(table: Table, observer: str, faults: Sequence[FaultChannel]) -> tuple[AlarmRule, ...]:
    rules = []
    known = {channel.name: channel for channel in faults}
    defaults = {key.name: key.default for key in fields(AlarmRule) if isinstance(key.default, float)}
    for name in table:
        channel = known.get(name)
        if channel is None and name != UNEXPLAINED:
            table.mistake(name, f": no such fault; the model has {', '.join(known)}")
            continue
        entry = table.table(name)
        threshold = entry.number("threshold", at_least=0.0)
        values = {
            key: entry.number(key, default, at_least=LEAST.get(key, 0.0))
            for key, default in {
                "clear": threshold / 2,
                "critical": 5 * threshold,
                "raise_s": 0.15,
                "clear_s": 0.5,
                **defaults,
            }.items()
        }
        rule = AlarmRule(
            observer=observer,
            channel=name,
            kind="residual" if channel is None else channel.kind,
            unit="times healthy" if channel is None else channel.unit,
            threshold=threshold,
            **values | {"fast": max(threshold, values["fast"])},
            sees=entry.text("sees", ""),
            **{key: entry.number(key, at_least=0.0) for key in MEASURED if entry.has(key)},
        )
        entry.done()
        if rule.clear > rule.threshold:
            entry.mistake("clear", "is above 'threshold'; an alarm must clear below it")
        rules.append(rule)
    return tuple(rules)


def _digest(files: Mapping[str, bytes]) -> str:
    digest = hashlib.sha256()
    for name in sorted(files):
        digest.update(name.encode() + b"\0" + hashlib.sha256(files[name]).digest())
    return digest.hexdigest()
