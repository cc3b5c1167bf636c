"""Smoothing a stretch gives the bits of smoothing its samples one by one."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from monitor.estimation.smoothing import smooth


@given(
    seed=st.integers(0, 10_000),
    keep=st.sampled_from([0.0, 0.3, 0.9, float(np.exp(-0.2))]),
    lengths=st.lists(st.integers(0, 40), min_size=1, max_size=8),
    odd=st.sampled_from([0.0, np.inf, -np.inf, np.nan, 1e300, -1e-310]),
)
def test_a_stretch_gives_what_its_samples_give_one_by_one(
    seed: int, keep: float, lengths: list[int], odd: float
) -> None:
    rng = np.random.default_rng(seed)
    one, many = np.zeros(3), np.zeros(3)
    for length in lengths:
        values = rng.normal(size=(length, 3))
        values[rng.random(values.shape) < 0.02] = odd
        with np.errstate(invalid="ignore"):
            found = smooth(values, keep, many)
            for row, expected in zip(values, found, strict=True):
                one *= keep
                one += (1.0 - keep) * row
                assert expected.tobytes() == one.tobytes()
        assert many.tobytes() == one.tobytes()
