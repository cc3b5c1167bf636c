"""The motors observer of a multirotor: any number of motors, effectiveness learned, one hypothesis for each motor."""

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from string import ascii_lowercase

import numpy as np
from numpy.typing import NDArray

from adapters.channels import Channel
from adapters.errors import ModelError, UntoldError
from gains.identification.segment import Segment
from gains.identification.shooting import split_segments
from gains.plants.plant import Plant
from gains.synthesis.bank import compile_bank, design_bank
from monitor.alarms.alarm import THRUST
from monitor.display import size_text
from monitor.estimation.bank import CALM_LEVELS
from monitor.estimation.changes import ChangeRule
from monitor.estimation.excitation import ExcitationRule
from monitor.fitting.calibrate import LEVEL_SHARE, SETTLE_S, bank_rule
from monitor.fitting.changes import fit_changes, healthy_nats
from monitor.fitting.excitation import fit_excitation
from monitor.fitting.extremes import ReturnLevel
from monitor.fitting.fit_report import (
    Comparison,
    compared,
    comparison_json,
    comparison_lines,
)
from monitor.fitting.fitted import FitRequest, Fitted, bare_rule, unexplained_alarm
from monitor.fitting.flights import Flight, flight_samples
from monitor.fitting.lasting import Scatter, scatter
from monitor.fitting.spread import fit_spread
from monitor.fitting.survey import MOTOR_MESSAGE, Survey, common_rate_hz, fitted_rates
from monitor.fitting.thresholds import (
    FALSE_ALARMS_PER_HOUR,
    Calibrated,
    Levels,
    Times,
    calibrated,
    healthy_evidence,
    healthy_levels,
    healthy_runs,
    plain_only,
    with_lasting,
)
from monitor.profile import FaultChannel, ObserverProfile
from monitor.sampling.gate import GateRule
from monitor.sampling.slow_telemetry import COMMANDS_PER_TICK
from monitor.sampling.supply import BATTERY_MESSAGE, SupplyRule
from monitor.sampling.transform import LiftRule, SampleSource
from monitor.vehicles.multirotor.flight_motors import AXES, motor_agreement
from monitor.vehicles.multirotor.frames import Frame, frame_of
from monitor.vehicles.multirotor.identify import (
    GYROS,
    RATE_AXES,
    MotorUncertainty,
    MultirotorFit,
    identify_multirotor,
    multirotor_plant,
)
from monitor.vehicles.multirotor.signals import hover_pulse, motor_commands, multirotor_channels, range_text
from monitor.vehicles.multirotor.speeds import EscSignals, motor_speeds
from monitor.vehicles.multirotor.trim import (
    SLOW_COMMANDS_HZ,
    TRIM_HZ,
    TURNED,
    choose_frame,
    identify_trim,
    slow_times,
    smallest_loss,
    usable_segments,
)
from monitor.vehicles.multirotor.voltage import fit_supply

SHOWN_S = 10.0
"""Length of the plot, seconds: it shows single manoeuvres over the width of a page."""


def compare_kept_back(flights: Sequence[Sequence[Segment]], rate_hz: float) -> Comparison | None:
    """Fit on most of the recordings and compare with the rest: the last of three or more, otherwise the last quarter.

    Return the liveliest seconds of the rest and statistics of all of it, or None if the part for the fit is too short,
    or nothing long enough is left for the comparison.
    """
    training, rest = split_segments(flights)
    places = {id(segment.u): number for number, flight in enumerate(flights) for segment in flight}
    try:
        fit, _ = identify_multirotor(training, rate_hz, flights=[places.get(id(segment.u), -1) for segment in training])
    except ModelError:
        return None
    unbroken = [segment for kept in rest for segment in kept.unbroken()]
    driven = [Segment(fit.drive(segment.u)[:, :3], segment.y[len(fit.taps) - 1 :, :3]) for segment in unbroken]
    model = np.diag(fit.a), np.eye(3), fit.c[:3]
    return compared(RATE_AXES, "body rates (rad/s)", model, driven, rate_hz, SHOWN_S)


