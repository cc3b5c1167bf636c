"""Estimate the share of its command that an actuator still delivers: loss and offset from the fault estimate.

A surface that lost a share of its effectiveness shows nothing while it is at trim: its additive fault estimate f^ has
to be compared with the deflection at which it arose. With u the effect commanded (lagged like f^) and m the effect of a
full constant deflection (speed scaling; 1 if there is none),

    f^ = -loss u + offset m + noise.

Both are followed by least squares with exponential forgetting: information Lambda and moments b,

    Lambda <- e^(-T / memory) Lambda + w phi phi',   b <- e^(-T / memory) b + w phi f^,     phi = [-u, m],

where 1 / w is the variance of the noise times the number of samples that count as one (noise is coloured). The noise is
that of the fitted flights, times two factors of this run: how much worse loss and offset explain f^ over the last 20 s
(gusts), and how far inputs and outputs are outside of the fitted flights (saturation, stall, products of rates: outputs
count by their squares). Loss alone and offset alone are each tested by estimate over standard error. The standard error
includes the error of the healthy model in both, and that the time between u and f^ is known only within ``timing_s``,
which looks like a fault of size timing_s u' while u moves. The size that explains more, b_i^2 / Lambda_ii, is the
evidence. An unexcited actuator has a large standard error: it is neither accused nor acquitted.

A short memory detects a large fault, and its end, at once; a long one a small fault. The shortest memory with a verdict
decides. If health explains the data of the shortest memory better than its accusation does, the accusation is dropped
and everything before is forgotten: the time in which an actuator was deflected would otherwise outweigh the time at
rest. The rules themselves, row after row, are :class:`monitor.core.effectiveness.EffectivenessEstimator`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapters.toml_tables import Table

_SMALLEST_NOISE = 1e-12
"""Least noise, in units of the output: evidence is divided by it."""
_SMALLEST_CERTAINTY = 1.0
"""Least certainty, standard errors. One is the least that tells a loss from none at all."""


def read_effectiveness(
    table: Table, faults: Mapping[str, int | None], inputs: Sequence[str], *, bank: bool
) -> dict[str, EffectivenessRule]:
    """Return the rules of an effectiveness table by fault; every fault has one.

    ``faults`` has the index of the input that each fault of the observer scales, None for a fault that scales none.
    Estimates of a ``bank`` each hold under one hypothesis only. Mistakes are recorded in the table's file: a key that
    is missing, unknown or wrong, or a fault that scales no input.
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
        misfit=table.number("misfit", default.misfit, at_least=0.0),
    )
    if table.good("memories_s") and list(rule.memories_s) != sorted(set(rule.memories_s)):
        table.mistake("memories_s", "does not grow; put the shortest memory first")
    if rule.full is not None and table.good("full") and rule.full not in inputs:
        table.mistake("full", f"is '{rule.full}'; no such input; there are {', '.join(inputs)}")
    table.done()
    return rule


Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class EffectivenessRule:
    """The rule by which one actuator's fault estimate is read."""

    noise: float  # standard deviation of f^ in healthy operation, in effect units
    inflation: float  # number of consecutive samples of that noise that count as one
    lag_s: float  # mean delay of f^ behind the fault, seconds
    loss_doubt: float  # standard deviation of loss and offset that the healthy model's own errors cause
    offset_doubt: float
    certainty: float  # number of standard errors that healthy operation does not reach
    # smallest loss, as a share of the command, and smallest offset, as a fraction of full deflection, that matter
    least_loss: float = 0.08
    least_offset: float = 0.04
    memories_s: tuple[float, ...] = (0.25, 1.0)  # time constants of forgetting, shortest first, seconds
    timing_s: float = 0.02  # how well the time between command and effect is known, seconds
    # how long an accusation is kept without the excitation that could confirm it, seconds; the shortest memory has to
    # fade first
    hold_s: float = 3.0
    full: str | None = None  # input that is the effect of a full constant deflection; None: that effect is 1
    # largest mean square over 20 s of the part of f^ that loss and offset do not explain in healthy flights, over
    # noise^2; 0: not compared
    misfit: float = 0.0


class EffectivenessRun(NamedTuple):
    """Loss and offset of an actuator after each of n samples (n,).

    NaN at samples that are no evidence, except ``size``.
    """

    # share of the commanded effect that is missing if there is no offset, and its standard error
    loss: Array
    loss_error: Array
    # constant deflection that exists without command if there is no loss, as a fraction of full deflection, likewise
    offset: Array
    offset_error: Array
    score: Array  # estimate over standard error of the one that explains more
    # deflection that is missing (negative) or exists without command in the actuator's present use, as a fraction of
    # full deflection, if one of the two is certain and matters; otherwise zero; NaN while an accusation can neither be
    # confirmed nor dropped for lack of excitation
    evidence: Array
    # -loss if the loss is certain beside an offset; or -loss alone, if loss explains more than an offset does and is
    # the evidence; otherwise NaN
    share: Array
    # evidence last known: while an accusation can neither be confirmed nor dropped it stays, without evidence it is
    # zero
    size: Array
    larger: Array  # factor of the errors of f^ over those in the fitted flights
