"""The vehicle had to descend and its thrust was low, but it did not descend."""

from collections.abc import Iterator

import numpy as np

from replay.review.facts.log_facts import Floats, LogFacts, LogSignal, spans_where
from replay.review.findings.loss_of_control import in_control
from replay.review.findings.rule import Judgement, Rule

_WANTED = 0.5
"""Smallest wanted descent, m/s: a slow landing's speed (MPC_LAND_SPEED 0.7, LAND_SPEED 0.5)."""
_LEAST_S = 3.0
"""Shortest time without descent, seconds. Chosen: an updraft or a stop from a fast climb lasts for two, and a vehicle
reaches 0.5 m/s in one."""
_NOT_DOWN = 0.0
"""Vertical speed above which the vehicle climbs, m/s."""
_ROUGH_S = 2.0
"""Time over which the barometer's height is averaged for its slope, seconds: it has 2 to 10 readings a second of 0.2
m."""


def _judge(facts: LogFacts, wanted: LogSignal, height: LogSignal, motors: LogSignal) -> Iterator[Judgement]:
    times = height.time_s[in_control(facts, height.time_s)]
    if len(times) < 2:
        return
    smooth = _smoothed(height.time_s, height.only, times)
    slope = np.gradient(smooth, times)
    asked = wanted.at(times)[:, 0]
    collective = np.nanmean(motors.at(times), axis=1)
    typical = float(np.nanmedian(collective))
    not_down = (asked < -_WANTED) & (slope > _NOT_DOWN) & (collective < typical)
    for start, end in spans_where(times, not_down, _LEAST_S):
        within = (times >= start) & (times <= end)
        gained = float(smooth[within][-1] - smooth[within][0])
        if gained < 1.0 or _received(facts, start, end) < gained / 2:
            continue
        down = float(np.nanmedian(asked[within]))
        yield Judgement(
            span=(start, end),
            text=f"the vehicle was to descend at {-down:.1f} m/s and climbed {gained:.1f} m instead, with its motors "
            f"at {100 * np.median(collective[within]):.0f} % of full command",
            evidence=(
                f"{wanted.origin}: {down:+.1f} m/s wanted (up is positive) for {end - start:.1f} s",
                f"{height.origin}: {gained:+.1f} m meanwhile",
                f"{motors.origin}: mean command {np.median(collective[within]):.2f}, {typical:.2f} over the flight",
            ),
        )


def _received(facts: LogFacts, start_s: float, end_s: float) -> float:
    """Return the climb (m) by the receiver's vertical speed; infinite if there is none.

    That speed is accurate to 0.05 m/s (data sheet of u-blox's M8), which is 0.2 m in the shortest of these climbs.
    """
    speed = facts.signal("climb_received").during(start_s, end_s)
    return float(np.mean(speed.only)) * (end_s - start_s) if speed else np.inf


def _smoothed(time_s: Floats, values: Floats, at_s: Floats) -> Floats:
    """Return running means of a series at some times."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    first = np.searchsorted(time_s, at_s - _ROUGH_S / 2)
    last = np.searchsorted(time_s, at_s + _ROUGH_S / 2, side="right")
    return np.asarray((total[last] - total[first]) / np.maximum(last - first, 1), np.float64)


RULE = Rule(
    title="Descent not followed",
    stage="motion",
    physics="At the least thrust that the autopilot allows (PX4's MPC_THR_MIN, ArduPilot's SPIN_MIN) a light, strong "
    "vehicle still climbs. It cannot descend, and its landing detector may take that for the ground.",
    evidence="a descent wanted for 3 s, motors below their usual command, and the barometer 1 m higher at its end",
    counter=(
        f"an updraft or the end of a climb passes within {_LEAST_S:g} s",
        "the barometer alone shows it, independent of the estimator, and the vertical speed by GPS half of it or more: "
        "near the ground slower rotors let the barometer read metres higher on a vehicle that stands",
    ),
    needs=("climb_wanted", "height", "motors"),
    plots=("climb_wanted", "height", "motors"),
    judge=_judge,
    multirotor=True,
)
