"""One motor was at full command for long, and the vehicle still turned towards it."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from replay.review.facts.log_facts import Floats, LogFacts, LogSignal, degrees_apart
from replay.review.findings.loss_of_control import FAST_M_S, FULL, spans_in_control, speed
from replay.review.findings.rule import Judgement, Rule

_APART = 0.25
"""Smallest difference to the others' median. Chosen: hard climbs take all motors to full command together; turns in
yaw, two."""
_LEAST_S = 1.0
"""Shortest time at full command, seconds: ArduPilot's thrust-loss check waits as long; a hard turn takes less."""

_STEEP_DEG = 25.0
"""Wanted tilt beyond which a vehicle gathers speed (4.6 m/s2 and more), so that drag and lift turn it as a weak motor
does. Sticks held at their end demand more (ArduPilot's ANGLE_MAX 30 degrees, PX4's MPC_MAN_TILT_MAX 35)."""
_LIMITS, _NEARLY = {"ANGLE_MAX": 100.0, "MPC_TILTMAX_AIR": 1.0, "MPC_MAN_TILT_MAX": 1.0}, 0.99
"""Parameters of the largest wanted tilt, with their parts of a degree, and the share of it that is as much: a vehicle
that wants no less is against the wind or at full stick. The share allows for a hundredth of rounding."""
_TURN_DEG, _TURN_S = 60.0, 1.0
"""Largest turn about the vertical that autopilots command, degrees in a second (ArduPilot's ATC_SLEW_YAW 60 degrees/s,
PX4's MPC_YAWRAUTO_MAX 60): a faster turn is commanded by sticks or is a spin, and takes its motors to their limits."""


def _judge(facts: LogFacts, motors: LogSignal) -> Iterator[Judgement]:
    if len(motors.names) < 4:
        return
    # in a dash the air turns the vehicle, too
    steep = min(_STEEP_DEG, *((facts.parameters.get(name) or np.inf) / unit for name, unit in _LIMITS.items()))
    dashes = (np.abs(facts.signal("attitude_wanted").at(motors.time_s)[:, :2]) > _NEARLY * steep).any(axis=1)
    dashes |= speed(facts).at(motors.time_s)[:, 0] > FAST_M_S
    for k, name in enumerate(motors.names):
        others, own = np.delete(motors.values, k, axis=1), motors.values[:, k]
        alone = (own > FULL) & (np.median(others, axis=1) < own - _APART) & ~(dashes | _beside(own, others))
        spans = spans_in_control(facts, motors, alone, _LEAST_S)
        for start, end in [(start, end) for start, end in spans if _turned_deg(facts, start) <= _TURN_DEG][:1]:
            mean = float(np.median(others[(motors.time_s >= start) & (motors.time_s <= end)]))
            yield Judgement(
                span=(start, end),
                text=f"{name} was at full command for {end - start:.1f} s while the others were at {100 * mean:.0f} %: "
                "the motor, its ESC or its propeller delivers too little",
                evidence=(f"{motors.origin}: {name} above {FULL:.2f}, median of the others {mean:.2f}",),
                weight="critical",
            )


def _beside(own: Floats, others: Floats) -> NDArray[np.bool_]:
    """Return the samples (n,) at which another motor is nearer to this one than to the rest: both turn the vehicle."""
    in_order = np.sort(others, axis=1)
    second = in_order[:, -1]
    return np.asarray(own - second < second - np.median(in_order[:, :-1], axis=1))


def _turned_deg(facts: LogFacts, before_s: float) -> float:
    """Return the angle by which a vehicle turned about the vertical in the second before a time, both ways added."""
    yaw = facts.signal("attitude").during(before_s - _TURN_S, before_s).values[:, 2:]
    return float(degrees_apart(yaw[1:], yaw[:-1]).sum())


RULE = Rule(
    title="One motor at full command",
    stage="motion",
    physics="The autopilot raises the command of a motor that lifts too little, up to full command.",
    evidence="one motor at 95 % or more for a second, with the others' median 25 % of full command lower",
    counter=(
        "a hard climb raises all motors; a turn in yaw, or contact with an obstacle, raises the two that turn the same "
        "way: here no other motor was nearer to this one than to the rest",
        f"the vehicle had yawed by no more than {_TURN_DEG:g} degrees in the second before",
        f"no more than {_STEEP_DEG:g} degrees of tilt, and less than the autopilot's limit, were wanted, and GPS speed "
        f"was no more than {FAST_M_S:g} m/s: in a dash the air turns the vehicle too",
    ),
    needs=("motors",),
    plots=("motors", "attitude", "rpm"),
    judge=_judge,
    multirotor=True,
    least_hz=4.0,  # four samples in a second
)
