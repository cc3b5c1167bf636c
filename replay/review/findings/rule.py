"""What a finding is: a rule with its physics, and what it says of one log."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final, Literal, get_args

Stage = Literal["link", "decision", "command", "supply", "rpm", "motion", "sensor", "estimator", "reaction"]
STAGES: Final[tuple[Stage, ...]] = get_args(Stage)
"""In causal order: what is asked, what the autopilot decides and commands, what carries it out and measures it,
and what the autopilot makes of that."""

Weight = Literal["information", "warning", "critical"]
Confidence = Literal["certain", "likely", "possible"]


@dataclass(frozen=True, slots=True)
class Judgement:
    """One thing that a rule says happened in a log."""

    span: tuple[float, float]  # from when to when it shows, seconds since the log's begin
    text: str  # what happened, as a sentence without its full stop
    evidence: tuple[str, ...]  # what the log shows for it, figures with their records
    counter: tuple[str, ...] = ()  # what else could have looked so and was not, beside what the rule says of all logs
    confidence: Confidence = "likely"  # how much of the evidence is direct
    weight: Weight = "warning"  # information alone is no finding
    plots: tuple[str, ...] = ()  # names of signals that show it, ahead of those that the rule names
    # whether it begins at its time; a condition of the whole flight comes first only where nothing else does
    event: bool = True

    @property
    def start_s(self) -> float:
        """When it begins to show."""
        return self.span[0]


@dataclass(frozen=True, slots=True)
class Rule:
    """A finding that logs are searched for."""

    title: str  # in words
    stage: Stage  # where in the order of causes it is
    physics: str  # why it shows in this way
    evidence: str  # what has to be seen
    counter: tuple[str, ...]  # what else looks so, and why it is not that
    needs: tuple[str, ...]  # signals without which nothing can be said
    plots: tuple[str, ...]  # names of the signals that show it
    # what it says of a log, given the signals that it needs; raises UnjudgedError where it cannot tell
    judge: Callable[..., Iterable[Judgement]]
    multirotor: bool = False  # whether it holds of multirotors alone
    least_hz: float = 0.0  # how often each of the signals has to come

    @property
    def name(self) -> str:
        """What reports call it: as the module in which it stands."""
        return self.judge.__module__.rpartition(".")[2]


class UnjudgedError(Exception):
    """A rule cannot tell, for the reason that is its text."""
