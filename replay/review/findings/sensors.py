"""Whether the sensors measured what was so: the rules of this stage."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from math import inf

import numpy as np

from replay.review.facts.log_facts import FIX_3D, LogFacts, LogSignal, spans_where
from replay.review.findings.learned_alarms import alarms_of
from replay.review.findings.loss_of_control import in_control, spans_in_control
from replay.review.findings.rule import Judgement, Rule

_LOST_S = 1.0
"""Chosen: five fixes of a receiver of usual rates."""


def _gps_lost(facts: LogFacts, gps: LogSignal) -> Iterator[Judgement]:
    known = np.logical_or.accumulate((gps.only >= FIX_3D) & in_control(facts, gps.time_s))
    for start, end in spans_in_control(facts, gps, known & (gps.only < FIX_3D), _LOST_S)[:1]:
        fewest = int(gps.during(start, end).values[:, 1].min())
        yield Judgement(
            start_s=start,
            end_s=end,
            text=f"GPS lost its fix for {end - start:.1f} s in flight, with {fewest} satellites",
            evidence=(f"{gps.origin}: fix below 3 from {start:.1f} to {end:.1f} s, {fewest} satellites at least",),
            confidence="certain",
        )


GPS_LOST = Rule(
    name="gps_lost",
    title="GPS fix lost in flight",
    stage="sensor",
    physics="Without a fix the estimator goes on by inertia alone, and drifts by metres within seconds.",
    evidence="no fix of three dimensions for a second in flight, after one",
    counter=(
        "the estimator used GPS in this flight: where vision or flow is used, a receiver moves nothing",
        "it had a fix before",
    ),
    needs=("gps",),
    plots=("gps", "ratios", "height_estimate"),
    judge=_gps_lost,
)


_STUCK_S = 2.0
"""Chosen: ten fixes of a receiver of usual rates."""
_JUMP_M = 5.0
"""Metres: twice the 2.5 m by which half of a receiver's fixes are off (data sheet of u-blox's M8). Measured in 239
simulated and public logs: of the positions repeated for 2 s in flight none but those of three logs with a faulty GPS
is as far off afterwards."""


def _gps_stuck(facts: LogFacts, position: LogSignal) -> Iterator[Judgement]:
    steps = np.append(np.hypot(*np.diff(position.values, axis=0).T), np.nan)
    for start, end in spans_in_control(facts, position, steps == 0.0, _STUCK_S):
        jump = float(steps[np.searchsorted(position.time_s, end)])
        if jump > _JUMP_M:
            yield Judgement(
                start_s=start,
                end_s=end,
                text=f"GPS repeated one position for {end - start:.1f} s and then was {jump:.0f} m away",
                evidence=(
                    f"{position.origin}: the same position from {start:.1f} to {end:.1f} s, then {jump:.1f} m off",
                ),
            )


GPS_STUCK = Rule(
    name="gps_stuck",
    title="GPS repeated a position",
    stage="sensor",
    physics="A receiver that computes fixes gives another centimetre each time. One that is stuck, or whose last fix "
    "is sent again and again, holds the estimator where the vehicle no longer is.",
    evidence="the same position for 2 s of flight, the next one more than 5 m away",
    counter=(
        "a receiver may hold its position while a vehicle hovers, but is where it was afterwards",
        "one that the estimator does not use (vision, flow) moves nothing, but is stuck all the same",
    ),
    needs=("position",),
    plots=("position", "ratios", "height_estimate"),
    judge=_gps_stuck,
)


_OUTSIDE = 3.0
"""Measured on fifteen healthy flights learned from their first 40 s: alarms of GPS that last come up to 1.9 times their
threshold (wind that the begin did not have), of gyros and accelerometers none lasts. Of faults they are 3.2 times and
more; smaller ones stay information."""


_CHANNELS = {("gyro_", "accel_"): 1.0, ("gps_", "baro", "motion_"): _OUTSIDE, ("compass",): inf}
"""How many times its threshold an alarm has to be, by the begin of the channel's name. Of a compass it stays
information: its error goes with the heading, of which 40 s show a few (14 degrees in a healthy flight that turned)."""

SENSOR_EFFECT = Rule(
    name="sensor_effect",
    title="A sensor disagrees with the others",
    stage="sensor",
    physics="GPS, barometer, compass, gyros and accelerometers are tied by kinematics: what one says beside the others "
    "is estimated, with the noise of the flight's own first 40 s.",
    evidence="the observer raises an alarm of one sensor until the flight ends, or for 12 s; of GPS "
    "and barometer at 3 times its threshold",
    counter=(
        "it agreed with the other sensors over the begin of the flight, and they agree with each other meanwhile",
        "wind that the begin did not have moves estimates of GPS: up to 2.5 m, its own accuracy, is no finding",
    ),
    needs=("watch",),
    plots=("height", "height_estimate", "ratios"),
    judge=partial(alarms_of, channels=_CHANNELS),
)


_ARDUPILOT, _PX4 = 60.0, 9.81
"""m/s2. ArduPilot's documentation: above 60 problems with height are nearly certain (below 30 is normal); PX4's
flight review draws its metric red from 9.81 on."""
_SHARE = 0.2
"""Chosen: over a fifth of the flight; single peaks are landings and touches."""
_CLIPPED = 100
"""ArduPilot's documentation: a steadily rising count of clipping, above 100 in a flight, is a problem."""


def _vibration(facts: LogFacts, vibration: LogSignal) -> Iterator[Judgement]:
    limit = _ARDUPILOT if facts.autopilot == "ArduPilot" else _PX4
    times = vibration.time_s
    judged = in_control(facts, times)
    high = judged & (vibration.only > limit)
    clipped = _clipped(facts)
    if not judged.any() or (high.sum() < _SHARE * judged.sum() and clipped < _CLIPPED):
        return
    most = float(np.max(vibration.only[judged]))
    spans = spans_where(times, high) or [(float(times[judged][0]), float(times[judged][-1]))]
    yield Judgement(
        start_s=spans[0][0],
        end_s=spans[-1][1],
        text=f"strong vibration, up to {most:.0f} m/s2"
        + (f", and {clipped:.0f} clipped samples of an accelerometer" if clipped else ""),
        evidence=(
            f"{vibration.origin}: above {limit:g} m/s2 in {100 * high.sum() / judged.sum():.0f} % of the flight",
            *([f"{facts.signals['clipping'].origin}: {clipped:.0f} clipped samples in flight"] if clipped else []),
        ),
        weight="warning" if clipped >= _CLIPPED else "information",
        event=False,
    )


def _clipped(facts: LogFacts) -> float:
    clipping = facts.signals.get("clipping")
    if clipping is None:
        return 0.0
    judged = clipping.only[in_control(facts, clipping.time_s)]
    return float(judged[-1] - judged[0]) if len(judged) else 0.0


VIBRATION = Rule(
    name="vibration",
    title="Strong vibration",
    stage="sensor",
    physics="Vibration beyond an accelerometer's range is cut off on one side more than on the other: the estimator "
    "sees an acceleration that is not there, in height first.",
    evidence="the autopilot's own level beyond its documented limit in a fifth of the flight, or 100 clipped samples",
    counter=("landings and what came after a fall are left out", "where little is clipped it is information alone"),
    needs=("vibration",),
    plots=("vibration", "clipping", "acceleration"),
    judge=_vibration,
)

RULES = GPS_LOST, GPS_STUCK, SENSOR_EFFECT, VIBRATION
