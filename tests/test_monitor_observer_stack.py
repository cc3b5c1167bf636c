"""Observers stepped together give what they give one by one."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gains.plants.model_file import builtin_model
from gains.plants.plant import Fault, Plant
from gains.synthesis.bank import compile_bank, design_bank
from gains.synthesis.gains_file import Gains
from monitor.estimation.observer import Observer
from monitor.estimation.observer_stack import ObserverStack
from monitor.estimation.stack_layout import stack_layout


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


@pytest.fixture(scope="module")
def delayed() -> tuple[Gains, ...]:
    """Return a bank of a linear plant whose two inputs act after a delay."""
    plant = Plant(
        name="delayed",
        domain="discrete",
        rate_hz=100.0,
        states=("a", "b"),
        inputs=("one", "other"),
        outputs=("a", "b"),
        A=np.array([[0.9, 0.1], [0.0, 0.8]]),
        B=np.array([[0.1, 0.0], [0.02, 0.3]]),
        C=np.eye(2),
        taps=(0.0, 0.0, 0.7, 0.3),
        faults=(
            Fault("one", "actuator", np.array([0.1, 0.02]), rate=1.0),
            Fault("other", "actuator", np.array([0.0, 0.3]), rate=1.0),
        ),
    )
    return compile_bank(plant, design_bank(plant))


def test_inputs_of_the_past_are_kept_once(delayed: tuple[Gains, ...]) -> None:
    layout = stack_layout(delayed)
    assert layout.held == ((1, 0), (1, 1), (2, 0), (2, 1), (3, 0), (3, 1))
    assert layout.cores == sum(len(one.initial_matrix) - 6 for one in delayed)


@given(
    seed=st.integers(0, 1000),
    linear=st.booleans(),
    lengths=st.lists(st.tuples(st.integers(0, 9), st.sampled_from(["step", "coast", "restart"])), max_size=12),
)
def test_a_stretch_gives_the_bits_of_its_samples_one_by_one(
    gains: tuple[Gains, ...],
    delayed: tuple[Gains, ...],
    seed: int,
    linear: bool,
    lengths: list[tuple[int, str]],
) -> None:
    bank = delayed if linear else gains
    rng = np.random.default_rng(seed)
    one, many = ObserverStack(bank), ObserverStack(bank)
    for length, what in lengths:
        u, y = rng.normal(size=(length + 1, len(bank[0].inputs))), rng.normal(size=(length + 1, len(bank[0].outputs)))
        for stack in (one, many):
            if what == "coast":
                stack.coast(u[-1])
            elif what == "restart":
                stack.restart(u[-1], y[-1])
            else:
                stack.step(u[-1], y[-1])
        run = many.run(u[:-1], y[:-1])
        for k in range(length):
            one.step(u[k], y[k])
            assert run.x[k].tobytes() == one.x.tobytes()
            assert run.fault[k].tobytes() == one.fault.tobytes()
            assert run.residual[k].tobytes() == one.residual.tobytes()
        assert many.x.tobytes() == one.x.tobytes()
        assert many.fault.tobytes() == one.fault.tobytes()


@given(rows=st.integers(1, 90), columns=st.integers(1, 60), count=st.integers(1, 4), seed=st.integers(0, 1000))
def test_products_with_many_rows_are_those_with_each(rows: int, columns: int, count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(rows, columns)) * 10.0 ** rng.integers(-3, 3, (rows, columns))
    vectors = rng.normal(size=(count, columns + 1))[:, 1:]
    found = np.matmul(matrix, vectors[:, :, None])[:, :, 0]
    assert found.tobytes() == np.array([np.dot(matrix, vector) for vector in vectors]).tobytes()
