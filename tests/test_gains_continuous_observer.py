"""Continuous observers reproduce the paper's printed one and run on samples without losing stability or accuracy."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gains_samples import multirotor, rmse
from paper_gains import BETA, DISTURBED, UNDISTURBED, Printed

from adapters.errors import ModelError
from adapters.simulation.arm import SCENARIOS, simulate_arm
from gains.plants.model_file import builtin_model, model_hash
from gains.synthesis.continuous_observer import ContinuousObserver, compile_continuous, fauio_observer
from gains.synthesis.gains_file import read_gains, write_gains
from monitor.estimation.affine import AffineObserver


def printed_observer(printed: Printed = DISTURBED) -> ContinuousObserver:
    L = BETA * printed.L2
    return fauio_observer(builtin_model(printed.model), printed.K, L, L, "printed")


@pytest.mark.parametrize("printed", [UNDISTURBED, DISTURBED])
def test_the_printed_gains_give_the_printed_n_and_j(printed: Printed) -> None:
    gains = printed_observer(printed).matrices
    assert gains is not None
    assert np.max(np.abs(gains.N - printed.N)) < 1.1e-4
    assert np.max(np.abs(gains.J - printed.J)) < 1.1e-4


def test_the_printed_gains_have_one_pole_faster_than_any_sample() -> None:
    poles = np.linalg.eigvals(printed_observer().A)
    assert np.sort(poles.real) == pytest.approx([-33_280.0, -170.5, -12.23, -0.998, -0.998, -0.383], rel=2e-3)
    assert np.max(np.abs(poles.imag)) < 0.01


@pytest.mark.parametrize("rate", [10.0, *(pytest.param(rate, marks=pytest.mark.long) for rate in (100.0, 1000.0))])
def test_the_printed_gains_run_at_telemetry_rates(rate: float) -> None:
    run = simulate_arm(SCENARIOS["case2"], 50.0, rate)
    found = AffineObserver([compile_continuous(printed_observer(), rate)]).run(run.u, run.y)
    settled = (run.t > 16.0) & (run.t < 19.0)
    assert np.max(np.abs(found.fault[settled, 0] - run.f_a[settled, 0])) < 0.1
    assert np.max(np.abs(found.fault[:, 0])) < 4.0


@pytest.mark.parametrize(
    ("case", "aligned_fa", "fa"), [("case1", 0.0027, 0.0205), ("case2", 0.0081, 0.0408), ("case3", 0.0111, 0.0235)]
)
def test_the_errors_of_the_printed_gains_at_100_hz(case: str, aligned_fa: float, fa: float) -> None:
    run = simulate_arm(SCENARIOS[case], 50.0, 100.0)
    found = AffineObserver([compile_continuous(printed_observer(), 100.0)]).run(run.u, run.y)
    assert rmse(found.fault[:, :1] - run.f_a) == pytest.approx(fa, abs=1e-4)
    assert rmse(found.fault[1:, :1] - run.f_a[:-1]) == pytest.approx(aligned_fa, abs=1e-4)
    assert rmse(found.fault[:, 1:] - run.f_s) == pytest.approx(0.00775, abs=2e-5)


@pytest.mark.long
def test_samples_joined_by_straight_lines_give_what_the_continuous_observer_gives() -> None:
    observer, fine = printed_observer(), 50
    run = simulate_arm(SCENARIOS["case3"], 35.0, 100.0)
    t = np.arange((len(run.t) - 1) * fine + 1) / (100.0 * fine)
    y = np.column_stack([np.interp(t, run.t, column) for column in run.y.T])
    u = np.interp(t, run.t, np.sin(run.t))[:, None]
    coarse = AffineObserver([compile_continuous(observer, 100.0)]).run(u[::fine], run.y)
    reference = AffineObserver([compile_continuous(observer, 100.0 * fine)]).run(u, y)
    assert rmse(coarse.fault - reference.fault[::fine]) < 1e-4
    assert rmse(coarse.x[:, 0] - reference.x[::fine, 0]) < 1e-4


def test_a_linear_observer_is_sampled_without_error() -> None:
    plant = builtin_model("arm-disturbed")
    plant = replace(plant, G=np.zeros((4, 0)), nonlinearities=(), c=np.array([0.1, -2.0, 0.3, 1.0]))
    L = BETA * DISTURBED.L2
    observer = fauio_observer(plant, DISTURBED.K, L, L, "printed")
    rng, fine = np.random.default_rng(2), 8
    t, fine_t = np.arange(40) / 20.0, np.arange(39 * fine + 1) / (20.0 * fine)
    u, y = rng.normal(size=(40, 1)), rng.normal(size=(40, 3))
    fine_u, fine_y = (np.column_stack([np.interp(fine_t, t, column) for column in z.T]) for z in (u, y))
    coarse = AffineObserver([compile_continuous(observer, 20.0)]).run(u, y)
    reference = AffineObserver([compile_continuous(observer, 20.0 * fine)]).run(fine_u, fine_y)
    assert coarse.x[:, 0] == pytest.approx(reference.x[::fine, 0], rel=1e-9, abs=1e-8)
    assert coarse.fault == pytest.approx(reference.fault[::fine], rel=1e-9, abs=1e-7)
    assert coarse.residual[:, 0] == pytest.approx(reference.residual[::fine, 0], rel=1e-9, abs=1e-8)


def test_compiled_gains_survive_the_file_and_say_what_they_are(tmp_path: Path) -> None:
    gains = compile_continuous(printed_observer(), 100.0)
    write_gains(gains, tmp_path / "gains.json")
    found = read_gains(tmp_path / "gains.json")
    assert (found.domain, found.rate_hz, found.method) == ("continuous", 100.0, "printed")
    assert found.model_hash == model_hash(builtin_model("arm-disturbed"))
    assert np.array_equal(found.step_matrix, gains.step_matrix)
    assert np.array_equal(found.N, gains.N)
    assert found.report["sqrt_mu"] is None


def test_an_observer_of_another_structure_survives_the_file_too(tmp_path: Path) -> None:
    observer = printed_observer()
    eye = np.eye(8, 6)  # the same observer with two states more
    wide = replace(
        observer,
        step=np.hstack([eye @ observer.A @ eye.T - np.diag([0.0] * 6 + [1.0] * 2), eye @ observer.B_y]),
        output=np.hstack([observer.output[:, :6] @ eye.T, observer.output[:, 6:]]),
        into=eye @ observer.into,
        start=eye @ observer.start,
        matrices=None,
    )
    write_gains(compile_continuous(wide, 100.0), tmp_path / "gains.json")
    found = AffineObserver([read_gains(tmp_path / "gains.json")])
    run = simulate_arm(SCENARIOS["case1"], 5.0, 100.0)
    expected = AffineObserver([compile_continuous(observer, 100.0)]).run(run.u, run.y)
    assert found.run(run.u, run.y).fault == pytest.approx(expected.fault, abs=1e-9)


def test_a_rate_at_which_the_sampled_nonlinearity_is_unstable_is_refused() -> None:
    observer = printed_observer()
    steep = replace(observer, plant=replace(observer.plant, G=1e4 * observer.plant.G))
    with pytest.raises(ModelError, match="printed observer is unstable at 1 Hz"):
        compile_continuous(steep, 1.0)


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan"), float("inf")])
def test_a_rate_that_is_none_is_refused(rate: float) -> None:
    with pytest.raises(ModelError, match="Hz is not positive"):
        compile_continuous(printed_observer(), rate)


def test_a_discrete_model_is_refused() -> None:
    nothing = np.zeros((4, 4))
    with pytest.raises(ModelError, match="multirotor: the model is discrete"):
        fauio_observer(multirotor(), nothing, nothing, nothing, "printed")
