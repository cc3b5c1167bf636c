"""Fit the observer of a vehicle whose deflections act with speed: model, gains, and the reading of its estimates.

The raw signals of a log are sampled once. A transform that knows only the speeds gives the signals from which the model
is identified. With the timing and curves found, the transform then gives the signals of the observer in operation, on
which the reading of its estimates is calibrated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf, radians
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adapters.errors import ModelError, TelemetryError
from gains.identification.axes import AxesFit
from gains.identification.segment import Segment
from gains.identification.shooting import split_segments
from gains.plants.plant import Plant
from gains.synthesis.certificate import certify
from gains.synthesis.compilation import compile_gains
from gains.synthesis.convex import design_convex
from gains.synthesis.gains_file import Gains
from monitor.alarms.excuse import ExcuseRule
from monitor.estimation.affine import AffineObserver
from monitor.estimation.effectiveness import EffectivenessRule
from monitor.estimation.isolation_rule import IndependentRule
from monitor.fitting.agreement import Agreement, ComparedEffect, FlightEffects, agreement, flight_effects
from monitor.fitting.calibrate import SETTLE_S
from monitor.fitting.changes import fit_changes, healthy_nats
from monitor.fitting.effect_signals import EffectSignals
from monitor.fitting.effectiveness import HealthyRun, calibrate_effectiveness, response_delay_s
from monitor.fitting.fit_report import Comparison, compared, comparison_lines
from monitor.fitting.fitted import FitRequest, Fitted, bare_rule
from monitor.fitting.flights import Flight, flight_samples, transformed
from monitor.fitting.output_functions import CONTROLS_MESSAGE
from monitor.fitting.thresholds import FALSE_ALARMS_PER_HOUR, Calibrated
from monitor.profile import fault_channels
from monitor.sampling.gate import GateRule
from monitor.sampling.transform import LiftRule, SampleSource, TransformRule, make_transform

SHOWN_S = 20.0
"""Length of the drawn comparison, seconds. Chosen: single manoeuvres are visible over the width of a page."""


def compare_effects(
    learn: Callable[[Sequence[Segment]], tuple[Mapping[str, float], Plant]],
    segments: Callable[[Mapping[str, float]], Sequence[Sequence[Segment]]],
    rate_hz: float,
) -> Comparison | None:
    """Fit on most of the recordings and compare with the rest: the last of three or more, else the last quarter.

    From training segments ``learn`` gives the lags and delays of the actuators, and a discrete plant that measures all
    its states and takes its inputs so delayed; ``segments`` gives healthy segments of each recording, their inputs
    delayed by such parameters.

    Return the liveliest seconds of the rest and statistics of all of it; None where what is left to fit on excites too
    little, or nothing long enough is left to compare with.
    """
    training, _ = split_segments(segments({}))
    try:
        parameters, plant = learn(training)
    except ModelError:
        return None
    _, rest = split_segments(segments(parameters))
    return compared(plant.outputs, "outputs", (plant.A, plant.B, plant.c), rest, rate_hz, SHOWN_S)


_OBSERVER_HZ = 50.0
"""Fastest rate of the observer, hertz. Chosen: servos and vehicles answer within 50 ms and more."""
_MOVING = 0.1
"""Share of the usual top speed below which a vehicle stands or taxis, so that the sample does not count for its
speed."""
_SMOOTHING_S = 0.05
"""Smoothing of estimates that are shown, seconds; the effectiveness rule has memories of its own."""
_LEAST_RUN_S = 1.0
"""Shortest stretch of evidence after settling, seconds: a shorter one holds fewer than ten independent samples."""
_ORDINARY_RATE, _ORDINARY_ACCELERATION = radians(60.0), 5.0
"""Rates (rad/s) and accelerations (m/s2) of ordinary motion: the errors of a calm drive straight on are noise, and do
not grow in proportion to the turns. Chosen: as for the sensors' observer, and half of what brakes and tyres allow."""
# Evidence is exactly zero unless a fault is certain, so any size counts.
_SCATTER = 0.03
"""Least scatter between recordings of an actuator's effect. Chosen: speed and air, by which deflections are scaled, are
known within some per cent."""
_THRESHOLD, _CLEAR, _CRITICAL = 0.001, 0.0005, 0.25
_RAISE_S, _CLEAR_S = 0.15, 0.3
_EXCUSED_S = 30.0
"""Time after the end of a sensor's fault for which it explains evidence of actuators, seconds: the autopilot's
estimator has learned a bias from it, subtracts that from rates and velocities, and unlearns it in half a minute."""


