"""What a finding is: a rule with its physics, and what it says of one log."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final, Literal, get_args

from replay.review.facts.log_facts import LogFacts

Stage = Literal["link", "decision", "command", "supply", "rpm", "motion", "sensor", "estimator", "reaction"]
STAGES: Final[tuple[Stage, ...]] = get_args(Stage)
"""In causal order: what is asked, what the autopilot decides and commands, what carries it out and measures it,
and what the autopilot makes of that."""

Weight = Literal["information", "warning", "critical"]
Confidence = Literal["certain", "likely", "possible"]


@dataclass(frozen=True, slots=True)
class Judgement:
    """One thing that a rule says happened in a log.

    Parameters
    ----------
    start_s, end_s : float
        From when to when it shows, seconds since the log's begin.
    text : str
        What happened, as a sentence without its full stop.
    evidence : tuple[str, ...]
        What the log shows for it, figures with their records.
    counter : tuple[str, ...]
        What else could have looked so and was not, beside what the rule says of all logs.
    confidence : {"certain", "likely", "possible"}
        How much of the evidence is direct.
    weight : {"information", "warning", "critical"}
        Information alone is no finding.
    plots : tuple[str, ...]
        Names of signals that show it, ahead of those that the rule names.
    event : bool
        Whether it begins at its time; a condition of the whole flight comes first only where nothing else does.
    """

    start_s: float
    end_s: float
    text: str
    evidence: tuple[str, ...]
    counter: tuple[str, ...] = ()
    confidence: Confidence = "likely"
    weight: Weight = "warning"
    plots: tuple[str, ...] = ()
    event: bool = True


@dataclass(frozen=True, slots=True)
class Rule:
    """A finding that logs are searched for.

    Parameters
    ----------
    name, title : str
        In reports, and in words.
    stage : Stage
        Where in the order of causes it is.
    physics : str
        Why it shows in this way.
    evidence : str
        What has to be seen.
    counter : tuple[str, ...]
        What else looks so, and why it is not that.
    needs : tuple[str, ...]
        Signals without which nothing can be said.
    plots : tuple[str, ...]
        Names of the signals that show it.
    judge : Callable
        Returns what it says of a log; raises :class:`UnjudgedError` where it cannot tell.
    multirotor : bool
        Whether it holds of multirotors alone.
    least_hz : float
        How often each of the signals has to come.
    """

    name: str
    title: str
    stage: Stage
    physics: str
    evidence: str
    counter: tuple[str, ...]
    needs: tuple[str, ...]
    plots: tuple[str, ...]
    judge: Callable[[LogFacts], Iterable[Judgement]]
    multirotor: bool = False
    least_hz: float = 0.0


class UnjudgedError(Exception):
    """A rule cannot tell, for the reason that is its text."""
