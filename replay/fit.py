"""Fit a profile: healthy recordings -> identified model -> designed gains -> calibrated thresholds."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tomli_w
from numpy.typing import NDArray

from adapters.channels import Channel
from adapters.clock import VehicleClock
from adapters.message import Message
from adapters.phase import FlightPhase
from adapters.sample import Sample
from adapters.sampler import Sampler
from gains.certificate import certify
from gains.compilation import compile_gains
from gains.gains_file import Gains, write_gains
from gains.model_file import write_model
from gains.multirotor import MultirotorFit, Segment, identify_multirotor, multirotor_plant
from gains.synthesis import design_convex
from monitor.alarm import AlarmRule
from monitor.chain import ObserverChain
from monitor.estimate import Estimate
from monitor.gate import FlightGate, GateRule
from monitor.isolation import IndependentChannels
from monitor.observer import Observer
from monitor.profile import (
    PROFILE_FILE,
    IsolationRule,
    Profile,
    observer_table,
    profile_table,
    read_profile,
)
from replay.survey import Survey, common_rate_hz, multirotor_channels, survey

OBSERVER = "motors"
Log = Callable[[], Iterable[Message]]

_SETTLE_S = 1.0
_AIRBORNE_SHARE = 0.5
_SMOOTHING_S = 0.05
_RAISE_S = 0.15
_CLEAR_S = 0.5
_MARGIN = 2.0
_SMALLEST_LOSS = 0.015
_CRITICAL_LOSS = 0.25
_TOLERANCE = 0.2
_GAIN_PENALTY = 25.0


class GatedSample(NamedTuple):
    """A sample and whether it is evidence."""

    sample: Sample
    armed: bool


@dataclass(frozen=True, slots=True)
class FitReport:
    """What ``fauio fit`` found, for people and for ``--json``.

    Parameters
    ----------
    model : MultirotorFit
        The identified model.
    motors : tuple[str, ...]
        Channel names of the motors.
    sqrt_mu : float
        Certified bound of the design.
    flight_s : float
        Healthy flight used, seconds.
    hover : NDArray[np.float64]
        Median command of each motor.
    thresholds : NDArray[np.float64]
        Alarm thresholds in units of full command.
    """

    model: MultirotorFit
    motors: tuple[str, ...]
    sqrt_mu: float
    flight_s: float
    hover: NDArray[np.float64]
    thresholds: NDArray[np.float64]


def fit_multirotor(logs: Sequence[Log], folder: Path, name: str) -> FitReport:
    """Write a profile for a multirotor.

    Parameters
    ----------
    logs : Sequence[Log]
        Healthy recordings; each call of a log goes through it once from the start.
    folder : Path
        The profile's folder; made where it does not exist.
    name : str
        Name of the vehicle and the model.

    Raises
    ------
    TelemetryError, ModelError, InfeasibleError
        The recordings do not hold what is needed, do not excite an axis, or allow no certified design.
    """
    surveys = [survey(log()) for log in logs]
    inputs, outputs = multirotor_channels(surveys)
    rate_hz = common_rate_hz(surveys, (*inputs, *outputs))
    gate = GateRule(settle_s=_SETTLE_S, airborne_command=_AIRBORNE_SHARE * mean_command(surveys, inputs))
    flights = [flight_samples(log(), inputs, outputs, rate_hz, gate) for log in logs]
    segments = [segment for flight in flights for segment in contiguous(flight)]
    model = identify_multirotor(segments, rate_hz)
    motors = tuple(channel.name for channel in inputs)
    plant = multirotor_plant(model, name, motors)
    design = design_convex(plant, rate_hz)
    gains = compile_gains(plant, design, certify(plant, design))
    isolation = isolation_rule(healthy_estimates(gains, segments))
    folder.mkdir(parents=True, exist_ok=True)
    write_model(plant, folder / f"{OBSERVER}.model.toml")
    write_gains(gains, folder / f"{OBSERVER}.gains.json")

    def write(alarms: Sequence[AlarmRule]) -> None:
        table = observer_table(inputs=inputs, outputs=outputs, isolation=isolation, alarms=alarms)
        content = profile_table(name=name, vehicle="multirotor", gate=gate, observers={OBSERVER: table})
        (folder / PROFILE_FILE).write_text(tomli_w.dumps(content, multiline_strings=False))

    write(())
    worst, hover = healthy_maxima(read_profile(folder), flights, _RAISE_S)
    thresholds = np.maximum(_MARGIN * worst, _SMALLEST_LOSS * hover)
    write([_rule(motor, thresholds[i], hover[i]) for i, motor in enumerate(motors)])
    report = FitReport(
        model, motors, float(design.sqrt_mu), sum(len(s.u) for s in segments) / rate_hz, hover, thresholds
    )
    (folder / "fit.json").write_text(json.dumps(report_json(report), indent=1) + "\n")
    return report


def mean_command(surveys: Sequence[Survey], inputs: Sequence[Channel]) -> float:
    """Return the mean command of the input channels while armed, over all recordings."""
    numbers = [int(channel.name.removeprefix("motor")) for channel in inputs]
    pulses = [found.outputs[number][0] for found in surveys for number in numbers]
    return float(np.mean([inputs[0].scale * pulse + inputs[0].offset for pulse in pulses]))


def flight_samples(
    messages: Iterable[Message],
    inputs: Sequence[Channel],
    outputs: Sequence[Channel],
    rate_hz: float,
    gate: GateRule,
) -> list[GatedSample]:
    """Return a recording's samples, each with whether it is evidence, as the monitor would take them."""
    sampler = Sampler(inputs, outputs, rate_hz, VehicleClock())
    phase, flight = FlightPhase(), FlightGate(gate)
    found = []
    for message in messages:
        phase.feed(message)
        for sample in sampler.feed(message):
            found.append(GatedSample(sample, flight.admits(phase, sample) and sample.complete))
    return found


