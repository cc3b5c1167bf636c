"""What one flight says of wear: the mean of each actuator's estimate over the flight, and how well it is known.

A share of the command is estimated by least squares through the origin, f^ = s u + noise; of a surface, which is read
against its deflection, beside a constant offset. What is no share of a command is the mean of its estimate. Noise is
coloured: its variance counts as often as :func:`gains.identification.regression.coloured_inflation` says. What differs
from flight to flight (load, weather, temperature) is not in this uncertainty; whoever compares flights has to estimate
it from them.

Rows in which an alarm of another channel of the same observer was active count nothing: a fault shows in its
neighbours' estimates, too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gains.identification.regression import coloured_inflation
from monitor.alarms.alarm import CURRENT, LOG_TIMES, RESISTANCE
from monitor.display import share_unit
from monitor.event import AlarmEvent
from monitor.profile import FaultChannel, ObserverProfile, Profile
from monitor.trace import Trace, alarm_spans

_LEAST_S = 20.0
"""Evidence that is needed, seconds: as much as observers need to be fitted."""
_LEAST_COMMAND = 1e-6
"""Root mean square of a command, of full command 1, below which no share of it is known: nothing was commanded."""


class WornChannel(NamedTuple):
    """A channel that shows wear: the observer's name, its own, and the unit that people say for its levels."""

    observer: str
    channel: str
    unit: str


@dataclass(frozen=True, slots=True)
class WearLevel:
    """What a flight says of one channel."""

    of: WornChannel
    value: float  # in the channel's unit, zero as when the profile was fitted
    sd: float  # one standard deviation of it, from what varies within the flight alone
    limit: float  # the value at which the monitor raises an alarm; its sign is that of wear


def worn_channels(profile: Profile) -> list[WornChannel]:
    """Return the channels of a profile whose levels are compared from flight to flight."""
    return [
        WornChannel(observer.name, fault.name, _unit(fault))
        for observer in profile.observers
        for fault in observer.faults
        if wear_sign(fault)
    ]


def level_columns(of: WornChannel) -> tuple[str, str, str]:
    """Return the names of a channel's columns in a table of flights: value, standard deviation, limit."""
    name = f"{of.observer}/{of.channel}"
    return f"{name} ({of.unit})", f"{name} sd", f"{name} limit"


def flight_levels(profile: Profile, events: Sequence[AlarmEvent], traces: Sequence[Trace]) -> list[WearLevel]:
    """Return the level of each such channel that a replayed flight tells of, from its events and traces."""
    by_name = {trace.layout.observer: trace for trace in traces}
    levels = []
    for observer in profile.observers:
        trace = by_name.get(observer.name)
        if trace is not None:
            found = (_level(observer, fault, trace, events) for fault in observer.faults if wear_sign(fault))
            levels += [level for level in found if level is not None]
    return levels


def wear_sign(fault: FaultChannel) -> int:
    """Return the sign of wear in a channel's estimates; 0 where it shows none.

    Worn actuators deliver less, worn motors draw more current, worn bearings and propellers shake more, and the
    resistance of worn batteries is larger.
    """
    if fault.kind != "actuator":
        return 0
    if fault.unit in (LOG_TIMES, CURRENT, RESISTANCE):
        return 1
    return 0 if fault.input is None else -1


def _unit(fault: FaultChannel) -> str:
    return fault.unit if fault.input is None else share_unit(fault.unit)


def _level(
    observer: ObserverProfile, fault: FaultChannel, trace: Trace, events: Sequence[AlarmEvent]
) -> WearLevel | None:
    index = trace.layout.faults.index(fault.name)
    estimate = trace.fault[:, index]
    kept = trace.armed & np.isfinite(estimate)
    for span in alarm_spans(event for event in events if event.observer == observer.name):
        if span.channel != fault.name:
            end_ns = math.inf if span.end_vehicle_ns is None else span.end_vehicle_ns
            kept &= (trace.vehicle_ns < span.start_vehicle_ns) | (trace.vehicle_ns >= end_ns)
    kept_ns = trace.vehicle_ns[kept]
    rate_hz = 1e9 / float(np.median(np.diff(kept_ns))) if len(kept_ns) > 1 else 0.0
    threshold = next((rule.threshold for rule in observer.alarms if rule.channel == fault.name), 0.0)
    if not (rate_hz > 0.0 and len(kept_ns) >= _LEAST_S * rate_hz and threshold > 0.0):
        return None
    command = np.ones(len(kept_ns)) if fault.input is None else trace.u[kept, fault.input]
    usual = float(np.sqrt(np.mean(command**2)))
    if not usual > _LEAST_COMMAND:
        return None
    by_effect = observer.effectiveness.get(fault.name)
    value, sd = _share(estimate[kept], command, rate_hz, beside_offset=by_effect is not None)
    limit = threshold / usual if by_effect is None else by_effect.least_loss
    factor = 1.0 if fault.input is None else 100.0
    of = WornChannel(observer.name, fault.name, _unit(fault))
    return WearLevel(of, factor * value, factor * sd, wear_sign(fault) * factor * limit)


def _share(
    estimate: NDArray[np.float64], command: NDArray[np.float64], rate_hz: float, *, beside_offset: bool
) -> tuple[float, float]:
    """Return which share of its command an estimate is, and one standard deviation of that."""
    X = np.column_stack([command, np.ones(len(command))] if beside_offset else [command])
    coefficients, _, rank, _ = np.linalg.lstsq(X, estimate, rcond=None)
    rest = estimate - X @ coefficients
    if rank < X.shape[1]:
        return 0.0, math.inf
    # what counts as one sample is counted on what moves the share
    inflation = coloured_inflation([rest * X[:, 0]], rate_hz)
    variance = float(rest @ rest) / len(rest) * inflation
    return float(coefficients[0]), math.sqrt(variance * float(np.linalg.inv(X.T @ X)[0, 0]))
