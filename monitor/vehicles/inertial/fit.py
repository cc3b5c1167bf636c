"""The inertial observer of any vehicle: GPS, barometer, compass, gyro and accelerometer against each other."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from math import inf, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from adapters.errors import TelemetryError
from gains.identification.segment import Segment
from gains.synthesis.bank import compile_bank
from gains.synthesis.gains_file import Gains
from monitor.alarms.excuse import ExcuseRule
from monitor.display import size_text
from monitor.estimation.affine import AffineObserver
from monitor.estimation.changes import WINDOW_S, ChangeRule
from monitor.estimation.envelope import reached
from monitor.fitting.calibrate import LEVEL_SHARE, SETTLE_S, bank_rule
from monitor.fitting.changes import fit_changes, healthy_nats
from monitor.fitting.fitted import FitRequest, Fitted, bare_rule
from monitor.fitting.flights import Flight, raw_flights, transformed
from monitor.fitting.spread import fit_spread
from monitor.fitting.thresholds import (
    FALSE_ALARMS_PER_HOUR,
    Calibrated,
    Times,
    calibrated,
    healthy_evidence,
    healthy_levels,
    plain_only,
)
from monitor.profile import FaultChannel
from monitor.sampling.gate import GateRule
from monitor.sampling.transform import SampleSource, TransformRule
from monitor.vehicles.inertial.identify import (
    GPS_VELOCITY,
    MOTION,
    SMALLEST_GYRO,
    WASHED_FAULTS,
    inertial_bank,
    inertial_plant,
    smallest_faults,
)
from monitor.vehicles.inertial.readings import BENT_DOUBLE, BENT_SINGLE, HELD_PERIODS, frozen_times, holds, line_s
from monitor.vehicles.inertial.ros_signals import BARE_POSITIONS, BODY_VELOCITY
from monitor.vehicles.inertial.sensor_fit import (
    BARE_SETTLE_S,
    InertialData,
    InertialFit,
    Washouts,
    bare_positions,
    best_delays,
    delay_costs,
    field_noise,
    identify_inertial,
)
from monitor.vehicles.inertial.signals import (
    LEARNED_HOLD_S,
    NAVIGATED_HZ,
    StrapdownSource,
    common_channels,
    inertial_rate_hz,
    with_learned_biases,
)
from monitor.vehicles.inertial.strapdown import (
    ACCELEROMETERS,
    BAROMETER,
    FIX_S,
    GPS,
    LEARNED,
    MAGNETOMETER,
    SENSORS,
    LearnedBias,
    Strapdown,
)
from monitor.vehicles.multirotor.identify import GYROS

OBSERVER = "inertial"

_RATE_HZ = 25.0
"""Rate of the observer, hertz: GPS and barometer come at 5 to 25 Hz, and means over 40 ms lose nothing of the other
sensors."""
_FASTEST_HZ = 100.0
"""Fastest raw rate, hertz: strapdown integrals gain nothing above the bandwidth of the attitude."""
_WASHOUT_S = 30.0
"""Time constant with which positions and angles forget, seconds. Chosen: drifts of receivers and barometers are slower,
spoofs and failures faster."""
_VELOCITY_WASHOUT_S = 10.0
"""Time constant with which velocities forget, seconds: an attitude that is wrong by 10 mrad turns gravity into 1 m/s in
that time, the smallest fault that is looked for."""
_POSITION_WASHOUT_S = 3.0
"""Time constant with which positions without a velocity forget, seconds: they are compared with twice integrated
accelerations, and an attitude that is wrong by 10 mrad makes .9 m of them in that time."""
_SMOOTHING_S = 0.12
"""Time constant of the smoothing before hypotheses are compared, seconds: three samples."""
_WASHOUTS = Washouts(_WASHOUT_S, _VELOCITY_WASHOUT_S, _POSITION_WASHOUT_S)
_SETTLE_S = 5.0
"""Time before samples are evidence, seconds. Chosen: the transients of a restarted washout and the first swings after
take-off are over."""
# Times of the alarms: two and five samples of 40 ms; the time of the slow mean covers several fixes of a GPS.
_TIMES = Times(fast_s=0.08, raise_s=0.2, slow_s=4.0, clear_s=0.5)
_JUMP_S = 0.2
"""Duration of a jump of the GPS's velocity, seconds: a straight line from fix to fix of a receiver at 5 Hz."""
# What the navigation has decided needs no debounce.
_DECIDED = replace(_TIMES, fast_s=0.0, raise_s=0.0)
# A jump is known after the time of two means, before and after it: 1.1 s. A touchdown is a jump, too, and autopilots
# report it 1.2 to 1.5 s later (11 of 12 flights): another half second leaves them the time to report it.
_JUMP = Times(fast_s=0.5, raise_s=0.5, clear_s=0.5)
# A fault that may be any of a set waits until a jump would have been known.
_SET = Times(fast_s=9.0 * _JUMP_S, raise_s=9.0 * _JUMP_S, slow_s=4.0, clear_s=0.5)
# A gyro's bias b tilts the attitude. The tilt moves the magnetic heading by 10 degrees after 0.09 / b seconds (dip of
# 63 degrees), and raises the alarm of the motion after sqrt(0.2 / b), at most 0.6 s later. The compass waits for that
# time.
_TILTED = Times(fast_s=_SET.raise_s + 0.6, raise_s=_SET.raise_s + 0.6, slow_s=4.0, clear_s=0.5)
_SUDDEN = {
    **dict.fromkeys(("gps_north", "gps_east", "gps_down"), GPS[0]),
    "baro": BAROMETER[0],
    "compass": MAGNETOMETER[0],
}
"""Faults whose beginning is detected by likelihood, and a signal that shows each of them. A receiver drifts by its
threshold within the washout; as a random walk, it drifts within the test's window by the square root of that share
of time: a position that moved further is no drift. Wind and currents act on barometer and compass at once and in
full."""
_MOST_OF_JUMPS = 1.5
"""Largest ratio of the level to the largest healthy step: steps are too rare to fit a tail to them."""
_TRIAL_DELAYS_S = tuple(0.04 * step for step in range(8))
"""Delays to try, seconds, one sample apart. Chosen: receivers with a delay of more than 0.28 s are rare."""
_TRIAL_S = 90.0
"""Length of the part of each flight, from its middle, on which delays are tried, seconds. Chosen: it holds several
manoeuvres, and a trial takes some seconds."""
_LEAST_LEVEL = float(-np.log(FALSE_ALARMS_PER_HOUR / 3600.0 * 0.2))
"""Least level of the log-likelihood: 12.1, from the granted rate of false alarms at five comparisons a second
(Wald)."""
_LEVEL_MARGIN = 1.5
"""Ratio of the level from which a fault is believed to the largest score of healthy flight. Chosen: the score of a
bank's hypotheses gets a factor of two, which would be four for a likelihood, its square; the score of a fault grows
a hundredfold within seconds."""
_NEVER = 1e9
"""A level that no score reaches."""
_CRITICAL = 5.0
"""Ratio of the critical size to the smallest one that is worth an alarm."""

