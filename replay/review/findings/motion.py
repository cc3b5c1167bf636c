"""Whether the vehicle moved as its actuators should have moved it: the rules of this stage."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from replay.review.facts.log_facts import Floats, LogFacts, LogSignal, degrees_apart, spans_where
from replay.review.findings.learned_alarms import alarms_of
from replay.review.findings.loss_of_control import (
    FULL,
    IDLE,
    in_control,
    lost_s,
    spans_in_control,
    stops,
    tilts_deg,
    tumbles,
    undisturbed,
)
from replay.review.findings.rule import Judgement, Rule

_ABOVE_OTHERS = 0.25
"""Chosen: how much less the others' mean is. Hard climbs take all motors to their most together; turns in yaw, two."""
_AT_LIMIT_S = 1.0
"""ArduPilot's thrust-loss check waits as long; a hard turn has motors at their most for less."""

_STEEP_DEG = 30.0
"""Tilt wanted beyond which a vehicle gathers speed (6 m/s2 and more), whose drag and lift turn it as a weak motor does:
default of PX4's and ArduPilot's position modes, half as much again in sports."""


def _motor_at_limit(facts: LogFacts, motors: LogSignal) -> Iterator[Judgement]:
    if len(motors.names) < 4:
        return
    for k, name in enumerate(motors.names):
        others, own = np.delete(motors.values, k, axis=1), motors.values[:, k]
        alone = (own > FULL) & (np.median(others, axis=1) < own - _ABOVE_OTHERS) & ~_dashes(facts, motors.time_s)
        for start, end in spans_in_control(facts, motors, alone, _AT_LIMIT_S)[:1]:
            mean = float(np.median(others[(motors.time_s >= start) & (motors.time_s <= end)]))
            yield Judgement(
                start_s=start,
                end_s=end,
                text=f"{name} was at full command for {end - start:.1f} s while the others were at {100 * mean:.0f} %: "
                "it, its ESC or its propeller gives too little",
                evidence=(f"{motors.origin}: {name} above {FULL:.2f}, median of the others {mean:.2f}",),
                weight="critical",
            )


def _dashes(facts: LogFacts, times_s: Floats) -> NDArray[np.bool_]:
    """Return at which of n times the autopilot wanted a steep tilt (n,): there the air turns a fast vehicle, too."""
    wanted = facts.signals.get("attitude_wanted")
    asked = np.zeros((len(times_s), 2)) if wanted is None else wanted.at(times_s)[:, :2]
    return np.asarray((np.abs(asked) > _STEEP_DEG).any(axis=1))


MOTOR_AT_LIMIT = Rule(
    name="motor_at_limit",
    title="One motor at its most",
    stage="motion",
    physics="The autopilot gives the motor that lifts too little more and more command, until there is no more.",
    evidence="one motor above 95 % for a second, the others' median 25 % of full command lower",
    counter=(
        "a hard climb takes all motors up, a turn in yaw the two that turn the same way",
        f"no more than {_STEEP_DEG:g} degrees of tilt were wanted: in a dash the air turns the vehicle, too",
    ),
    needs=("motors",),
    plots=("motors", "attitude", "rpm"),
    judge=_motor_at_limit,
    multirotor=True,
    least_hz=4.0,  # of a second four samples
)


_ACTUATORS = "motor", "esc", "prop", "aileron", "elevator", "rudder", "throttle", "steering"

ACTUATOR_EFFECT = Rule(
    name="actuator_effect",
    title="An actuator does less than it did",
    stage="motion",
    physics="Motion follows commands as the first 40 s of the flight show: a copter's angular acceleration follows its "
    "motors, a plane's body rates follow its surfaces times the dynamic pressure, its thrust (forward specific force "
    "and drag) the throttle, a rover's yaw rate its steering times the speed. An actuator that fails leaves that, "
    "whatever the autopilot does to hold the vehicle.",
    evidence="the observer designed from that model raises an alarm of one actuator until the flight ends, or for 12 s",
    counter=(
        "the same command had another effect before: what was so from the begin is how the vehicle is built",
        "wind and load move the estimates of all actuators together, hard turns those of one for some seconds",
        "a size that no actuator can have says that what was learned does not hold, and is not stated",
    ),
    needs=("watch",),
    plots=("motors", "attitude", "airspeed"),
    judge=partial(alarms_of, channels={_ACTUATORS: 1.0}),
)


_WANTED = 0.5
"""m/s down: a slow landing's speed (MPC_LAND_SPEED 0.7, LAND_SPEED 0.5)."""
_CLIMBS_S = 3.0
"""Chosen: an updraft or a stop from a fast climb lasts for two seconds, and a vehicle reaches 0.5 m/s in one."""
_NOT_DOWN = 0.0
"""m/s: it climbs."""
_ROUGH_S = 2.0
"""Over which a barometer's reading is averaged for its slope: at 2 to 10 readings a second of 0.2 m."""


