"""A live step is one product into arrays that stand ready."""

import tracemalloc
from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from random_gains import random_gains

from monitor.estimation.input_curve import curve_columns, effect_into, effect_of_command
from monitor.estimation.observer import Observer


def test_a_step_allocates_no_arrays() -> None:
    gains = random_gains(0, states=12, outputs=500, faults=10, inputs=500)
    observer, u, y = Observer(gains), np.ones(500), np.ones(500)
    observer.restart(u, y)
    observer.step(u, y)
    tracemalloc.start()
    for _ in range(100):
        observer.step(u, y)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 500 * 8


def test_estimates_are_views_that_the_next_step_overwrites() -> None:
    observer = Observer(random_gains(0))
    observer.restart(np.ones(1), np.ones(3))
    views = observer.x, observer.fault, observer.residual
    observer.step(np.ones(1), np.ones(3))
    before = [view.copy() for view in views]
    observer.step(np.zeros(1), np.zeros(3))
    assert all(np.any(view != old) for view, old in zip(views, before, strict=True))


@given(seed=st.integers(0, 10**6), degree=st.integers(1, 4), inputs=st.integers(0, 6), plain=st.booleans())
def test_the_effect_of_a_command_has_the_same_bits_wherever_it_is_written(
    seed: int, degree: int, inputs: int, plain: bool
) -> None:
    rng = np.random.default_rng(seed)
    curve = np.ones((inputs, 1)) if plain else rng.normal(size=(inputs, degree))
    u, out = rng.normal(size=inputs), np.empty(inputs)
    effect_into(curve_columns(curve), u, out)
    assert out.tobytes() == effect_of_command(curve, u).tobytes()


def test_an_observer_without_inputs_runs() -> None:
    gains = random_gains(0, inputs=0)
    run = Observer(replace(gains, input_curves=np.zeros((0, 1)))).run(np.zeros((5, 0)), np.ones((5, 3)))
    assert np.isfinite(run.x).all()
