"""The compiled observer is the recursion of its gains, alone and in a bank, however its rows are cut into batches."""

from dataclasses import replace

import numpy as np
import pytest
from cuts import cuts
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from random_gains import random_gains

from gains.plants.expression import compile_expression
from gains.plants.model_file import builtin_model
from gains.plants.plant import Fault, Plant
from gains.synthesis.bank import compile_bank, design_bank
from gains.synthesis.gains_file import Gains
from monitor.estimation.affine import AffineObserver, stack_layout
from monitor.estimation.input_curve import effect_of_command

Array = NDArray[np.float64]
COUNT = 60


def textbook(gains: Gains, u: Array, y: Array) -> tuple[Array, Array, Array]:
    """Return x, [fa; fs] and residual of the recursion that gains files hold, row by row.

    Where there is a bend, it is that of the second state.
    """
    n, a, p, ns = len(gains.states), len(gains.faults), len(gains.outputs), len(gains.initial_matrix)
    functions = [compile_expression(g.expression, g.arguments) for g in gains.nonlinearities]
    ends = np.cumsum([len(g.arguments) for g in gains.nonlinearities])
    inputs = len(gains.inputs)
    curved = [[np.polyval([*c[::-1], 0.0], x) for c, x in zip(gains.input_curves, row, strict=True)] for row in u]
    bends = np.split(gains.input_bends, gains.known - inputs) if gains.known > inputs else []

    def bent(row: Array) -> list[float]:
        return [sum(np.polyval([*c[::-1], 0.0], x) for c, x in zip(of, row, strict=True)) for of in bends]

    v = np.array([[*row, *bent(row)] for row in curved])
    fault, sources = np.zeros(inputs), [source for source in gains.fault_inputs if source is not None]
    s = gains.initial_matrix @ [*v[0], *y[0], 1.0]
    rows = []
    for k in range(len(u)):
        nu = np.split(gains.argument_matrix @ [*s, *v[k], *y[k], 1.0], ends)
        g = [function(*arguments) for function, arguments in zip(functions, nu, strict=False)]
        out = gains.step_matrix @ [*s, *v[k], *y[k], 1.0, *g]
        if bends:
            acting = sum(h * v[max(k - d, 0), :inputs] for d, h in enumerate(gains.input_taps))
            faulty = acting + np.clip(fault, -np.abs(acting), np.abs(acting))
            driven = np.vstack([gains.L1, gains.L_q])[:, 1]
            out[: len(driven)] += driven * (bent(faulty)[0] - bent(acting)[0])
            fault[sources] = out[len(out) - p - len(sources) : len(out) - p]
        s = out[:ns]
        rows.append(out[ns:])
    x, fs, fa, residual = np.split(np.array(rows), [n, n + a - gains.fault_kinds.count("actuator"), n + a], axis=1)
    return x, np.hstack([fa, fs]), residual[:, :p]


@pytest.fixture(scope="module")
def nonlinear() -> tuple[Gains, ...]:
    plant = replace(builtin_model("arm-disturbed"), curves=((1.0, 0.1),))
    return compile_bank(plant, design_bank(plant, 100.0))


@pytest.fixture(scope="module")
def delayed() -> tuple[Gains, ...]:
    """Return a bank of a linear plant whose two inputs, and a bend, act after a delay."""
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
        bends=np.array([[[0.0, 0.0]] * 2, [[0.3, -0.1], [0.0, 0.2]]]),
        faults=(
            Fault("one", "actuator", np.array([0.1, 0.02]), rate=1.0, input="one"),
            Fault("other", "actuator", np.array([0.0, 0.3]), rate=1.0, input="other"),
        ),
    )
    return compile_bank(plant, design_bank(plant))


def test_a_fault_bends_what_its_input_bends(delayed: tuple[Gains, ...]) -> None:
    u, y = np.tile([0.5, 0.8], (200, 1)), np.zeros((201, 2))
    acting = np.array([0.5, 0.6])  # a quarter of the other is lost
    r = 0.3 * acting[0] - 0.1 * acting[0] ** 2 + 0.2 * acting[1] ** 2
    for k in range(200):
        y[k + 1] = [[0.9, 0.1], [0.0, 0.8]] @ y[k] + [[0.1, 0.0], [0.02, 0.3]] @ acting + [0.0, r]
    names = [name for gains in delayed for name in gains.faults]
    estimates = AffineObserver(delayed).run(u, y[:-1]).fault[-1]
    assert estimates[[at for at, name in enumerate(names) if name == "other"]] == pytest.approx(-0.2)


def driven(bank: tuple[Gains, ...], seed: int, count: int = COUNT) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, len(bank[0].inputs))), rng.normal(size=(count, len(bank[0].outputs)))


