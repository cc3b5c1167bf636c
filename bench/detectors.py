"""The detectors that are compared: a fitted profile, Kalman filters with the same models, windowed residual energy.

All take the same samples through the same gate and are calibrated on the same healthy flights by the same rule
(:mod:`monitor.fitting.thresholds`: extreme values at the same number of false alarms per hour and observer, same
debounce).

Kalman filter: states augmented by random-walk faults at the rates of the model. One filter for as many faults of the
profile as can be estimated together, taken in the order of its hypotheses (all four motors of a quadcopter; some motors
of a hexacopter); every channel answers for itself.

Kalman bank: one such filter for each hypothesis of the profile, and the profile's own way to choose among hypotheses:
what is left of the difference is the gains. Only where the profile runs a bank; elsewhere it is the filter above.

Faults that a bank only watches for jumps are left out of both: a sensor bias that may walk explains any motor fault.

Residual energy, in the manner of control invariants: r = y - y^ of one-step prediction (the innovation of the Kalman
filter of the model without faults), the mean of r' S^-1 r over a window, S its healthy covariance. It names nothing.

GLR bank and CUSUM bank, as textbooks have them: the same r, whitened by S alone, z. The response of z to a fault that
begins as a unit step is its signature s. The GLR is the largest (sum s'z)^2 / (2 sum s's) over windows of 1 to
``GLR_ROWS`` samples, the CUSUM sums 1/2 above noise along the mean direction of s, of either sign. The channel with the
largest statistic answers, as soon as it exceeds its level.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adapters.errors import InfeasibleError
from adapters.logs.recordings import packed
from adapters.message import Message
from adapters.sample import Given
from gains.analysis.estimability import problem_of, restricted
from gains.plants.model_file import read_model
from gains.plants.plant import Plant
from gains.published.kalman import design_ekf, filter_model
from gains.synthesis.gains_file import Gains
from monitor.alarms.alarm import Alarm, AlarmRule
from monitor.alarms.excuse import Excuses
from monitor.chain import ObserverChain, alarm_events
from monitor.core.alarms import ChainRows, walk
from monitor.core.sampling import VehicleClock
from monitor.estimation.affine import AffineObserver
from monitor.estimation.isolation_rule import BankRule, IndependentRule
from monitor.event import AlarmEvent
from monitor.fitting.calibrate import bank_rule
from monitor.fitting.extremes import return_level, standing
from monitor.fitting.flights import Flight, flight_samples
from monitor.fitting.thresholds import FALSE_ALARMS_PER_HOUR, Times, calibrated, healthy_evidence, healthy_levels
from monitor.profile import ObserverProfile, Profile, fault_channels, read_profile
from monitor.sampling.gate import GateRule
from monitor.trace import Trace, TraceBuilder
from replay.player import interests, play

FAUIO, KALMAN, KALMAN_BANK, ENERGY = "fauio", "Kalman filter", "Kalman bank", "residual energy"
GLR, CUSUM = "GLR bank", "CUSUM bank"
DETECTORS = (FAUIO, KALMAN, KALMAN_BANK, GLR, CUSUM, ENERGY)
WINDOW_S = 0.5
GLR_ROWS = 256
FACTORS = (2.0, 4.0, 8.0, 16.0, 32.0, 64.0)
"""Sizes by which baselines are asked for more, to have no more false alarms than fauio."""


@dataclass(frozen=True, slots=True, eq=False)
class EnergyDetector:
    """Windowed energy of one observer's one-step prediction residual.

    Parameters
    ----------
    observer : str
        Whose model and samples it takes.
    gains : Gains
        Kalman filter of the model without faults.
    W : NDArray[np.float64]
        W' W = S^-1 / p (p, p).
    rule : AlarmRule
        Its alarm.
    """

    observer: str
    gains: Gains
    W: NDArray[np.float64]
    rule: AlarmRule


@dataclass(frozen=True, slots=True, eq=False)
class TextbookBank:
    """A statistic for each fault, of the white part of one observer's one-step prediction residual.

    Parameters
    ----------
    name, observer : str
        Which of both it is, and whose model and samples it takes.
    gains : Gains
        Kalman filter of the model without faults.
    W : NDArray[np.float64]
        W' W = S^-1 (p, p).
    signatures : NDArray[np.float64]
        What a step of each fault makes of W r (m, rows, p).
    rules : tuple[AlarmRule, ...]
        Their alarms.
    """

    name: str
    observer: str
    gains: Gains
    W: NDArray[np.float64]
    signatures: NDArray[np.float64]
    rules: tuple[AlarmRule, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Suite:
    """Detectors fitted and calibrated on the same healthy flights.

    Parameters
    ----------
    profile : Profile
        What ``fauio fit`` wrote.
    kalman, kalman_bank : tuple[ObserverProfile, ...]
        Kalman filters in place of its observers.
    energy : tuple[EnergyDetector, ...]
        One for each observer.
    banks : tuple[TextbookBank, ...]
        Two for each observer.
    notes : tuple[str, ...]
        Baselines that could not be made, and why.
    """

    profile: Profile
    kalman: tuple[ObserverProfile, ...]
    kalman_bank: tuple[ObserverProfile, ...]
    energy: tuple[EnergyDetector, ...]
    banks: tuple[TextbookBank, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """What a detector gave on a flight: events, and estimates where it has any.

    ``rarer`` are the events with all its sizes so many times as large, by :data:`FACTORS`.
    """

    events: tuple[AlarmEvent, ...]
    traces: tuple[Trace, ...]
    rarer: tuple[tuple[AlarmEvent, ...], ...] = ()


Log = Callable[[frozenset[str]], Iterable[Message]]


def make_suite(folder: Path, logs: Sequence[Log]) -> Suite:
    """Return a profile's detectors, the baselines calibrated on the healthy logs it was fitted on."""
    profile = read_profile(folder)
    only = interests(profile)
    filters: list[tuple[ObserverProfile, list[Flight]]] = []
    banks: list[tuple[ObserverProfile, list[Flight]]] = []
    energy, notes, textbook = [], [], []
    for observer in profile.observers:
        gate = replace(profile.gate, settle_s=max(profile.gate.settle_s, observer.settle_s))
        flights = [flight_samples(packed(log(only)), observer.source, observer.rate_hz, gate) for log in logs]
        plant = read_model(folder / f"{observer.name}.model.toml")
        try:
            filters.append((_one_filter(observer, plant), flights))
            banks.append((_filter_bank(observer, plant, flights) or filters[-1][0], flights))
        except InfeasibleError as error:
            notes.append(f"{KALMAN}: {error}")
        try:
            energy.append(_energy(observer, plant, flights, FALSE_ALARMS_PER_HOUR / len(profile.observers)))
            for name in (GLR, CUSUM):
                textbook.append(_textbook(name, observer, plant, flights, FALSE_ALARMS_PER_HOUR))
        except InfeasibleError as error:
            notes.append(f"{ENERGY}: {error}")
    return Suite(
        profile,
        _with_alarms(filters, profile),
        _with_alarms(banks, profile),
        tuple(energy),
        tuple(textbook),
        tuple(notes),
    )


