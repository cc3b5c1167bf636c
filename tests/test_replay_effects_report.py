"""What a fit is worth on data kept back: a right model explains it, a wrong one does not, no data is no verdict."""

from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from adapters.errors import ModelError
from gains.identification.segment import Segment
from gains.plants.plant import Plant
from monitor.fitting.fit_effects import compare_effects
from monitor.fitting.fit_report import predict_ahead

RATE_HZ = 50.0


def plant(gain: float = 0.2) -> Plant:
    return Plant(
        name="wheel",
        domain="discrete",
        rate_hz=RATE_HZ,
        states=("yaw_rate",),
        inputs=("steering",),
        outputs=("yaw_rate",),
        A=np.array([[0.9]]),
        B=np.array([[gain]]),
        C=np.eye(1),
        c=np.array([0.01]),
    )


def drive(seconds: float, noise: float = 0.0) -> Segment:
    rng = np.random.default_rng(0)
    count = round(seconds * RATE_HZ)
    u = np.sign(np.sin(np.arange(count) / 20.0))[:, None]
    y = np.zeros((count, 1))
    for k in range(count - 1):
        y[k + 1] = 0.9 * y[k] + 0.2 * u[k] + 0.01 + noise * rng.normal()
    return Segment(u, y)


def test_predictions_are_those_of_the_plant() -> None:
    before, measured, predicted = predict_ahead((plant().A, plant().B, plant().c), drive(10.0), 7)
    assert predicted == pytest.approx(measured)
    assert np.abs(measured - before).max() > 0.5


@pytest.mark.parametrize(("gain", "low", "high"), [(0.2, 0.98, 1.0), (0.05, -10.0, 0.6)])
def test_the_share_explained_tells_a_right_model_from_a_wrong_one(gain: float, low: float, high: float) -> None:
    asked: list[Mapping[str, float]] = []

    def segments(parameters: Mapping[str, float]) -> Sequence[Sequence[Segment]]:
        asked.append(parameters)
        return [[drive(60.0, noise=0.003)]]

    found = compare_effects(lambda _: ({"lag": 0.1}, plant(gain)), segments, RATE_HZ)
    assert found is not None
    assert asked == [{}, {"lag": 0.1}]
    assert low < found.explained["0.2 s ahead"][0] <= high
    assert found.names == ("yaw_rate",)


def test_without_enough_to_fit_or_to_compare_there_is_no_verdict() -> None:
    def refuse(_: Sequence[Segment]) -> tuple[Mapping[str, float], Plant]:
        raise ModelError("not excited")

    assert compare_effects(refuse, lambda _: [[drive(60.0)]], RATE_HZ) is None
    assert compare_effects(lambda _: ({}, plant()), lambda _: [[drive(3.0)]], RATE_HZ) is None