OBSERVER, PROPS, TRIM = "motors", "props", "trim"


@dataclass(frozen=True, slots=True)
class _Drive:
    """The inputs that an observer takes as the motion's cause: commands, or thrusts expected at measured speeds."""

    observer: str
    inputs: tuple[Channel, ...]
    rate_hz: float
    called: str
    unit: str
    supply: SupplyRule | None = None

    @property
    def numbers(self) -> list[int]:
        """Numbers of the outputs."""
        return [int(channel.name.lstrip(ascii_lowercase)) for channel in self.inputs]


def _commanded(request: FitRequest, gate: GateRule, inputs: tuple[Channel, ...]) -> _Drive:
    rate_hz = min(survey.rate_hz[MOTOR_MESSAGE] for survey in request.surveys)
    supply = fit_supply(request, gate, inputs)
    return _Drive(OBSERVER, inputs, rate_hz, "motor commands", "fraction of full command", supply)


def _turned(speeds: EscSignals, observer: str) -> _Drive:
    return _Drive(observer, speeds.thrusts(), speeds.rate_hz, "speeds of motors", THRUST)


_ENOUGH_HZ = 100.0
"""Fastest rate of the grid for logs, hertz: several samples in the lag of any motor (20 to 100 ms with its link)."""
_CALM_HZ = 10.0
"""Assumed rate of commands in flights without manoeuvres, hertz, that of logs: what commands at this rate show in hover
alone is measured (docs/rates.md)."""
_AIRBORNE_SHARE = 0.5
"""Share of the mean command, which is that of hovering, above which a vehicle is in the air. Chosen: motors idle far
below half of it, descents stay above."""
_CARRYING_SHARE = 0.8
"""Share of the mean command above which the rotors of a vehicle with wings carry it. Measured on a simulated VTOL:
hover in gusts stays above it, and after forward flight the rotors reach it below 9 m/s."""
_BRIDGED_S = 0.5
"""Longest break in the evidence that identification bridges, seconds. Chosen: over a shorter one the commands, on a
straight line, determine the body rates; after a longer one the rates begin anew."""
_SMALLEST_LOSS = 0.015
"""Smallest loss in hover that is worth an alarm. Measured on healthy flights: the standard errors of motors' effects
are 0.1 to 1.4 %, so that a smaller loss may be the model's own error."""
_LIVELY = 0.05
"""Least standard deviation of a body rate, rad/s, with which a flight shows what motors do about that axis. Chosen: in
hover the controller alone moves the motors, and its answers to gusts are taken for their effects. Two hovers of
simulated quadcopters (0.002 to 0.021) had effects that were wrong by up to 20 % at stated 1 %, and took turns of other
flights for lost motors; squares at 3 m/s have 0.1 and more."""
_CRITICAL_LOSS = 0.25
"""Critical loss. Chosen: without a quarter of a motor, a quadrotor has little control left in gusts."""
_PAIRED = 4
"""Number of motors with which losses of any two motors are told from all other losses. The effects of four
motors on three body rates have one linear combination that is zero, with coefficients of one sign: two losses are
told from any other two, since losses have one sign, too. With six motors, the losses of two opposite motors turn the
vehicle as little as those of any other opposite two."""
_OPPOSITE = 0.5
"""Largest effect of two motors together on roll and pitch, as a share of one motor's, for which they are opposite.
Chosen: opposite motors of a quadrotor have none, neighbours 1.4 times that of one."""
_CALM_S = 10.0
"""Longest time without a turn for which opposite motors are waited for, where commands come slowly. Chosen: at 10 Hz it
is 3 s; over radios with two commands a second it would be 15 s, and flights seldom go straight on for so long."""
_SMALLEST_JUMP = 0.05
"""Smallest jump of a gyro that is worth an alarm, rad/s: an autopilot rides out a smaller one, and gusts make steps of
that size."""
_MOST_OF_JUMPS = 1.5
"""Largest ratio of the level to the largest healthy step: steps are too rare to fit a tail to them."""
# A jump is seen in one sample, so it needs no debounce.
_JUMP = Times(fast_s=0.0, raise_s=0.0, clear_s=0.5)
_BEYOND, _BEYOND_SLOW = (1.5e-7, 1e-3), (3e-5, 1e-2)
"""Variance of a motor's relative loss per squared body rate, (rad/s)^2, and per squared change of a command, in flights
that are livelier than the fitted ones. Measured: about the geometric means of fits of recorded flights, at 100 Hz
(three ArduPilot quadcopters: 5e-8 to 8e-7, 1.5e-4 to 4.5e-3) and with commands at 10 Hz (ArduPilot's and PX4's logs,
PX4's link: 6e-6 to 1.4e-4, 7e-3 to 1.8e-2)."""


