"""Observers stepped together give what they give one by one."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gains.bank import compile_bank, design_bank
from gains.gains_file import Gains
from gains.model_file import builtin_model
from monitor.observer import Observer
from monitor.observer_stack import ObserverStack


@pytest.fixture(scope="module")
def gains() -> tuple[Gains, ...]:
    plant = builtin_model("arm-disturbed")
    plant = replace(plant, curves=((1.0, 0.1),))
    return compile_bank(plant, design_bank(plant, 100.0))


@given(seed=st.integers(0, 1000))
def test_a_stack_steps_each_observer_as_it_would_step_alone(gains: tuple[Gains, ...], seed: int) -> None:
    rng = np.random.default_rng(seed)
    u, y = rng.normal(size=(20, 1)), rng.normal(size=(20, 3))
    stack = ObserverStack(gains)
    alone = [Observer(one) for one in gains]
    assert len(gains) > 1
    assert all(one.nonlinearities for one in gains)
    stack.restart(u[0], y[0])
    for observer in alone:
        observer.restart(u[0], y[0])
    for k in range(len(u)):
        stack.step(u[k], y[k])
        for at, observer in enumerate(alone):
            observer.step(u[k], y[k])
            assert stack.x[at] == pytest.approx(observer.x, rel=1e-9, abs=1e-9)
            assert stack.residual[at] == pytest.approx(observer.residual, rel=1e-9, abs=1e-9)
            assert stack.fault[stack.spans[at]] == pytest.approx(observer.fault, rel=1e-9, abs=1e-9)
