"""The panels of a run's fault channels: which channels get one of their own, which share one, and their axes."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from monitor.core.lagged import exponential_mean
from monitor.display import display_unit
from monitor.estimate import Layout
from monitor.estimation.input_curve import LEAST_COMMAND
from monitor.estimation.isolation_rule import keep_share
from monitor.event import AlarmEvent
from monitor.trace import Trace
from monitor.views.way import Way

Thresholds = Mapping[tuple[str, str], float]
TrueSizes = Mapping[str, tuple[NDArray[np.float64], NDArray[np.float64]]]


class RunView(NamedTuple):
    """A run to be shown."""

    traces: Sequence[Trace]  # one per observer
    events: Sequence[AlarmEvent]
    thresholds: Thresholds  # of alarms, by observer and fault channel
    truth: TrueSizes = MappingProxyType({})  # by fault channel: times on the vehicle's clock (s), true size at them
    # channels, by observer and name, whose evidence is not the estimate that their standard deviation is about
    without_sd: Collection[tuple[str, str]] = ()
    way: Way | None = None  # the vehicle's way, if known


def in_display_units(run: RunView) -> RunView:
    """Return a run with the sizes of its faults in the units shown to people: per cent, degrees.

    The loss of a motor is at each sample a share of its command then, as in the sentence of its alarm; its threshold is
    a share of its usual command.
    """
    thresholds, truth, traces = dict(run.thresholds), dict(run.truth), []
    for trace in run.traces:
        layout = trace.layout
        usual = layout.usual_commands or (None,) * len(layout.faults)
        units, scale = [], np.empty((len(trace.vehicle_ns), len(layout.faults)))
        for at, (name, unit, command) in enumerate(zip(layout.faults, layout.fault_units, usual, strict=True)):
            factor, said = display_unit(unit, command)
            units.append(said)
            scale[:, at] = factor
            if command is not None and name in layout.inputs and len(scale):
                u = trace.u[:, layout.inputs.index(name)]
                u = _smoothed(trace, np.where(np.isfinite(u), u, command))
                scale[:, at] = 100.0 / np.maximum(u, LEAST_COMMAND)
            if (key := (layout.observer, name)) in thresholds:
                thresholds[key] *= factor
            if name in truth and truth[name] is run.truth[name] and len(scale):
                times, sizes = truth[name]
                truth[name] = times, sizes * np.interp(times, trace.vehicle_ns / 1e9, scale[:, at])
        sizes_said = {name: getattr(trace, name) * scale for name in ("fault", "isolated", "sd")}
        traces.append(replace(trace, layout=replace(layout, fault_units=tuple(units)), **sizes_said))
    return run._replace(traces=traces, thresholds=thresholds, truth=truth)


def _smoothed(trace: Trace, u: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a signal smoothed like the estimates (N,)."""
    rate_hz = 1e9 / float(np.median(np.diff(trace.vehicle_ns))) if len(u) > 1 else trace.layout.rate_hz
    keep = keep_share(trace.layout.smoothing_s, rate_hz)
    return np.asarray(u[0] + exponential_mean((u - u[0])[:, None], keep)[:, 0])


FEW = 6
"""Number of channels up to which each gets a panel. Chosen: six panels still fit a page."""
OUTLIERS_PERCENT = 0.02
"""Share of values beyond an axis, percent, at either end. Chosen: one sample of a minute at 100 Hz, so that a single
spike does not flatten a panel."""
AXIS_MARGIN = 0.06
"""Share of an axis's range left free at either end, so that lines do not touch the frame; a matter of looks."""


@dataclass(frozen=True, slots=True)
class Panels:
    """Panels of one observer's fault channels."""

    alone: tuple[int, ...]  # indices of the channels that get a panel each
    # indices of the quiet channels that share one panel, each in units of its own alarm threshold
    together: tuple[int, ...]


def choose_panels(
    layouts: Sequence[Layout], alarmed: Collection[tuple[str, str]], known: Collection[str], thresholds: Thresholds
) -> tuple[Panels, ...]:
    """Return each observer's panels.

    Up to :data:`FEW` channels in all get a panel each. If there are more, a channel gets one only if it had an alarm,
    its true size is known, or it has no threshold to be measured in. ``alarmed`` and ``thresholds`` are by observer and
    channel.
    """
    few = sum(len(layout.faults) for layout in layouts) <= FEW
    chosen = []
    for layout in layouts:
        alone = [
            few or channel in known or key in alarmed or not thresholds.get(key)
            for channel, key in ((channel, (layout.observer, channel)) for channel in layout.faults)
        ]
        chosen.append(Panels(_places(alone), _places([not is_alone for is_alone in alone])))
    return tuple(chosen)


def same_scale(layout: Layout, panels: Panels, place: int) -> tuple[int, ...]:
    """Return the indices of the channels that share a channel's vertical scale.

    If every channel has its own panel, channels of one unit share a scale, so that they can be compared. A channel that
    has a panel because of its alarm has its own scale.
    """
    if panels.together:
        return (place,)
    return tuple(other for other in panels.alone if layout.fault_units[other] == layout.fault_units[place])


def fault_limits(trace: Trace, places: Iterable[int], thresholds: Thresholds, truth: TrueSizes) -> tuple[float, float]:
    """Return the ends of a vertical axis that shows channels' estimates, thresholds and truth, around zero.

    Only estimates from which alarms could be raised count, without single outliers.
    """
    ends = [0.0]
    for place in places:
        channel = trace.layout.faults[place]
        threshold = thresholds.get((trace.layout.observer, channel), 0.0)
        ends += [-threshold, threshold, *_range(evidence(trace, trace.isolated[:, place]))]
        if channel in truth:
            ends += _range(truth[channel][1])
    return _padded(ends)


def evidence(trace: Trace, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the finite values at samples from which alarms could be raised; if there are none, at all samples."""
    used = values[trace.armed] if trace.armed.any() else values
    return used[np.isfinite(used)]


def _places(chosen: Sequence[bool]) -> tuple[int, ...]:
    return tuple(place for place, is_chosen in enumerate(chosen) if is_chosen)


def _range(values: NDArray[np.float64]) -> list[float]:
    values = values[np.isfinite(values)]
    if not len(values):
        return []
    low, high = np.percentile(values, (OUTLIERS_PERCENT, 100.0 - OUTLIERS_PERCENT))
    return [float(low), float(high)]


def _padded(ends: Sequence[float]) -> tuple[float, float]:
    low, high = min(ends), max(ends)
    margin = AXIS_MARGIN * (high - low) or 0.05
    return low - margin, high + margin
