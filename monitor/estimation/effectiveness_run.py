"""The verdicts of ``effectiveness`` over a stretch of samples, from the moments after each of them.

The same formulas as there, in the same order, on arrays, where not a number stands for None. A test holds the two
together to the last bit: change both.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from monitor.estimation.effectiveness import EffectivenessRule

# An actuator cannot lose more than everything, and one that seems to deliver much more than commanded is out of trim.
LOSSES = (-0.25, 1.0)
ACQUITTAL = 2.0
CONTRADICTION = 9.0
SMALLEST_INFORMATION = 1e-30

Array = NDArray[np.float64]


class Moments(NamedTuple):
    """Information, moments and those of the speed of u after each sample (n,), under one time constant."""

    uu: Array
    um: Array
    mm: Array
    bu: Array
    bm: Array
    su: Array
    sm: Array

    def at(self, rows: NDArray[np.intp] | slice) -> Moments:
        """Return those after some of the samples."""
        return Moments(*(one[rows] for one in self))


class Heard(NamedTuple):
    """What the memory that is heard says after each sample (n,), as ``Effectiveness``.

    ``confirmed`` says where an accusation would stand out if things went on as lately; ``contradicted`` is the first
    row where health explains better what the shortest memory holds: what comes after it does not count.
    """

    loss: Array
    offset: Array
    evidence: Array
    is_loss: NDArray[np.bool_]
    relative: Array
    confirmed: NDArray[np.bool_]
    contradicted: int | None


def heard_verdicts(
    rule: EffectivenessRule,
    moments: Sequence[Moments],
    taken: NDArray[np.bool_],
    sizes: Sequence[tuple[float, float]],
) -> Heard:
    """Return what is heard.

    Parameters
    ----------
    rule : EffectivenessRule
        How the estimates are read.
    moments : Sequence[Moments]
        Of each memory, shortest first.
    taken : NDArray[np.bool_]
        Where a sample is evidence (n,); all others say nothing.
    sizes : Sequence[tuple[float, float]]
        Length of each memory in samples, and how many of them count as one.
    """
    count = len(taken)
    loss, offset, relative = np.zeros(count), np.zeros(count), np.full(count, np.nan)
    evidence, is_loss = np.full(count, np.nan), np.zeros(count, np.bool_)
    asked = np.flatnonzero(taken)
    for one in moments:
        loss[asked], offset[asked], evidence[asked], is_loss[asked] = _judged(rule, one.at(asked))
        asked = asked[np.isnan(evidence[asked])]
        if not len(asked):
            break
    confirmed = np.zeros(count, np.bool_)
    accused = np.flatnonzero(~np.isnan(evidence) & (evidence != 0.0))
    if not len(accused):
        return Heard(loss, offset, evidence, is_loss, relative, confirmed, None)
    shortest = moments[0].at(accused)
    size = np.where(is_loss[accused], loss[accused], offset[accused])
    lately = np.where(is_loss[accused], shortest.uu, shortest.mm)
    moment = np.where(is_loss[accused], shortest.bu, shortest.bm)
    against = np.flatnonzero(size * (size * lately - 2.0 * moment) > CONTRADICTION)
    length, inflation = sizes[0]
    for own_length, own_inflation in sizes:
        reach = np.abs(size) * np.sqrt(lately * inflation / length * own_length / own_inflation)
        confirmed[accused] |= reach >= rule.certainty
    asked = accused
    for one in moments:
        relative[asked] = _loss_beside_offset(rule, one.at(asked))
        asked = asked[np.isnan(relative[asked])]
    if not len(against):
        return Heard(loss, offset, evidence, is_loss, relative, confirmed, None)
    contradicted = int(accused[against[0]])
    confirmed[contradicted], relative[contradicted] = False, np.nan
    return Heard(loss, offset, evidence, is_loss, relative, confirmed, contradicted)


def _judged(rule: EffectivenessRule, of: Moments) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Return loss, offset, evidence, and whether the loss explains more than the offset."""
    doubts = rule.loss_doubt, rule.offset_doubt
    loss, loss_error = _single(of.bu, of.uu, of.um * doubts[1], of.su * rule.timing_s, doubts[0])
    offset, offset_error = _single(of.bm, of.mm, of.um * doubts[0], of.sm * rule.timing_s, doubts[1])
    is_loss = _plausible(loss, loss_error) & (loss * of.bu >= offset * of.bm)
    score = np.where(is_loss, np.abs(loss) / loss_error, np.abs(offset) / offset_error)
    matters = np.where(is_loss, np.abs(loss) >= rule.least_loss, np.abs(offset) >= rule.least_offset)
    innocent = (np.abs(loss) + ACQUITTAL * loss_error < rule.least_loss) & (
        np.abs(offset) + ACQUITTAL * offset_error < rule.least_offset
    )
    missing = np.where(is_loss, -loss * np.sqrt(of.uu / np.maximum(of.mm, SMALLEST_INFORMATION)), offset)
    evidence = np.where((score >= rule.certainty) & matters, missing, np.where(innocent, 0.0, np.nan))
    return loss, offset, evidence, is_loss


def _loss_beside_offset(rule: EffectivenessRule, of: Moments) -> Array:
    """Return -loss of the fit of both, where it is certain and plausible."""
    determinant = of.uu * of.mm - of.um * of.um
    known = determinant > SMALLEST_INFORMATION
    determinant = np.where(known, determinant, 1.0)
    beside = (of.mm * of.bu - of.um * of.bm) / determinant
    slip = rule.timing_s * (of.mm * of.su + of.um * of.sm) / determinant
    error = np.sqrt(of.mm / determinant + slip * slip + rule.loss_doubt**2)
    certain = known & (rule.certainty * error <= np.abs(beside)) & _plausible(beside, error)
    return np.where(certain, -beside, np.nan)


def _single(moment: Array, own: Array, other: Array, timing: Array, doubt: float) -> tuple[Array, Array]:
    """Return one size fitted alone and its standard error."""
    known = own > SMALLEST_INFORMATION
    own = np.where(known, own, 1.0)
    variance = 1.0 / own + doubt * doubt + _square(other / own) + _square(timing / own)
    return np.where(known, moment / own, 0.0), np.where(known, np.sqrt(variance), np.inf)


def _square(values: Array) -> Array:
    """Return what ``**`` gives, which is now and then not the nearest number to the square."""
    return np.array([value**2 for value in values.tolist()], np.float64)


def _plausible(loss: Array, error: Array) -> NDArray[np.bool_]:
    return np.asarray((error < np.inf) & (loss >= LOSSES[0]) & (loss <= LOSSES[1] + ACQUITTAL * error))
