"""The battery's voltage fell below that of an empty battery."""

from collections.abc import Iterator

import numpy as np

from replay.review.facts.log_facts import LogFacts, LogSignal
from replay.review.findings.loss_of_control import in_control, spans_in_control
from replay.review.findings.rule import Judgement, Rule

_CELL_V = 3.3
"""Smallest voltage of a lithium polymer cell under load: below it the voltage collapses (PX4's docs: empty at 3.5 under
load, damage below 3.3)."""
_FULL_CELL_V = 4.2
"""Voltage of a full cell, from which the number of cells is guessed if no parameter gives it; then the finding is
information only."""
_LEAST_CELL_V = 3.0
"""Highest voltage of a flight below which a number of cells is wrong, volts for each: so empty before the motors turn,
no battery of lithium delivers a flight's current."""
_LEAST_S = 3.0
"""Shortest time below that voltage, seconds. Chosen: longer than a full command of the motors, during which the voltage
drops and recovers."""
_CELLS, _EMPTY = ("BAT1_N_CELLS", "BAT_N_CELLS"), ("BAT1_V_EMPTY", "BAT_V_EMPTY")


def _judge(facts: LogFacts, battery: LogSignal) -> Iterator[Judgement]:
    volts = battery.only
    if not (in_control(facts, battery.time_s) & np.isfinite(volts)).any():
        return
    said = next((facts.parameters[name] for name in _CELLS if facts.parameters.get(name, 0) > 0), 0.0)
    if np.nanmax(volts) < _LEAST_CELL_V * said:
        said = 0.0
    cells = int(said) or max(1, round(float(np.nanmax(volts)) / _FULL_CELL_V))
    source = "as its parameters say" if said else "from the highest voltage"
    # cells of lithium ion may be discharged further, if their owner sets that parameter
    limit = min([_CELL_V, *(facts.parameters[name] for name in _EMPTY if facts.parameters.get(name, 0.0) > 1.0)])
    for start, end in spans_in_control(facts, battery, volts < limit * cells, _LEAST_S)[:1]:
        least = float(battery.during(start, end).only.min())
        yield Judgement(
            span=(start, end),
            text=f"the battery was down to {least:.1f} V, {least / cells:.2f} V for each of {cells} cells",
            evidence=(
                f"{battery.origin}: below {limit * cells:.1f} V from {start:.1f} to {end:.1f} s",
                f"{cells} cells, {source}",
            ),
            confidence="likely" if said else "possible",
            weight="warning" if said else "information",
        )


RULE = Rule(
    title="Battery empty",
    stage="supply",
    physics="Below 3.3 V a cell's voltage collapses under load: motors deliver less than commanded, and at last "
    "the autopilot loses power.",
    evidence="less than 3.3 V for each cell, or less than the parameters call empty, if lower, over 3 s of flight",
    counter=(
        "the log reports a connected battery and a voltage above zero",
        "a dip under full command passes within seconds",
        "if the number of cells is a guess, or the highest voltage contradicts it, this is information only",
    ),
    needs=("battery",),
    plots=("battery", "motors"),
    judge=_judge,
)