_FLYING = ("rotor", "copter", "wing", "vtol")
"""Words in the types of vehicles that fly."""
_POSITION = ("gps_north", "gps_east")
_HEIGHT = ("gps_down", "baro")
_POOLS = (_POSITION, MOTION, GPS_VELOCITY, GYROS)

_EXCUSES = (
    # A jump of a gyro, or an estimator that receives a wrong GPS, tilts the attitude: motion forgets the tilt with its
    # washout.
    ExcuseRule(MOTION, (*GYROS, *ACCELEROMETERS, *_POSITION, *GPS_VELOCITY), 2.0 * _VELOCITY_WASHOUT_S, precedes=True),
    # The position is compared with the velocity: if the velocity is wrong, the position is not responsible.
    ExcuseRule(_POSITION, GPS_VELOCITY, 0.5 * _VELOCITY_WASHOUT_S),
    # With a tilted attitude, the dip of the magnetic field appears as heading (forgotten with the washout of angles),
    # and gravity as less than it is.
    ExcuseRule(("compass",), (*GYROS, *MOTION), 2.0 * _WASHOUT_S),
    ExcuseRule(("accel_z",), (*GYROS, *MOTION), 2.0 * _VELOCITY_WASHOUT_S),
    # An estimator that received a wrong GPS tilts the attitude, and later takes the tilt back without a rotation.
    ExcuseRule(GYROS, _POSITION, 2.0 * _VELOCITY_WASHOUT_S),
)