def multirotor_gate(surveys: Sequence[Survey]) -> GateRule:
    """Return the rule for a multirotor's evidence: in the air, told by half the mean command if nothing else tells it.

    Low commands do not show that a vehicle with wings has landed.
    """
    winged = any(survey.is_vtol for survey in surveys)
    return GateRule(settle_s=SETTLE_S, airborne_command=0.0 if winged else _AIRBORNE_SHARE * _hover_command(surveys))


def _hover_command(surveys: Sequence[Survey]) -> float:
    inputs, _ = multirotor_channels(surveys)
    return inputs[0].scale * hover_pulse(surveys, motor_commands(surveys)) + inputs[0].offset


def _lift(surveys: Sequence[Survey]) -> LiftRule | None:
    """Return the rule that the rotors have to carry a vehicle that has wings."""
    winged = any(survey.is_vtol for survey in surveys)
    return LiftRule("rotors", float(f"{_CARRYING_SHARE * _hover_command(surveys):.3g}")) if winged else None


@dataclass(frozen=True, slots=True, eq=False)
class _Identified:
    """A model of the motors, its data, and the report about it.

    ``doubt`` is the error of the next body rates (n,) from the uncertainty of the coefficients, ``times`` how long
    evidence has to last.
    """

    model: MultirotorFit
    source: SampleSource
    flights: Sequence[Flight]
    segments: Sequence[Segment]
    doubt: NDArray[np.float64]
    gyros: bool
    times: Times
    smallest_loss: float
    findings: Mapping[str, object]
    line: str
    details: tuple[str, ...]
    comparison: Comparison | None = None


def fit_multirotor(request: FitRequest) -> tuple[Fitted, GateRule]:
    """Identify the motors' model on healthy recordings, design its bank, calibrate its alarms.

    Where motor commands come slower than :data:`SLOW_COMMANDS_HZ`, or a slower grid is asked for, the observer compares
    mean command and mean motion. Where speeds of motors come faster, they stand in for the commands: what is lost
    before them is told by the esc observer, what is lost behind them is the propellers'. Not so where their controllers
    measure no voltage: speeds that are made out of commands would hide what motors lose.

    Raises
    ------
    TelemetryError, ModelError, InfeasibleError
        The recordings do not hold what is needed, or allow no certified design.
    """
    gate = multirotor_gate(request.surveys)
    commands, outputs = multirotor_channels(request.surveys)
    speeds = motor_speeds(request, gate, commands)
    if speeds is not None and speeds.measured and speeds.rate_hz >= SLOW_COMMANDS_HZ:
        return _fitted(request, gate, _turned(speeds, OBSERVER), outputs), gate
    return _fitted(request, gate, _commanded(request, gate, commands), outputs), gate


def fit_props(request: FitRequest, gate: GateRule) -> Fitted | None:
    """Fit an observer whose inputs are speeds of motors that come slowly; None if there are none.

    Speeds that come fast are the inputs of the motors observer (:func:`fit_multirotor`).
    """
    commands, outputs = multirotor_channels(request.surveys)
    speeds = motor_speeds(request, gate, commands)
    if speeds is None or not speeds.measured or speeds.rate_hz >= SLOW_COMMANDS_HZ:
        return None
    return _fitted(request, gate, _turned(speeds, PROPS), outputs)


