"""A certificate holds for what was designed and for nothing that was tampered with."""

import math
from dataclasses import replace

import numpy as np
import pytest
from gains_samples import random_plant

from gains.plants.model_file import builtin_model
from gains.plants.plant import Plant
from gains.synthesis.certificate import certify, design_report
from gains.synthesis.convex import design_convex
from gains.synthesis.design import Design


@pytest.fixture(scope="module")
def arm() -> Plant:
    return builtin_model("arm-disturbed")


@pytest.fixture(scope="module")
def design(arm: Plant) -> Design:
    return design_convex(arm, 100.0)


def test_a_design_is_certified_with_a_margin_and_its_norm_within_the_bound(arm: Plant, design: Design) -> None:
    certificate = certify(arm, design)
    assert certificate.holds
    assert certificate.margin > 1e-9
    assert 0.99 * design.sqrt_mu < certificate.norm <= design.sqrt_mu
    assert certificate.poles_max < 1.0


def test_a_smaller_bound_than_the_norm_is_never_certified(arm: Plant, design: Design) -> None:
    norm = certify(arm, design).norm
    assert not certify(arm, replace(design, mu=(0.999 * norm) ** 2)).holds


@pytest.mark.parametrize("name", ["K", "L_i", "L_p", "N", "J", "L1", "F"])
def test_tampered_gains_are_not_certified(arm: Plant, design: Design, name: str) -> None:
    tampered = replace(design.gains, **{name: 1.1 * getattr(design.gains, name)})
    assert not certify(arm, replace(design, gains=tampered)).holds


def test_gains_of_another_model_are_not_certified(arm: Plant, design: Design) -> None:
    assert not certify(replace(arm, A=1.05 * arm.A), design).holds
    faster = tuple(replace(fault, rate=2.0) for fault in arm.faults)
    assert not certify(replace(arm, faults=faster), design).holds


def test_an_unstable_error_system_has_no_norm(arm: Plant, design: Design) -> None:
    certificate = certify(arm, replace(design, gains=replace(design.gains, L_i=-design.gains.L_i)))
    assert certificate.norm == math.inf
    assert certificate.poles_max > 1.0
    assert not certificate.holds


def test_a_matrix_that_is_no_storage_function_is_no_certificate(arm: Plant, design: Design) -> None:
    assert certify(arm, replace(design, P=-design.P)).margin == -math.inf
    assert not certify(arm, replace(design, P=np.eye(6))).holds


def test_rounding_is_counted_against_the_margin() -> None:
    plant = random_plant(3, 1, 1)
    design = design_convex(plant)
    stretched = np.ones(len(design.P))
    stretched[0] = 1e9
    assert certify(plant, replace(design, P=design.P * stretched * stretched[:, None])).margin < 0.0


def test_the_report_has_the_keys_of_the_contract(arm: Plant, design: Design) -> None:
    found = design_report(arm, design, certify(arm, design))
    keys = "model method domain rate_hz status sqrt_mu norm poles_max_abs gain_max_abs certificate solve_s total_s"
    assert set(keys.split()) <= set(found)
    assert found["certificate"] | {"margin": None} == {
        "holds": True,
        "margin": None,
        "proof": "vertices",
        "slopes": 2,
    }


@pytest.fixture(scope="module")
def free(arm: Plant) -> Design:
    return design_convex(arm, 100.0, vertices=False, pole_radius=0.98)


def test_multipliers_prove_a_design_without_its_vertices(arm: Plant, free: Design) -> None:
    certificate = certify(arm, free)
    assert certificate.holds
    assert certificate.margin > 0.0
    assert (certificate.proof, certificate.slopes) == ("multipliers", 3)
    assert certificate.poles_max <= 0.98
    assert certify(arm, replace(free, multipliers=None)).holds


@pytest.mark.parametrize("row", [0, 1])
@pytest.mark.parametrize("factor", [-1.0, 0.0, 1e-3, 1e3])
def test_other_multipliers_prove_nothing(arm: Plant, free: Design, row: int, factor: float) -> None:
    assert free.multipliers is not None
    others = free.multipliers.copy()
    others[row] *= factor
    assert not certify(arm, replace(free, multipliers=others)).holds


@pytest.mark.parametrize("name", ["K", "L_i", "L_p"])
def test_multipliers_do_not_prove_tampered_gains(arm: Plant, free: Design, name: str) -> None:
    tampered = replace(free.gains, **{name: 1.1 * getattr(free.gains, name)})
    assert not certify(arm, replace(free, gains=tampered)).holds
    assert not certify(arm, replace(free, P=1.1 * free.P)).holds


def test_multipliers_do_not_prove_wider_slopes(arm: Plant, free: Design) -> None:
    (g,) = arm.nonlinearities
    assert not certify(replace(arm, nonlinearities=(replace(g, slopes=10.0 * g.slopes),)), free).holds


def test_poles_and_gains_beyond_what_was_asked_are_not_certified(arm: Plant, design: Design) -> None:
    certificate = certify(arm, design)
    assert certify(arm, replace(design, gain_bound=design.gains.gain_max_abs)).holds
    assert not certify(arm, replace(design, gain_bound=0.999 * design.gains.gain_max_abs)).holds
    assert not certify(arm, replace(design, pole_radius=0.999 * certificate.poles_max)).holds