def run_suite(suite: Suite, messages: Iterable[Message]) -> dict[str, Run]:
    """Return what each detector gives on a flight; the baselines take the samples that the profile's observers took."""
    held = list(messages)
    found = play(suite.profile, held, keep_traces=True)
    samples = {}
    for observer in suite.profile.observers:
        gate = replace(suite.profile.gate, settle_s=max(suite.profile.gate.settle_s, observer.settle_s))
        samples[observer.name] = flight_samples(packed(held), observer.source, observer.rate_hz, gate)
    return {
        FAUIO: Run(found.events, found.traces),
        KALMAN: _run_chains(suite.kalman, suite.profile.gate, samples),
        KALMAN_BANK: _run_chains(suite.kalman_bank, suite.profile.gate, samples),
        **{
            name: _together([_run_textbook(one, samples[one.observer]) for one in suite.banks if one.name == name])
            for name in (GLR, CUSUM)
        },
        ENERGY: _together([_run_energy(one, samples[one.observer]) for one in suite.energy]),
    }


def _together(runs: Sequence[Sequence[tuple[AlarmEvent, ...]]]) -> Run:
    """Return the runs of a detector's parts as one; each has its events at all factors, as they are first."""
    events, *rarer = (tuple(event for part in at for event in part) for at in zip(*runs, strict=True))
    return Run(events, (), tuple(rarer))