@dataclass(frozen=True, slots=True)
class EffectKind:
    """The differences between the kinds of vehicles that this fit serves."""

    observer: str  # name of the observer, and of its transform
    slowest: float  # speed below which samples are no evidence, as a share of the reference speed
    speed: Callable[[NDArray[np.float64]], NDArray[np.float64]]  # speeds (N,) in raw signals (N, s)
    # input that is the effect of a full deflection, by actuator; an actuator without acts the same at every speed
    full: Mapping[str, str]
    # from segments, rate and input names to the fit
    identify: Callable[[Sequence[Segment], float, Sequence[str]], AxesFit]
    # channels of sensors that measure the vehicle's motion: their faults look like those of actuators
    sensors: tuple[str, ...]


def fit_effects(
    kind: EffectKind, request: FitRequest, signals: EffectSignals, gate: GateRule
) -> tuple[Fitted, GateRule]:
    """Identify, design and calibrate; return the observer, and the given gate.

    Raises
    ------
    TelemetryError, ModelError, InfeasibleError
        The recordings lack a message that is needed, excite no axis, or allow no certified design.
    """
    rate_hz = request.fraction_hz(signals.rate_hz, min(signals.rate_hz, _OBSERVER_HZ))
    # Surfaces are not what turns a vehicle with rotors while it hovers or makes a transition.
    lift = LiftRule("wings") if any(survey.is_vtol for survey in request.surveys) else None
    source = SampleSource(inputs=signals.channels, lift=lift)
    raw = [flight_samples(log(), source, signals.rate_hz, gate, commands=False) for log in request.logs]
    reference = _reference_speed(kind, raw)
    speeds = {"reference_speed": reference, "minimum_speed": kind.slowest * reference, **signals.parameters}
    bare = TransformRule(kind.observer, signals.rate_hz, speeds)
    inputs = make_transform(bare, rate_hz).inputs

    def segments(parameters: Mapping[str, float]) -> list[list[Segment]]:
        delayed = replace(bare, parameters=speeds | dict(parameters))
        return [transformed(flight, make_transform(delayed, rate_hz)).segments() for flight in raw]

    def learn(some: Sequence[Segment]) -> tuple[Mapping[str, float], Plant]:
        trained = kind.identify(some, rate_hz, inputs)
        return trained.parameters(), trained.plant(request.name)

    fit = kind.identify([part for flight in segments({}) for part in flight], rate_hz, inputs)
    plant = fit.plant(request.name)
    design = design_convex(plant, rate_hz)
    gains = compile_gains(plant, design, certify(plant, design))
    rule = replace(bare, parameters=speeds | {key: round(value, 6) for key, value in fit.parameters().items()})
    flights = [transformed(flight, make_transform(rule, rate_hz)) for flight in raw]
    reading = _reading(kind, fit, plant, gains, flights)
    lags_s = {fault: rule.parameters[f"{fault}_lag_s"] for fault in gains.faults}
    changes = fit_changes(plant, rate_hz, plant.outputs, flights, lags_s=lags_s)
    nats = inf
    if changes is not None:
        nats = healthy_nats(plant, rate_hz, fault_channels((gains,)), changes, flights, FALSE_ALARMS_PER_HOUR).level
    comparison = compare_effects(learn, segments, rate_hz)
    fitted = Fitted(
        name=kind.observer,
        plant=plant,
        gains=(gains,),
        source=SampleSource(transform=rule, signals=signals.channels, lift=lift),
        isolation=IndependentRule(_SMOOTHING_S),
        alarms=_alarms(kind, gains, nats, reading),
        effectiveness=reading,
        changes=changes,
        reached=_reached(gains, flights),
        flight_s=sum(len(flight.evidence) for flight in flights) / rate_hz,
        findings=_findings(fit, rate_hz, reference, reading),
        lines=(*_lines(fit, rate_hz, reference, reading, signals), *_asked(signals)),
        details=() if comparison is None else ("on data kept back:", *comparison_lines(comparison)),
        comparison=comparison,
        excuses=(ExcuseRule(tuple(gains.faults), kind.sensors, _EXCUSED_S, precedes=True),),
        agreement=_agreement(plant, gains.faults, request.names, [flight.segments() for flight in flights]),
    )
    return fitted, gate


