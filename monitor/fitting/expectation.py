"""Observers that compare measurements with what is expected of them: their plant, bare profile and alarms."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from adapters.errors import ModelError
from gains.plants.plant import Disturbance, Fault, FloatArray, Noise, Plant
from gains.synthesis.certificate import certify
from gains.synthesis.compilation import compile_gains
from gains.synthesis.design import Design
from monitor.estimation.isolation_rule import IndependentRule
from monitor.fitting.fitted import Fitted, bare_rule
from monitor.fitting.flights import Flight
from monitor.fitting.thresholds import FALSE_ALARMS_PER_HOUR, Calibrated, Times, calibrated, healthy_levels
from monitor.sampling.transform import SampleSource

_LEAST_S = 20.0
"""Evidence that is needed, seconds, as of the motors observer."""


class Expectation(NamedTuple):
    """A measurement that is compared with what is expected of it."""

    measured: str  # its name among the outputs
    left: float  # its standard deviation from what is expected
    fault: str  # channel of the fault that it shows
    unit: str
    error: float  # smallest size that matters
    rate: float  # units per second by which the fault may grow
    input: str | None = None  # input that the fault is a share of; None: it has a size of its own


def check_length(rows: int, rate_hz: float, what: str) -> None:
    """Raise ModelError where there is too little healthy flight with ``what`` to learn what is expected."""
    if rows < _LEAST_S * rate_hz:
        raise ModelError(f"only {rows / rate_hz:.0f} s of flight with {what}; {_LEAST_S:.0f} s are needed")


def expectation_plant(
    name: str,
    rate_hz: float,
    inputs: Sequence[str],
    expectations: Sequence[Expectation],
    B: FloatArray | None = None,
) -> Plant:
    """Return the plant behind a transform: a state is what a tick lets expect, an output what it measured.

    It has no dynamics, and every fault shows in a measurement of its own, so that all are estimated at once. Each input
    is what is expected of one measurement where ``B`` (n, s) says nothing else.
    """
    identity = np.eye(len(expectations))
    columns = list(zip(expectations, identity, strict=True))
    return Plant(
        name=name,
        domain="discrete",
        rate_hz=rate_hz,
        states=tuple(f"expected_{one.measured}" for one in expectations),
        inputs=tuple(inputs),
        outputs=tuple(one.measured for one in expectations),
        A=0.0 * identity,
        B=identity if B is None else B,
        C=identity,
        faults=tuple(
            Fault(one.fault, "actuator", column, one.rate, one.error, one.unit, input=one.input)
            for one, column in columns
        ),
        disturbances=tuple(Disturbance(f"disturbance_{one.measured}", column, one.left) for one, column in columns),
        noises=tuple(Noise(f"noise_{one.measured}", column, one.left) for one, column in columns),
        state_errors=np.array([one.left for one in expectations]),
    )


def bare_observer(
    observer: str, plant: Plant, design: Design, source: SampleSource, flights: Sequence[Flight]
) -> Fitted:
    """Return an observer of such a plant that has no alarms yet, and its samples in healthy flights."""
    gains = compile_gains(plant, design, certify(plant, design))
    flight_s = sum(len(flight.evidence) for flight in flights) / gains.rate_hz
    isolation = IndependentRule(1.0 / gains.rate_hz)
    return Fitted(observer, (gains,), source, isolation, plant=plant, flight_s=flight_s)


def pooled_alarms(
    bare: Fitted,
    evidence: Sequence[FloatArray],
    channels: Sequence[str],
    smallest: float,
    critical: float,
    times: Times,
    alarms_per_hour: float = FALSE_ALARMS_PER_HOUR,
) -> list[Calibrated]:
    """Return the alarms of some channels, all at one level: what one has not seen in healthy flight another has.

    ``evidence`` is that of all channels in healthy flight, ``smallest`` and ``critical`` the sizes that are worth an
    alarm and critical.
    """
    rate_hz, units = bare.gains[0].rate_hz, dict(zip(bare.gains[0].faults, bare.gains[0].fault_units, strict=True))
    places = [bare.gains[0].faults.index(name) for name in channels]
    levels = healthy_levels([run[:, at] for at in places for run in evidence], rate_hz, alarms_per_hour, times)
    rules = [bare_rule(bare.name, name, "actuator", units[name]) for name in channels]
    return [calibrated(rule, levels, 1.0, floor=smallest, critical=critical, times=times) for rule in rules]
