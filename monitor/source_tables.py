"""Where an observer's samples come from, as tables of profile.toml: channels, or the signals of a transform."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from adapters.channels import Channel, channel_table, parse_channel
from adapters.errors import ProfileError, TelemetryError
from gains.synthesis.gains_file import Gains
from monitor.sampling.transform import Source, TransformRule, make_transform
from monitor.tables import Table


def read_source(table: Table, gains: Gains) -> Source:
    """Return where an observer's samples come from, as its table says.

    Raises
    ------
    ProfileError
        A channel is missing or wrong, or a transform gives other signals than the gains take.
    """
    if "transform" not in table.keys():  # noqa: SIM118 - a Table is no dict
        inputs, outputs = (
            _channels(table.table("inputs"), gains.inputs),
            _channels(table.table("outputs"), gains.outputs),
        )
        return Source(inputs, outputs)
    found = table.table("transform")
    where = found.where("kind")
    kind, rate_hz = found.text("kind"), found.number("rate_hz", at_least=gains.rate_hz)
    parameters = {key: found.number(key) for key in found.keys() if key not in ("kind", "rate_hz")}  # noqa: SIM118
    rule = TransformRule(kind, rate_hz, parameters)
    try:
        transform = make_transform(rule, gains.rate_hz)
    except TelemetryError as error:
        raise ProfileError(f"{where}: {error}") from error
    if (transform.inputs, transform.outputs) != (gains.inputs, gains.outputs):
        raise ProfileError(f"{where}: gives other signals than the gains take; fit the profile again")
    return Source(transform=rule, signals=_channels(table.table("signals"), transform.signals))


def source_table(source: Source) -> dict[str, Any]:
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
    try:
        channels = tuple(parse_channel(name, table.table(name).raw(), table.where(name)) for name in names)
    except TelemetryError as error:
        raise ProfileError(str(error)) from error
    table.done()
    return channels
