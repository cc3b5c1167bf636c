"""Fit a profile: healthy recordings -> identified model -> designed gains -> calibrated thresholds."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tomli_w
from numpy.typing import NDArray

from adapters.channels import Channel
from adapters.message import Message
from gains.bank import compile_bank, design_bank
from gains.certificate import certify
from gains.compilation import compile_gains
from gains.gains_file import write_gains
from gains.model_file import write_model
from gains.multirotor import MultirotorFit, identify_multirotor, multirotor_plant
from gains.synthesis import design_convex
from monitor.alarm import AlarmRule
from monitor.gate import GateRule
from monitor.isolation_rule import BankRule, SingleRule, gains_file_name
from monitor.profile import PROFILE_FILE, UNEXPLAINED, observer_table, profile_table, read_profile
from replay.calibrate import MARGIN, SETTLE_S, bank_rule, contiguous, flight_samples, healthy_maxima, single_rule
from replay.survey import Survey, common_rate_hz, multirotor_channels, survey

OBSERVER = "motors"
Log = Callable[[], Iterable[Message]]

_AIRBORNE_SHARE = 0.5
_RAISE_S = 0.15
_CLEAR_S = 0.5
_UNEXPLAINED_S = 0.5
_SMALLEST_LOSS = 0.015
_CRITICAL_LOSS = 0.25


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
    gate = GateRule(settle_s=SETTLE_S, airborne_command=_AIRBORNE_SHARE * mean_command(surveys, inputs))
    flights = [flight_samples(log(), inputs, outputs, rate_hz, gate) for log in logs]
    segments = [segment for flight in flights for segment in contiguous(flight)]
    model = identify_multirotor(segments, rate_hz)
    motors = tuple(channel.name for channel in inputs)
    plant = multirotor_plant(model, name, motors)
    folder.mkdir(parents=True, exist_ok=True)
    write_model(plant, folder / f"{OBSERVER}.model.toml")
    isolation: SingleRule | BankRule
    if len(motors) > len(plant.outputs):
        bank = compile_bank(plant, design_bank(plant, rate_hz))
        isolation = bank_rule(bank, segments)
    else:
        design = design_convex(plant, rate_hz)
        bank = (compile_gains(plant, design, certify(plant, design)),)
        isolation = single_rule(bank[0], segments)
    for gains in bank:
        write_gains(gains, folder / gains_file_name(OBSERVER, gains.faults if len(bank) > 1 else ()))

    def write(alarms: Sequence[AlarmRule]) -> None:
        table = observer_table(inputs=inputs, outputs=outputs, isolation=isolation, alarms=alarms)
        content = profile_table(name=name, vehicle="multirotor", gate=gate, observers={OBSERVER: table})
        (folder / PROFILE_FILE).write_text(tomli_w.dumps(content, multiline_strings=False))

    write(())
    worst, hover = healthy_maxima(read_profile(folder), flights, _RAISE_S)
    thresholds = np.maximum(MARGIN * worst, _SMALLEST_LOSS * hover)
    rules = [_rule(motor, thresholds[i], hover[i]) for i, motor in enumerate(motors)]
    if isinstance(isolation, BankRule):
        rules.append(_unexplained(isolation.score_floor))
    write(rules)
    sqrt_mu = max(float(gains.report["sqrt_mu"]) for gains in bank)
    report = FitReport(model, motors, sqrt_mu, sum(len(s.u) for s in segments) / rate_hz, hover, thresholds)
    (folder / "fit.json").write_text(json.dumps(report_json(report), indent=1) + "\n")
    return report


def mean_command(surveys: Sequence[Survey], inputs: Sequence[Channel]) -> float:
    """Return the mean command of the input channels while armed, over all recordings."""
    numbers = [int(channel.name.removeprefix("motor")) for channel in inputs]
    pulses = [found.outputs[number][0] for found in surveys for number in numbers]
    return float(np.mean([inputs[0].scale * pulse + inputs[0].offset for pulse in pulses]))


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


def _unexplained(score_floor: float) -> AlarmRule:
    return AlarmRule(
        observer=OBSERVER,
        channel=UNEXPLAINED,
        kind="residual",
        unit="times healthy",
        threshold=round(score_floor, 3),
        clear=round(score_floor / 2, 3),
        critical=round(5 * score_floor, 3),
        raise_s=_UNEXPLAINED_S,
        clear_s=_CLEAR_S,
    )
