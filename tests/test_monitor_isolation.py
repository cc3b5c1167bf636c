"""Isolation: every channel's smoothed estimate is its own evidence."""

import numpy as np
import pytest
from cuts import cuts
from hypothesis import given
from hypothesis import strategies as st

from monitor.core.bank import IndependentIsolation
from monitor.estimation.isolation_rule import keep_share


def test_smoothing_follows_a_step_with_its_time_constant_and_a_restart_forgets() -> None:
    restart = (np.arange(11) == 10).astype(np.uint8)
    fault = np.append(np.ones(10), 0.0)[:, None]
    evidence = IndependentIsolation(1, keep_share(0.1, 100.0)).run(fault, np.ones(11, np.uint8), restart)
    assert evidence[9] == pytest.approx(1 - np.exp(-1))
    assert evidence[10] == 0.0


@given(seed=st.integers(0, 10_000), parts=cuts(100))
def test_cuts_do_not_change_a_bit(seed: int, parts: list[slice]) -> None:
    rng = np.random.default_rng(seed)
    fault = rng.normal(size=(100, 4))
    measured, restart = (rng.random(100) > 0.1).astype(np.uint8), (rng.random(100) > 0.98).astype(np.uint8)
    one, other = (IndependentIsolation(4, keep_share(0.05, 100.0)) for _ in range(2))
    cut = [other.run(fault[part], measured[part], restart[part]) for part in parts]
    assert np.concatenate(cut).tobytes() == one.run(fault, measured, restart).tobytes()
