"""Measure the real uncertainty of fault estimates in healthy flight, where all faults are zero."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gains.plants.plant import Plant
from monitor.fitting.flights import Flight
from monitor.fitting.thresholds import healthy_runs
from monitor.profile import ObserverProfile
from monitor.sampling.gate import GateRule

_WITHIN_TWO = 0.9545
"""Share of a normal distribution within two standard deviations."""


def fit_spread(observer: ObserverProfile, plant: Plant, gate: GateRule, flights: Sequence[Flight]) -> dict[str, float]:
    """Return how many times the standard deviation of the design each fault's estimate has in healthy flight.

    The estimate is within twice that deviation 95 % of the time. A channel without any error in these flights, as one
    that only a judgement fills, is left out, and so is a channel without a standard deviation from the design.
    """
    errors = []
    for run, stretches in healthy_runs(replace(observer, model=plant), gate, flights):
        with np.errstate(all="ignore"):
            off = np.abs(run.estimates.fault / run.estimates.sd)
        errors += [off[rows] for rows in stretches]
    if not errors:
        return {}
    joined = np.concatenate(errors)
    found = {}
    for fault, off in zip(observer.faults, joined.T, strict=True):
        known = off[np.isfinite(off)]
        size = float(np.quantile(known, _WITHIN_TWO)) / 2.0 if len(known) else 0.0
        if size > 0.0:
            found[fault.name] = float(f"{size:.3g}")
    return found