@pytest.mark.parametrize("name", ["nonlinear", "delayed"])
def test_each_observer_of_a_bank_is_its_own_recursion(name: str, request: pytest.FixtureRequest) -> None:
    bank = request.getfixturevalue(name)
    u, y = driven(bank, 0)
    run = AffineObserver(bank).run(u, y)
    at = 0
    for k, gains in enumerate(bank):
        x, fault, residual = textbook(gains, u, y)
        assert run.x[:, k] == pytest.approx(x, rel=1e-9, abs=1e-9)
        assert run.fault[:, at : at + fault.shape[1]] == pytest.approx(fault, rel=1e-9, abs=1e-9)
        assert run.residual[:, k] == pytest.approx(residual, rel=1e-9, abs=1e-9)
        at += fault.shape[1]


@given(seed=st.integers(0, 10_000), outputs=st.integers(1, 5), states=st.integers(1, 8), inputs=st.integers(0, 3))
@settings(max_examples=20)
def test_random_observers_are_their_recursions(seed: int, outputs: int, states: int, inputs: int) -> None:
    gains = random_gains(seed, states, outputs, inputs=inputs, nonlinearities=("sin(v)", "v ** 2 / (1 + v ** 2)"))
    u, y = driven((gains,), seed)
    run = AffineObserver([gains]).run(u, y)
    for ours, theirs in zip((run.x[:, 0], run.fault, run.residual[:, 0]), textbook(gains, u, y), strict=True):
        assert ours == pytest.approx(theirs, rel=1e-9, abs=1e-9)


@given(
    parts=cuts(COUNT),
    seed=st.integers(0, 10_000),
    lost=st.floats(0.0, 0.5),
    restarts=st.lists(st.integers(0, COUNT - 1), max_size=3),
    linear=st.booleans(),
)
def test_cuts_do_not_change_a_bit(
    nonlinear: tuple[Gains, ...],
    delayed: tuple[Gains, ...],
    parts: list[slice],
    seed: int,
    lost: float,
    restarts: list[int],
    linear: bool,
) -> None:
    bank = delayed if linear else nonlinear
    u, y = driven(bank, seed)
    measured, restart = np.random.default_rng(seed).random(COUNT) >= lost, np.zeros(COUNT, np.bool_)
    restart[restarts] = True
    whole, cut = AffineObserver(bank).run(u, y, measured, restart), AffineObserver(bank)
    runs = [cut.run(u[part], y[part], measured[part], restart[part]) for part in parts]
    for column, expected in zip(zip(*runs, strict=True), whole, strict=True):
        assert np.concatenate(column).tobytes() == expected.tobytes()


def test_a_restart_forgets_the_past(nonlinear: tuple[Gains, ...]) -> None:
    u, y = driven(nonlinear, 1)
    restart = np.arange(COUNT) == 20
    after = AffineObserver(nonlinear).run(u, y, restart=restart).fault[20:]
    assert after.tobytes() == AffineObserver(nonlinear).run(u[20:], y[20:]).fault.tobytes()


def test_inputs_of_the_past_are_kept_once(delayed: tuple[Gains, ...]) -> None:
    layout = stack_layout(delayed)
    assert layout.held == tuple((delay, source) for delay in (1, 2, 3) for source in (0, 1, 2))
    assert len(layout.initial) == sum(len(one.initial_matrix) - 9 for one in delayed)


def test_what_is_no_number_stays_where_it_can_matter() -> None:
    gains = random_gains(0, outputs=2)
    u, y = driven((gains,), 0)
    y[10:] = np.nan
    run = AffineObserver([gains]).run(u, y)
    assert np.isfinite(run.x[:10]).all()
    assert np.isnan(run.residual[10:]).all()


def test_arrays_that_do_not_fit_are_refused(delayed: tuple[Gains, ...]) -> None:
    u, y = driven(delayed, 0)
    for wrong in (
        (u[:, :1], y),
        (u, y[:, :1]),
        (u, y[:-1]),
        (u, y, np.ones(3, np.bool_)),
        (u, y, None, np.ones(3, np.bool_)),
    ):
        with pytest.raises(ValueError, match=r"differ in length|inputs and"):
            AffineObserver(delayed).run(*wrong)


@given(seed=st.integers(0, 10**6), degree=st.integers(1, 4), inputs=st.integers(1, 6))
def test_the_effect_of_a_command_is_the_curves_polynomial(seed: int, degree: int, inputs: int) -> None:
    rng = np.random.default_rng(seed)
    curve, u = rng.normal(size=(inputs, degree)), rng.normal(size=(3, 2, inputs))
    powers = u[..., None] ** np.arange(1, degree + 1)
    assert effect_of_command(curve, u) == pytest.approx(np.sum(curve * powers, axis=-1), abs=1e-12)