def asking_for_more(rule: AlarmRule, factor: float) -> AlarmRule:
    """Return a rule with so many times its sizes."""
    sizes = {key: factor * getattr(rule, key) for key in ("threshold", "clear", "critical", "fast", "slow")}
    return replace(rule, **sizes)


def _compared(observer: ObserverProfile) -> list[Gains]:
    """Return an observer's gains, of a bank those that it compares."""
    rule = observer.isolation
    if not isinstance(rule, BankRule):
        return list(observer.gains)
    return [one for one, edge in zip(observer.gains, rule.edges, strict=True) if not edge]


def _one_filter(observer: ObserverProfile, plant: Plant) -> ObserverProfile:
    """Return an observer with one Kalman filter in place of its gains, and without alarms."""
    together: tuple[str, ...] = ()
    for name in dict.fromkeys(name for one in _compared(observer) for name in one.faults):
        if problem_of(plant, (*together, name)) is None:
            together = (*together, name)
    gains = (design_ekf(restricted(plant, together), observer.rate_hz),)
    isolation = IndependentRule(observer.isolation.smoothing_s)
    return _with_filters(observer, gains, isolation)


def _with_filters(
    observer: ObserverProfile, gains: tuple[Gains, ...], isolation: BankRule | IndependentRule
) -> ObserverProfile:
    """Return an observer with Kalman filters in place of its gains, and none of what was fitted to those."""
    return replace(
        observer,
        gains=gains,
        faults=fault_channels(gains),
        isolation=isolation,
        alarms=(),
        effectiveness={},
        changes=None,
        excitation=None,
    )


def _filter_bank(observer: ObserverProfile, plant: Plant, flights: Sequence[Flight]) -> ObserverProfile | None:
    """Return an observer with a Kalman filter for each hypothesis, without alarms; None where it is no bank."""
    compared = _compared(observer)
    if len(compared) < 2:
        return None
    gains = tuple(design_ekf(restricted(plant, one.faults), observer.rate_hz) for one in compared)
    isolation = bank_rule(gains, [segment for flight in flights for segment in flight.segments()])
    return _with_filters(observer, gains, isolation)


_UNMOVED = 1e-6
"""Share of a threshold below which what a filter makes of nothing is rounding."""


def _with_alarms(
    observers: Sequence[tuple[ObserverProfile, Sequence[Flight]]], profile: Profile
) -> tuple[ObserverProfile, ...]:
    """Return observers with alarms calibrated on healthy flights; channels that differ in their number are pooled.

    What never moved there, as clips, keeps the profile's threshold: no level can be learned.
    """
    share = FALSE_ALARMS_PER_HOUR / max(1, sum(len(observer.faults) for observer, _ in observers))
    times, found = Times(), []
    thresholds = {(one.name, rule.channel): rule.threshold for one in profile.observers for rule in one.alarms}
    for observer, flights in observers:
        evidence = healthy_evidence(observer, profile.gate, flights)
        families: dict[str, list[int]] = {}
        for at, channel in enumerate(observer.faults):
            families.setdefault(channel.name.rstrip("0123456789"), []).append(at)
        rules = []
        for places in families.values():
            series = [stretch[:, at] for at in places for stretch in evidence]
            levels = healthy_levels(series, observer.rate_hz, share, times)
            largest = max((float(np.abs(one).max()) for one in series if len(one)), default=0.0)
            for channel in (observer.faults[at] for at in places):
                own = thresholds.get((observer.name, channel.name), 0.0)
                floor = own if largest < _UNMOVED * own else 0.0
                bare = AlarmRule(observer.name, channel.name, channel.kind, channel.unit, 0.0, 0.0, 0.0, 0.0, 0.0)
                rules.append(calibrated(bare, levels, 1.0, floor=floor, critical=inf, times=times).rule)
        found.append(replace(observer, alarms=tuple(rules)))
    return tuple(found)


def _run_chains(observers: Sequence[ObserverProfile], gate: GateRule, samples: Mapping[str, Flight]) -> Run:
    traces: list[Trace] = []
    events: list[list[AlarmEvent]] = []
    for factor in (1.0, *FACTORS):
        events.append([])
        for observer in observers:
            rules = tuple(asking_for_more(rule, factor) for rule in observer.alarms)
            chain = ObserverChain(replace(observer, alarms=rules), KALMAN, gate, VehicleClock())
            run = chain.estimate(Given(samples[observer.name].samples), samples[observer.name].armed)
            events[-1] += alarm_events([run], Excuses(()))
            if len(events) == 1:
                builder = TraceBuilder(chain.layout)
                builder.extend(run.estimates)
                traces.append(builder.build())
    first, *rarer = (tuple(sorted(at, key=lambda event: event.vehicle_time_ms)) for at in events)
    return Run(first, tuple(traces), tuple(rarer))


