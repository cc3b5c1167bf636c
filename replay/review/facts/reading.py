"""Reads a log once for the facts that it states."""

from dataclasses import replace
from pathlib import Path

from adapters.errors import TelemetryError
from adapters.logs.damage import Damage
from adapters.logs.recordings import Recording, onboard_source
from monitor.alarms.command_watch import command_risk
from replay.review.facts import ardupilot, mavlink, px4
from replay.review.facts.log_facts import SUBMARINE, LogFacts, LogRecords, Statement, flown

_ABOVE = ("gps", "position")
"""Signals of a receiver, which tell nothing of a submarine."""


def read_facts(path: Path) -> tuple[LogFacts, tuple[Damage, ...]]:
    """Return the facts that a log states, and its unreadable parts.

    Raises
    ------
    TelemetryError
        The file is no recording, cannot be read, or the vehicle reports nothing in it.
    """
    source = onboard_source(path)
    topics, translate = {
        "ulog": (px4.TOPICS, px4.px4_facts),
        "dataflash": (ardupilot.TOPICS, ardupilot.ardupilot_facts),
    }.get(source or "", (mavlink.TOPICS, mavlink.mavlink_facts))
    recording = Recording(path, topics)
    records = LogRecords(recording.records())
    if not any(True for _ in records.names()):
        raise TelemetryError(f"{path}: holds no telemetry of a flight; give a log of a flight")
    said = translate(records)
    dives = said.vehicle == SUBMARINE
    facts = replace(
        said,
        signals={name: signal for name, signal in said.signals.items() if signal and not (dives and name in _ABOVE)},
        lacks={**said.lacks, **dict.fromkeys(_ABOVE if dives else (), "receivers have no fix under water")},
        commands=tuple(sorted(said.commands, key=lambda command: command.time_s)),
    )
    flight = tuple(flown(facts)) if facts.flies else facts.armed
    changed = (
        Statement(records.time_s(at), "parameter", f"{name} set to {value:g} ({before:g} before)")
        for at, name, before, value in records.changed
        if any(start <= records.time_s(at) < end for start, end in flight) and command_risk("PARAM_SET", (name,))
    )
    statements = sorted((*said.statements, *changed), key=lambda statement: statement.time_s)
    return replace(facts, flight=flight, statements=tuple(statements)), recording.damage()
