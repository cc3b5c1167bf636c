"""How actuators' fault estimates are read against their deflection: the effectiveness part of a profile."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

from adapters.toml_tables import Table
from monitor.estimation.effectiveness import EffectivenessRule

_SMALLEST_NOISE = 1e-12
"""In units of the output: evidence is divided by it."""
_SMALLEST_CERTAINTY = 1.0
"""Standard errors. One is the least that tells a loss from none at all."""


def read_effectiveness(
    table: Table, faults: Mapping[str, int | None], inputs: Sequence[str], *, bank: bool
) -> dict[str, EffectivenessRule]:
    """Return the rules of an effectiveness table by fault.

    Parameters
    ----------
    table : Table
        A table for each fault.
    faults : Mapping[str, int | None]
        Index of the input that each fault of the observer scales, None where it scales none.
    inputs : Sequence[str]
        Names of the observer's inputs.
    bank : bool
        Whether the observer is a bank, whose estimates hold under one hypothesis each only.

    Mistakes are recorded in the table's file: a key that is missing, unknown or wrong, or a fault that scales no input.
    """
    rules = {}
    for name in table:
        if faults.get(name) is None:
            scaling = ", ".join(fault for fault, source in faults.items() if source is not None) or "none"
            table.mistake(name, f": no fault of that name scales an input; those that do: {scaling}")
        elif bank:
            table.mistake(name, ": a bank's estimates cannot be read this way; use one observer")
        else:
            rules[name] = _read_rule(table.table(name), inputs)
    return rules


def effectiveness_table(rule: EffectivenessRule) -> dict[str, Any]:
    """Return the table that :func:`read_effectiveness` reads back as the same rule."""
    table = {key.name: getattr(rule, key.name) for key in fields(rule)}
    return {
        key: list(value) if isinstance(value, tuple) else value for key, value in table.items() if value is not None
    }


def _read_rule(table: Table, inputs: Sequence[str]) -> EffectivenessRule:
    default = EffectivenessRule(noise=1.0, inflation=1.0, lag_s=0.0, loss_doubt=0.0, offset_doubt=0.0, certainty=1.0)
    rule = EffectivenessRule(
        noise=table.number("noise", at_least=_SMALLEST_NOISE),
        inflation=table.number("inflation", at_least=1.0),
        lag_s=table.number("lag_s", at_least=0.0),
        loss_doubt=table.number("loss_doubt", at_least=0.0),
        offset_doubt=table.number("offset_doubt", at_least=0.0),
        certainty=table.number("certainty", at_least=_SMALLEST_CERTAINTY),
        least_loss=table.number("least_loss", default.least_loss, at_least=0.0),
        least_offset=table.number("least_offset", default.least_offset, at_least=0.0),
        memories_s=table.numbers("memories_s", default.memories_s, above=0.0),
        timing_s=table.number("timing_s", default.timing_s, at_least=0.0),
        hold_s=table.number("hold_s", default.hold_s, at_least=0.0),
        full=table.optional_text("full"),
    )
    if table.good("memories_s") and list(rule.memories_s) != sorted(set(rule.memories_s)):
        table.mistake("memories_s", "does not grow; put the shortest memory first")
    if rule.full is not None and table.good("full") and rule.full not in inputs:
        table.mistake("full", f"is '{rule.full}'; no such input; there are {', '.join(inputs)}")
    table.done()
    return rule
