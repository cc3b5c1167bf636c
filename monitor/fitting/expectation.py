"""Fit observers that compare measurements with the values that a transform expects: plant, design and alarms."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from adapters.errors import ModelError
from gains.plants.plant import Disturbance, Fault, FloatArray, Noise, Plant, on_each
from gains.synthesis.blocks import design_blocks
from gains.synthesis.certificate import certify
from gains.synthesis.compilation import compile_gains
from gains.synthesis.design import Design
from monitor.estimation.isolation_rule import IndependentRule
from monitor.fitting.fitted import Fitted, bare_rule
from monitor.fitting.flights import Flight, transformed
from monitor.fitting.thresholds import FALSE_ALARMS_PER_HOUR, Times, calibrated, healthy_evidence, healthy_levels
from monitor.sampling.gate import GateRule
from monitor.sampling.transform import SampleSource, TransformRule, make_transform

_LEAST_S = 20.0
"""Evidence that a fit needs, seconds, as for the motors observer."""


class Expectation(NamedTuple):
    """A measurement that is compared with its expected value."""

    measured: str  # its name among the outputs
    left: float  # its standard deviation from the expected value
    fault: str  # channel of the fault that it shows
    unit: str
    smallest: float  # smallest size that is worth an alarm
    critical: float
    rate: float  # rate at which the fault may grow, units per second
    input: str | None = None  # input that the fault is a share of; None: its size is absolute


def check_length(rows: int, rate_hz: float, what: str) -> None:
    """Raise ModelError if there is too little healthy flight with ``what`` to learn the expected values."""
    if rows < _LEAST_S * rate_hz:
        raise ModelError(f"only {rows / rate_hz:.0f} s of flight with {what}; {_LEAST_S:.0f} s are needed")


def fit_expectations(
    name: str,
    source: SampleSource,
    rate_hz: float,
    raw: Sequence[Flight],
    gate: GateRule,
    expectations: Sequence[Expectation],
    times: Times,
    *,
    B: FloatArray | None = None,
    alarms_per_hour: float | None = None,
    design: Callable[[Plant], Design] = design_blocks,
) -> Fitted:
    """Design the observer of a vehicle behind a transform on healthy flights of raw signals, and calibrate its alarms.

    It has the name of the transform's kind. Channels of one unit share a level: one may have shown in healthy flight
    what another has not. ``times`` is how long evidence has to last, ``B`` as in :func:`expectation_plant`.
    ``alarms_per_hour`` is the rate of false alarms of each channel; None: the channels share the observer's.

    Raises
    ------
    ModelError
        Too little of the flights is evidence.
    """
    rule = source.transform or TransformRule("", rate_hz)
    flights = [transformed(flight, make_transform(rule, rate_hz)) for flight in raw]
    plant = expectation_plant(name, rate_hz, make_transform(rule, rate_hz).inputs, expectations, B)
    designed = design(plant)
    gains = compile_gains(plant, designed, certify(plant, designed))
    flight_s = sum(len(flight.evidence) for flight in flights) / rate_hz
    fitted = Fitted(rule.kind, (gains,), source, IndependentRule(1.0 / rate_hz), plant=plant, flight_s=flight_s)
    evidence = healthy_evidence(fitted.profile(), gate, flights)
    check_length(sum(map(len, evidence)), rate_hz, f"evidence for {', '.join(one.fault for one in expectations)}")
    share = alarms_per_hour or FALSE_ALARMS_PER_HOUR / len(expectations)
    alarms = []
    for unit in dict.fromkeys(one.unit for one in expectations):
        alike = [(gains.faults.index(one.fault), one) for one in expectations if one.unit == unit]
        levels = healthy_levels([run[:, at] for at, _ in alike for run in evidence], rate_hz, share, times)
        for _, one in alike:
            bare = bare_rule(rule.kind, one.fault, "actuator", unit)
            alarms.append(calibrated(bare, levels, 1.0, floor=one.smallest, critical=one.critical, times=times))
    return replace(fitted, alarms=tuple(alarms))


def expectation_plant(
    name: str,
    rate_hz: float,
    inputs: Sequence[str],
    expectations: Sequence[Expectation],
    B: FloatArray | None = None,
) -> Plant:
    """Return the plant behind a transform: a state is the value expected at a tick, an output the measured one.

    It has no dynamics, and every fault shows in a measurement of its own, so that all are estimated at once. Each input
    is the expected value of one measurement, unless ``B`` (n, s) is given.
    """
    identity = np.eye(len(expectations))
    measured, left = tuple(one.measured for one in expectations), np.array([one.left for one in expectations])
    return Plant(
        name=name,
        domain="discrete",
        rate_hz=rate_hz,
        states=tuple(f"expected_{name}" for name in measured),
        inputs=tuple(inputs),
        outputs=measured,
        A=0.0 * identity,
        B=identity if B is None else B,
        C=identity,
        faults=tuple(
            Fault(one.fault, "actuator", column, one.rate, one.smallest, one.unit, input=one.input)
            for one, column in zip(expectations, identity, strict=True)
        ),
        disturbances=on_each(Disturbance, measured, left),
        noises=on_each(Noise, measured, left),
        state_errors=left,
    )