def fit_trim(request: FitRequest, gate: GateRule) -> Fitted | None:
    """Fit an observer of the mean command of each second beside a faster one; None if commands come that slowly.

    It detects faults that manoeuvres and noise hide from the fast one: a propeller that is cut or dirty for a whole
    flight.
    """
    commands, outputs = multirotor_channels(request.surveys)
    drive = replace(_commanded(request, gate, commands), observer=TRIM)
    if min(drive.rate_hz / COMMANDS_PER_TICK, request.rate_hz or math.inf) <= TRIM_HZ:
        return None
    fitted = _fitted(replace(request, rate_hz=TRIM_HZ), gate, drive, outputs)
    return replace(fitted, measured=False)


def _fitted(request: FitRequest, gate: GateRule, drive: _Drive, outputs: tuple[Channel, ...]) -> Fitted:
    surveys = request.surveys
    slow = min(drive.rate_hz, request.rate_hz or drive.rate_hz) < SLOW_COMMANDS_HZ
    identified = (_slow if slow else _fast)(request, gate, drive, outputs)
    model, segments = identified.model, identified.segments
    motors = tuple(channel.name for channel in drive.inputs)
    plant = multirotor_plant(
        model, request.name, motors, doubt=identified.doubt, gyros=identified.gyros, unit=drive.unit
    )
    level_s = LEVEL_SHARE * identified.times.slow_s
    adjacent, opposite = pairs_of(motors, model.B)
    calm = {}
    if slow:
        # They show in yaw alone.
        opposite = opposite if len(plant.outputs) == len(AXES) and CALM_LEVELS * level_s <= _CALM_S else []
        calm = {frozenset(pair): np.array([0.0, 0.0, TURNED]) for pair in opposite}
    gains = compile_bank(plant, design_bank(plant, model.rate_hz, together=(*adjacent, *opposite)))
    rule = bank_rule(gains, segments, edges=GYROS, level_s=level_s, calm=calm)
    source = replace(identified.source, fitted_hz=fitted_rates(surveys, identified.source.channels))
    bare = Fitted(drive.observer, gains, source, rule, supply=drive.supply, plant=plant)
    channels = bare.profile().faults
    hover = np.median(np.concatenate([segment.u for segment in segments]), axis=0)
    watched = {channel.name: float(hover[channel.input]) for channel in channels if channel.input is not None}
    bare = replace(bare, excitation=_excitation(bare.profile(), gate, identified, watched))
    evidence = healthy_evidence(bare.profile(), gate, identified.flights)
    changes, nats = _changes(plant, channels, identified)
    lasting = None if nats is not None else _lasting(bare.profile(), gate, identified, watched)
    alarms = _alarms(drive.observer, channels, evidence, watched, identified, rule.score_floor, nats, lasting)
    smallest = _smallest(watched, alarms, bare.excitation)
    agreed = None
    if not request.agreed:
        agreed = motor_agreement(model, request.names, [flight.segments() for flight in identified.flights], motors)
    # a flight that disagrees may hide all losses: the others are then fitted without it
    if agreed is None or not agreed.left_out:
        _check_watched(watched, smallest)
    commands = motor_commands(surveys)
    ranges = (
        {}
        if commands.pulses or drive.unit == THRUST
        else {"command_range": {"none": commands.stop, "full": commands.full}}
    )
    return replace(
        bare,
        alarms=tuple(alarms),
        changes=changes,
        **fit_spread(bare.profile(), plant, gate, identified.flights)._asdict(),
        flight_s=sum(len(segment.u) for segment in segments) / model.rate_hz,
        findings={
            "rate_hz": model.rate_hz,
            "motors": list(motors),
            "hover_command": dict(zip(motors, hover.tolist(), strict=True)),
            "effectiveness": {motor: model.B[:3, i].tolist() for i, motor in enumerate(motors)},
            **identified.findings,
            **({} if drive.supply is None else {"supply": asdict(drive.supply)}),
            **ranges,
            "validation": None if identified.comparison is None else comparison_json(identified.comparison),
        },
        lines=(
            *([range_text(commands, surveys)] if ranges else []),
            identified.line,
            *([] if drive.supply is None else [_supply_text(drive.supply)]),
            *_lines(watched, smallest, alarms),
        ),
        details=identified.details,
        comparison=identified.comparison,
        measured=True,
        agreement=agreed,
    )