def fit_alone(request: FitRequest) -> tuple[Fitted, GateRule]:
    """Fit the inertial observer alone. If the vehicle does not fly, samples are evidence whenever it is armed."""
    names = [name for survey in request.surveys for name in survey.vehicle_types]
    gate = GateRule(settle_s=SETTLE_S, require_airborne=any(word in name for name in names for word in _FLYING))
    return fit_inertial(request, gate, alone=True), gate


def fit_inertial(request: FitRequest, gate: GateRule, *, alone: bool = False) -> Fitted:
    """Measure on healthy recordings how well the sensors agree, design the bank, calibrate its alarms.

    ``alone``: it is the vehicle's only observer, so that the user may choose its rate.

    Raises
    ------
    TelemetryError, ModelError, InfeasibleError
        Attitude or inertial measurements are missing, or too little healthy motion was recorded.
    """
    surveys = request.surveys
    channels = common_channels(surveys)
    settle_s = BARE_SETTLE_S if channels.parameters["gps"] == BARE_POSITIONS else _SETTLE_S
    gate = replace(gate, settle_s=max(gate.settle_s, settle_s))
    if (learned := with_learned_biases(surveys, channels)) is not None and _told(*_sampled(request, learned, gate)[:2]):
        channels = learned
    raw, signal_hz, rate_hz = _sampled(request, channels, gate)
    if alone:
        rate_hz = request.fraction_hz(signal_hz, rate_hz)
    parameters = {
        **channels.parameters,
        "washout_s": _WASHOUT_S,
        "velocity_washout_s": _VELOCITY_WASHOUT_S,
        **({"position_washout_s": _POSITION_WASHOUT_S} if channels.parameters["gps"] == BARE_POSITIONS else {}),
    }
    parameters |= holds(surveys, channels.channels, raw, signal_hz)
    parameters |= frozen_times(raw, channels.channels, signal_hz, FALSE_ALARMS_PER_HOUR / len(SENSORS))
    parameters |= _delays(raw, parameters, signal_hz, rate_hz)
    if channels.parameters["gps"] in (1.0, BODY_VELOCITY) and channels.imu and signal_hz >= NAVIGATED_HZ:
        if parameters["magnetometer"]:
            parameters |= _field(raw, parameters, signal_hz, rate_hz)
        parameters["judge_level"] = _judge_level(raw, parameters, signal_hz, rate_hz)
    found = _designed(request, channels, raw, gate, parameters, signal_hz, rate_hz, settle_s)
    gyro = next((alarm.rule for alarm in found.alarms if alarm.rule.channel in GYROS), None)
    if gyro is not None and "judge_level" in parameters and gyro.threshold > SMALLEST_GYRO:
        # The gyro estimates of the navigation are not limited by how well the attitude agrees with the gyros.
        parameters["attitude_share"] = round(SMALLEST_GYRO / gyro.threshold, 3)
        found = _designed(request, channels, raw, gate, parameters, signal_hz, rate_hz, settle_s)
    return found


