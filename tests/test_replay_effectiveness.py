"""What healthy operation teaches about reading a fault estimate."""

import numpy as np
import pytest
from gains_samples import multirotor

from gains.synthesis.certificate import certify
from gains.synthesis.compilation import compile_gains
from gains.synthesis.convex import design_convex
from monitor.core.effectiveness import EffectivenessEstimator
from monitor.estimation.effectiveness import EffectivenessRule, EffectivenessRun
from monitor.fitting.effectiveness import HealthyRun, calibrate_effectiveness, response_delay_s

RATE_HZ = 50.0
UNCALIBRATED = EffectivenessRule(noise=1.0, inflation=1.0, lag_s=0.0, loss_doubt=0.0, offset_doubt=0.0, certainty=5.0)


def test_calibration_finds_noise_colour_and_the_models_own_error() -> None:
    rng = np.random.default_rng(0)
    slow = np.convolve(rng.normal(size=6003), np.full(4, 0.25), mode="valid") * 0.02
    command = 0.3 * np.sign(np.sin(np.arange(6000) / 40.0))
    run = HealthyRun(slow - 0.06 * command, command, np.ones(6000))
    rule = calibrate_effectiveness([run], RATE_HZ, UNCALIBRATED)
    assert rule.noise == pytest.approx(0.01, rel=0.1)
    assert rule.inflation > 3.0
    assert rule.loss_doubt >= 0.02
    assert rule.certainty >= 5.0
    estimator = EffectivenessEstimator(rule, RATE_HZ)
    flags = np.ones(6000, np.bool_)
    evidence = EffectivenessRun(
        *estimator.run(np.arange(6000) * 20_000_000, ~flags, flags, *run, np.ones(6000))
    ).evidence
    assert not np.nan_to_num(evidence).any()


def test_the_estimates_delay_is_that_of_its_step_response() -> None:
    plant = multirotor()
    design = design_convex(plant, plant.rate_hz)
    gains = compile_gains(plant, design, certify(plant, design))
    delay = response_delay_s(plant, gains, plant.faults[0].name)
    assert 1.0 / gains.rate_hz <= delay < 1.0
