"""Errors of a model that are correlated in time, as an autoregression, and equations filtered until they are white.

With errors e(k) = sum_j d_j e(k-j) + eps(k) generalised least squares weighs every equation by what is new in it: the
filter 1 - sum_j d_j q^-j goes over both of its sides. A row without a measurement of its own breaks the filter; rows
after it are predicted from as many as there are since, each with the variance of that shorter prediction.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gains.plants.plant import FloatArray

_RIDGE = 1e-8
"""Share of the variance added to it: predictions of very smooth errors must not depend on rounding, 1e-16 of their
squares."""
_LEAST = 2
"""Errors before a row that have to be known for it to count. After a break commands have answered disturbances that no
row shows; two rows predict all but a few per cent of errors that are correlated as those of real flights (.87 to .98).
"""


class Autoregression(NamedTuple):
    """Predictors of an error from the errors before it, of orders 0, 1, ..., p."""

    coefficients: tuple[FloatArray, ...]  # of e(k-1), ..., e(k-m) for each order m
    variances: FloatArray  # variance that each order leaves (p + 1,)


def autoregression(errors: Sequence[FloatArray], own: Sequence[NDArray[np.bool_]], longest: int) -> Autoregression:
    """Return the autoregression of errors by least squares.

    ``errors`` (N,) and which of them are known, ``own``, are given by stretch; the order is ``longest``, less where too
    few rows in a row are known.
    """
    while True:
        gram, count = np.zeros((longest + 1, longest + 1)), 0
        for e, known in zip(errors, own, strict=True):
            rows = np.flatnonzero(known & (known_before(known) >= longest))
            past = np.stack([e[rows - j] for j in range(longest + 1)])
            gram += past @ past.T
            count += len(rows)
        if longest == _LEAST or count >= 0.5 * sum(int(known.sum()) for known in own):
            break
        longest = max(_LEAST, longest // 2)
    gram = gram / max(count, 1)
    gram += max(_RIDGE * gram[0, 0], np.finfo(np.float64).tiny) * np.eye(longest + 1)
    coefficients: list[FloatArray] = [np.zeros(0)]
    for m in range(1, longest + 1):
        coefficients.append(np.asarray(np.linalg.solve(gram[1 : m + 1, 1 : m + 1], gram[1 : m + 1, 0])))
    variances = np.array([gram[0, 0] - d @ gram[1 : len(d) + 1, 0] for d in coefficients])
    return Autoregression(tuple(coefficients), variances)


def whitened(columns: FloatArray, own: NDArray[np.bool_], noise: Autoregression) -> tuple[NDArray[np.intp], FloatArray]:
    """Return the rows that count and the filtered columns there, all with the variance of the longest prediction.

    ``columns`` (c, N) are both sides of the equations; ``own`` says which rows are known (N,).
    """
    before = known_before(own)
    order = len(noise.variances) - 1
    filtered = finite_response(np.append(1.0, -noise.coefficients[order]), columns)
    rows = np.flatnonzero(own & (before >= _LEAST))
    known = before[rows]
    for m in np.unique(known[known < order]).tolist():
        short = rows[known == m]
        predicted = np.cumsum(noise.coefficients[m] * columns[:, short[:, None] - 1 - np.arange(m)], axis=-1)
        left = columns[:, short] - predicted[:, :, -1]
        filtered[:, short] = left * np.sqrt(noise.variances[order] / noise.variances[m])
    return rows, filtered[:, rows]


def finite_response(taps: FloatArray, signals: FloatArray) -> FloatArray:
    """Return sum_d h_d x(k-d) along the last axis, zero before its start."""
    signals = np.ascontiguousarray(signals)
    rows = signals.reshape(-1, signals.shape[-1])
    return np.array([np.convolve(taps, row)[: len(row)] for row in rows]).reshape(signals.shape)


def past_errors(errors: FloatArray, own: NDArray[np.bool_], rows: NDArray[np.intp], order: int) -> FloatArray:
    """Return what the noise's coefficients multiply: the errors before some rows, zero where not known (p, n)."""
    before = known_before(own)[rows]
    return np.stack([np.where(before > j, errors[rows - 1 - j], 0.0) for j in range(order)])


def known_before(own: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return the number of consecutive known rows before each row (N,)."""
    index = np.arange(len(own))
    return np.asarray(index - 1 - np.maximum.accumulate(np.where(own, -1, index)))
