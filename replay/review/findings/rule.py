"""A finding: a rule with its physics, and its judgement of one log."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final, Literal, get_args

Stage = Literal["link", "decision", "command", "supply", "rpm", "motion", "sensor", "estimator", "reaction"]
STAGES: Final[tuple[Stage, ...]] = get_args(Stage)
"""Stages in causal order: the demand, the autopilot's decision and command, the parts that execute and measure it, and
the autopilot's reaction."""

Weight = Literal["information", "warning", "critical"]
WEIGHTS: Final[tuple[Weight, ...]] = get_args(Weight)
"""Severities, rising; information alone is no finding."""

Confidence = Literal["certain", "likely", "possible"]


@dataclass(frozen=True, slots=True)
class Judgement:
    """One event in a log, as a rule judges it."""

    span: tuple[float, float]  # begin and end of its evidence, seconds since the log's begin
    text: str  # what happened, as a sentence without its full stop
    evidence: tuple[str, ...]  # evidence in the log: figures with their records
    # other causes that are excluded in this log, in addition to those that the rule excludes in all logs
    counter: tuple[str, ...] = ()
    confidence: Confidence = "likely"  # how much of the evidence is direct
    weight: Weight = "warning"
    plots: tuple[str, ...] = ()  # names of signals that show it, before those that the rule names
    # whether it begins at its time; a condition of the whole flight is first only if there is no other finding
    event: bool = True

    @property
    def start_s(self) -> float:
        """The begin of its evidence."""
        return self.span[0]


@dataclass(frozen=True, slots=True)
class Rule:
    """A finding that is looked for in logs."""

    title: str  # in words
    stage: Stage  # its place in the order of causes
    physics: str  # why it has this evidence
    evidence: str  # the evidence that is required
    counter: tuple[str, ...]  # other causes that look the same, and why they are excluded
    needs: tuple[str, ...]  # signals without which it cannot be judged
    plots: tuple[str, ...]  # names of the signals that show it
    # its judgements of a log, given the needed signals; raises UnjudgedError if it cannot tell
    judge: Callable[..., Iterable[Judgement]]
    multirotor: bool = False  # whether it applies to multirotors only
    least_hz: float = 0.0  # lowest rate of each of the signals

    @property
    def name(self) -> str:
        """Its name in reports: the name of its module."""
        return self.judge.__module__.rpartition(".")[2]


class UnjudgedError(Exception):
    """A rule cannot judge a log; the text is the reason."""
