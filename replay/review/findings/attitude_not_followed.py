"""The vehicle's roll or pitch was far from the attitude that its autopilot wanted."""

from collections.abc import Iterator

import numpy as np

from replay.review.facts.log_facts import Floats, LogFacts, LogSignal, degrees_apart, spans_where
from replay.review.findings.loss_of_control import FULL, IDLE, lost_s, undisturbed
from replay.review.findings.rule import Judgement, Rule

_APART_DEG = 30.0
"""Smallest deviation, degrees: ArduPilot's crash check has 30. Measured: in eleven healthy flights, some at full sticks
and 60 degrees of tilt, the attitude is at most 24 degrees behind for half a second."""
_APART_S = 0.5
"""Shortest deviation, seconds. Chosen: twice the time in which a multirotor rolls by its greatest angle."""


def _judge(facts: LogFacts, attitude: LogSignal, wanted: LogSignal, throttle: LogSignal) -> Iterator[Judgement]:
    times = attitude.time_s
    apart = _apart(attitude, wanted)
    end_s = lost_s(facts)
    # judged is the flight until the motors were stopped, and the tumbling itself; idle motors hold no attitude
    commanded = throttle.at(times)[:, 0]
    judged = facts.in_flight(times) & (times < end_s + _APART_S) & np.isfinite(commanded)
    usual = np.median(commanded[judged] if judged.any() else 0.0)
    judged &= commanded > IDLE * usual
    far = (apart > _APART_DEG).any(axis=1) & judged
    # in acro PX4 wants turn rates, and sends no attitude
    sent = np.searchsorted(wanted.time_s, times, side="right") - 1
    far &= times - wanted.time_s[sent] < _APART_S
    # the attitude must have followed before: an estimator may not know its attitude yet
    far &= np.logical_or.accumulate(judged & ~far)
    motors, height = facts.signal("motors"), facts.signal("height")
    spans = (span for span in spans_where(times, far, _APART_S) if _left(attitude, apart, *span))
    for start, end in [span for span in spans if not undisturbed(facts, span[0])][:1]:
        within = (times >= start) & (times <= end)
        axis = int(np.argmax(np.nanmax(apart[within], axis=0)))
        most = float(np.nanmax(apart[within, axis]))
        name = attitude.names[axis]
        origins = " and ".join(dict.fromkeys((attitude.origin, wanted.origin)))
        high = height.at(np.array([start]))[0, 0]
        about = motors.during(start - 1.0, start + 1.0)
        usual_then = np.median(about.values, axis=0) if about else np.zeros(len(motors.names))
        full = [motor for motor, command in zip(motors.names, usual_then.tolist(), strict=True) if command > FULL]
        yield Judgement(
            span=(start, end),
            text=f"{name} was up to {most:.0f} degrees off the wanted value, for {end - start:.1f} s"
            + (f", with {' and '.join(full)} at full command" if full else ""),
            evidence=(
                f"{origins}: {name} and the {name} wanted up to {most:.0f} degrees apart, from {start:.2f} s on",
                *([f"{motors.origin}: {', '.join(full)} at full command"] if full else []),
                *([f"{height.origin}: {high:.1f} m above the begin of the log"] if height else []),
            ),
            weight="critical",
        )


def _apart(attitude: LogSignal, wanted: LogSignal) -> Floats:
    """Return the distance of roll and pitch from all values wanted over the last half second (n, 2), degrees."""
    ways = [
        degrees_apart(attitude.values[:, :2], wanted.at(attitude.time_s - ago)[:, :2])
        for ago in np.linspace(0.0, _APART_S, _AGO)
    ]
    return np.asarray(np.fmin.reduce(ways))


def _left(attitude: LogSignal, apart: Floats, start_s: float, end_s: float) -> bool:
    """Return whether the attitude itself moved away: on the ground only the sticks move."""
    first, last = np.searchsorted(attitude.time_s, (start_s - 2 * _APART_S, end_s))
    moved = np.ptp(attitude.values[first:last, :2], axis=0)
    return bool((moved[apart[first:last].max(axis=0) > _APART_DEG] > _APART_DEG / 2).any())


_AGO = 6
"""Moments of that half second that are compared: two more samples than the slowest judged log has."""


RULE = Rule(
    title="Attitude not followed",
    stage="motion",
    physics="An autopilot holds roll and pitch within some degrees of the wanted values as long as its motors have "
    "room. If they have none (a lost motor, a load, a blow), the attitude departs.",
    evidence="30 degrees off for half a second in flight, while motors were commanded to turn",
    counter=(
        "motors were commanded above idle until then: the autopilot did not drop the vehicle",
        f"it is far from every value wanted in the last {_APART_S:g} s; with full sticks it would not be",
        "the attitude itself moved; on the ground only the sticks would",
        "accelerometers or the barometer show a blow, a fall or a tilt, if the log has them",
    ),
    needs=("attitude", "attitude_wanted", "throttle"),
    plots=("attitude", "attitude_wanted", "motors", "throttle"),
    judge=_judge,
    multirotor=True,
    least_hz=7.5,  # four samples in half a second
)
