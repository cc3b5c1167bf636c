"""The level of wear in one flight: the mean of each actuator's estimate over the flight, and its uncertainty.

A share of the command is estimated by least squares through the origin, f^ = s u + noise; for a surface, whose effect
is judged against its deflection, together with a constant offset. The level of a channel without a command is the mean
of its estimate. Noise is coloured: its variance is multiplied by the factor of
:func:`gains.identification.regression.coloured_inflation`. The differences from flight to flight (load, weather,
temperature) are not in this uncertainty; a comparison of flights has to estimate them.

Rows in which an alarm of another channel of the same observer was active are left out: a fault shows in its neighbours'
estimates, too.
"""

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
"""Shortest evidence, seconds: as much as observers need to be fitted."""
_LEAST_COMMAND = 1e-6
"""Smallest root mean square of a command, relative to full command, for which a share is estimated: below it nothing
was commanded."""


class WornChannel(NamedTuple):
    """A channel that shows wear: its observer, its name, and the unit of its levels for people."""

    observer: str
    channel: str
    unit: str


@dataclass(frozen=True, slots=True)
class WearLevel:
    """The level of one channel in one flight."""

    of: WornChannel
    value: float  # in the channel's unit; zero: as in the fitted flights
    sd: float  # standard deviation of the value, from the variation within the flight alone
    limit: float  # the value at which the monitor raises an alarm; it has the sign of wear


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
    """Return the level of each channel that shows wear, if a replayed flight's events and traces allow an estimate."""
    by_name = {trace.layout.observer: trace for trace in traces}
    levels = []
    for observer in profile.observers:
        trace = by_name.get(observer.name)
        if trace is not None:
            found = (_level(observer, fault, trace, events) for fault in observer.faults if wear_sign(fault))
            levels += [level for level in found if level is not None]
    return levels


def wear_sign(fault: FaultChannel) -> int:
    """Return the sign of wear in a channel's estimates; 0 if the channel does not show wear.

    Worn actuators deliver less, worn motors draw more current, worn bearings and propellers vibrate more, and worn
    batteries have a larger resistance.
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
    """Return the estimate as a share of its command, and the standard deviation of that share."""
    X = np.column_stack([command, np.ones(len(command))] if beside_offset else [command])
    coefficients, _, rank, _ = np.linalg.lstsq(X, estimate, rcond=None)
    rest = estimate - X @ coefficients
    if rank < X.shape[1]:
        return 0.0, math.inf
    # the correlation of the noise is measured on the terms that determine the share
    inflation = coloured_inflation([rest * X[:, 0]], rate_hz)
    variance = float(rest @ rest) / len(rest) * inflation
    return float(coefficients[0]), math.sqrt(variance * float(np.linalg.inv(X.T @ X)[0, 0]))
