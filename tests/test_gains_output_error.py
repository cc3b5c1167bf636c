"""Identification on noisy data: unbiased, honest about what the data do not say."""

from pathlib import Path

import numpy as np
import pytest
from gains_samples import dynamics_of

from adapters.errors import ModelError
from gains.identification.fitted_plant import fitted_plant, parameter_uncertainty
from gains.identification.free_model import FreeModel, read_free_model
from gains.identification.output_error import OutputErrorFit, identify
from gains.identification.segment import Segment
from gains.identification.shooting import split_segments
from gains.identification.simulation import Stepper

RATE_HZ = 50.0
LAG, GAIN = 0.15, 3.0
TEXT = """
name = "turret"
states = ["angle", "rate"]
inputs = ["command"]
outputs = ["angle", "gyro"]
[parameters]
lag = { start = 0.4, min = 0.02, max = 2.0 }
gain = { start = 1.0, min = 0.1, max = 20.0 }
[A]
angle = { rate = 1.0 }
rate = { rate = "-1 / lag" }
[B]
rate = { command = "gain / lag" }
[C]
angle = "angle"
gyro = "rate"
[[fault]]
name = "motor"
kind = "actuator"
input = "command"
[[disturbance]]
name = "torque"
into = "rate"
"""


def model_of(folder: Path, text: str = TEXT) -> FreeModel:
    path = folder / "turret.toml"
    path.write_text(text)
    return read_free_model(path)


def recording(
    model: FreeModel, *, count: int = 1200, delay: int = 0, amplitude: float = 1.0, rough: float = 2.0
) -> Segment:
    rng = np.random.default_rng(0)
    t = np.arange(count) / RATE_HZ
    command = amplitude * (np.sin(0.9 * t) + 0.6 * np.sin(4.0 * t) + 0.5 * np.sin(11.0 * t + 1.0))[:, None]
    late = np.vstack([np.repeat(command[:1], delay, axis=0), command[: len(command) - delay]])
    plant = model.plant([LAG, GAIN])
    stepper = Stepper([dynamics_of(plant)], RATE_HZ, "first")
    x, y = np.zeros((1, 1, 2)), np.empty((count, 2))
    drives = stepper.drives(late[None])
    for k in range(count):
        y[k] = x[0, 0] @ plant.C.T + rng.normal(size=2) * [0.02, 0.3]
        if k < count - 1:
            x = stepper.step(x, drives[k] + np.array([0.0, rough / RATE_HZ]) * rng.normal())
    return Segment(command, y)


def fit_of(model: FreeModel, *recordings: Segment) -> OutputErrorFit:
    return identify(model, *split_segments([[one] for one in recordings]), RATE_HZ)


@pytest.fixture(scope="module")
def noisy(tmp_path_factory: pytest.TempPathFactory) -> OutputErrorFit:
    model = model_of(tmp_path_factory.mktemp("turret"))
    return fit_of(model, recording(model, count=3000, delay=4))


def test_parameters_are_found_within_a_few_standard_errors(noisy: OutputErrorFit) -> None:
    errors = np.sqrt(np.diag(noisy.covariance))
    assert np.all(np.abs(noisy.theta - [LAG, GAIN]) < 3.0 * errors)
    assert np.all(errors < 0.1 * noisy.theta)
    assert all(verdict.determined and not verdict.note for verdict in noisy.verdicts)


def test_least_squares_on_the_same_gyro_would_be_far_off(noisy: OutputErrorFit) -> None:
    data = noisy.training
    now, after = data.measured[:, :-1, 1].ravel(), data.measured[:, 1:, 1].ravel()
    slope = np.linalg.lstsq(np.column_stack([now, data.u[:, :-1, 0].ravel()]), after, rcond=None)[0][0]
    assert -1.0 / (RATE_HZ * np.log(slope)) < 0.8 * LAG


def test_the_transport_delay_is_found(noisy: OutputErrorFit) -> None:
    assert (noisy.delay, noisy.hold) == (4, "first")
    assert fitted_plant(noisy).taps == (0.0, 0.0, 0.0, 0.0, 1.0)


def test_disturbance_and_noise_are_told_apart(noisy: OutputErrorFit) -> None:
    scales = {w.name: w.scale for w in (*noisy.signals.disturbances, *noisy.signals.noises)}
    assert scales["torque"] == pytest.approx(2.0, rel=0.15)
    assert scales["noise_angle"] == pytest.approx(0.02, rel=0.1)
    assert scales["noise_gyro"] == pytest.approx(0.3, rel=0.1)


def test_the_innovations_of_the_right_model_are_white(noisy: OutputErrorFit) -> None:
    assert all(found.white or np.abs(found.autocorrelation).max() < 0.1 for found in noisy.residuals)
    assert noisy.validation.simulated_share[0] > 0.95


