"""The continuous certificate finds the printed gains' norms and rejects what is not proven."""

from dataclasses import replace

import numpy as np
import pytest
from gains_samples import continuous_plant
from paper_gains import BETA, DISTURBED, UNDISTURBED, Printed

from gains.analysis.augment import augment, error_model
from gains.plants.model_file import builtin_model
from gains.plants.plant import Plant
from gains.synthesis.certificate import certify, closed_error_system, design_report
from gains.synthesis.continuous_synthesis import design_continuous
from gains.synthesis.design import Design, FaultState, observer_matrices


def printed_design(printed: Printed) -> tuple[Plant, Design]:
    plant = builtin_model(printed.model)
    L = BETA * printed.L2
    gains = observer_matrices(augment(plant), printed.K, L, L)
    return plant, Design("printed", None, gains, np.eye(6), 1.0, fault_state="error")


@pytest.mark.parametrize(("printed", "norm"), [(UNDISTURBED, 2.157e-4), (DISTURBED, 0.1878)])
def test_the_printed_gains_have_their_true_norms_at_rest(printed: Printed, norm: float) -> None:
    certificate = certify(*printed_design(printed))
    assert certificate.norm == pytest.approx(norm, rel=5e-4)
    assert certificate.norm_hz == pytest.approx(0.0, abs=1e-6)


def test_the_printed_poles_are_found() -> None:
    certificate = certify(*printed_design(DISTURBED))
    assert certificate.poles_min == pytest.approx(-33_280.0, rel=1e-3)
    assert certificate.poles_max == pytest.approx(-0.13, abs=0.3)


def test_a_p_that_proves_nothing_is_no_proof() -> None:
    assert not certify(*printed_design(DISTURBED)).holds


def test_both_coordinates_are_one_system_for_real_signals() -> None:
    plant, design = printed_design(DISTURBED)
    model = error_model(plant, augment(plant))
    rng = np.random.default_rng(4)
    w, rate, s = rng.normal(size=2), rng.normal(size=1), 3.7j
    inputs = np.concatenate([w, s * w, rate])  # w' = s w
    errors = []
    states: tuple[FaultState, ...] = ("integral", "error")
    for state in states:
        system = closed_error_system(model, design.gains, state)
        response = system.C @ np.linalg.solve(s * np.eye(6) - system.A[0], system.B @ inputs) + system.D @ inputs
        errors.append(response)
    assert errors[0] == pytest.approx(errors[1], rel=1e-9)


def test_the_norm_is_the_highest_gain_over_the_frequencies() -> None:
    plant = continuous_plant(5, 1, 1, nonlinear=1)
    design = design_continuous(plant)
    certificate = certify(plant, design)
    model = error_model(plant, design.gains.inverse(augment(plant)))
    system = closed_error_system(model, design.gains, "integral")
    eye = np.eye(len(design.P))
    gains = [
        np.linalg.norm(system.C @ np.linalg.solve(1j * w * eye - A, system.B) + system.D, 2)
        for w in [0.0, *np.geomspace(1e-4, 1e4, 800)]
        for A in system.A
    ]
    assert max(gains) <= certificate.norm * (1.0 + 1e-9)
    assert max(gains) >= 0.999 * certificate.norm


@pytest.mark.parametrize("what", ["mu", "P", "sign", "K", "N"])
def test_a_design_that_was_tampered_with_is_rejected(what: str) -> None:
    plant = builtin_model("arm-disturbed")
    design = design_continuous(plant, gain_weight=0.01)
    assert certify(plant, design).holds
    gains = design.gains
    tampered = {
        "mu": replace(design, mu=0.98 * design.mu),
        "P": replace(design, P=design.P + 0.05 * np.trace(design.P) * np.eye(len(design.P))),
        "sign": replace(design, P=-design.P),
        "K": replace(design, gains=observer_matrices(augment(plant), -gains.K, gains.L_i, gains.L_p)),
        "N": replace(design, gains=replace(gains, N=gains.N + 1e-3)),
    }[what]
    assert not certify(plant, tampered).holds


def test_the_report_has_what_the_contract_names() -> None:
    plant = builtin_model("arm-disturbed")
    design = design_continuous(plant)
    found = design_report(plant, design, certify(plant, design))
    assert (found["domain"], found["rate_hz"], found["status"]) == ("continuous", None, "optimal")
    assert found["poles_max_re"] < 0.0
    assert found["certificate"]["holds"] is True
    assert 0.0 < found["solve_s"] <= found["total_s"]
