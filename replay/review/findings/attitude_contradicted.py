"""The estimator's attitude was so tilted that the vehicle would have fallen, and it did not fall."""

from collections.abc import Iterator

import numpy as np

from replay.review.facts.log_facts import LogFacts, LogSignal
from replay.review.findings.loss_of_control import FELL_M, spans_in_control, struck, tilts_deg
from replay.review.findings.rule import Judgement, Rule

_GRAVITY = 9.81
_LEANS_DEG = 45.0
"""Smallest tilt that is judged, degrees. Chosen: from there on an error of the attitude rotates the force by which it
is judged, whatever its own error."""
_LEAST_S = 3.0
"""Shortest time of such a tilt, seconds. Chosen: a vehicle that lacks 0.3 g falls 13 m in it, six times a barometer's
error when rotors change their speed."""
_BIAS = 1.0
"""Largest error of the accelerometers of a vehicle that flies, m/s2."""


def _judge(facts: LogFacts, attitude: LogSignal, force: LogSignal, height: LogSignal) -> Iterator[Judgement]:
    leans = tilts_deg(attitude)
    for start, end in spans_in_control(facts, attitude, leans > _LEANS_DEG, _LEAST_S):
        felt, heights = force.during(start, end), height.during(start, end).only
        if not len(felt.time_s) or not len(heights) or struck(facts, start):
            continue
        roll, pitch = np.radians(attitude.at(felt.time_s)[:, :2].T)
        x, y, z = felt.values.T
        # the part of gravity that is not compensated by the force, rotated by the attitude
        lacks = _GRAVITY - float(np.mean(np.sin(pitch) * x - np.cos(pitch) * (np.sin(roll) * y + np.cos(roll) * z)))
        # the least height change of such an acceleration: up to the vertex and down again
        if np.ptp(heights) < FELL_M and lacks > 8.0 * FELL_M / (end - start) ** 2 + _BIAS:
            said = float(np.median(leans[(attitude.time_s >= start) & (attitude.time_s <= end)]))
            yield Judgement(
                span=(start, end),
                text=f"the estimator had the vehicle {said:.0f} degrees from level for {end - start:.1f} s, and it did "
                "not fall: the estimator was wrong",
                evidence=(
                    f"{attitude.origin}: more than {_LEANS_DEG:g} degrees from level from {start:.1f} to {end:.1f} s",
                    f"{force.origin}: by that attitude it would have fallen with {lacks:.1f} m/s2",
                    f"{height.origin}: within {np.ptp(heights):.1f} m meanwhile",
                ),
                weight="critical",
            )


RULE = Rule(
    title="Attitude contradicted by accelerometers",
    stage="estimator",
    physics="Accelerometers feel thrust, drag and ground; turned upright by the true attitude these carry a vehicle "
    "that keeps its height. An estimator with a wrong gyro, or one that was never aligned, turns them aside.",
    evidence=f"{_LEANS_DEG:g} degrees from level for {_LEAST_S:g} s by the estimator, a height within {FELL_M:g} m, "
    "and accelerations that by that attitude do not carry the vehicle",
    counter=(
        "a dash that keeps its height is carried by its thrust and drag, at any tilt",
        "a vehicle that lies on its side has accelerometers that say so",
        "there was no blow in the seconds before: a crash leaves the estimator with a wrong attitude",
    ),
    needs=("attitude", "acceleration", "height"),
    plots=("attitude", "acceleration", "height"),
    judge=_judge,
    multirotor=True,
    least_hz=2.0,  # six samples in three seconds
)
