"""The mean of a healthy flight: its scatter over flights of known truth, and the rate of false alarms it promises."""

import math

import numpy as np
import pytest

from monitor.alarms.alarm import LASTING_S
from monitor.fitting.lasting import FACTOR, FLIGHT_S, USUAL, scatter

RATE_HZ = 2.0
ROWS = round(30 * RATE_HZ)


def flights(rng: np.random.Generator, tau: float, count: int) -> list[np.ndarray]:
    """Return flights whose means scatter by tau, less what a model learns of all of them."""
    means = rng.normal(0.0, tau, (count, 3))
    return [np.tile(mean, (ROWS, 1)) for mean in means - means.mean(axis=0)]


@pytest.mark.parametrize("count", [2, 5])
def test_flights_that_differ_about_one_axis_most_keep_the_rate_that_was_promised(count: int) -> None:
    rng = np.random.default_rng(count)
    share = 0.001
    # what each axis moves the estimates of four motors by, one axis three times as much as the others
    motors = np.array([[-1, 1, -1], [-1, -1, 1], [1, -1, -1], [1, 1, 1]]) * [3.0, 1.0, 1.0] / np.sqrt(11.0)
    exceeded = []
    for tau in USUAL * FACTOR ** rng.normal(0.0, 1.0, 400):
        means = tau * rng.normal(0.0, 1.0, (count, 3)) @ motors.T
        fitted = [np.tile(mean, (ROWS, 1)) for mean in means - means.mean(axis=0)]
        level = scatter(fitted, RATE_HZ).level(share * 3600.0 / FLIGHT_S)
        # the next flight is off by its own mean and by that of the others, which the model learned
        exceeded.append(math.erfc(level / (math.sqrt(2.0 * (1.0 + 1.0 / count)) * tau)))
    assert 0.5 * share < np.mean(exceeded) < 2.0 * share


def test_flights_that_are_alike_bring_the_level_down_and_those_that_differ_bring_it_up() -> None:
    rng = np.random.default_rng(1)
    none, calm, rough = (
        scatter(found, RATE_HZ).level(0.01)
        for found in ([], flights(rng, 0.2 * USUAL, 6), flights(rng, 3.0 * USUAL, 6))
    )
    assert calm < 0.1 * none
    assert calm < 0.1 * rough
    # tau^2 (1 + 1 / F) at the quantile of a normal law is the least that rough flights ask for
    assert rough > 3.0 * 3.0 * USUAL


def test_noise_that_lasts_counts_and_noise_that_averages_out_does_not() -> None:
    rng = np.random.default_rng(2)
    white = [rng.normal(0.0, 0.02, (4 * ROWS, 3)) for _ in range(5)]
    slow = [np.repeat(rng.normal(0.0, 0.02, (12, 3)), ROWS // 3, axis=0) for _ in range(5)]
    assert scatter(white, RATE_HZ).level(0.01) < 0.5 * scatter(slow, RATE_HZ).level(0.01)


def test_a_flight_too_short_for_a_mean_says_nothing() -> None:
    short = np.full((round(LASTING_S * RATE_HZ) - 1, 3), 0.1)
    assert scatter([short, short], RATE_HZ).level(0.01) == scatter([], RATE_HZ).level(0.01)


def test_the_rate_of_a_level_is_the_rate_it_was_asked_for() -> None:
    found = scatter(flights(np.random.default_rng(3), USUAL, 4), RATE_HZ)
    assert found.per_hour(found.level(0.007)) == pytest.approx(0.007, rel=1e-6)
    assert found.per_hour(0.0) == pytest.approx(3600.0 / FLIGHT_S)
