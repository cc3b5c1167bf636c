"""Runs over whole arrays give what the live observer gives step by step, to rounding, on both paths."""

import sys
import tracemalloc
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from random_gains import random_gains

from adapters.simulation.arm import SCENARIOS, ArmRun, simulate_arm
from gains.plants.model_file import builtin_model
from gains.synthesis.certificate import certify
from gains.synthesis.compilation import compile_gains
from gains.synthesis.convex import design_convex
from gains.synthesis.gains_file import Gains
from monitor.errors import ExtraMissingError
from monitor.estimation import compiled_run
from monitor.estimation.observer import Observer
from monitor.estimation.recursion import ObserverRun, recursion_of
from monitor.estimation.whole_run import AGREEMENT, WholeRun, run_whole

PATHS = pytest.mark.parametrize("compiled", [False, True], ids=["numpy", "compiled"])
SHAPES = ("sin(v)", "tanh(v)", "0.1*v*abs(v)/(1+v**2)", "atan(v)-0.5*cos(v)", "exp(-v**2)", "log(2+sin(v))")


def signals(gains: Gains, seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, len(gains.inputs))), rng.normal(size=(count, len(gains.outputs)))


def zeros(count: int) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros((count, 1)), np.zeros((count, 3))


def assert_agree(gains: Gains, u: np.ndarray, y: np.ndarray, found: ObserverRun) -> None:
    """Compare with live steps, relative to the numbers that estimates are summed from."""
    expected = Observer(gains).run(u, y)
    recursion = recursion_of(gains)
    w = np.concatenate([np.abs(u).max(axis=0, initial=0.0), np.nanmax(np.abs(y), axis=0, initial=0.0), [1.0]])
    given = np.abs(recursion.step[recursion.ns :, recursion.ns :][:, : recursion.nw]) @ w
    for ours, theirs, terms in zip(found, expected, recursion.split(given[None]), strict=True):
        np.testing.assert_array_equal(np.isnan(ours), np.isnan(theirs))
        size = np.abs(np.nan_to_num(theirs)).max(initial=0.0) + terms.max(initial=0.0)
        np.testing.assert_allclose(np.nan_to_num(ours), np.nan_to_num(theirs), rtol=0.0, atol=AGREEMENT * size)


@PATHS
@given(
    seed=st.integers(0, 10**6),
    states=st.integers(1, 40),
    outputs=st.integers(1, 12),
    faults=st.integers(0, 10),
    inputs=st.integers(0, 6),
    radius=st.floats(0.0, 0.999),
    shapes=st.lists(st.sampled_from(SHAPES), max_size=3),
    count=st.integers(0, 400),
)
@example(seed=0, states=40, outputs=12, faults=10, inputs=6, radius=0.999, shapes=[], count=400)
@example(seed=0, states=4, outputs=3, faults=2, inputs=1, radius=0.99, shapes=["sin(v)"], count=400)
def test_a_whole_run_agrees_with_the_live_steps(
    compiled: bool,
    seed: int,
    states: int,
    outputs: int,
    faults: int,
    inputs: int,
    radius: float,
    shapes: list[str],
    count: int,
) -> None:
    gains = random_gains(
        seed, states, outputs, faults, inputs=inputs, radius=radius, nonlinearities=tuple(shapes), coupling=0.02
    )
    u, y = signals(gains, seed, count)
    assert_agree(gains, u, y, run_whole(gains, u, y, compiled))


@PATHS
@given(seed=st.integers(0, 10**6), at=st.integers(0, 299), shapes=st.sampled_from([(), ("sin(v)",), ("sqrt(v)",)]))
def test_what_is_not_a_number_stands_in_the_same_places(
    compiled: bool, seed: int, at: int, shapes: tuple[str, ...]
) -> None:
    gains = random_gains(seed, nonlinearities=shapes)
    u, y = signals(gains, seed, 300)
    y[at, seed % 3] = np.nan
    found = run_whole(gains, u, y, compiled)
    assert np.isnan(found.x[at:]).all()
    assert_agree(gains, u, y, found)


@PATHS
def test_a_restart_after_what_is_not_a_number_is_a_fresh_start(compiled: bool) -> None:
    gains = random_gains(1, nonlinearities=("sin(v)",))
    u, y = signals(gains, 1, 100)
    run = WholeRun(gains, compiled)
    run.restart(u[0], y[0])
    assert np.isnan(run.advance(u, np.full_like(y, np.nan)).x).all()
    run.restart(u[0], y[0])
    assert_agree(gains, u, y, run.advance(u, y))