def _alarms(
    kind: EffectKind, gains: Gains, nats: float, reading: Mapping[str, EffectivenessRule]
) -> tuple[Calibrated, ...]:
    rules = [
        replace(
            bare_rule(kind.observer, fault, "actuator", unit),
            threshold=_THRESHOLD,
            clear=_CLEAR,
            critical=_CRITICAL,
            raise_s=_RAISE_S,
            clear_s=_CLEAR_S,
            nats=nats,
            least=reading[fault].least_offset,
        )
        for fault, unit in zip(gains.faults, gains.fault_units, strict=True)
    ]
    return tuple(Calibrated(rule, None) for rule in rules)


def _reference_speed(kind: EffectKind, raw: Sequence[Flight]) -> float:
    """Return the median healthy speed while moving."""
    moving = [flight.samples.u[flight.armed] for flight in raw]
    speed = kind.speed(np.concatenate(moving)) if sum(map(len, moving)) else np.zeros(1)
    fastest = float(np.quantile(speed, 0.95))
    if fastest <= 0.0:
        raise TelemetryError("no healthy motion in these logs: the vehicle was never seen armed and moving")
    return float(f"{np.median(speed[speed > _MOVING * fastest]):.3g}")


def _reading(
    kind: EffectKind, fit: AxesFit, plant: Plant, gains: Gains, flights: Sequence[Flight]
) -> dict[str, EffectivenessRule]:
    """Return the effectiveness rule of each fault."""
    runs = [run for flight in flights for run in _observed(gains, flight)]
    doubts = {axis.model.actuator: 1.0 / axis.t_value for axis in fit.axes}
    rules = {}
    for place, fault in enumerate(gains.faults):
        command, full = gains.inputs.index(fault), kind.full.get(fault)
        start = EffectivenessRule(
            noise=1.0,
            inflation=1.0,
            lag_s=response_delay_s(plant, gains, fault),
            loss_doubt=doubts[fault],
            offset_doubt=0.0,
            certainty=1.0,
            full=full,
        )
        healthy = [
            HealthyRun(
                estimates[:, place],
                u[:, command],
                np.ones(len(u)) if full is None else u[:, gains.inputs.index(full)],
            )
            for estimates, u in runs
        ]
        rule = calibrate_effectiveness(healthy, gains.rate_hz, start)
        learned = ("noise", "inflation", "lag_s", "loss_doubt", "offset_doubt", "certainty", "misfit")
        rounded: dict[str, Any] = {name: float(f"{getattr(rule, name):.4g}") for name in learned}
        rules[fault] = replace(rule, **rounded)
    return rules


def _reached(gains: Gains, flights: Sequence[Flight]) -> dict[str, float]:
    """Return the largest sizes of inputs and outputs in healthy flight; of outputs at least those of ordinary motion.

    An input that never moved is left out: nothing shows that the model of its effect is wrong.
    """
    found = {}
    for names, column in ((gains.inputs, "u"), (gains.outputs, "y")):
        rows = np.concatenate([getattr(flight.samples, column)[flight.evidence] for flight in flights])
        for name, largest in zip(names, np.abs(rows).max(axis=0, initial=0.0), strict=True):
            ordinary = 0.0 if column == "u" else _ORDINARY_RATE if name.endswith("rate") else _ORDINARY_ACCELERATION
            if (size := max(largest, ordinary)) > 0.0:
                found[name] = float(f"{size:.3g}")
    return found


