"""A motor stood still, or turned much too slowly, while it was commanded to turn."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from replay.review.facts.log_facts import Floats, LogFacts, LogSignal, spans_where
from replay.review.findings.loss_of_control import IDLE, in_control
from replay.review.findings.rule import Judgement, Rule

_SLOW = 0.4
"""Share of the usual speed at that command, below which a motor is too slow: with a third less thrust the speed is 0.8,
and what the fastest motor still runs down from a commanded step within a sample is above 0.5."""
_LEAST_S = 0.6
"""Shortest time of such a speed, seconds. Chosen: two samples of the slowest reports of ESCs, 3 a second."""
_COMMANDED = 0.08
"""Share of full command from which a motor turns (see loss_of_control.STOPPED)."""


def _judge(facts: LogFacts, rpm: LogSignal, motors: LogSignal) -> Iterator[Judgement]:
    if len(rpm.names) != len(motors.names):
        return
    times = rpm.time_s
    command = motors.at(times)
    judged = in_control(facts, times) & (command > _COMMANDED).all(axis=1) & np.isfinite(rpm.values).all(axis=1)
    if not judged.any():
        return
    # ArduPilot's motors idle at MOT_SPIN_MIN, and thrust is proportional to the command above it
    thrust = np.maximum(command - facts.parameters.get("MOT_SPIN_MIN", 0.0), _COMMANDED)
    # with the same command all motors of a vehicle turn about equally fast: the others show the usual speed
    speed = rpm.values / np.sqrt(thrust)
    usual = float(np.median(speed[judged]))
    least = IDLE * np.median(thrust[judged])
    for k, name in enumerate(motors.names):
        others_turn = np.median(np.delete(speed, k, axis=1), axis=1) > _SLOW * usual
        slow = judged & (thrust[:, k] > least) & others_turn & (speed[:, k] < _SLOW * usual)
        if not _own(thrust, rpm.values, judged & ~slow, k):
            continue
        for start, end in spans_where(times, slow, _LEAST_S)[:1]:
            within = slow & (times >= start) & (times <= end)
            turned, asked = float(np.median(rpm.values[within, k])), float(np.median(command[within, k]))
            normal = usual * float(np.median(thrust[within, k])) ** 0.5
            yield Judgement(
                span=(start, end),
                text=f"{name} turned at {turned:.0f} rpm while commanded to {100 * asked:.0f} %: motor or ESC failed",
                evidence=(
                    f"{rpm.origin}: {turned:.0f} rpm, usual at that command {normal:.0f} rpm",
                    f"{motors.origin}: command {asked:.2f} meanwhile",
                ),
                confidence="certain",
                weight="critical",
            )


def _own(thrust: Floats, speed: Floats, during: NDArray[np.bool_], k: int) -> bool:
    """Return whether an ESC's speed follows its own motor's command best: ESCs may be numbered in another order."""
    asked, turned = (part[during] - part[during].mean(axis=1, keepdims=True) for part in (thrust, speed))
    together = asked.T @ turned[:, k]
    return bool(together[k] >= together.max())


RULE = Rule(
    title="Motor slower than commanded",
    stage="rpm",
    physics="Thrust is proportional to the square of the speed and roughly to the command, so speed over the root of "
    "the command is equal for all motors of a vehicle, but not for a stopped motor or ESC.",
    evidence="less than 40 % of the usual speed at that command for 0.6 s, in flight",
    counter=(
        "its command was neither zero nor idle; large propellers take seconds to slow down",
        "the other motors were reported and turned as usual; at take-off all run up together",
        "at other times this ESC follows this motor's command, and not another's",
    ),
    needs=("rpm", "motors"),
    plots=("rpm", "motors", "attitude"),
    judge=_judge,
    multirotor=True,
)