def _designed(
    request: FitRequest,
    channels: StrapdownSource,
    raw: Sequence[Flight],
    gate: GateRule,
    parameters: Mapping[str, float],
    signal_hz: float,
    rate_hz: float,
    settle_s: float,
) -> Fitted:
    """Design the bank of a transform with these parameters, and calibrate its alarms."""
    rule = TransformRule("strapdown", signal_hz, parameters)
    flights = [transformed(flight, Strapdown(parameters, signal_hz, rate_hz)) for flight in raw]
    segments = [segment for flight in flights for segment in flight.segments()]
    transform = Strapdown(parameters, signal_hz, rate_hz)
    fit = identify_inertial(_data(segments, transform, rate_hz))
    plant = inertial_plant(fit, request.name)
    gains = compile_bank(plant, inertial_bank(plant))
    if "judge_level" in parameters:
        parameters = {**parameters, **_bias_angles(gains)}
        rule = replace(rule, parameters=parameters)
    names = {fault.name for fault in plant.faults}
    bare = {f"gps_{axis}" for axis in bare_positions(fit.inputs, fit.outputs)}
    isolation = bank_rule(
        gains,
        segments,
        smoothing_s=_SMOOTHING_S,
        settle_s=settle_s,
        noise=np.array([fit.noise[output] for output in fit.outputs]),
        # positions that are washed out twice: nothing of a lasting fault is left to be given back
        washouts={fault: _WASHOUT_S for fault in WASHED_FAULTS if fault in names - bare},
        edges=GPS_VELOCITY,
        jump_s=_JUMP_S,
        level_s=LEVEL_SHARE * _TIMES.slow_s,
    )
    source = SampleSource(transform=rule, signals=channels.channels)
    designed = Fitted(OBSERVER, gains, source, isolation, settle_s=settle_s, plant=plant)
    own = healthy_evidence(designed.profile(), gate, flights, own=True)
    lasting = round(_JUMP.raise_s * rate_hz)
    jumps = [part[: max(0, len(part) - lasting)] for part in healthy_evidence(designed.profile(), gate, flights)]
    alarms = _alarms(designed.profile().faults, own, jumps, rate_hz, smallest_faults(fit), bare)
    if not channels.imu:
        # without an IMU these estimates show only how far the vehicle is from hovering
        silent = {*MOTION, *GPS_VELOCITY, "accel_z"} | (set() if LEARNED in parameters else set(GYROS))
        alarms = [found for found in alarms if found.rule.channel not in silent]
    watched, signals = {found.rule.channel for found in alarms}, [channel.name for channel in channels.channels]
    lines_s = {
        # a GPS's fixes alone are of double precision
        name: line_s(raw, signals.index(signal), signal_hz, BENT_DOUBLE if signal == GPS[0] else BENT_SINGLE)
        for name, signal in _SUDDEN.items()
        if name in watched and signal in signals
    }
    changes, alarms = _sudden(lines_s if channels.imu else {}, designed, alarms, flights, smallest_faults(fit))
    return replace(
        designed,
        **fit_spread(replace(designed, lines_s=lines_s).profile(), plant, gate, flights)._asdict(),
        lines_s={} if changes else lines_s,
        alarms=tuple(alarms),
        changes=changes,
        envelope=reached(transform.signals, [flight.samples.u[flight.armed] for flight in raw], signal_hz),
        flight_s=fit.seconds,
        findings=_findings(fit, parameters),
        lines=_lines(parameters, alarms, channels.imu),
        excuses=_EXCUSES,
    )


def _sudden(
    lasts_s: Mapping[str, float],
    designed: Fitted,
    alarms: Sequence[Calibrated],
    flights: Sequence[Flight],
    smallest: Mapping[str, float],
) -> tuple[ChangeRule | None, list[Calibrated]]:
    """Return the rule for sudden faults of GPS, barometer and compass, and the alarms with that path."""
    rate_hz, plant = designed.gains[0].rate_hz, designed.plant
    outputs = [output for output in plant.outputs if output not in ACCELEROMETERS]
    if rate_hz < NAVIGATED_HZ or not lasts_s or bare_positions(plant.inputs, plant.outputs):
        return None, list(alarms)
    changes = fit_changes(plant, rate_hz, outputs, flights, lasts_s)
    if changes is None:
        return None, list(alarms)
    faults = designed.profile().faults
    share = FALSE_ALARMS_PER_HOUR / len(faults)
    nats = healthy_nats(plant, rate_hz, faults, changes, flights, share)
    drifts = sqrt(WINDOW_S / _WASHOUT_S)
    sudden = []
    for found in alarms:
        rule = found.rule
        if rule.channel in lasts_s:
            least = rule.threshold
            if rule.channel in (*_POSITION, *_HEIGHT):
                least *= drifts
            if rule.channel in _HEIGHT:
                # gusts and the ground move the pressure, and so the height, within a second
                least = max(least, smallest[rule.channel])
            rule = replace(rule, nats=nats.level, least=float(f"{least:.4g}"))
            sudden.append(replace(found, rule=rule, sudden=nats, sharing=len(lasts_s)))
        else:
            sudden.append(found)
    return changes, sudden


def _data(segments: Sequence[Segment], transform: Strapdown, rate_hz: float) -> InertialData:
    """Return the signals in which the sensors are compared."""
    return InertialData(segments, transform.inputs, transform.outputs, rate_hz, _WASHOUTS)