def pairs_of(motors: Sequence[str], B: NDArray[np.float64]) -> tuple[list[tuple[str, str]], list[tuple[str, str]]]:
    """Return the adjacent and the opposite motors that are watched together.

    B (n, s) are their effects on rates, roll and pitch first.
    """
    if len(motors) != _PAIRED:
        return [], []
    level = dict(zip(motors, B[:2].T, strict=True))
    apart = {
        (a, b): float(np.linalg.norm(level[a] + level[b])) > _OPPOSITE * float(np.linalg.norm(level[a]))
        for a, b in combinations(motors, 2)
    }
    return [pair for pair, turns in apart.items() if turns], [pair for pair, turns in apart.items() if not turns]


def _supply_text(supply: SupplyRule) -> str:
    return (
        f"commands lose {supply.share:.2f} % when the battery loses 1 % of {supply.volts:.1f} V: corrected by "
        f"{BATTERY_MESSAGE}"
    )


def _smallest(
    watched: Mapping[str, float], alarms: Sequence[Calibrated], excitation: ExcitationRule | None
) -> dict[str, tuple[float, str]]:
    """Return the smallest loss of each motor that raises an alarm, including the errors at rest, and its unit."""
    scale = math.sqrt(max(1.0, excitation.constant if excitation is not None else 0.0))
    rules = {calibrated.rule.channel: calibrated.rule for calibrated in alarms}
    return {motor: (scale * rules[motor].threshold, rules[motor].unit) for motor in watched}


def _check_watched(watched: Mapping[str, float], smallest: Mapping[str, tuple[float, str]]) -> None:
    """Make sure that some motor's loss would raise an alarm; ``watched`` are their commands in hover, by channel."""
    least = min(smallest[motor][0] / command for motor, command in watched.items())
    if least >= 1.0:
        raise ModelError(
            f"no motor could be watched: only losses above {100 * least:.0f} % of its command would stand out; these "
            "commands do not explain the motion: is it a multirotor in the air, and are these the motors' outputs?"
        )


def _fast(request: FitRequest, gate: GateRule, drive: _Drive, outputs: Sequence[Channel]) -> _Identified:
    """Identify how the body rates answer the commands, sample by sample; use means if no manoeuvre shows that."""
    source = SampleSource(drive.inputs, tuple(outputs), lift=_lift(request.surveys))
    fastest_hz = common_rate_hz(request.surveys, source.channels)
    rate_hz = request.grid_hz(min(fastest_hz, _ENOUGH_HZ))
    flights = [flight_samples(log(), source, rate_hz, gate, drive.supply) for log in request.logs]
    segments = [segment for flight in flights for segment in flight.segments()]
    records = [flight.segments(round(_BRIDGED_S * rate_hz)) for flight in flights]
    frame = _frame_of(request, drive)
    origin = "the vehicle's parameters"
    if frame is None:
        every = max(1, round(rate_hz / SLOW_COMMANDS_HZ))
        frame, origin = choose_frame([Segment(s.u[::every], s.y[::every]) for s in segments], rate_hz / every), "motion"
    model, uncertainty, told = _identify(records, rate_hz, frame)
    rates = np.concatenate([segment.y[:, : len(AXES)] for segment in segments])
    if not told[:2].all():
        return _slow(request, gate, drive, outputs)
    if (rates[:, :2].std(axis=0) < _LIVELY).any():
        with suppress(UntoldError):  # which needs the frame
            return _slow(request, gate, drive, outputs)
    from_frame = ""
    if not told[2]:
        known_of = "hardly known" if frame is None else f"from geometry only ({frame.name}, from {origin})"
        from_frame = f"; yaw axis {known_of}"
    comparison = compare_kept_back(records, rate_hz)
    motors = tuple(channel.name for channel in drive.inputs)
    known = _percentages(AXES, uncertainty.of_axes)
    return _Identified(
        model=model,
        source=source,
        flights=flights,
        segments=segments,
        doubt=uncertainty.drive,
        gyros=True,
        times=Times(),
        smallest_loss=_SMALLEST_LOSS,
        findings={**_findings(model, motors, uncertainty), "not_told": [*np.array(AXES)[~told].tolist()]},
        line=f"model {rate_hz:g} Hz, motors {1000 * uncertainty.times_s.sum():.0f} ms late; standard errors of "
        f"their effects: {known}{from_frame}",
        details=(
            f"standard error of each motor's effect: {_percentages(motors, uncertainty.relative)}",
            *(
                ("on data kept back:", *(f"  {line}" for line in comparison_lines(comparison)))
                if comparison
                else ("too little data to keep any back",)
            ),
        ),
        comparison=comparison,
    )