def _descent_not_followed(
    facts: LogFacts, wanted: LogSignal, height: LogSignal, motors: LogSignal
) -> Iterator[Judgement]:
    times = height.time_s[in_control(facts, height.time_s)]
    if len(times) < 2:
        return
    smooth = _smoothed(height.time_s, height.only, times)
    slope = np.gradient(smooth, times)
    asked = wanted.at(times)[:, 0]
    collective = np.nanmean(motors.at(times), axis=1)
    typical = float(np.nanmedian(collective))
    not_down = (asked < -_WANTED) & (slope > _NOT_DOWN) & (collective < typical)
    for start, end in spans_where(times, not_down, _CLIMBS_S):
        within = (times >= start) & (times <= end)
        gained = float(smooth[within][-1] - smooth[within][0])
        if gained < 1.0:
            continue
        down = float(np.nanmedian(asked[within]))
        yield Judgement(
            start_s=start,
            end_s=end,
            text=f"the vehicle was to descend at {-down:.1f} m/s and climbed {gained:.1f} m instead, with its motors "
            f"at {100 * np.median(collective[within]):.0f} % of full command",
            evidence=(
                f"{wanted.origin}: {down:+.1f} m/s wanted (up is positive) for {end - start:.1f} s",
                f"{height.origin}: {gained:+.1f} m meanwhile",
                f"{motors.origin}: mean command {np.median(collective[within]):.2f}, {typical:.2f} over the flight",
            ),
        )


