"""Where an observer's samples come from, as tables of profile.toml: channels, or the signals of a transform."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from adapters.channels import Channel, channel_table, read_channel
from adapters.errors import TelemetryError
from adapters.toml_tables import Table
from gains.synthesis.gains_file import Gains
from monitor.sampling.transform import SampleSource, TransformRule, make_transform


def read_source(table: Table, gains: Gains) -> SampleSource:
    """Return where an observer's samples come from, as its table says; mistakes are recorded in its file."""
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
    if source.transform is None:
        return {
            "inputs": {channel.name: channel_table(channel) for channel in source.inputs},
            "outputs": {channel.name: channel_table(channel) for channel in source.outputs},
        }
    rule = source.transform
    return {
        "transform": {"kind": rule.kind, "rate_hz": rule.rate_hz, **rule.parameters},
        "signals": {channel.name: channel_table(channel) for channel in source.signals},
    }


def _channels(table: Table, names: Sequence[str]) -> tuple[Channel, ...]:
    channels = tuple(read_channel(name, table.table(name)) for name in names)
    table.done()
    return channels