def _whitening(healthy: NDArray[np.float64], plant: Plant) -> NDArray[np.float64]:
    """Return what makes healthy residuals (N, p) white; one that was never anything, as clips, has its model's noise.

    In units of its rounding a fault of it would be so large that the rounding of convolutions raises alarms before it.
    """
    S, noise = healthy.T @ healthy / len(healthy), np.square(plant.D).sum(axis=1)
    return np.linalg.cholesky(np.linalg.inv(S + np.diag(np.where(np.diag(S) <= _UNMOVED**2 * noise, noise, 0.0)))).T


def _energy(observer: ObserverProfile, plant: Plant, flights: Sequence[Flight], share: float) -> EnergyDetector:
    gains = design_ekf(restricted(plant, ()), observer.rate_hz)
    residuals = [_residuals(gains, flight) for flight in flights]
    healthy = np.concatenate([r[flight.armed] for r, flight in zip(residuals, flights, strict=True)])
    W = _whitening(healthy, plant) / np.sqrt(healthy.shape[1])
    raise_s, rate_hz = Times().raise_s, observer.rate_hz
    energies = [_windowed(r, W, flight, rate_hz) for r, flight in zip(residuals, flights, strict=True)]
    stretches = [stretch for e in energies for stretch in _finite_stretches(e)]
    level = return_level([standing(one, round(raise_s * rate_hz)) for one in stretches], rate_hz, share).level
    rule = AlarmRule(observer.name, "energy", "residual", "times healthy", level, level / 2, inf, raise_s, 0.5)
    return EnergyDetector(observer.name, gains, W, rule)


def _run_energy(detector: EnergyDetector, flight: Flight) -> list[tuple[AlarmEvent, ...]]:
    energy = _windowed(_residuals(detector.gains, flight), detector.W, flight, detector.gains.rate_hz)[:, None]
    known = np.isfinite(energy)
    rules = [[asking_for_more(detector.rule, factor)] for factor in (1.0, *FACTORS)]
    return [_walked(ENERGY, at, flight, np.where(known, energy, 0.0), known) for at in rules]


def _walked(
    name: str, rules: Sequence[AlarmRule], flight: Flight, evidence: NDArray[np.float64], known: NDArray[np.bool_]
) -> tuple[AlarmEvent, ...]:
    """Return the events of evidence (N, m) for some alarms."""
    alarms, samples, events = [Alarm(rule, name) for rule in rules], flight.samples, list[AlarmEvent]()
    states, index = [alarm.state for alarm in alarms], np.arange(len(flight))
    rows = ChainRows(states, index, samples.vehicle_time_ns, samples.restart, evidence, known)
    walk([rows], lambda _, row, at, code: events.append(alarms[at].event(code, samples, row, None, None)))
    return tuple(events)


def _textbook(
    name: str, observer: ObserverProfile, plant: Plant, flights: Sequence[Flight], share: float
) -> TextbookBank:
    gains = design_ekf(restricted(plant, ()), observer.rate_hz)
    residuals = [_residuals(gains, flight) for flight in flights]
    healthy = np.concatenate([r[flight.armed] for r, flight in zip(residuals, flights, strict=True)])
    W = _whitening(healthy, plant)
    faults = list(dict.fromkeys(fault for one in _compared(observer) for fault in one.faults))
    signatures = np.stack([_signature(plant, fault, gains, W, observer.rate_hz) for fault in faults])
    bank = TextbookBank(name, observer.name, gains, W, signatures, ())
    series = [
        stretch
        for flight in flights
        for stretch in _finite_stretches(_statistics(bank, flight).max(axis=1, initial=-inf))
    ]
    level = return_level(series, observer.rate_hz, share).level
    rules = tuple(
        AlarmRule(observer.name, fault, "sensor", "nats", level, level / 2, inf, 0.0, 0.5) for fault in faults
    )
    return replace(bank, rules=rules)