def _smoothed(time_s: Floats, values: Floats, at_s: Floats) -> Floats:
    """Return running means of a series at some times."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    first = np.searchsorted(time_s, at_s - _ROUGH_S / 2)
    last = np.searchsorted(time_s, at_s + _ROUGH_S / 2, side="right")
    return np.asarray((total[last] - total[first]) / np.maximum(last - first, 1), np.float64)


DESCENT_NOT_FOLLOWED = Rule(
    name="descent_not_followed",
    title="Descent not followed",
    stage="motion",
    physics="At the least thrust that the autopilot allows (PX4's MPC_THR_MIN, ArduPilot's SPIN_MIN) a light, strong "
    "vehicle still climbs: it cannot come down, and its landing detector may take that for the ground.",
    evidence="a descent wanted for 3 s, motors below their usual command, and the barometer 1 m higher at its end",
    counter=(
        f"an updraft or the end of a climb passes within {_CLIMBS_S:g} s",
        "the barometer says so by itself, whatever the estimator believed; rotors disturb it by less",
    ),
    needs=("climb_wanted", "height", "motors"),
    plots=("climb_wanted", "height", "motors"),
    judge=_descent_not_followed,
    multirotor=True,
)


_ON_PURPOSE = ("Acro", "ACRO", "FLIP", "RATTITUDE")
_STAYED_S = 1.0
"""Chosen: who is on its back so shortly before the flight ends did not fly on."""


def _turned_over(facts: LogFacts, attitude: LogSignal, _: LogSignal) -> Iterator[Judgement]:
    stopped = [start for start, _, _ in stops(facts)]
    for start, end in tumbles(facts)[:1]:
        if any(at < start for at in stopped):
            return
        modes = [
            statement.text for statement in facts.statements if statement.kind == "mode" and statement.time_s <= start
        ]
        stayed = any(until > facts.flight[-1][1] - _STAYED_S for _, until in tumbles(facts))
        meant = bool(modes) and any(word in modes[-1] for word in _ON_PURPOSE) and not stayed
        most = tilts_deg(attitude.during(start, end + 0.1)).max()
        yield Judgement(
            start_s=start,
            end_s=end,
            text=f"the vehicle turned over: {most:.0f} degrees from level for {end - start:.1f} s",
            evidence=(f"{attitude.origin}: beyond 100 degrees from level from {start:.2f} s on",),
            counter=(
                f"the mode was {modes[-1].removeprefix('mode ') if modes else 'not recorded'}"
                + (", in which pilots turn over on purpose" if meant else ""),
            ),
            confidence="possible" if meant else "certain",
            weight="information" if meant else "critical",
        )


TURNED_OVER = Rule(
    name="turned_over",
    title="Turned over",
    stage="motion",
    physics="With a motor or a propeller gone, or with a wrong attitude, a multirotor tumbles within a second.",
    evidence="100 degrees from level for 0.3 s in flight",
    counter=(
        "its motors had not been commanded to stop before",
        "flips in acro modes, after which it flies on, are information alone",
        "where an estimator errs there is no blow, no fall, and the accelerometer along the rotors does not hang",
    ),
    needs=("attitude", "motors"),
    plots=("attitude", "motors", "height"),
    judge=_turned_over,
    multirotor=True,
)


_APART_DEG = 30.0
"""ArduPilot's crash check has 30 degrees. Measured: in eleven healthy flights, some at full sticks and 60 degrees of
tilt, the attitude is at most 24 degrees behind for half a second."""
_APART_S = 0.5
"""Chosen: twice the time in which a multirotor rolls by its greatest angle."""


def _attitude_not_followed(
    facts: LogFacts, attitude: LogSignal, wanted: LogSignal, motors: LogSignal
) -> Iterator[Judgement]:
    times = attitude.time_s
    apart = _apart(attitude, wanted)
    end_s = lost_s(facts)
    # what came before the motors were stopped, and the tumbling itself; idle motors hold no attitude
    most = motors.at(times).max(axis=1)
    judged = facts.in_flight(times) & (times < end_s + _APART_S)
    judged &= most > IDLE * np.median(most[judged & np.isfinite(most)] if judged.any() else 0.0)
    far = (apart > _APART_DEG).any(axis=1) & judged
    # what never followed has not stopped to: an estimator that does not know its attitude yet
    far &= np.logical_or.accumulate(judged & ~far)
    spans = (span for span in spans_where(times, far, _APART_S) if _left(attitude, apart, *span))
    for start, end in [span for span in spans if not undisturbed(facts, span[0])][:1]:
        within = (times >= start) & (times <= end)
        axis = int(np.argmax(np.nanmax(apart[within], axis=0)))
        most = float(np.nanmax(apart[within, axis]))
        name = attitude.names[axis]
        about = motors.during(start - 1.0, start + 1.0)
        peaks = np.nanmax(about.values, axis=0, initial=0.0)
        full = [motor for motor, peak in zip(motors.names, peaks.tolist(), strict=True) if peak > FULL]
        yield Judgement(
            start_s=start,
            end_s=end,
            text=f"{name} went up to {most:.0f} degrees from what the autopilot wanted, for {end - start:.1f} s"
            + (f", with {' and '.join(full)} at full command" if full else ""),
            evidence=(
                f"{attitude.origin} against {wanted.origin}: {most:.0f} degrees apart in {name} from {start:.2f} s on",
                *([f"{motors.origin}: {', '.join(full)} at full command"] if full else []),
                *_high(facts, start),
            ),
            weight="critical",
        )


def _apart(attitude: LogSignal, wanted: LogSignal) -> Floats:
    """Return how far roll and pitch are from all that was wanted over the last half second (n, 2), degrees."""
    ways = [
        degrees_apart(attitude.values[:, :2], wanted.at(attitude.time_s - ago)[:, :2])
        for ago in np.linspace(0.0, _APART_S, _AGO)
    ]
    return np.asarray(np.fmin.reduce(ways))


def _left(attitude: LogSignal, apart: Floats, start_s: float, end_s: float) -> bool:
    """Return whether the attitude left what was wanted: on the ground sticks move, and the vehicle does not."""
    first, last = np.searchsorted(attitude.time_s, (start_s - 2 * _APART_S, end_s))
    moved = np.ptp(attitude.values[first:last, :2], axis=0)
    return bool((moved[apart[first:last].max(axis=0) > _APART_DEG] > _APART_DEG / 2).any())


_AGO = 6
"""Moments of that half second that are looked at: as many as the slowest log that is judged has, and two more."""


def _high(facts: LogFacts, at_s: float) -> Iterator[str]:
    height = facts.signals.get("height")
    if height is not None:
        yield f"{height.origin}: {height.at(np.array([at_s]))[0, 0]:.1f} m above where the log begins"


ATTITUDE_NOT_FOLLOWED = Rule(
    name="attitude_not_followed",
    title="Attitude not followed",
    stage="motion",
    physics="An autopilot holds roll and pitch within some degrees of what it wants as long as its motors have room. "
    "Where they do not (a motor lost, a load, a blow), the attitude leaves it.",
    evidence="30 degrees apart for half a second in flight, while motors were commanded to turn",
    counter=(
        "motors were commanded to turn until then, more than idle: it was not let fall",
        f"it is far from all that was wanted over the last {_APART_S:g} s: a vehicle at full sticks is not",
        "the attitude itself moved: on the ground sticks do, and the vehicle does not",
        "accelerometers or the barometer show a blow, a fall or a tilt, so far as the log has them",
    ),
    needs=("attitude", "attitude_wanted", "motors"),
    plots=("attitude", "attitude_wanted", "motors"),
    judge=_attitude_not_followed,
    multirotor=True,
    least_hz=7.5,  # of half a second four samples
)

RULES = MOTOR_AT_LIMIT, ACTUATOR_EFFECT, DESCENT_NOT_FOLLOWED, TURNED_OVER, ATTITUDE_NOT_FOLLOWED