def _observed(gains: Gains, flight: Flight) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return fault estimates and inputs of each healthy stretch, with the observer settled."""
    samples = flight.samples
    estimates = AffineObserver([gains]).run(samples.u, samples.y, restart=samples.restart).fault
    settle, least = round(SETTLE_S * gains.rate_hz), round((SETTLE_S + _LEAST_RUN_S) * gains.rate_hz)
    return [
        (estimates[rows][settle:], samples.u[rows][settle:])
        for rows in flight.stretches(at_restart=True)
        if rows.stop - rows.start > least
    ]


def _agreement(
    plant: Plant, actuators: Sequence[str], names: Sequence[str], flights: Sequence[Sequence[Segment]]
) -> Agreement:
    """Compare, for each actuator, the share of its pooled effect that each recording shows.

    Offsets of the outputs are each recording's own.
    """
    effects = [
        ComparedEffect(name, f"{name} has {{}} less effect", f"{name} has {{}} more effect", _SCATTER)
        for name in actuators
    ]
    places = [plant.inputs.index(name) for name in actuators]
    others = [place for place in range(len(plant.inputs)) if place not in places]
    n, rate_hz = len(plant.states), plant.rate_hz or 1.0
    std = np.array([disturbance.scale for disturbance in plant.disturbances])
    found: list[FlightEffects | str] = []
    for name, segments in zip(names, flights, strict=True):
        usable = [segment for segment in segments if len(segment.u) > 1]
        if not usable:
            found.append(name)
            continue
        u = np.concatenate([segment.u[:-1] for segment in usable])
        now, after = (
            np.concatenate([segment.y[part] for segment in usable]) for part in (slice(None, -1), slice(1, None))
        )
        offsets = np.broadcast_to(np.eye(n), (len(u), n, n))
        regressors = np.concatenate([u[:, None, places] * plant.B[:, places], offsets], axis=2)
        target = after - now @ plant.A.T - u[:, others] @ plant.B[:, others].T
        one = flight_effects(name, regressors, target, std, rate_hz)
        found.append(one if isinstance(one, str) else one.first(len(places)))
    return agreement(effects, found)


def _findings(
    fit: AxesFit, rate_hz: float, reference: float, reading: Mapping[str, EffectivenessRule]
) -> dict[str, object]:
    return {
        "rate_hz": rate_hz,
        "reference_speed": reference,
        "axes": {
            axis.model.output: {
                "actuator": axis.model.actuator,
                "explained": axis.explained,
                "t_value": axis.t_value,
                "delay_s": axis.delay_s,
                "lag_s": axis.lag_s,
                "residual_std": axis.residual_std,
                "whiteness": axis.whiteness,
            }
            for axis in fit.axes
        },
        "watched": list(reading),
        "advice": {verdict.actuator: verdict.advice for verdict in fit.excitation if not verdict.excited},
    }


def _lines(
    fit: AxesFit, rate_hz: float, reference: float, reading: Mapping[str, EffectivenessRule], signals: EffectSignals
) -> Iterable[str]:
    explained = ", ".join(f"{axis.model.output.replace('_', ' ')} {100 * axis.explained:.1f} %" for axis in fit.axes)
    yield f"model {rate_hz:g} Hz, speed {reference:g} m/s, actuators explain {explained} of what changes"
    for fault, rule in reading.items():
        # a size of which the model itself may be wrong is never certain
        loss = max(rule.least_loss, rule.certainty * rule.loss_doubt)
        offset = max(rule.least_offset, rule.certainty * rule.offset_doubt)
        yield (
            f"{fault} alarm from {100 * loss:.0f} % loss or {100 * offset:.0f} % of full deflection off, at "
            f"{rule.certainty:.1f} standard errors"
        )
    for verdict in fit.excitation:
        if not verdict.excited:
            driven = verdict.actuator not in signals.undriven
            why = verdict.advice if driven else "by the vehicle's parameters no output drives it"
            yield f"note: {verdict.actuator} is not watched: {why}"


def _asked(signals: EffectSignals) -> Iterable[str]:
    if any(channel.message == CONTROLS_MESSAGE for channel in signals.channels):
        yield (
            f"commands are what PX4's controllers ask of the mixer ({CONTROLS_MESSAGE}), which its logs hold but links "
            "do not: fit a profile for a link to recordings of the link"
        )
