"""One motor was commanded to stop while the others flew on: the autopilot's own decision, not a failed motor."""

from collections.abc import Iterator

import numpy as np

from replay.review.facts.log_facts import LogFacts, LogSignal, overlap, state_spans
from replay.review.findings.loss_of_control import STOPPED, spans_in_control
from replay.review.findings.rule import Judgement, Rule

_LEAST_S = 1.5
"""Shortest stop, seconds. Measured: at full sticks a saturated mixer keeps single motors at zero for up to 0.5 s; three
times that."""
_FLYING = 0.2
"""Share of full command above which the others' median carries a vehicle: the strongest vehicles hover from 0.15 on,
and there a saturated mixer takes single motors to zero."""


def _judge(facts: LogFacts, motors: LogSignal) -> Iterator[Judgement]:
    times = motors.time_s
    for k, name in enumerate(motors.names):
        others = np.median(np.delete(motors.values, k, axis=1), axis=1)
        marks = [(said.time_s, said.level) for said in facts.statements if (said.kind, said.text) == ("stopped", name)]
        marked = overlap(state_spans(marks, facts.duration_s), facts.flight)
        stopped = spans_in_control(facts, motors, (motors.values[:, k] < STOPPED) & (others > _FLYING), _LEAST_S)
        for start, end in sorted(stopped + marked)[:1]:
            mean = float(np.median(others[(times >= start) & (times <= end)]))
            said = ("the log marks the output as stopped, not as zero",) if marked else ()
            yield Judgement(
                span=(start, end),
                text=f"{name} was commanded to stop for {end - start:.1f} s while the others were at "
                f"{100 * mean:.0f} %: the autopilot stopped it",
                evidence=(f"{motors.origin}: {name} below {STOPPED:g}, the others at {mean:.2f}", *said),
                confidence="certain" if marked else "likely",
                weight="critical",
            )


RULE = Rule(
    title="One motor commanded to stop",
    stage="command",
    physics="Autopilots stop a motor whose ESC reports a failure, or to test failures (PX4's failure injection).",
    evidence="one command at zero for 1.5 s, or marked as stopped, while the others carry the vehicle",
    counter=(
        "its command is zero: a motor that fails by itself gets more command, not less",
        "outputs without a motor never move; a saturated mixer recovers within half a second",
    ),
    needs=("motors",),
    plots=("motors", "attitude", "rpm"),
    judge=_judge,
    multirotor=True,
)