def _field(
    raw: Sequence[Flight], parameters: Mapping[str, float], signal_hz: float, rate_hz: float
) -> dict[str, float]:
    """Return noise and random walk of the magnetic field's direction, as the navigation uses it."""
    transform = Strapdown(parameters, signal_hz, rate_hz)
    flights = [transformed(flight, Strapdown(parameters, signal_hz, rate_hz)) for flight in raw]
    segments = [segment for flight in flights for segment in flight.segments()]
    over_s = max(FIX_S, parameters.get("compass_hold_s", 0.0) / HELD_PERIODS)
    values = field_noise(_data(segments, transform, rate_hz), over_s)
    return {key: float(f"{value:.3g}") for key, value in values.items()}


def _judge_level(raw: Sequence[Flight], parameters: Mapping[str, float], signal_hz: float, rate_hz: float) -> float:
    """Return the likelihood, as a logarithm, from which the navigation holds a gyro or accelerometer responsible."""
    scores = []
    for flight in raw:
        transform = Strapdown({**parameters, "judge_level": _NEVER}, signal_hz, rate_hz)
        given = transformed(flight, transform)
        scores += [transform.scores[rows] for rows in given.stretches(at_restart=False)]
    largest = max((float(score.max(initial=0.0)) for score in scores), default=0.0)
    return round(max(_LEAST_LEVEL, _LEVEL_MARGIN * largest), 1)


def _bias_angles(gains: Sequence[Gains]) -> dict[str, float]:
    """Return the angle about each axis from which a gyro's estimate jumps by 1 rad/s, seconds.

    After some samples of rise, the estimate follows a constant angle as exp(-t / T) / T, and a bias that ends as
    exp(-t / T). If the rotation is set back by T times the bias, the estimate jumps, and stays there.
    """
    angles, rows = {}, round(gains[0].rate_hz)
    for gyro in GYROS:
        single = next(single for single in gains if gyro in single.faults)
        y = np.zeros((rows, len(single.outputs)))
        y[1:, single.outputs.index(f"rotation_{gyro[-1]}")] = 1.0
        run = AffineObserver([single]).run(np.zeros((rows, len(single.inputs))), y)
        jump = np.abs(run.fault[:, single.faults.index(gyro)]).max()
        angles[f"bias_angle_{gyro[-1]}_s"] = round(1.0 / float(jump), 4)
    return angles


def _sampled(request: FitRequest, source: StrapdownSource, gate: GateRule) -> tuple[list[Flight], float, float]:
    """Return the flights' raw signals, their rate, and the rate of the observer, which is a whole fraction of it."""
    signal_hz = min(inertial_rate_hz(request.surveys, source), _FASTEST_HZ)
    rate_hz = signal_hz / max(1, round(signal_hz / _RATE_HZ))
    if LEARNED in source.parameters:
        # tells which messages came at the same time
        signal_hz *= max(1, round(_RATE_HZ / signal_hz))
    return raw_flights(request.logs, source.channels, signal_hz, gate), signal_hz, rate_hz


def _told(raw: Sequence[Flight], signal_hz: float) -> bool:
    """Return whether every flight shows most of the time the bias that its estimator has learned of the gyros."""
    hold = round(LEARNED_HOLD_S * signal_hz)
    lost = [LearnedBias(hold).run(flight.samples).lost[flight.evidence, 3] for flight in raw]
    return all(2 * missing.sum() < len(missing) for missing in lost)