def test_parameter_uncertainty_becomes_disturbance(noisy: OutputErrorFit) -> None:
    states, outputs = parameter_uncertainty(noisy)
    assert states[0] < 0.2 * states[1]
    assert not outputs.any()
    fitted = next(w.scale for w in noisy.signals.disturbances if w.name == "torque")
    plant = fitted_plant(noisy)
    assert plant.rate_hz == RATE_HZ
    widened = next(w.scale for w in plant.disturbances if w.name == "torque")
    assert widened == pytest.approx(np.hypot(fitted, states[1] * RATE_HZ))


def test_a_parameter_without_excitation_is_named_with_what_to_move(tmp_path: Path) -> None:
    model = model_of(tmp_path)
    fit = fit_of(model, recording(model, amplitude=0.0002, rough=0.02))
    notes = {verdict.name: verdict.note for verdict in fit.verdicts if not verdict.determined}
    assert "gain" in notes
    assert "record manoeuvres that move command (standard deviation" in notes["gain"]


def test_parameters_known_only_together_or_not_at_all_are_named(tmp_path: Path) -> None:
    text = TEXT.replace('"gain / lag"', '"gain * lever / lag"').replace(
        "[A]", "lever = { start = 1.0, min = 0.1, max = 10.0 }\ngust = { start = 1.0, min = 0.0 }\n[A]"
    )
    model = model_of(tmp_path, text + 'scale = "gust"\n')
    fit = fit_of(model, recording(model_of(tmp_path)))
    undetermined = {verdict.name: verdict.note for verdict in fit.verdicts if not verdict.determined}
    assert set(undetermined) == {"gain", "lever", "gust"}
    assert "only in combination with 'lever'" in undetermined["gain"]
    assert undetermined["gust"].startswith("no measured output depends on it:")


def test_scales_that_the_file_states_stay(tmp_path: Path) -> None:
    model = model_of(tmp_path, TEXT + "scale = 7.0\n")
    fit = fit_of(model, recording(model_of(tmp_path)))
    states, _ = parameter_uncertainty(fit)
    assert fitted_plant(fit).disturbances[0].scale == pytest.approx(np.hypot(7.0, states[1] * RATE_HZ))


def test_too_little_data_is_refused(tmp_path: Path) -> None:
    model = model_of(tmp_path)
    whole = recording(model)
    for samples, said in (
        (450, "only 6 s of healthy samples"),
        (200, "longest stretch of healthy samples lasts 1.0 s"),
    ):
        with pytest.raises(ModelError, match=said):
            fit_of(model, Segment(whole.u[:samples], whole.y[:samples]))


def test_a_start_far_off_is_recovered_from(tmp_path: Path) -> None:
    model = model_of(tmp_path, TEXT.replace("start = 0.4", "start = 2.0").replace("start = 1.0", "start = 20.0"))
    fit = fit_of(model, recording(model))
    assert np.all(np.abs(fit.theta - [LAG, GAIN]) < 3.0 * np.sqrt(np.diag(fit.covariance)))
    assert fit.delay == 0


def test_a_model_that_runs_away_from_its_start_is_refused(tmp_path: Path) -> None:
    text = TEXT.replace('"-1 / lag"', '"-1 / lag + grow"').replace("[A]", "grow = { start = 9000.0 }\n[A]")
    with pytest.raises(ModelError, match=r"diverges|grows without bound"):
        fit_of(model_of(tmp_path, text), recording(model_of(tmp_path)))


def test_without_parameters_and_inputs_the_noise_is_still_found(tmp_path: Path) -> None:
    path = tmp_path / "walk.toml"
    path.write_text('name = "walk"\nstates = ["x"]\noutputs = ["y"]\nA = [[-0.5]]\nC = [[1.0]]\n')
    rng = np.random.default_rng(5)
    x = np.zeros(3000)
    for k in range(2999):
        x[k + 1] = np.exp(-0.5 / RATE_HZ) * x[k] + 0.1 * rng.normal()
    data = Segment(np.zeros((3000, 0)), (x + 0.2 * rng.normal(size=3000))[:, None])
    fit = identify(read_free_model(path), *split_segments([[data]]), RATE_HZ)
    assert fit.signals.disturbances[0].scale == pytest.approx(0.1 * RATE_HZ, rel=0.15)
    assert fit.signals.noises[0].scale == pytest.approx(0.2, rel=0.1)


def test_of_three_logs_the_last_is_kept_back() -> None:
    logs = [[Segment(np.zeros((8, 1)) + i, np.zeros((8, 1)))] for i in range(3)]
    training, validation = split_segments(logs)
    assert [one.u[0, 0] for one in training] == [0.0, 1.0]
    assert [one.u[0, 0] for one in validation] == [2.0]
    assert [len(one.u) for one in split_segments(logs[:1])[0]] == [6]