def _signature(plant: Plant, fault: str, gains: Gains, W: NDArray[np.float64], rate_hz: float) -> NDArray[np.float64]:
    """Return what a unit step of a fault makes of the white residual (rows, p)."""
    model = filter_model(restricted(plant, (fault,)), rate_hz)
    state, y = np.zeros(len(model.A)), []
    state[-1] = 1.0
    for _ in range(GLR_ROWS):
        y.append(model.C @ state)
        state = model.A @ state
    none = np.zeros((GLR_ROWS, len(gains.inputs)))
    shown, nothing = (
        AffineObserver([gains]).run(none, one, restart=np.arange(GLR_ROWS) == 0).residual[:, 0]
        for one in (np.array(y), np.zeros((GLR_ROWS, len(model.C))))
    )
    return np.asarray((shown - nothing) @ W.T, np.float64)


def _statistics(bank: TextbookBank, flight: Flight) -> NDArray[np.float64]:
    """Return each fault's statistic at each sample (N, m), nan where there is no evidence."""
    from scipy.signal import fftconvolve

    z = _residuals(bank.gains, flight) @ bank.W.T
    found = np.full((len(z), len(bank.signatures)), np.nan)
    for rows in flight.stretches(at_restart=True):
        part = z[rows]
        for j, s in enumerate(bank.signatures):
            if bank.name == CUSUM:
                direction = s.sum(axis=0) / max(float(np.linalg.norm(s.sum(axis=0))), 1e-300)
                sums = [np.cumsum(sign * part @ direction - 0.5) for sign in (1.0, -1.0)]
                found[rows, j] = np.max([one - np.minimum(np.minimum.accumulate(one), 0.0) for one in sums], axis=0)
                continue
            best, length = np.zeros(len(part)), 1
            while length <= min(GLR_ROWS, len(part)):
                shape = s[length - 1 :: -1] if length < len(s) else s[::-1]
                energy = float((s[:length] ** 2).sum())
                along = sum(fftconvolve(part[:, i], shape[:, i])[: len(part)] for i in range(part.shape[1]))
                if energy > 0.0:
                    best = np.maximum(best, along**2 / (2.0 * energy))
                length *= 2
            found[rows, j] = best
    return found


def _run_textbook(bank: TextbookBank, flight: Flight) -> list[tuple[AlarmEvent, ...]]:
    statistics = _statistics(bank, flight)
    known = np.isfinite(statistics)
    largest = np.where(known, statistics, -inf)
    named = largest.argmax(axis=1)[:, None] == np.arange(len(bank.rules))
    found = []
    for factor in (1.0, *FACTORS):
        rules = [asking_for_more(rule, factor) for rule in bank.rules]
        # A sum that has grown for a minute would take as long to fall: what is beyond three levels counts as three.
        evidence = np.where(named & known, np.minimum(statistics, 3.0 * rules[0].threshold), 0.0)
        found.append(_walked(bank.name, rules, flight, evidence, known))
    return found


def _residuals(gains: Gains, flight: Flight) -> NDArray[np.float64]:
    """Return the one-step prediction residual at each sample (N, p)."""
    samples = flight.samples
    return AffineObserver([gains]).run(samples.u, samples.y, restart=samples.restart).residual[:, 0]


def _windowed(
    residuals: NDArray[np.float64], W: NDArray[np.float64], flight: Flight, rate_hz: float
) -> NDArray[np.float64]:
    """Return the mean of r' S^-1 r / p over the window before each sample (N,), nan without a window of evidence."""
    width = max(1, round(WINDOW_S * rate_hz))
    sizes = np.sum((residuals @ W.T) ** 2, axis=1)
    total = np.concatenate([[0.0], np.cumsum(sizes)])
    energy = np.full(len(sizes), np.nan)
    start = 0
    for k, (armed, restart) in enumerate(zip(flight.armed.tolist(), flight.samples.restart.tolist(), strict=True)):
        if not armed or restart:
            start = k + (not armed)
        if k + 1 - start >= width:
            energy[k] = (total[k + 1] - total[k + 1 - width]) / width
    return energy


def _finite_stretches(values: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    breaks = np.flatnonzero(np.diff(np.isfinite(values)))
    return [part for part in np.split(values, breaks + 1) if len(part) and np.isfinite(part[0])]
