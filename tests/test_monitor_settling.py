"""How long a wrong start shows in the estimates of faults."""

from dataclasses import replace

import numpy as np
import pytest
from test_monitor_coasting import plant

from gains.synthesis.certificate import certify
from gains.synthesis.compilation import compile_gains
from gains.synthesis.convex import design_convex
from monitor.estimation.affine import AffineObserver, settling_s
from monitor.profile import Profile


def test_an_observer_of_measured_states_has_nothing_to_forget() -> None:
    whole = plant()
    design = design_convex(whole)
    assert settling_s(compile_gains(whole, design, certify(whole, design))) == 0.0


def test_two_observers_started_apart_agree_after_it(arm_profile: Profile) -> None:
    (gains,) = arm_profile.observers[0].gains
    wait = round(settling_s(gains) * gains.rate_hz)
    assert 100 < wait < 950
    # a motion that the three outputs do not show: the link's angle and rate against each other
    wrong = gains.initial_matrix.copy()
    wrong[:, -1] += np.vstack([gains.L1, gains.L_q]) @ np.array([0.0, 0.0, -1.0, 1.0]) * 1e-3
    u, y = np.zeros((wait + 500, 1)), np.zeros((wait + 500, 3))
    one, other = (AffineObserver([start]).run(u, y).fault for start in (gains, replace(gains, initial_matrix=wrong)))
    series = np.abs(one - other)
    assert series[wait:].max(axis=0) == pytest.approx(np.zeros(2), abs=0.06 * series.max())
