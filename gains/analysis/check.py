"""Which faults can be estimated with a plant's sensors, why others cannot, and what would help."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from adapters.errors import ModelError
from gains.analysis.augment import sloped_dynamics
from gains.analysis.estimability import (
    Estimability,
    Problem,
    estimability,
    hides_at_every_frequency,
    late_faults,
    problem_of,
    restricted,
)
from gains.analysis.hidden_modes import signal_scales, step_matrix
from gains.analysis.zeros import Zero, invariant_zeros, mode_text
from gains.plants.discretise import discretise
from gains.plants.plant import FloatArray, Plant, first_dependent

_MOST_LISTED = 15
"""Largest number of lines of a kind in the report: those that fit on a screen beside the others; the JSON report has
all."""
_WIDTH = 14
"""Width of the labels: the letters of the longest one, and two."""
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
            lines += _entries(
                "mend", [f"one more sensor, of {_listed(check.sensors, 'or')}, makes all estimable together"]
            )
        elif len(check.explanations) > 1:
            lines += _entries("mend", ["no single additional sensor makes all estimable together"])
    pairs = [
        f"{' and '.join(pair.faults)}: "
        + ("look the same at every frequency" if pair.strength == "strong" else "look the same once they are constant")
        for pair in check.pairs
    ]
    lines += _entries("pairs", _capped(pairs, "pair"))
    if check.late:
        lines += _entries("seen late", [f"{_listed(check.late)}: not in the first sample after it acts"])
    zeros = [
        f"{_listed((*zero.faults, *zero.states))} move unseen together: {mode_text(zero.s)}" for zero in check.zeros
    ]
    lines += _entries("hidden", _capped(zeros, "motion"))
    return "\n".join([*lines, *_structure(check)]) + "\n"


def sentence(explanation: Explanation, plant: Plant) -> str:
    """Return why a set of faults cannot be estimated, and what would help."""
    problem = explanation.problem
    faults, states = _listed(problem.faults), _listed(problem.states)
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
        mends.append("add one" if plain else f"add a sensor of {_listed(explanation.sensors, 'or')}")
    if explanation.leak:
        on = "" if len(explanation.problem.states) == 1 else f" in {_listed(explanation.leak)}"
        mends.append(f"a leak of 1/60 s{on}")
    if not mends:
        return "leave one out" if len(explanation.problem.faults) > 1 else "leave it out or model it otherwise"
    return ", or ".join(mends)


def _missing(explanation: Explanation) -> str:
    if explanation.shown_elsewhere:
        return "the other sensors do not settle it"
    states = explanation.problem.states
    return f"no other {states[0]} sensor" if len(states) == 1 else f"no other sensor of {_listed(states)}"


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


def _listed(names: Sequence[str], word: str = "and") -> str:
    return f" {word} ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


Effect = Literal["steady", "change", "ramp", "none"]

LEAK_S = 60.0
"""Time constant of the leak that an advice tries, s. Chosen: twice that of the position washout, slow beside every
fault that has to be detected."""
_MOST_EXPLAINED = 20
"""Largest number of problems with an explanation: each costs a check of the plant for every sensor that could be
added."""
_EFFECT_TOLERANCE = 1e-11
"""Share of the largest possible effect below which there is none. Rounding leaves 1e-16 to 1e-13 of it (double
precision times the condition of a scaled system)."""


@dataclass(frozen=True, slots=True)
class Explanation:
    """A smallest set of faults that cannot be estimated together, and what would help.

    It would help to add an unattacked sensor of any of the states ``sensors``, or a leak of 1/LEAK_S per second on the
    states ``leak``; either may be empty. ``shown_elsewhere``: an output without these faults shows one of the states
    that move.
    """

    problem: Problem
    sensors: tuple[str, ...]
    leak: tuple[str, ...]
    shown_elsewhere: bool


@dataclass(frozen=True, slots=True)
class FaultPair:
    """Two faults that cannot be distinguished: at any frequency (strong) or only if they are constant (weak)."""

    faults: tuple[str, str]
    strength: Literal["strong", "weak"]


@dataclass(frozen=True, slots=True)
class Check:
    """The findings about a plant."""

    plant: Plant  # the plant that was checked
    estimability: Estimability  # the largest sets of faults that can be estimated together and the smallest that cannot
    explanations: tuple[Explanation, ...]  # those problems with what would help, at most the first 20
    sensors: tuple[str, ...]  # states of which one additional sensor would make all faults estimable together
    pairs: tuple[FaultPair, ...]  # pairs that cannot be told apart
    # actuator faults that, in some set, have no effect on the first sample after they act (Cb L1 E_f lacks rank)
    late: tuple[str, ...]
    zeros: tuple[Zero, ...]  # invariant zeros
    # effect of each fault on each output: a constant fault shifts it (steady), moves it without end (ramp) or has no
    # effect although a change has one (change)
    structure: dict[str, dict[str, Effect]]

    @property
    def estimable(self) -> bool:
        """Whether all declared faults can be estimated together."""
        return self.estimability.sets[:1] == (tuple(fault.name for fault in self.plant.faults),)


def check_plant(plant: Plant, rate_hz: float | None = None) -> Check:
    """Check a plant, a continuous one as it is or sampled at a rate; its faults may depend on each other.

    Raises
    ------
    ModelError
        The plant has no faults or cannot be sampled at that rate.
    """
    if not plant.faults:
        raise ModelError(f"{plant.name}: 'fault' is empty; there is nothing to estimate")
    if rate_hz is not None:
        plant = discretise(plant, rate_hz)
    result = estimability(plant)
    everything = tuple(fault.name for fault in plant.faults)
    fixing = _mending_sensors(plant, everything) if result.sets != (everything,) else ()
    late = {name for part in result.sets[:_MOST_EXPLAINED] for name in late_faults(restricted(plant, part))}
    return Check(
        plant=plant,
        estimability=result,
        explanations=tuple(_explanation(plant, problem) for problem in result.problems[:_MOST_EXPLAINED]),
        sensors=fixing,
        pairs=tuple(_pairs(plant)),
        late=tuple(name for name in everything if name in late),
        zeros=invariant_zeros(plant) if first_dependent(plant.D_f) is None else (),
        structure=structure_matrix(plant),
    )


def structure_matrix(plant: Plant) -> dict[str, dict[str, Effect]]:
    """Return the effect of each fault on each output, at the mean slopes."""
    A = sloped_dynamics(plant)[0][0]
    n = len(plant.states)
    states = signal_scales(plant)[:n]
    step = step_matrix(A, plant.domain) / states[:, None] * states
    size = float(np.linalg.norm(step, 2)) or 1.0
    paces = np.abs(np.linalg.eigvals(step))
    slowest = float(np.min(paces[paces > 1e-6 * size], initial=size))
    points = np.array([1e-3 * slowest, 1e-2 * slowest, 0.7 * size, 1.3 * size]) * np.exp(1.1j)
    resolvents = np.linalg.inv(points[:, None, None] * np.eye(n) - step)
    rows = plant.C * states
    matrix: dict[str, dict[str, Effect]] = {}
    for fault in plant.faults:
        if fault.kind == "sensor":
            effects: list[Effect] = ["steady" if entry else "none" for entry in fault.column]
        else:
            column = fault.column / states
            reach = np.linalg.norm(resolvents, 2, axis=(1, 2)) * np.linalg.norm(column)
            moved = resolvents @ column
            effects = [_effect(np.abs(moved @ row), reach * np.linalg.norm(row)) for row in rows]
        matrix[fault.name] = dict(zip(plant.outputs, effects, strict=True))
    return matrix


def check_report(check: Check) -> dict[str, Any]:
    """Return the findings as the JSON object of the command line."""
    plant = check.plant
    return {
        "model": plant.name,
        "domain": plant.domain,
        "rate_hz": plant.rate_hz,
        "estimable": check.estimable,
        "faults": [fault.name for fault in plant.faults],
        "outputs": list(plant.outputs),
        "sets": [list(names) for names in check.estimability.sets],
        "complete": check.estimability.complete,
        "problems": [
            {
                "faults": list(explanation.problem.faults),
                "condition": explanation.problem.condition,
                "states": list(explanation.problem.states),
                "mode": _complex(explanation.problem.mode),
                "at_every_frequency": explanation.problem.at_every_frequency,
                "add_sensor_of": list(explanation.sensors),
                "leak_s": LEAK_S if explanation.leak else None,
                "leak_on": list(explanation.leak),
                "message": sentence(explanation, plant),
            }
            for explanation in check.explanations
        ],
        "add_sensor_of": list(check.sensors),
        "pairs": [{"faults": list(pair.faults), "strength": pair.strength} for pair in check.pairs],
        "late": list(check.late),
        "zeros": [
            {
                "s": _complex(zero.s),
                "hz": abs(zero.s.imag) / (2.0 * math.pi),
                "time_constant_s": 1.0 / abs(zero.s.real) if zero.s.real and math.isfinite(zero.s.real) else None,
                "of": zero.of,
                "faults": list(zero.faults),
                "states": list(zero.states),
            }
            for zero in check.zeros
        ],
        "structure": check.structure,
    }


def _complex(s: complex) -> list[float] | None:
    return [s.real, s.imag] if math.isfinite(s.real) else None


def _explanation(plant: Plant, problem: Problem) -> Explanation:
    attacked = [f.column != 0.0 for f in plant.sensor_faults if f.name in problem.faults]
    clean = ~np.any(attacked, axis=0) if attacked else np.ones(len(plant.outputs), dtype=bool)
    moving = [plant.states.index(state) for state in problem.states]
    leak: tuple[str, ...] = ()
    for states in (*((state,) for state in problem.states), problem.states):
        if not leak and states and problem_of(_with_leak(plant, states), problem.faults) is None:
            leak = states
    return Explanation(
        problem=problem,
        sensors=_mending_sensors(plant, problem.faults),
        leak=leak,
        shown_elsewhere=bool(np.any(plant.C[clean][:, moving])),
    )


def _mending_sensors(plant: Plant, faults: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(state for state in plant.states if problem_of(_with_sensor(plant, state), faults) is None)


def _with_sensor(plant: Plant, state: str) -> Plant:
    """Return the plant with one more output, which measures a state and has no fault."""
    name = next(f"added{i}" for i in itertools.count() if f"added{i}" not in plant.outputs)
    row = np.array([[float(other == state) for other in plant.states]])
    return replace(
        plant,
        outputs=(*plant.outputs, name),
        C=np.vstack([plant.C, row]),
        faults=tuple(
            replace(fault, column=np.append(fault.column, 0.0)) if fault.kind == "sensor" else fault
            for fault in plant.faults
        ),
        noises=(),
    )


def _with_leak(plant: Plant, states: tuple[str, ...]) -> Plant:
    leak = np.diag([float(state in states) / LEAK_S / (plant.rate_hz or 1.0) for state in plant.states])
    return replace(plant, A=plant.A - leak)


def _pairs(plant: Plant) -> Iterator[FaultPair]:
    """Yield pairs that cannot be distinguished at all, or although each of the two can be estimated."""
    A = sloped_dynamics(plant)[0][0]
    alone = {fault.name: problem_of(plant, (fault.name,)) is None for fault in plant.faults}
    for first, second in itertools.combinations(alone, 2):
        part = restricted(plant, (first, second))
        if hides_at_every_frequency(part, A) and not any(
            hides_at_every_frequency(restricted(plant, (name,)), A) for name in (first, second)
        ):
            yield FaultPair((first, second), "strong")
        elif alone[first] and alone[second] and problem_of(plant, (first, second)) is not None:
            yield FaultPair((first, second), "weak")


def _effect(gains: FloatArray, reach: FloatArray) -> Effect:
    """Return the effect from the gains at two low and two higher frequencies, and from their largest possible size."""
    shows = gains > _EFFECT_TOLERANCE * reach
    if not np.any(shows[2:]):
        return "none"
    if not shows[0]:
        return "change"
    slope = math.log10(gains[1] / gains[0])
    return "change" if slope > 0.5 else "ramp" if slope < -0.5 else "steady"
