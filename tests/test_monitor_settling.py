"""How long a wrong start shows in the estimates of faults."""

import numpy as np
import pytest
from test_monitor_coasting import plant

from gains.synthesis.certificate import certify
from gains.synthesis.compilation import compile_gains
from gains.synthesis.convex import design_convex
from monitor.estimation.observer import Observer
from monitor.estimation.settling import settling_s
from monitor.profile import Profile


def test_an_observer_of_measured_states_has_nothing_to_forget() -> None:
    whole = plant()
    design = design_convex(whole)
    assert settling_s([compile_gains(whole, design, certify(whole, design))]) == 0.0


def test_two_observers_started_apart_agree_after_it(arm_profile: Profile) -> None:
    (gains,) = arm_profile.observers[0].gains
    wait = round(settling_s([gains]) * gains.rate_hz)
    assert 100 < wait < 950
    one, other = Observer(gains), Observer(gains)
    u, y = np.zeros(1), np.zeros(3)
    one.restart(u, y)
    other.restart(u, y)
    # a motion that the three outputs do not show: the link's angle and rate against each other
    other._state[: len(gains.L1)] += gains.L1 @ np.array([0.0, 0.0, -1.0, 1.0]) * 1e-3
    apart = []
    for _ in range(wait + 500):
        one.step(u, y)
        other.step(u, y)
        apart.append(np.abs(one.fault - other.fault))
    series = np.stack(apart)
    assert series[wait:].max(axis=0) == pytest.approx(np.zeros(2), abs=0.06 * series.max())