@cache
def arm_at(case: str, rate_hz: float) -> tuple[Gains, ArmRun]:
    """Return gains for the arm and a run of it; nobody may change them."""
    plant = builtin_model("arm-disturbed")
    design = design_convex(plant, rate_hz)
    return compile_gains(plant, design, certify(plant, design)), simulate_arm(SCENARIOS[case], 20.0, rate_hz)


@PATHS
@pytest.mark.parametrize("case", ["case1", "case3"])
@pytest.mark.parametrize("rate_hz", [100.0, 1000.0])
def test_the_arm_agrees_with_its_live_steps_at_any_rate(compiled: bool, case: str, rate_hz: float) -> None:
    gains, run = arm_at(case, rate_hz)
    assert_agree(gains, run.u, run.y, run_whole(gains, run.u, run.y, compiled))


@PATHS
@given(seed=st.integers(0, 10**6), pieces=st.lists(st.integers(0, 200), max_size=5))
def test_stretch_after_stretch_is_the_same_as_all_at_once(compiled: bool, seed: int, pieces: list[int]) -> None:
    gains = random_gains(seed, nonlinearities=("sin(v)",))
    u, y = signals(gains, seed, sum(pieces))
    run = WholeRun(gains, compiled)
    if len(u):
        run.restart(u[0], y[0])
    ends = np.cumsum(pieces).tolist()
    parts = [run.advance(u[end - size : end], y[end - size : end]) for size, end in zip(pieces, ends, strict=True)]
    parts.append(run.advance(u[:0], y[:0]))
    assert_agree(gains, u, y, ObserverRun(*(np.concatenate(part) for part in zip(*parts, strict=True))))


@pytest.mark.parametrize("coupling", [0.5, 2.0, 8.0])
def test_nonlinearities_too_strong_to_settle_at_once_settle_in_shorter_blocks(coupling: float) -> None:
    gains = random_gains(5, radius=0.5, nonlinearities=("tanh(v)",), coupling=coupling)
    u, y = signals(gains, 5, 3000)
    assert_agree(gains, u, y, run_whole(gains, u, y, compiled=False))


@PATHS
@pytest.mark.parametrize("radius", [1.0, 1.02, 1.3])
def test_an_observer_that_is_not_stable_grows_as_it_does_live(compiled: bool, radius: float) -> None:
    gains = random_gains(3, radius=radius)
    u, y = signals(gains, 3, 1500)
    found, expected = run_whole(gains, u, y, compiled), Observer(gains).run(u, y)
    for ours, theirs in zip(found, expected, strict=True):
        size = np.maximum.accumulate(np.abs(theirs).max(axis=1))[:, None]
        assert np.all(np.abs(ours - theirs) <= 1e-9 * (1.0 + size))


@PATHS
def test_a_state_of_zero_stays_zero_where_powers_of_an_unstable_observer_overflow(compiled: bool) -> None:
    gains = random_gains(3, radius=10.0)
    gains.step_matrix[:, -1] = 0.0
    assert not run_whole(replace(gains, initial_matrix=0.0 * gains.initial_matrix), *zeros(5000), compiled).x.any()


def test_memory_stays_bounded_over_any_length() -> None:
    gains = random_gains(2, states=12, outputs=12, faults=10, nonlinearities=("sin(v)",))
    u, y = signals(gains, 2, 20_000)
    run = WholeRun(gains, compiled=False)
    run.restart(u[0], y[0])
    run.advance(u, y)
    tracemalloc.start()
    for _ in range(6):
        run.advance(u, y)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 3 * 20_000 * (12 + 10 + 12) * 8


def test_without_numba_compiled_code_names_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "numba", None)
    compiled_run._compiled.cache_clear()
    gains = random_gains(0)
    with pytest.raises(ExtraMissingError, match=r"pip install 'fauio\[fast\]'"):
        WholeRun(gains, compiled=True)
    compiled_run._compiled.cache_clear()


def test_without_numba_a_run_that_leaves_the_choice_open_takes_plain_numpy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "numba", None)
    monkeypatch.setattr("monitor.estimation.whole_run._WORTH_LOADING", 1)
    gains = random_gains(0)
    u, y = signals(gains, 0, 50)
    assert_agree(gains, u, y, run_whole(gains, u, y))


def test_arrays_of_other_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="shapes"):
        WholeRun(random_gains(0)).advance(np.zeros((5, 1)), np.zeros((4, 3)))
