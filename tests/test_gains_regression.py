"""One axis: no bias from noise, the right timing, an honest standard error."""

import numpy as np
import pytest
from simulated_vehicles import DELAY_S, LAG_S, RATE_HZ, ROLL, SIDE_FORCE, flight

from adapters.errors import ModelError
from gains.identification.regression import AxisModel, coloured_inflation, fit_axis
from gains.identification.segment import Segment
from monitor.vehicles.plane.transform import SurfaceInputs

ROLL_AXIS = AxisModel("roll_rate", "aileron", ("pressure", "side_force"), offset=False)
OUTPUTS = SurfaceInputs.outputs


def test_coefficients_and_timing_are_recovered() -> None:
    fit = fit_axis([flight(1), flight(2)], RATE_HZ, SurfaceInputs.inputs, OUTPUTS, ROLL_AXIS)
    assert (fit.lag_s, fit.delay_s) == (LAG_S, DELAY_S)
    assert (fit.a, fit.b) == pytest.approx(ROLL, rel=0.02)
    assert fit.effects == pytest.approx([0.0, SIDE_FORCE], abs=2e-4)
    assert fit.disturbance_std == pytest.approx(0.002, rel=0.1)


def test_measurement_noise_neither_biases_the_model_nor_passes_for_disturbance() -> None:
    noisy = fit_axis([flight(1, noise=0.02)], RATE_HZ, SurfaceInputs.inputs, OUTPUTS, ROLL_AXIS)
    assert noisy.a == pytest.approx(ROLL[0], abs=0.02)
    assert noisy.b / (1.0 - noisy.a) == pytest.approx(ROLL[1] / (1.0 - ROLL[0]), rel=0.03)
    assert noisy.noise_std == pytest.approx(0.02, rel=0.1)
    assert noisy.disturbance_std < 0.01


def test_breaks_between_segments_are_respected() -> None:
    whole = flight(3)
    pieces = [type(whole)(whole.u[k : k + 300], whole.y[k : k + 300]) for k in range(0, 2400, 300)]
    fit = fit_axis(pieces, RATE_HZ, SurfaceInputs.inputs, OUTPUTS, ROLL_AXIS)
    assert (fit.a, fit.b) == pytest.approx(ROLL, rel=0.05)


def test_an_output_that_forgets_within_a_sample_has_no_memory() -> None:
    rng = np.random.default_rng(1)
    u, y = rng.normal(size=1500), np.zeros(1500)
    for k in range(1499):
        y[k + 1] = -0.2 * y[k] + 5.0 * u[k] + rng.normal()
    axis = AxisModel("roll_rate", "aileron", (), offset=False)
    fit = fit_axis([Segment(u[:, None], y[:, None])], RATE_HZ, ["aileron"], ["roll_rate"], axis)
    assert fit.a == 0.0
    assert fit.b == pytest.approx(5.0, rel=0.05)
    assert fit.t_value > 50.0


def test_a_rival_that_moves_in_step_makes_the_coefficient_uncertain() -> None:
    rivalled = AxisModel("roll_rate", "aileron", ("pressure", "side_force"), rivals=("rudder",), offset=False)
    apart = fit_axis([flight(1)], RATE_HZ, SurfaceInputs.inputs, OUTPUTS, rivalled)
    mixed = fit_axis([flight(1, mixed=True)], RATE_HZ, SurfaceInputs.inputs, OUTPUTS, rivalled)
    assert apart.t_value > 20.0
    assert mixed.t_value < 5.0


def test_noise_that_holds_on_counts_less() -> None:
    rng = np.random.default_rng(0)
    white = rng.normal(size=20000)
    slow = np.convolve(white, np.ones(10) / 10.0, mode="valid")
    assert coloured_inflation([white], RATE_HZ) == pytest.approx(1.0, abs=0.1)
    assert coloured_inflation([slow], RATE_HZ) == pytest.approx(10.0, rel=0.25)


def test_too_little_is_refused() -> None:
    with pytest.raises(ModelError, match="at least 20 s"):
        fit_axis([flight(1, count=500)], RATE_HZ, SurfaceInputs.inputs, OUTPUTS, ROLL_AXIS)