def contiguous(samples: Iterable[GatedSample]) -> list[Segment]:
    """Return the stretches of evidence without a break."""
    runs: list[list[Sample]] = [[]]
    for sample, armed in samples:
        if runs[-1] and (not armed or sample.restart):
            runs.append([])
        if armed:
            runs[-1].append(sample)
    return [Segment(np.stack([s.u for s in run]), np.stack([s.y for s in run])) for run in runs if run]


def healthy_estimates(gains: Gains, segments: Sequence[Segment]) -> NDArray[np.float64]:
    """Return the smoothed joint fault estimates (N, a) over healthy flight, each segment's start left out."""
    observer = Observer(gains)
    settle = round(_SETTLE_S * gains.rate_hz)
    smoothed = []
    for segment in segments:
        stage = IndependentChannels(len(gains.faults), _SMOOTHING_S, gains.rate_hz)
        fault = observer.run(segment.u, segment.y).fault
        smoothed.extend([stage.update(value).single for value in fault][settle:])
    return np.stack(smoothed)


def isolation_rule(healthy: NDArray[np.float64]) -> IsolationRule:
    """Return the isolation stage that healthy estimates (N, a) call for.

    The covariance is taken about zero, so that a constant offset counts as disturbance; the floor of the score
    is the largest one of healthy flight with a margin.
    """
    covariance = healthy.T @ healthy / len(healthy)
    projected = healthy @ np.linalg.inv(covariance)
    score = np.abs(projected) / np.sqrt(np.diag(np.linalg.inv(covariance)))
    return IsolationRule(
        method="single",
        smoothing_s=_SMOOTHING_S,
        tolerance=_TOLERANCE,
        score_floor=_MARGIN * float(score.max()),
        gain_penalty=_GAIN_PENALTY,
        covariance=covariance,
    )


def healthy_maxima(
    profile: Profile, flights: Sequence[Sequence[GatedSample]], raise_s: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Step the profile's first observer over healthy samples as the monitor does.

    Returns
    -------
    worst : NDArray[np.float64]
        For each fault the largest size that stood for ``raise_s`` (a,).
    typical : NDArray[np.float64]
        Median command of each input (s,).
    """
    observer = profile.observers[0]
    width = max(1, round(raise_s * observer.gains.rate_hz))
    worst = np.zeros(len(observer.gains.faults))
    for flight in flights:
        chain = ObserverChain(observer, profile.name, profile.gate, VehicleClock(), lambda: 0)
        sizes = [
            np.abs(output.isolated) if output.armed else np.zeros(len(worst))
            for sample, armed in flight
            for output in chain.step(sample, armed)
            if isinstance(output, Estimate)
        ]
        if len(sizes) >= width:
            stood = np.lib.stride_tricks.sliding_window_view(np.stack(sizes), width, axis=0).min(axis=-1)
            worst = np.maximum(worst, stood.max(axis=0))
    commands = [sample.u for flight in flights for sample, armed in flight if armed]
    return worst, np.asarray(np.median(np.stack(commands), axis=0))


def report_json(report: FitReport) -> dict[str, object]:
    """Return the report as a JSON object."""
    model = report.model
    return {
        "vehicle": "multirotor",
        "rate_hz": model.rate_hz,
        "flight_s": report.flight_s,
        "motors": list(report.motors),
        "explained": dict(zip(("roll", "pitch", "yaw"), model.explained.tolist(), strict=True)),
        "t_value": dict(zip(("roll", "pitch", "yaw"), model.t_value.tolist(), strict=True)),
        "lag_taps": model.taps.tolist(),
        "thrust_curvature": model.kappa,
        "sqrt_mu": report.sqrt_mu,
        "hover_command": dict(zip(report.motors, report.hover.tolist(), strict=True)),
        "threshold": dict(zip(report.motors, report.thresholds.tolist(), strict=True)),
        "threshold_relative": dict(zip(report.motors, (report.thresholds / report.hover).tolist(), strict=True)),
    }


def _rule(motor: str, threshold: float, hover: float) -> AlarmRule:
    return AlarmRule(
        observer=OBSERVER,
        channel=motor,
        kind="actuator",
        unit="fraction of full command",
        threshold=round(float(threshold), 6),
        clear=round(float(threshold) / 2, 6),
        critical=round(max(_CRITICAL_LOSS * float(hover), 2 * float(threshold)), 6),
        raise_s=_RAISE_S,
        clear_s=_CLEAR_S,
    )
