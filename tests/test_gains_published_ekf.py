"""The augmented-state Kalman filter: compiled steady state, and the extended filter of the benchmark beside it."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gains_samples import integrator_with_drift, multirotor, rmse, with_rates

from adapters.errors import InfeasibleError, ModelError
from adapters.simulation.arm import SCENARIOS, simulate_arm
from gains.plants.model_file import builtin_model
from gains.plants.plant import FloatArray, Plant
from gains.published.kalman import design_ekf, filter_model
from gains.synthesis.gains_file import read_gains, write_gains
from monitor.estimation.affine import AffineObserver

sys.path.insert(0, str(Path(__file__).parents[1] / "bench"))
from extended_kalman import ExtendedKalmanFilter


def arm() -> Plant:
    return with_rates(builtin_model("arm-disturbed"), 20.0)


def linear_run(plant: Plant, count: int) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(1)
    return rng.normal(size=(count, len(plant.inputs))), rng.normal(size=(count, len(plant.outputs)))


def test_both_faults_of_the_arm_are_followed_by_both_filters() -> None:
    run = simulate_arm(SCENARIOS["case2"], 24.0, 100.0)
    steady = AffineObserver([design_ekf(arm(), 100.0)]).run(run.u, run.y).fault
    extended, full = ExtendedKalmanFilter(arm(), 100.0), []
    extended.restart(run.y[0])
    for u, y in zip(run.u, run.y, strict=True):
        extended.step(u, y)
        full.append(extended.fault.copy())
    for found in (steady, np.array(full)):
        assert rmse(found[1:, 0] - run.f_a[:-1, 0]) < 0.02
        assert rmse(found[:, 1] - run.f_s[:, 0]) < 0.012


def test_on_a_linear_plant_the_filter_converges_to_the_compiled_one() -> None:
    plant = multirotor()
    u, y = linear_run(plant, 2000)
    steady = AffineObserver([design_ekf(plant)]).run(u, y)
    full = ExtendedKalmanFilter(plant)
    full.restart(y[0])
    for k in range(len(u)):
        full.step(u[k], y[k])
    assert full.fault == pytest.approx(steady.fault[-1], rel=1e-3, abs=1e-6)
    assert full.x == pytest.approx(steady.x[-1, 0], rel=1e-3, abs=1e-6)
    assert full.residual == pytest.approx(steady.residual[-1, 0], rel=1e-3, abs=1e-6)


def test_the_compiled_filter_survives_a_gains_file(tmp_path: Path) -> None:
    gains = design_ekf(arm(), 100.0)
    write_gains(gains, tmp_path / "ekf.json")
    again = read_gains(tmp_path / "ekf.json")
    assert np.array_equal(again.step_matrix, gains.step_matrix)
    assert again.report["sqrt_mu"] is None


def test_delayed_inputs_are_folded_in() -> None:
    plant = replace(multirotor(), taps=(0.25, 0.75))
    u, y = linear_run(plant, 50)
    late = AffineObserver([design_ekf(plant)]).run(u, y)
    effect = np.vstack([u[:1], 0.25 * u[1:] + 0.75 * u[:-1]])
    assert late.fault == pytest.approx(AffineObserver([design_ekf(multirotor())]).run(effect, y).fault, abs=1e-9)


def test_a_fault_that_hides_in_drift_has_no_steady_state() -> None:
    with pytest.raises(InfeasibleError, match="no steady state"):
        design_ekf(integrator_with_drift())


def test_a_sensor_fault_that_may_hardly_move_is_followed_late() -> None:
    slow = replace(arm(), faults=tuple(replace(f, rate=0.01 if f.kind == "sensor" else 20.0) for f in arm().faults))
    run = simulate_arm(SCENARIOS["case2"], 40.0, 100.0)
    late, quick = (AffineObserver([design_ekf(plant, 100.0)]).run(run.u, run.y).fault for plant in (slow, arm()))
    assert rmse(late[:, 1] - run.f_s[:, 0]) > 5.0 * rmse(quick[:, 1] - run.f_s[:, 0])


def test_a_continuous_model_needs_a_rate_and_the_extended_filter_no_delays() -> None:
    with pytest.raises(ModelError, match="rate"):
        filter_model(arm())
    with pytest.raises(ModelError, match="delays"):
        ExtendedKalmanFilter(replace(multirotor(), taps=(0.5, 0.5)))
