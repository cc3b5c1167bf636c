"""Equations are weighed by what is new in them, also where measurements are missing."""

import numpy as np
import pytest
from numpy.typing import NDArray

from gains.identification.coloured_noise import autoregression, known_before, whitened

TRUE = np.array([1.5, -0.56])


def coloured(count: int, seed: int) -> NDArray[np.float64]:
    from scipy.signal import lfilter

    return np.asarray(lfilter([1.0], np.append(1.0, -TRUE), np.random.default_rng(seed).normal(size=count)))


def test_the_colour_is_learned() -> None:
    errors = [coloured(8000, 1), coloured(8000, 2)]
    noise = autoregression(errors, [np.ones(8000, np.bool_)] * 2, 16)
    assert len(noise.variances) - 1 == 16
    assert noise.coefficients[2] == pytest.approx(TRUE, abs=0.02)
    assert noise.variances[-1] == pytest.approx(1.0, abs=0.03)


def test_filtered_errors_are_white_and_alike_on_both_sides_of_missing_rows() -> None:
    e = coloured(40_000, 3)
    own = np.random.default_rng(4).random(len(e)) > 0.1
    noise = autoregression([e], [own], 8)
    rows, white = whitened(e[None], own, noise)
    assert own[rows].all()
    assert white[0].std() == pytest.approx(1.0, abs=0.03)
    after = known_before(own)[rows] == 2
    assert white[0, after].std() == pytest.approx(1.0, abs=0.1)
    assert np.corrcoef(white[0, 1:], white[0, :-1])[0, 1] == pytest.approx(0.0, abs=0.02)


def test_rows_known_before_count_from_the_last_that_is_missing() -> None:
    own = np.array([True, True, False, True, True, True])
    assert known_before(own)[own].tolist() == [0, 1, 0, 1, 2]
