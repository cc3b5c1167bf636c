"""What is said about a multirotor's model holds for simulated ones whose truth is known."""

import numpy as np
import pytest

from gains.identification.segment import Segment
from monitor.fitting.fit_report import explained_change, predict_ahead
from monitor.vehicles.multirotor.identify import MultirotorFit, identify_multirotor, multirotor_plant

RATE_HZ = 100.0
A = np.array([0.98, 0.98, 0.99])
B = np.array([[-0.3, 0.3, 0.02, -0.02], [0.02, -0.02, 0.3, -0.3], [0.05, 0.05, -0.05, -0.05]])
TAPS = np.array([0.0, 0.6, 0.4])
GUST = 2e-3


def flight(seed: int, seconds: float, gust_s: float = 0.0) -> Segment:
    """Simulate random manoeuvres; gusts are white or have a correlation time."""
    rng = np.random.default_rng(seed)
    count = round(seconds * RATE_HZ)
    u = 0.5 + 0.1 * np.repeat(rng.normal(size=(count // 20 + 1, 4)), 20, axis=0)[:count]
    effect = np.stack([np.convolve(column, TAPS)[:count] for column in u.T], axis=1)
    keep = np.exp(-1.0 / (gust_s * RATE_HZ)) if gust_s else 0.0
    y, gust = np.zeros((count, 4)), np.zeros(3)
    y[:, 3] = -9.81 * u.sum(axis=1) / 2.0
    for k in range(count - 1):
        gust = keep * gust + np.sqrt(1.0 - keep * keep) * GUST * rng.normal(size=3)
        y[k + 1, :3] = A * y[k, :3] + B @ effect[k] + gust
    return Segment(u, y)


@pytest.fixture(scope="module")
def segments() -> list[Segment]:
    return [flight(1, 60.0), flight(2, 60.0)]


@pytest.fixture(scope="module")
def model(segments: list[Segment]) -> MultirotorFit:
    return identify_multirotor(segments, RATE_HZ)[0]


def test_the_effect_of_commands_is_delayed_and_curved(model: MultirotorFit) -> None:
    u = np.random.default_rng(0).random((50, 4))
    effect = model.effect(u)
    v = (1.0 - model.square) * u + model.square * u**2
    count = len(model.taps)
    assert effect.shape == (50 - count, 4)
    assert effect[-1] == pytest.approx(sum(h * v[48 - d] for d, h in enumerate(model.taps)))
    assert model.effect(u[:count]).shape == (0, 4)


@pytest.mark.long
def test_correlated_gusts_leave_more_doubt_than_white_ones() -> None:
    white, coloured = (identify_multirotor([flight(8, 60.0, gust_s=gust_s)], RATE_HZ)[1] for gust_s in (0.0, 0.5))
    assert np.all(coloured.drive > 1.5 * white.drive)


def test_doubt_about_the_motors_widens_the_disturbance_of_the_design(model: MultirotorFit) -> None:
    names = ("motor1", "motor2", "motor3", "motor4")
    sure, doubtful = (multirotor_plant(model, "quad", names, doubt=doubt) for doubt in ((0, 0, 0), (1e-3, 2e-3, 0)))
    wider = [b.scale - a.scale for a, b in zip(sure.disturbances, doubtful.disturbances, strict=True)]
    assert wider == pytest.approx([1e-3, 2e-3, 0.0, 0.0])
    assert [one.scale for one in sure.noises] == [one.scale for one in doubtful.noises]


def test_predictions_of_unseen_flight_miss_by_the_gusts_alone(model: MultirotorFit) -> None:
    unseen = flight(9, 40.0)
    driven = Segment(model.effect(unseen.u), unseen.y[len(model.taps) - 1 :, :3])
    one, several = (predict_ahead((np.diag(model.a), model.B[:3], model.c[:3]), driven, steps) for steps in (1, 10))
    assert one.measured - one.predicted == pytest.approx(0.0, abs=6 * GUST)
    assert (one.measured - one.predicted).std(axis=0) == pytest.approx([GUST] * 3, rel=0.1)
    grown = GUST * np.sqrt(np.sum(A[:, None] ** (2 * np.arange(10)), axis=1))
    assert (several.measured - several.predicted).std(axis=0) == pytest.approx(grown, rel=0.2)
    assert np.array_equal(several.measured, one.measured[9:])
    assert np.all(explained_change([several]) > explained_change([one]))
