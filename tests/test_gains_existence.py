"""Models whose faults cannot be estimated are refused with the condition and the signals named."""

from dataclasses import replace

import numpy as np
import pytest
from gains_samples import integrator_with_drift, multirotor, random_plant, sine
from hypothesis import given, settings
from hypothesis import strategies as st

from adapters.errors import InfeasibleError, ModelError
from gains.analysis.check import check_plant
from gains.analysis.estimability import check_existence
from gains.plants.discretise import discretise
from gains.plants.model_file import builtin_model
from gains.plants.plant import Fault, Plant


@pytest.mark.parametrize("rate", [1.0, 100.0, 10_000.0])
@pytest.mark.parametrize("name", ["arm", "arm-disturbed"])
def test_the_arm_meets_every_condition_at_every_rate(name: str, rate: float) -> None:
    assert check_existence(discretise(builtin_model(name), rate)) == ()


@settings(deadline=None, derandomize=True)
@given(st.integers(0, 10_000), st.integers(0, 2), st.integers(0, 1), st.floats(0, 4))
def test_random_plants_meet_the_conditions_in_any_units(seed: int, a1: int, a2: int, decades: float) -> None:
    if a1 + a2:
        assert check_existence(random_plant(seed, a1, a2, decades=decades)) == ()


def test_an_attack_that_looks_like_drift_fails_detectability_by_name() -> None:
    message = r"drift: detectability of \(L1 A_z, Cb\) fails: 'gps_offset' moving with 'position' shows in no output"
    with pytest.raises(InfeasibleError, match=message) as caught:
        check_existence(integrator_with_drift())
    assert "mode at z = 1" in str(caught.value)
    assert caught.value.exit_status == 3


def test_a_leak_or_a_second_sensor_makes_the_attack_estimable() -> None:
    plant = integrator_with_drift()
    check_existence(replace(plant, A=plant.A - np.diag([1.0 / 600.0, 0.0])))
    check_existence(
        replace(
            plant,
            outputs=("gps", "speedometer", "lidar"),
            C=np.array([[1.0, 0], [0, 1.0], [1.0, 0]]),
            faults=(Fault("gps_offset", "sensor", np.array([1.0, 0, 0])),),
            noises=(),
        )
    )


@settings(deadline=None, derandomize=True)
@given(st.integers(0, 10_000), st.floats(0, 3))
def test_faults_whose_steady_effects_cancel_in_every_output_fail_condition_two(seed: int, decades: float) -> None:
    rng = np.random.default_rng(seed)
    plant = random_plant(seed, 2, 0, decades=decades)
    if len(plant.states) < 3:
        return
    mix = rng.normal(size=2)
    steady = np.linalg.solve(np.eye(len(plant.A)) - plant.A, plant.E_f @ mix)
    C = plant.C - np.outer(plant.C @ steady, steady / plant.state_errors**2) / np.sum(
        (steady / plant.state_errors) ** 2
    )
    with pytest.raises(InfeasibleError, match=r"condition II fails: .*'actuator[01]'.* z = 1"):
        check_existence(replace(plant, C=C))


def test_more_faults_than_outputs_cannot_be_told_apart() -> None:
    plant = builtin_model("arm")
    faults = (
        *plant.faults,
        Fault("rate_attack", "sensor", np.array([0, 1.0, 0])),
        Fault("push", "actuator", np.array([0, 0, 0, 1.0])),
    )
    with pytest.raises(InfeasibleError, match="4 faults cannot be told apart with 3 outputs"):
        check_existence(discretise(replace(plant, faults=faults), 100.0))


def test_a_model_without_faults_is_refused() -> None:
    with pytest.raises(ModelError, match="nothing to estimate"):
        check_existence(replace(multirotor(), faults=()))


def test_an_unstable_hidden_mode_is_a_mistake_of_the_model() -> None:
    plant = random_plant(4, 1, 0)
    n = len(plant.states)
    A = np.zeros((n + 1, n + 1))
    A[:n, :n], A[n, n] = plant.A, 1.01
    widened = replace(
        plant,
        states=(*plant.states, "ghost"),
        A=A,
        B=np.vstack([plant.B, np.zeros((1, plant.B.shape[1]))]),
        C=np.hstack([plant.C, np.zeros((len(plant.C), 1))]),
        c=np.append(plant.c, 0.0),
        G=np.zeros(0),
        state_errors=np.append(plant.state_errors, 1.0),
        faults=tuple(replace(fault, column=np.append(fault.column, 0.0)) for fault in plant.faults),
        disturbances=(),
    )
    with pytest.raises(ModelError, match=r"hidden mode: 'ghost' shows in no output \(mode at z = 1\.01\)") as caught:
        check_existence(widened)
    assert caught.value.exit_status == 2
    A[n, n] = 0.99
    check_existence(replace(widened, A=A))


def test_a_mode_that_only_some_slope_hides_is_found_at_its_vertex() -> None:
    plant = Plant(
        name="sloped",
        domain="discrete",
        rate_hz=10.0,
        states=("seen", "hidden"),
        inputs=(),
        outputs=("y",),
        A=np.diag([0.5, 0.8]),
        B=np.zeros((2, 0)),
        C=np.array([[1.0, 0.0]]),
        G=np.array([[0.0], [0.3]]),
        nonlinearities=(sine(np.array([0.0, 1.0])),),
        faults=(Fault("motor", "actuator", np.array([1.0, 0.0])),),
    )
    with pytest.raises(ModelError, match=r"hidden mode: 'hidden' .* z = 1\.1 at slopes 1\)"):
        check_existence(plant)


def test_a_fault_that_is_seen_late_is_noted() -> None:
    plant = replace(integrator_with_drift(), faults=(Fault("motor", "actuator", np.array([0.0, 1.0])),))
    plant = replace(plant, outputs=("gps",), C=np.array([[1.0, 0.0]]), noises=())
    (note,) = check_existence(plant)
    assert "Cb L1 E_f lacks rank: 'motor' cannot be seen in the first sample" in note


@pytest.mark.parametrize("seed", [60, 126])
def test_units_ten_decades_apart_do_not_make_faults_look_alike(seed: int) -> None:
    plant = random_plant(seed, 2, 1, decades=5.0)
    assert check_existence(plant) == ()
    assert check_plant(plant).estimable