def _delays(
    raw: Sequence[Flight], parameters: Mapping[str, float], signal_hz: float, rate_hz: float
) -> dict[str, float]:
    """Return the delays of GPS, barometer and compass, from trial delays over the middle of each flight."""
    keys = ("gps_delay_s", "baro_delay_s", "compass_delay_s")
    length = round(_TRIAL_S * signal_hz)
    trials = {}
    for delay in _TRIAL_DELAYS_S:
        values = {**parameters, **dict.fromkeys(keys, delay)}
        segments = []
        for flight in raw:
            evidence = flight.evidence
            if not len(evidence):
                continue
            start = int(max(evidence[0], evidence[len(evidence) // 2] - length // 2))
            transform = Strapdown(values, signal_hz, rate_hz)
            segments += transformed(flight.part(start, start + length), transform).segments()
        longest = [segment for segment in segments if len(segment.u) > 10 * rate_hz]
        if not longest:
            raise TelemetryError("no 10 s of healthy motion in the logs; record it moving, armed and in the air")
        trials[delay] = delay_costs(_data(longest, transform, rate_hz))
    return best_delays(trials)


def _alarms(
    channels: Sequence[FaultChannel],
    own: Sequence[NDArray[np.float64]],
    jumps: Sequence[NDArray[np.float64]],
    rate_hz: float,
    smallest: Mapping[str, float],
    swinging: Collection[str],
) -> list[Calibrated]:
    """Return the alarms. Channels of one kind share their levels: one axis may have seen what another has not.

    ``own`` is the evidence of each fault under its own hypothesis. ``jumps`` is the evidence of edges, which appear for
    a moment only, without the edges that would end too soon to raise an alarm.
    """
    share = FALSE_ALARMS_PER_HOUR / len(channels)
    places = {channel.name: at for at, channel in enumerate(channels)}
    decided = (*ACCELEROMETERS, *GYROS) if places.keys() & set(ACCELEROMETERS) else ()
    alarms = []
    for channel in channels:
        edges = channel.name in GPS_VELOCITY
        times = _JUMP if edges else _SET if channel.name in MOTION else _TIMES
        times = _DECIDED if channel.name in decided else times
        if channel.name == "compass" and places.keys() & set(MOTION):
            times = _TILTED
        pool = next((pool for pool in _POOLS if channel.name in pool), (channel.name,))
        evidence = jumps if edges else own
        series = [stretch[:, places[name]] for name in pool if name in places for stretch in evidence]
        floor = smallest[channel.name]
        shown = replace(times, fast_s=0.0, raise_s=0.0) if edges else times
        levels = healthy_levels(series, rate_hz, share, shown, _MOST_OF_JUMPS if edges else inf)
        bare = bare_rule(OBSERVER, channel.name, channel.kind, channel.unit)
        found = calibrated(bare, levels, 1.0, floor=floor, critical=_CRITICAL * floor, times=times)
        if channel.name in decided or channel.name == "compass":
            # Half of that is no fault: gyros drift by it as they warm up, and where the field dips by 69 degrees an
            # attitude that is wrong by 2 degrees, as a plane's is in gusts, turns the heading by 5. What the navigation
            # has decided needs no mean.
            found = replace(found, rule=replace(found.rule, slow=max(found.rule.slow, found.rule.threshold)))
        if channel.unit == "rad" and found.rule.threshold > pi:
            continue  # no heading is off by more than that
        if edges:
            found = plain_only(found)
        # a jump that is washed out twice swings back by a seventh of its size, which the slow mean does not allow for
        alarms.append(replace(found, rule=replace(found.rule, slow=inf)) if channel.name in swinging else found)
    return alarms


def _findings(fit: InertialFit, parameters: Mapping[str, float]) -> dict[str, object]:
    return {
        "rate_hz": fit.rate_hz,
        "delays_s": {
            key.removesuffix("_delay_s"): value for key, value in parameters.items() if key.endswith("_delay_s")
        },
        "noise": dict(fit.noise),
        "disturbance": dict(fit.disturbance),
        "speed_scale": dict(fit.speed_scale),
    }


def _lines(parameters: Mapping[str, float], alarms: Sequence[Calibrated], imu: bool) -> tuple[str, ...]:
    late = ", ".join(
        f"{key.removesuffix('_delay_s')} {value:.2f} s" for key, value in parameters.items() if "delay" in key
    )
    sizes = ", ".join(f"{found.rule.channel} {size_text(found.rule.threshold, found.rule.unit)}" for found in alarms)
    if parameters["magnetometer"] and not any(found.rule.channel == "compass" for found in alarms):
        sizes += "; no compass: in healthy flight it is off by as much as any fault could make it"
    if not imu:
        gyros = "; gyros by what the autopilot's estimator learns of their bias, in some 10 to 20 s"
        compared = "no IMU of 10 Hz or more: GPS and barometer against each other and the attitude"
        return (compared + gyros * (LEARNED in parameters), f"alarms from: {sizes}")
    return (f"late against the IMU: {late}", f"alarms from: {sizes}")