def _identify(
    records: Sequence[Sequence[Segment]], rate_hz: float, frame: Frame | None
) -> tuple[MultirotorFit, MotorUncertainty, NDArray[np.bool_]]:
    """Return the model, its accuracy, and the axes about which the flights show the motors' effects.

    Yaw is taken from the frame if the flights do not show it.
    """
    segments = [record for flight in records for record in flight]
    numbers = [number for number, flight in enumerate(records) for _ in flight]
    model, uncertainty = identify_multirotor(segments, rate_hz, flights=numbers)
    told = uncertainty.told(model, None if frame is None else frame.effects)
    if frame is not None and told[:2].all() and not told[2]:
        yaw = frame.effects * ~told[:, None]
        model, uncertainty = identify_multirotor(segments, rate_hz, yaw, numbers)
    return model, uncertainty, told


def _slow(request: FitRequest, gate: GateRule, drive: _Drive, outputs: Sequence[Channel]) -> _Identified:
    """Identify the mean commands with which the vehicle flies: its trim."""
    commands_hz = drive.rate_hz
    calm = commands_hz >= SLOW_COMMANDS_HZ and request.rate_hz is None
    named = f"{drive.called} come at {commands_hz:.3g} Hz"
    calmly = "too few manoeuvres to know what motors do in tenths of a second (fly brisk roll and pitch for that)"
    why = calmly if calm else named
    why = "beside the faster observer" if drive.observer == TRIM else why
    commands_hz = min(commands_hz, _CALM_HZ) if calm else commands_hz
    rates = tuple(outputs[: len(RATE_AXES)])
    lift = _lift(request.surveys)
    source = SampleSource(tuple(replace(channel, interpolation="mean") for channel in drive.inputs), rates, lift=lift)
    rate_hz = request.grid_hz(
        min(float(f"{commands_hz / COMMANDS_PER_TICK:.3g}"), common_rate_hz(request.surveys, rates))
    )
    flights = [flight_samples(log(), source, rate_hz, gate, drive.supply) for log in request.logs]
    segments = usable_segments([segment for flight in flights for segment in flight.segments()], rate_hz)
    frame, origin = _frame(request, gate, drive, rates)
    model = identify_trim(segments, rate_hz, frame)
    if len(model.a) < len(rates):
        source = replace(source, outputs=rates[: len(model.a)])
        flights = [flight_samples(log(), source, rate_hz, gate, drive.supply) for log in request.logs]
    segments = [segment for flight in flights for segment in flight.segments()]
    still = "the flights never turned" if frame.effects[2].any() else "which no motor turns"
    return _Identified(
        model=model,
        source=source,
        flights=flights,
        segments=segments,
        doubt=np.zeros(len(model.a)),
        gyros=False,
        times=slow_times(rate_hz),
        smallest_loss=smallest_loss(segments, commands_hz),
        findings={
            "frame": frame.name,
            "frame_from": origin,
            "commands_hz": commands_hz,
            "lag_taps": model.taps.tolist(),
        },
        line=f"{why}: mean command against mean motion, every "
        f"{1 / rate_hz:.2g} s; {frame.name} (from {origin})"
        + ("" if len(model.a) == len(rates) else f"; yaw is not used, {still}"),
        details=(),
    )


