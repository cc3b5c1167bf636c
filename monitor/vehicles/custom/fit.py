"""An observer of any plant: a model with free parameters, healthy recordings, certified gains, alarms."""

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch, messages
from adapters.channels import Channel, read_channel
from adapters.errors import InfeasibleError, ModelError, TelemetryError
from gains.analysis.estimability import problem_of
from gains.identification.fitted_plant import fitted_plant
from gains.identification.free_model import FreeModel, read_free_model
from gains.identification.output_error import FittedData, OutputErrorFit, identify
from gains.identification.segment import Segment
from gains.identification.shooting import split_segments
from gains.plants.plant import Disturbance, Noise, Plant
from gains.synthesis.bank import compile_bank, design_bank
from gains.synthesis.certificate import certify
from gains.synthesis.compilation import compile_gains
from gains.synthesis.convex import design_convex
from gains.synthesis.gains_file import Gains
from monitor.display import size_text
from monitor.estimation.isolation_rule import BankRule, IndependentRule
from monitor.fitting.calibrate import SETTLE_S, SMOOTHING_S, bank_rule, measured_settling_s
from monitor.fitting.fit_report import Comparison, comparison_json, comparison_lines, parameter_lines
from monitor.fitting.fitted import BatchSource, FitRequest, Fitted, bare_rule, unexplained_alarm
from monitor.fitting.flights import flight_samples
from monitor.fitting.survey import of_one_vehicle
from monitor.fitting.thresholds import (
    FALSE_ALARMS_PER_HOUR,
    Calibrated,
    Times,
    calibrated,
    healthy_evidence,
    healthy_levels,
)
from monitor.sampling.gate import GateRule, read_gate
from monitor.sampling.phase import FlightPhase
from monitor.sampling.transform import SampleSource

_LEAST_THRESHOLD = 1e-3
"""Smallest threshold, in units of the error that matters: a thousandth of that error is no fault."""
_CRITICAL = 5.0
"""Ratio of the critical size to the level that healthy operation reaches."""
_SHOWN_S = 20.0
"""Length of the plot, seconds: it shows single manoeuvres over the width of a page."""
_FORGET_S = 0.5
"""Time constant with which an observer forgets its start, seconds. Chosen: a gap then costs 2.3 s (until a hundredth of
the error is left), and faster poles let more noise through."""


def fit_custom(request: FitRequest) -> tuple[Fitted, GateRule]:
    """Identify the plant that a model file with free parameters describes, design its observer, calibrate its alarms.

    The request's model is one of :mod:`gains.identification.free_model`: its ``[channels]`` say where inputs and
    outputs come from, its ``[phase]`` when samples count (as in a profile; flight is not required unless it says so).
    The observer is named after it, and its samples are evidence as it says, and not before it has settled.

    Raises
    ------
    ModelError, TelemetryError, ProfileError, InfeasibleError
        The model is not valid, the recordings lack a channel or do not determine a parameter (the message says what to
        record), or no certified design exists.
    """
    if request.model is None:
        raise ModelError("a custom vehicle needs a model file")
    logs, model_path = request.logs, request.model
    model = read_free_model(model_path)
    source = SampleSource(*model_channels(model))
    gate = read_gate(model.file.root.table("phase"), GateRule(require_airborne=False, settle_s=SETTLE_S))
    model.file.check()
    names = {channel.message for channel in source.channels}
    own = [partial(_of_one_system, log, names) for log in logs]
    rate_hz = request.grid_hz(model.example.rate_hz or _rate_hz(own, source.channels, str(model_path)))
    stretches = [flight_samples(log(), source, rate_hz, gate).segments() for log in own]
    segments = [segment for flight in stretches for segment in flight]
    fit = identify(model, *split_segments(stretches), rate_hz)
    _check_determined(fit)
    plant = fitted_plant(fit)
    gains, isolation = _design(plant, rate_hz, segments)
    flights = [flight_samples(log(), source, rate_hz, gate) for log in own]
    bare = Fitted(plant.name, gains, source, isolation, plant=plant)
    gate = replace(gate, settle_s=max(gate.settle_s, measured_settling_s(bare.profile(), gate, flights)))
    flights = [flight_samples(log(), source, rate_hz, gate) for log in own]
    declared = {fault["name"] for fault in model.document.get("fault", ()) if "error" in fault}
    alarms = _alarms(bare, healthy_evidence(bare.profile(), gate, flights), declared)
    comparison = comparison_of(fit)
    fitted = replace(
        bare,
        alarms=tuple(alarms),
        flight_s=sum(len(segment.u) for segment in segments) / rate_hz,
        findings=_findings(fit, plant, comparison),
        lines=_lines(fit, alarms),
        details=_details(fit, plant, comparison),
        comparison=comparison,
        measured=True,
    )
    return fitted, gate


