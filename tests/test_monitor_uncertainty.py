"""The uncertainty that is shown is that of the estimates: it grows while coasting and shrinks when measured again."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from stretches import partitions
from test_monitor_coasting import plant

from gains.synthesis.certificate import certify
from gains.synthesis.compilation import compile_gains
from gains.synthesis.convex import design_convex
from gains.synthesis.gains_file import Gains
from monitor.estimation.observer import Observer
from monitor.estimation.uncertainty import Uncertainty

NAMES = ("motor", "sensor")
RUNS = 250


@pytest.fixture(scope="module")
def gains() -> Gains:
    whole = plant()
    design = design_convex(whole)
    return compile_gains(whole, design, certify(whole, design))


def uncertainty(gains: Gains) -> Uncertainty:
    return Uncertainty([gains], plant(), NAMES)


def test_it_is_the_scatter_of_the_estimates_measured_coasted_and_resumed(gains: Gains) -> None:
    whole, rng = plant(), np.random.default_rng(1)
    measured = [True] * 60 + [False] * 8 + [True] * 6 + [False] * 2 + [True] * 4
    errors = np.zeros((len(measured), RUNS, 2))
    for run in range(RUNS):
        observer, x, f = Observer(gains), np.zeros(2), np.zeros(2)
        observer.restart(np.zeros(1), x)
        for k, seen in enumerate(measured):
            if seen:
                observer.step(np.zeros(1), x + [0.0, f[1]] + 0.001 * rng.normal(size=2))
            else:
                observer.coast(np.zeros(1))
            errors[k, run] = observer.fault - f
            x = whole.A @ x + whole.E_f[:, 0] * f[0] + 0.001 * rng.normal(size=2)
            f = f + 0.01 * rng.normal(size=2)
    shown, said = uncertainty(gains), []
    for seen in measured:
        shown.follow(seen)
        said.append(shown.sd)
    scatter = np.sqrt(np.mean(errors**2, axis=1))
    late = slice(50, None)
    assert scatter[late] == pytest.approx(np.stack(said)[late], rel=0.2)


def test_it_grows_with_every_coasted_sample_and_comes_back_to_where_it_was(gains: Gains) -> None:
    shown = uncertainty(gains)
    at_rest, last = shown.sd, shown.sd
    for _ in range(10):
        shown.follow(False)
        assert np.all(shown.sd > last)
        last = shown.sd
    for _ in range(2_000):
        shown.follow(True)
    assert shown.sd is at_rest


def test_a_restart_begins_with_more_than_is_left_later(gains: Gains) -> None:
    shown = uncertainty(gains)
    at_rest = shown.sd
    shown.restart()
    shown.follow(True)
    assert shown.sd[0] > 2.0 * at_rest[0]


def test_without_a_model_it_is_not_known(gains: Gains) -> None:
    shown = Uncertainty([gains], None, NAMES)
    shown.restart()
    shown.follow(False)
    assert np.isnan(shown.sd).all()


@settings(max_examples=40, deadline=None)
@given(
    parts=partitions(400),
    restarts=st.lists(st.integers(0, 399), max_size=3),
    lost=st.lists(st.tuples(st.integers(0, 399), st.integers(1, 4)), max_size=3),
)
def test_stretches_and_single_samples_mix_to_the_bit(
    gains: Gains, parts: list[tuple[int, int, bool]], restarts: list[int], lost: list[tuple[int, int]]
) -> None:
    measured, restart = np.ones(400, np.bool_), np.zeros(400, np.bool_)
    for start, length in lost:
        measured[start : start + length] = False
    restart[restarts] = True
    one, other = uncertainty(gains), uncertainty(gains)
    expected = singly(one, measured, restart)
    for start, stop, by_one in parts:
        take = singly if by_one else Uncertainty.run
        found = take(other, measured[start:stop], restart[start:stop])
        assert found.tobytes() == expected[start:stop].tobytes()
    assert other.sd.tobytes() == one.sd.tobytes()
    later = np.arange(300) != 7
    assert singly(one, later, ~later).tobytes() == singly(other, later, ~later).tobytes()


def singly(shown: Uncertainty, measured: NDArray[np.bool_], restart: NDArray[np.bool_]) -> NDArray[np.float64]:
    said = []
    for seen, anew in zip(measured.tolist(), restart.tolist(), strict=True):
        if anew:
            shown.restart()
        shown.follow(seen)
        said.append(shown.sd)
    return np.array(said).reshape(-1, len(shown.sd))


def test_what_follows_a_restart_is_stepped_once_and_can_be_left_anywhere(gains: Gains) -> None:
    one, other = uncertainty(gains), uncertainty(gains)
    restart = np.zeros(300, np.bool_)
    restart[[0, 100]] = True
    measured = np.ones(300, np.bool_)
    measured[130] = False
    for _ in range(3):
        assert other.run(measured, restart).tobytes() == singly(one, measured, restart).tobytes()


def test_without_a_model_no_stretch_is_known_either(gains: Gains) -> None:
    shown = Uncertainty([gains], None, NAMES)
    assert np.isnan(shown.run(np.ones(3, np.bool_), np.zeros(3, np.bool_))).all()
