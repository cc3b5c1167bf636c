"""The battery's voltage, with which motors respond to commands: u (1 + share v), v its relative deviation from usual.

Reports about batteries come seldom and without a time of measurement. The voltage is therefore no channel, for which
samples would wait: each sample takes the last report before it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch
from adapters.toml_tables import Table

BATTERY_MESSAGE = "SYS_STATUS"
"""Message with voltage, current and charge of the first battery."""
CELLS_MESSAGE = "BATTERY_STATUS"
"""Message with the same of each battery, and the voltage of each cell, or of all together in place of the first."""
_FIELD = "voltage_battery"
_VOLTS = 0.001
"""MAVLink gives millivolts."""
_FURTHEST = 0.5
"""Share of the usual voltage beyond which a number is no voltage. Chosen: lithium cells go from 4.2 to 3 V, and an
unknown voltage is sent as 65.5 V."""


@dataclass(frozen=True, slots=True)
class SupplyRule:
    """How commands depend on the battery's voltage."""

    volts: float  # usual voltage
    share: float  # by how many per cent a command weakens if the voltage is one per cent lower


class Supply:
    """The factor by which commands are multiplied; one until a voltage is known."""

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
