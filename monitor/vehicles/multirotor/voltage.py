"""How much a sagging battery reduces the effect of a command: flights show it by more command for the same thrust.

A controller without a governor applies u V, and the mean thrust of a flying vehicle is constant: ln u falls by
``share`` per cent where the voltage V rises by one. Climbs and braking change both at once, as the current pulls the
voltage down. So the slope is taken over the time in the air, in which a battery only empties (instrumental variables;
Wooldridge, Econometric Analysis, 5.1):

    share = -cov(t, ln u) / cov(t, ln V),     within flights.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from adapters.channels import Channel
from monitor.fitting.fitted import FitRequest
from monitor.fitting.flights import raw_flights
from monitor.sampling.gate import GateRule
from monitor.sampling.supply import BATTERY_MESSAGE, SupplyRule

_GRID_HZ, _BLOCK = 1.0, 10
"""Length of the means, in samples of the grid of 1 Hz: ten seconds are longer than manoeuvres and gusts."""
_SURE = 5.0
"""Standard errors from which a share is determined. Chosen: modes and wind change thrust in minutes, too, and errors of
blocks are not quite independent."""
_LEAST, _MOST = 0.5, 1.5
"""Range of shares that are believed. The share is one without a governor, and zero with one; a share far from both has
another cause."""
_ALIKE = 3.0
"""Standard errors within which a share counts as one."""
_LEAST_RANGE = 0.02
"""Least relative range of voltages. Chosen: a smaller range changes no size of a fault by more than flights scatter."""


def fit_supply(request: FitRequest, gate: GateRule, commands: Sequence[Channel]) -> SupplyRule | None:
    """Return how commands act with the battery's voltage; None if the flights do not determine it."""
    if not all(survey.rate_hz.get(BATTERY_MESSAGE, 0.0) > 0.0 for survey in request.surveys):
        return None
    volts = Channel("volts", BATTERY_MESSAGE, ("voltage_battery",), scale=0.001, interpolation="previous")
    channels = (*(replace(channel, interpolation="mean") for channel in commands), volts)
    blocks = []
    for flight in raw_flights(request.logs, channels, _GRID_HZ, gate):
        kept = flight.samples.u[flight.armed & (flight.samples.u > 0.0).all(axis=1)]
        of_flight = len(kept) // _BLOCK
        if of_flight < 2:
            continue
        mean = kept[: of_flight * _BLOCK].reshape(of_flight, _BLOCK, -1).mean(axis=1)
        block = np.column_stack([np.arange(of_flight), np.log(mean[:, :-1].mean(axis=1)), np.log(mean[:, -1])])
        blocks.append(np.column_stack([block - block.mean(axis=0), mean[:, -1]]))
    if not blocks:
        return None
    time, command, voltage, level = np.concatenate(blocks).T
    free = len(time) - len(blocks) - 1
    joint = float(time @ voltage)
    if free < 1 or np.ptp(level) < _LEAST_RANGE * level.mean() or not joint < 0.0:
        return None
    share = -float(time @ command) / joint
    left = float(np.sum((command + share * voltage) ** 2)) / free
    error = (left * float(time @ time)) ** 0.5 / -joint
    if not (_LEAST <= share <= _MOST and share > _SURE * error):
        return None
    if abs(share - 1.0) < _ALIKE * error:
        share = 1.0  # the share without a governor, which flights determine less accurately
    return SupplyRule(float(f"{level.mean():.4g}"), float(f"{share:.3g}"))
