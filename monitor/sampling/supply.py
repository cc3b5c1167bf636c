"""The battery's voltage, with which motors act on their commands: u (1 + share v), v its deviation from the usual one.

What is reported of batteries comes seldom and without a time. So it is no channel, for which samples would wait: each
sample takes what came last before it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch
from adapters.toml_tables import Table

BATTERY_MESSAGE = "SYS_STATUS"
"""Voltage, current and charge of the first battery."""
CELLS_MESSAGE = "BATTERY_STATUS"
"""The same of each battery, with the voltage of each cell, or of all together in place of the first."""
_FIELD = "voltage_battery"
_VOLTS = 0.001
"""MAVLink gives millivolts."""
_FURTHEST = 0.5
"""Share of the usual voltage beyond which a number is none: chosen, lithium cells go from 4.2 to 3 V, and what is not
known is sent as 65.5 V."""


@dataclass(frozen=True, slots=True)
class SupplyRule:
    """How commands act with the battery's voltage."""

    volts: float  # usual voltage
    share: float  # how many per cent a command loses by a voltage that is lower by one


class Supply:
    """What commands are multiplied by; one, before a voltage is known."""

    def __init__(self, rule: SupplyRule) -> None:
        self._rule = rule
        self._last = 1.0

    def factors(self, batch: Batch, position: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the factor of each sample (n,), by the positions in the batch of the messages that completed them."""
        places, values = [np.empty(0, np.int64)], [np.empty(0)]
        for columns in batch.columns:
            column = columns.fields.get(_FIELD) if columns.name == BATTERY_MESSAGE else None
            if column is not None and column.dtype.kind in "iuf" and column.ndim == 1:
                places.append(columns.position)
                values.append(_VOLTS * column.astype(np.float64))
        for at, message in batch.others.items():
            if message.name == BATTERY_MESSAGE and type(value := message.fields.get(_FIELD)) in (int, float):
                places.append(np.array([at]))
                values.append(np.array([_VOLTS * float(value or 0.0)]))
        place, volts = np.concatenate(places), np.concatenate(values)
        deviation = volts / self._rule.volts - 1.0
        order = np.argsort(place, kind="stable")
        order = order[np.abs(deviation[order]) <= _FURTHEST]
        known = np.append(self._last, 1.0 + self._rule.share * deviation[order])
        self._last = float(known[-1])
        return np.asarray(known[np.searchsorted(place[order], position, side="right")])


def read_supply(table: Table) -> SupplyRule:
    """Return the rule of a profile's table, its fields by name; mistakes are recorded in its file."""
    rule = SupplyRule(table.number("volts", above=0.0), table.number("share", above=0.0, at_most=2.0))
    table.done()
    return rule