def _frame_of(request: FitRequest, drive: _Drive) -> Frame | None:
    """Return the frame that the parameters in the recordings describe."""
    frames = (frame_of(survey.parameters, drive.numbers) for survey in request.surveys)
    return next((frame for frame in frames if frame is not None), None)


def _frame(request: FitRequest, gate: GateRule, drive: _Drive, rates: Sequence[Channel]) -> tuple[Frame, str]:
    """Return the vehicle's frame and its origin: the parameters, or the standard frame that agrees with the motion.

    UntoldError is raised if neither determines it.
    """
    if (frame := _frame_of(request, drive)) is not None:
        return frame, "the vehicle's parameters"
    inputs = tuple(replace(channel, interpolation="previous") for channel in drive.inputs)
    source = SampleSource(inputs, tuple(rates), lift=_lift(request.surveys))
    rate_hz = min(common_rate_hz(request.surveys, rates), SLOW_COMMANDS_HZ)
    segments = [
        segment
        for log in request.logs
        for segment in flight_samples(log(), source, rate_hz, gate, drive.supply).segments()
    ]
    frame = choose_frame(segments, rate_hz)
    if frame is None:
        raise UntoldError(
            f"which way its {len(drive.inputs)} motors turn the vehicle is not known: no parameters in the logs say it "
            "(CA_ROTOR* of PX4, FRAME_CLASS or Q_FRAME_CLASS of ArduPilot), and no standard frame fits the motion; "
            "fit on a log of the autopilot itself, or on a flight with brisk roll, pitch and yaw"
        )
    return frame, "the motion"


def _excitation(
    observer: ObserverProfile, gate: GateRule, identified: _Identified, watched: Mapping[str, float]
) -> ExcitationRule:
    """Return how the thresholds of motors' alarms grow with rates and changes of commands."""
    return fit_excitation(
        observer,
        gate,
        identified.flights,
        observer.gains[0].outputs[: len(identified.model.a)],
        np.array(list(watched.values())),
        identified.smallest_loss,
        _BEYOND if identified.gyros else _BEYOND_SLOW,
        FALSE_ALARMS_PER_HOUR / (len(observer.faults) + 1),
        identified.times,
    )


def _changes(
    plant: Plant, channels: Sequence[FaultChannel], identified: _Identified
) -> tuple[ChangeRule | None, ReturnLevel | None]:
    """Return how sudden losses are told from noise, and the nats that raise an alarm; None if there is no such test.

    Means over commands that come slowly hold too little of a moment for it.
    """
    flights = identified.flights
    changes = fit_changes(plant, identified.model.rate_hz, RATE_AXES, flights) if identified.gyros else None
    if changes is None:
        return None, None
    share = FALSE_ALARMS_PER_HOUR / (len(channels) + 1)
    return changes, healthy_nats(plant, identified.model.rate_hz, channels, changes, flights, share)


def _lasting(
    observer: ObserverProfile, gate: GateRule, identified: _Identified, watched: Mapping[str, float]
) -> tuple[Scatter, float]:
    """Return how the means of healthy flights scatter, and the mean factor on the size that evidence has to reach."""
    motors = [place for place, channel in enumerate(observer.faults) if channel.input is not None]
    flights, scales = [], []
    for run, stretches in healthy_runs(observer, gate, identified.flights):
        rows = np.concatenate([np.arange(found.start, found.stop) for found in stretches or [slice(0, 0)]])
        flights.append(run.found.smoothed[rows][:, motors] / list(watched.values()))
        scales.append(run.scale[rows][:, motors])
    return scatter(flights, identified.model.rate_hz), float(np.concatenate(scales).mean())


