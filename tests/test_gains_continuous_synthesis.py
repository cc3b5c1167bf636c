"""The continuous convex synthesis reaches the known optimum, keeps what is asked of it, and proves what it returns."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from gains_samples import assert_proven, continuous_plant, multirotor, with_rates
from hypothesis import given, settings
from hypothesis import strategies as st

import gains.synthesis.continuous_synthesis
from adapters.errors import InaccurateError, InfeasibleError, ModelError
from adapters.simulation.arm import SCENARIOS, simulate_arm
from gains.plants.model_file import builtin_model
from gains.plants.plant import Fault, Plant
from gains.synthesis.certificate import Certificate, certify
from gains.synthesis.continuous_observer import compile_continuous, designed_observer
from gains.synthesis.continuous_synthesis import design_continuous
from gains.synthesis.design import Design
from monitor.estimation.affine import AffineObserver

FLOOR = 0.13628


def test_the_disturbed_arm_is_certified_at_the_optimum_of_the_class() -> None:
    plant = builtin_model("arm-disturbed")
    design = design_continuous(plant)
    certificate = assert_proven(plant, design)
    assert FLOOR < certificate.norm <= design.sqrt_mu <= 0.1453
    assert certificate.poles_min > -1000.0


@pytest.mark.parametrize(("case", "paper_fa", "paper_fs"), [("case2", 0.0340, 0.0295), ("case3", 0.0189, 0.0120)])
def test_the_continuous_design_beats_the_printed_errors_on_samples(case: str, paper_fa: float, paper_fs: float) -> None:
    plant = with_rates(builtin_model("arm-disturbed"), 20.0)
    run = simulate_arm(SCENARIOS[case], 50.0, 100.0)
    observer = designed_observer(plant, design_continuous(plant))
    found = AffineObserver([compile_continuous(observer, 100.0)]).run(run.u, run.y)
    assert np.sqrt(np.mean((found.fault[1:, 0] - run.f_a[:-1, 0]) ** 2)) < paper_fa
    assert np.sqrt(np.mean((found.fault[:, 1] - run.f_s[:, 0]) ** 2)) < paper_fs


@pytest.mark.parametrize("decay", [(0.0, 30.0), (0.9, math.inf), (0.5, 100.0)])
def test_a_range_of_decay_rates_is_kept_at_every_vertex(decay: tuple[float, float]) -> None:
    plant = builtin_model("arm-disturbed")
    certificate = assert_proven(plant, design_continuous(plant, decay=decay))
    assert certificate.poles_max <= -decay[0]
    assert certificate.poles_min >= -decay[1]


def test_dearer_gains_are_smaller_and_the_bound_pays_for_them() -> None:
    plant = builtin_model("arm-disturbed")
    cheap, dear = design_continuous(plant), design_continuous(plant, gain_weight=0.1)
    assert dear.gains.gain_max_abs < 0.11 * cheap.gains.gain_max_abs
    assert dear.sqrt_mu > cheap.sqrt_mu


def test_an_arm_without_noise_gets_finite_gains() -> None:
    plant = builtin_model("arm")
    design = design_continuous(plant)
    assert_proven(plant, design)
    assert design.gains.gain_max_abs < 1e6


@pytest.mark.long
@settings(deadline=None, derandomize=True, max_examples=20)
@given(
    st.integers(0, 10_000),
    st.sampled_from([(1, 0), (0, 1), (1, 1), (2, 1)]),
    st.integers(0, 1),
    st.sampled_from([0.0, 3.0]),
    st.sampled_from([0.1, 10.0, 1000.0]),
)
def test_random_plants_get_proven_gains_that_run(
    seed: int, faults: tuple[int, int], nonlinear: int, decades: float, speed: float
) -> None:
    plant = continuous_plant(seed, *faults, nonlinear=nonlinear, decades=decades, speed=speed)
    design = design_continuous(plant)
    certificate = assert_proven(plant, design)
    assert design.sqrt_mu < 1.02 * certificate.norm or nonlinear
    compile_continuous(designed_observer(plant, design), 20.0 * speed)


def test_the_bound_does_not_depend_on_the_unit_of_time_or_state() -> None:
    plant = builtin_model("arm-disturbed")
    x = 10.0 ** np.array([2.0, -1.0, 0.0, -3.0])
    other = replace(
        plant,
        A=x[:, None] * plant.A / x,
        B=x[:, None] * plant.B,
        C=plant.C / x,
        G=x[:, None] * plant.G,
        nonlinearities=tuple(replace(g, rows=g.rows / x) for g in plant.nonlinearities),
        state_errors=x,
        faults=tuple(replace(f, column=f.column * x) if f.kind == "actuator" else f for f in plant.faults),
        disturbances=tuple(replace(w, column=w.column * x) for w in plant.disturbances),
    )
    assert design_continuous(other).sqrt_mu == pytest.approx(design_continuous(plant).sqrt_mu, rel=1e-3)


def test_failed_conditions_are_named_in_continuous_terms() -> None:
    plant = Plant(
        name="drift",
        states=("position", "velocity"),
        inputs=(),
        outputs=("gps", "speedometer"),
        A=np.array([[0.0, 1.0], [0.0, -1.0]]),
        B=np.zeros((2, 0)),
        C=np.eye(2),
        faults=(Fault("gps_offset", "sensor", np.array([1.0, 0.0])),),
    )
    with pytest.raises(InfeasibleError, match=r"detectability of \(L1 A_z, Cb\) fails: 'gps_offset'.*s = 0"):
        design_continuous(plant)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"decay": (-1.0, 5.0)}, "decay rates from -1 to 5"),
        ({"decay": (5.0, 1.0)}, "decay rates from 5 to 1"),
        ({"decay": (float("nan"), 1.0)}, "decay rates from nan"),
        ({"gain_weight": 0.0}, "a gain weight of 0.0 is not positive"),
    ],
)
def test_what_cannot_be_asked_is_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        design_continuous(builtin_model("arm"), **arguments)


def test_a_discrete_model_is_refused() -> None:
    with pytest.raises(ModelError, match="the model is discrete"):
        design_continuous(multirotor())


def test_rates_that_no_gains_reach_are_said_to_be_infeasible() -> None:
    with pytest.raises(InfeasibleError, match="no gains make every error decay at 2000 rad/s"):
        design_continuous(builtin_model("arm-disturbed"), decay=(2000.0, 2001.0))


def test_gains_that_no_certificate_confirms_are_never_returned(monkeypatch: pytest.MonkeyPatch) -> None:
    def rejecting(plant: Plant, design: Design) -> Certificate:
        return replace(certify(plant, design), holds=False)

    monkeypatch.setattr(gains.synthesis.continuous_synthesis, "certify", rejecting)
    with pytest.raises(InaccurateError, match="no gains it found could be certified"):
        design_continuous(builtin_model("arm-disturbed"))
