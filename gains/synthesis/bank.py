"""Banks: one observer for each hypothesis about which faults act, if not all can be estimated together.

Under the hypothesis that no fault outside a set acts, the observer of the plant with that set alone estimates it. If
the hypothesis is right, the residual of that observer stays as small as noise and disturbances make it; if another
fault acts, it grows, unless no output distinguishes the two (structured residuals).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from adapters.errors import InfeasibleError
from gains.analysis.estimability import problem_of, restricted
from gains.plants.model_file import model_hash
from gains.plants.plant import Plant
from gains.synthesis.design import Design
from gains.synthesis.gains_file import Gains


class Hypothesis(NamedTuple):
    """The faults that may act, the plant with only them, and its observer."""

    faults: tuple[str, ...]
    plant: Plant
    design: Design


def admissible_hypotheses(plant: Plant) -> tuple[tuple[str, ...], ...]:
    """Return the sets of faults that get an observer: each single fault that can be estimated.

    Raises
    ------
    InfeasibleError
        No fault can be estimated even by itself, or too many slopes vary.
    """
    hypotheses = tuple((fault.name,) for fault in plant.faults if problem_of(plant, (fault.name,)) is None)
    if not hypotheses:
        raise InfeasibleError(
            f"{plant.name}: no fault can be estimated even when it is the only one; 'fauio check' says why"
        )
    return hypotheses


def design_bank(
    plant: Plant, rate_hz: float | None = None, *, together: Sequence[tuple[str, ...]] = ()
) -> tuple[Hypothesis, ...]:
    """Return a certified observer for each of the :func:`admissible_hypotheses`, at a rate or that of a discrete model.

    ``together`` are sets of faults that get an observer, too, if all faults of the set can be estimated.
    """
    from gains.synthesis.convex import design_convex

    sets = [faults for faults in together if problem_of(plant, faults) is None]
    plants = [(faults, restricted(plant, faults)) for faults in (*admissible_hypotheses(plant), *sets)]
    return tuple(Hypothesis(faults, part, design_convex(part, rate_hz)) for faults, part in plants)


def compile_bank(plant: Plant, bank: Sequence[Hypothesis]) -> tuple[Gains, ...]:
    """Return the compiled, certified gains of each hypothesis, marked as designed for the whole plant."""
    from gains.synthesis.certificate import certify
    from gains.synthesis.compilation import compile_gains

    whole = model_hash(plant)
    return tuple(
        replace(compile_gains(part, design, certify(part, design)), model_hash=whole) for _, part, design in bank
    )