def _alarms(
    observer: str,
    channels: Sequence[FaultChannel],
    evidence: Sequence[NDArray[np.float64]],
    watched: Mapping[str, float],
    identified: _Identified,
    score_floor: float,
    nats: ReturnLevel | None,
    lasting: tuple[Scatter, float] | None,
) -> list[Calibrated]:
    """Return the alarms: motors pooled relative to their hover commands, gyros pooled, and unexplained residuals."""
    rate_hz = identified.model.rate_hz
    share = FALSE_ALARMS_PER_HOUR / (len(channels) + 1)
    commands = [watched.get(channel.name) for channel in channels]

    def levels(places: Sequence[int], times: Times, most: float = math.inf) -> Levels:
        series = [stretch[:, at] / (commands[at] or 1.0) for at in places for stretch in evidence]
        return healthy_levels(series, rate_hz, share, times, most)

    of_motors = levels([at for at, command in enumerate(commands) if command is not None], identified.times)
    gyros = [at for at, command in enumerate(commands) if command is None]
    of_gyros = levels(gyros, _JUMP, _MOST_OF_JUMPS) if gyros else None
    alarms = []
    for channel, command in zip(channels, commands, strict=True):
        bare = bare_rule(observer, channel.name, channel.kind, channel.unit)
        if command is not None:
            floor, critical = identified.smallest_loss * command, _CRITICAL_LOSS * command
            if nats is not None:
                bare = replace(bare, nats=nats.level, least=float(f"{floor:.4g}"))
            found = calibrated(bare, of_motors, command, floor=floor, critical=critical, times=identified.times)
            if lasting is not None:
                means, usual = lasting
                found = with_lasting(found, means, command / usual, floor=floor / usual, alarms_per_hour=share)
            alarms.append(replace(found, sudden=nats, sharing=len(commands) - len(gyros)))
        elif of_gyros is not None:
            jump = calibrated(bare, of_gyros, 1.0, floor=_SMALLEST_JUMP, critical=4 * _SMALLEST_JUMP, times=_JUMP)
            alarms.append(plain_only(jump))
    return [*alarms, unexplained_alarm(observer, evidence, rate_hz, share, score_floor, identified.times)]


def _findings(model: MultirotorFit, motors: Sequence[str], uncertainty: MotorUncertainty) -> dict[str, object]:
    return {
        "axis_relative_error": dict(zip(AXES, uncertainty.of_axes.tolist(), strict=True)),
        "damping_per_s": dict(zip(AXES, (-np.log(model.a) * model.rate_hz).tolist(), strict=True)),
        **dict(zip(("delay_s", "lag_s", "filter_s"), uncertainty.times_s.tolist(), strict=True)),
        "lag_taps": model.taps.tolist(),
        "thrust_square_share": model.square,
        "effectiveness_error": {motor: uncertainty.B_error[:, i].tolist() for i, motor in enumerate(motors)},
        "effectiveness_relative_error": dict(zip(motors, uncertainty.relative.tolist(), strict=True)),
    }


def _percentages(names: Sequence[str], shares: NDArray[np.float64]) -> str:
    return ", ".join(f"{name} {100 * share:.1f} %" for name, share in zip(names, shares, strict=True))


def _lines(
    watched: Mapping[str, float], smallest: Mapping[str, tuple[float, str]], alarms: Sequence[Calibrated]
) -> tuple[str, ...]:
    sudden = {calibrated.rule.channel: calibrated.rule.least for calibrated in alarms}
    lines = []
    for motor, command in watched.items():
        size, unit = smallest[motor]
        least = sudden[motor]
        from_size, at_once = size_text(size, unit, command), size_text(least, unit, command)
        sooner = f", {at_once} where it comes at once" if 0.0 < least < size and at_once != from_size else ""
        lines.append(f"{motor} alarm from {from_size}{sooner} (hovers at {command:.2f})")
    return tuple(lines)
