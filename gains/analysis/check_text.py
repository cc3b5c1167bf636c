"""The findings about a plant as sentences, for people who do not know the theory."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from gains.analysis.zeros import mode_text

if TYPE_CHECKING:
    from gains.analysis.check import Check, Explanation
    from gains.plants.plant import Plant

_MOST_LISTED = 15
"""Lines of a kind in the report: what fits on a screen beside the others; the JSON report has all."""
_WIDTH = 14
"""Letters of the longest label, and two."""
_LEGEND = {
    "steady": "a constant fault shifts the output",
    "ramp": "a constant fault moves it on and on",
    "change": "it shows changes of the fault only",
}


def check_text(check: Check) -> str:
    """Return the whole report."""
    lines = [_headline(check), *_entries("why not", _reasons(check))]
    if not check.estimable:
        together = [" + ".join(names) for names in check.estimability.sets]
        lines += _entries("together", _capped(together, "set") or ["none"])
        if not check.estimability.complete:
            lines += _entries("", ["(there may be more: the search was stopped)"])
        if check.sensors:
            lines += _entries("mend", [f"one more sensor, of {_or(check.sensors)}, makes all estimable together"])
        elif len(check.explanations) > 1:
            lines += _entries("mend", ["no single additional sensor makes all estimable together"])
    pairs = [
        f"{' and '.join(pair.faults)}: "
        + ("look the same at every frequency" if pair.strength == "strong" else "look the same once they are constant")
        for pair in check.pairs
    ]
    lines += _entries("pairs", _capped(pairs, "pair"))
    if check.late:
        lines += _entries("seen late", [f"{_and(check.late)}: not in the first sample after it acts"])
    zeros = [f"{_and((*zero.faults, *zero.states))} move unseen together: {mode_text(zero.s)}" for zero in check.zeros]
    lines += _entries("hidden", _capped(zeros, "motion"))
    return "\n".join([*lines, *_structure(check)]) + "\n"


def sentence(explanation: Explanation, plant: Plant) -> str:
    """Return why a set of faults cannot be estimated, and what mends it."""
    problem = explanation.problem
    faults, states = _and(problem.faults), _and(problem.states)
    number = len(problem.faults)
    if problem.condition == "hidden mode":
        why = f"{states} shows in no output although {_noun(problem.mode)} there does not decay"
    elif problem.condition.startswith("detectability"):
        why = f"{faults} cannot be told from {states} {_noun(problem.mode)}: {_missing(explanation)}"
    elif number == 1:
        motion = "shows in no output" if problem.at_every_frequency else "shows in no output once it is constant"
        why = f"{faults} {motion}" + (f": {states} answers unseen" if states else "")
    else:
        why = f"{faults} cannot be told apart{'' if problem.at_every_frequency else ' once they are constant'}"
        if problem.condition.startswith("rank"):
            why += ": they do the same" if number == 2 else ": what some of them do, the others can undo"
        elif number > len(plant.outputs):
            why += f": {number} faults for {_count(len(plant.outputs), 'output')}"
    return f"{why}; {_mend(explanation)}"


def _mend(explanation: Explanation) -> str:
    mends = []
    if explanation.sensors:
        alone = len(explanation.problem.states) == 1 and not explanation.shown_elsewhere
        plain = (
            alone
            and explanation.problem.states[0] in explanation.sensors
            and explanation.problem.condition.startswith("detect")
        )
        mends.append("add one" if plain else f"add a sensor of {_or(explanation.sensors)}")
    if explanation.leak:
        on = "" if len(explanation.problem.states) == 1 else f" in {_and(explanation.leak)}"
        mends.append(f"a leak of 1/60 s{on}")
    if not mends:
        return "leave one out" if len(explanation.problem.faults) > 1 else "leave it out or model it otherwise"
    return ", or ".join(mends)


def _missing(explanation: Explanation) -> str:
    if explanation.shown_elsewhere:
        return "the other sensors do not settle it"
    states = explanation.problem.states
    return f"no other {states[0]} sensor" if len(states) == 1 else f"no other sensor of {_and(states)}"


def _noun(s: complex) -> str:
    if abs(s) < 1e-9:
        return "drift"
    if abs(s.imag) < 1e-9 * abs(s):
        return f"growth (time constant {1.0 / abs(s.real):.3g} s)"
    return f"oscillation at {abs(s.imag) / (2.0 * math.pi):.3g} Hz"


def _headline(check: Check) -> str:
    plant, number = check.plant, len(check.plant.faults)
    sampled = "" if plant.rate_hz is None else f" at {plant.rate_hz:g} Hz"
    start = f"{plant.name}{sampled}: {_count(number, 'fault')}, {_count(len(plant.outputs), 'output')}: "
    if check.estimable:
        return start + ("it can be estimated" if number == 1 else "all can be estimated together")
    return start + ("it cannot be estimated" if number == 1 else "not all can be estimated together")


def _reasons(check: Check) -> list[str]:
    reasons = [
        f"{sentence(explanation, check.plant)} [{explanation.problem.condition}]" for explanation in check.explanations
    ]
    reasons = _capped(reasons, "reason", len(check.estimability.problems))
    faults, outputs = len(check.plant.faults), len(check.plant.outputs)
    if faults > outputs:
        at_most = f"at most {outputs} can be estimated together"
        reasons.insert(0, f"{_count(faults, 'fault')} for {_count(outputs, 'output')}: {at_most}")
    return reasons


def _structure(check: Check) -> Iterator[str]:
    """Yield the effect of each fault on each output as a table."""
    outputs = check.plant.outputs
    name_width = max(len(name) for name in ("effect of", *check.structure))
    yield f"  {'effect of':<{name_width}}   {'   '.join(f'{output:<6}' for output in outputs)}"
    for name, effects in check.structure.items():
        cells = "   ".join(f"{effects[output].replace('none', '-'):<{max(6, len(output))}}" for output in outputs)
        yield f"  {name:<{name_width}}   {cells}".rstrip()
    shown = {effect for effects in check.structure.values() for effect in effects.values()}
    legend = [f"{effect}: {meaning}" for effect, meaning in _LEGEND.items() if effect in shown]
    yield f"  ({'; '.join(legend)})"


def _entries(label: str, items: Sequence[str]) -> list[str]:
    return [f"  {label if i == 0 else '':<{_WIDTH}}{item}" for i, item in enumerate(items)]


def _capped(items: list[str], noun: str, total: int | None = None) -> list[str]:
    total = len(items) if total is None else total
    shown = items[:_MOST_LISTED]
    return shown if len(shown) == total else [*shown, f"... and {_count(total - len(shown), noun)} more"]


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _and(names: Sequence[str]) -> str:
    return _joined(names, "and")


def _or(names: Sequence[str]) -> str:
    return _joined(names, "or")


def _joined(names: Sequence[str], word: str) -> str:
    return f" {word} ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