def custom_messages(model_path: Path) -> frozenset[str]:
    """Return the names of the messages that a fit of this model reads: a filter for recordings."""
    inputs, outputs = model_channels(read_free_model(model_path))
    return frozenset(channel.message for channel in (*inputs, *outputs)) | FlightPhase.interests


def model_channels(model: FreeModel) -> tuple[tuple[Channel, ...], tuple[Channel, ...]]:
    """Return the channels of a model's inputs and outputs.

    Raises
    ------
    ModelError
        Some are missing, unknown or wrong; the message has a line for each.
    """
    signals = (*model.example.inputs, *model.example.outputs)
    table = model.file.root.table("channels")
    for name in table:
        if name not in signals:
            table.mistake(name, f"is no input or output; there are {', '.join(signals)}")
    found = []
    for signal in signals:
        if table.has(signal):
            found.append(read_channel(signal, table.table(signal)))
        else:
            table.mistake(signal, f"is missing; write [channels.{signal}] with 'message' and 'field'")
    model.file.check()
    split = len(model.example.inputs)
    return tuple(found[:split]), tuple(found[split:])


def comparison_of(fit: OutputErrorFit) -> Comparison:
    """Return at most :data:`_SHOWN_S` seconds of the flight that was kept back, beside the outputs of the model."""
    data = fit.validation
    W, T, p = data.measured.shape
    shown = min(W, max(1, round(_SHOWN_S * fit.rate_hz / T)))

    def line(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.concatenate([values[:shown], np.full((shown, 1, p), np.nan)], axis=1).reshape(-1, p)

    times = np.add.outer(np.arange(shown) * T, np.append(np.arange(T), T - 1)).ravel() / fit.rate_hz
    return Comparison(
        names=fit.model.example.outputs,
        times=times,
        measured=line(data.measured),
        predicted=line(data.simulated),
        residuals=line(data.innovations),
        explained=_shares(data),
        statistics=fit.residuals,
        about="simulated against measured, data kept back; residual one step ahead",
    )


def _alarms(bare: Fitted, evidence: Sequence[NDArray[np.float64]], declared: Collection[str]) -> list[Calibrated]:
    """Return the alarms: each channel at its own healthy level, and what no hypothesis of a bank explains.

    A channel that was never held responsible while healthy gets the level of the worst other one, each in units of the
    error that matters. A fault is critical from five times its healthy level on; where the model declares the error
    that matters (``declared`` names the faults), not below that.
    """
    rate_hz, channels = bare.gains[0].rate_hz, bare.profile().faults
    bank = isinstance(bare.isolation, BankRule)
    share, times = FALSE_ALARMS_PER_HOUR / (len(channels) + bank), Times()
    errors = {fault.name: fault.error for fault in bare.plant.faults}
    levels = [
        healthy_levels([flight[:, at] for flight in evidence], rate_hz, share, times) for at in range(len(channels))
    ]
    known = [found.plain.level / errors[channel.name] for found, channel in zip(levels, channels, strict=True)]
    alarms = []
    for channel, found, relative in zip(channels, levels, known, strict=True):
        least = errors[channel.name] * (_LEAST_THRESHOLD if relative else max(*known, _LEAST_THRESHOLD))
        critical = _CRITICAL * max(found.plain.level, least)
        if channel.name in declared:
            critical = max(critical, errors[channel.name])
        rule = bare_rule(bare.name, channel.name, channel.kind, channel.unit)
        alarms.append(calibrated(rule, found, 1.0, floor=least, critical=critical, times=times))
    if isinstance(bare.isolation, BankRule):
        alarms.append(unexplained_alarm(bare.name, evidence, rate_hz, share, bare.isolation.score_floor, times))
    return alarms


def _lines(fit: OutputErrorFit, alarms: Sequence[Calibrated]) -> tuple[str, ...]:
    hold = "ramps between samples" if fit.hold == "first" else "steps that last a sample"
    explained = ", ".join(
        f"{name} {100 * share:.1f} %"
        for name, share in zip(fit.model.example.outputs, fit.validation.predicted_share, strict=True)
    )
    rules = [found.rule for found in alarms]
    return (
        f"model {fit.rate_hz:g} Hz, explains {explained} of the changes one step ahead on data kept back",
        f"inputs act {fit.delay / fit.rate_hz:.3g} s late, as {hold}",
        *parameter_lines(fit.verdicts),
        *(f"{rule.channel} alarm from {size_text(rule.threshold, rule.unit)}" for rule in rules),
    )


def _details(fit: OutputErrorFit, plant: Plant, comparison: Comparison) -> tuple[str, ...]:
    windows, length = fit.validation.measured.shape[:2]
    signals: list[Disturbance | Noise] = [*plant.disturbances, *plant.noises]
    return (
        f"on data kept back ({windows} windows of {length / fit.rate_hz:.3g} s):",
        *(f"  {line}" for line in comparison_lines(comparison)),
        "disturbances and noises, with the parameters' uncertainty added:",
        *(f"  {signal.name} {signal.scale:.3g}" for signal in signals),
    )


def _findings(fit: OutputErrorFit, plant: Plant, comparison: Comparison) -> dict[str, object]:
    outputs = fit.model.example.outputs
    return {
        "rate_hz": fit.rate_hz,
        "delay_s": fit.delay / fit.rate_hz,
        "hold": fit.hold,
        "parameters": {
            verdict.name: {"value": verdict.value, "standard_error": verdict.standard_error, "note": verdict.note}
            for verdict in fit.verdicts
        },
        "validation": comparison_json(comparison),
        "explained_training": {
            what: dict(zip(outputs, share.tolist(), strict=True)) for what, share in _shares(fit.training).items()
        },
        "disturbances": {signal.name: signal.scale for signal in plant.disturbances},
        "noises": {signal.name: signal.scale for signal in plant.noises},
    }


def _shares(data: FittedData) -> dict[str, NDArray[np.float64]]:
    return {"simulation explains": data.simulated_share, "one step ahead": data.predicted_share}


def _of_one_system(log: BatchSource, names: Collection[str]) -> Iterable[Batch]:
    return of_one_vehicle(log(), names)


def _rate_hz(logs: Sequence[BatchSource], channels: Sequence[Channel], where: str) -> float:
    """Return the rate of the grid: the rate of the slowest channel in its slowest log, rounded to a whole number."""
    slowest = np.inf
    for number, log in enumerate(logs, 1):
        stamps: dict[str, list[int]] = {channel.name: [] for channel in channels}
        for message in (message for batch in log() for message in messages(batch)):
            for channel in channels:
                if message.name == channel.message and channel.selects(message.fields):
                    stamp = channel.stamp_ns(message.fields)
                    stamps[channel.name].append(message.received_ns if stamp is None else stamp)
        for channel in channels:
            found = np.unique(stamps[channel.name])
            if len(found) < 2:
                raise TelemetryError(
                    f"{where}: 'channels.{channel.name}': recording {number} holds no {channel.message} that fits it"
                )
            slowest = min(slowest, 1e9 / float(np.median(np.diff(found))))
    return float(max(1, round(slowest)))


def _check_determined(fit: OutputErrorFit) -> None:
    missing = [verdict for verdict in fit.verdicts if not verdict.determined]
    if missing:
        reasons = "; ".join(
            f"'parameters.{verdict.name}' ({verdict.value:.3g} +- {verdict.standard_error:.2g}): {verdict.note}"
            for verdict in missing
        )
        raise ModelError(f"{fit.model.path}: the recordings do not determine {reasons}")


def _design(
    plant: Plant, rate_hz: float, segments: Sequence[Segment]
) -> tuple[tuple[Gains, ...], IndependentRule | BankRule]:
    """Return one observer if all faults can be estimated together, otherwise a bank.

    A single observer forgets its initial state with a time constant of at most ``_FORGET_S`` if that is possible.
    """
    if problem_of(plant, [fault.name for fault in plant.faults]) is not None:
        bank = compile_bank(plant, design_bank(plant, rate_hz))
        return bank, bank_rule(bank, segments)
    try:
        design = design_convex(plant, rate_hz, pole_radius=math.exp(-1.0 / (_FORGET_S * rate_hz)))
    except InfeasibleError:
        design = design_convex(plant, rate_hz)
    return (compile_gains(plant, design, certify(plant, design)),), IndependentRule(SMOOTHING_S)
