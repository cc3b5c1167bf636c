"""What a multirotor's motors do is identified in a closed loop, in coloured gusts, and its errors are stated truly."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from simulated_multirotor import HOVER, Quad, closed_loop

from adapters.errors import ModelError
from gains.identification.segment import Segment
from monitor.vehicles.multirotor.identify import MotorUncertainty, MultirotorFit, identify_multirotor

QUAD = Quad()


def effects(fit: MultirotorFit) -> NDArray[np.float64]:
    """Return what each motor does to the rates at hover, per step."""
    return fit.B[:3] * (1.0 - fit.square + 2.0 * fit.square * HOVER)


def truth(rate_hz: float) -> NDArray[np.float64]:
    damping = np.array(QUAD.damping)
    return QUAD.effects() * (-np.expm1(-damping / rate_hz) / damping)[:, None]


def deviations(found: tuple[MultirotorFit, MotorUncertainty], rate_hz: float) -> NDArray[np.float64]:
    """Return how far the effects are from the truth, in standard errors."""
    fit, errors = found
    return np.asarray((fit.B[:3] * effects(fit) / fit.B[:3] - truth(rate_hz)) / (errors.B_error * effects(fit) / fit.B))


@pytest.mark.parametrize(
    ("rate_hz", "flights"),
    [(100.0, 4), *(pytest.param(rate_hz, 24, marks=pytest.mark.long) for rate_hz in (50.0, 100.0, 250.0))],
)
def test_effects_are_true_within_their_errors_at_any_rate(rate_hz: float, flights: int) -> None:
    found = [identify_multirotor([flight], rate_hz) for flight in closed_loop(QUAD, rate_hz, 62.0, flights, 1)]
    z = np.array([deviations(one, rate_hz) for one in found])
    assert 0.90 <= np.mean(np.abs(z) < 1.96) <= 0.99
    mean = np.mean([effects(fit) for fit, _ in found], axis=0)
    axes = np.abs(mean).mean(axis=1) / np.abs(truth(rate_hz)).mean(axis=1)
    assert axes == pytest.approx(np.ones(3), abs=0.015)
    assert np.mean([errors.relative for _, errors in found]) < 0.03
    assert np.mean([errors.times_s.sum() for _, errors in found]) == pytest.approx(0.05, abs=0.004)


def test_drag_has_its_own_curve_over_the_command() -> None:
    u = np.tile([[0.3], [0.5], [0.7]], (1, 4))
    v = (1.0 - QUAD.square) * u + QUAD.square * u**2
    for drag in (0.0, 0.7):
        fit, _ = identify_multirotor(closed_loop(replace(QUAD, drag=drag), 100.0, 62.0, 3, 1, turning=2.0), 100.0)
        assert not fit.bends[:2].any()
        found = np.abs(fit.B[2] * ((1.0 - fit.square) * u + fit.square * u**2) + bent(fit, u)).mean(axis=1)
        true = (v + drag * (v**2 - v)).mean(axis=1)
        assert np.diff(found) / np.diff(found)[0] == pytest.approx(np.diff(true) / np.diff(true)[0], rel=0.1)


def bent(fit: MultirotorFit, u: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what the drag of each motor does besides what its thrust would."""
    v = (1.0 - fit.square) * u + fit.square * u**2
    return np.asarray(sum(fit.bends[2, :, d] * v ** (d + 1) for d in range(fit.bends.shape[2])))


def test_a_lost_measurement_costs_its_own_row() -> None:
    flight = closed_loop(QUAD, 100.0, 62.0, 4, 1)[0].part(0, 3000)
    lost = np.random.default_rng(3).random(len(flight.u)) < 0.03
    kept = np.flatnonzero(~lost)
    y = np.stack([np.interp(np.arange(len(lost)), kept, column[kept]) for column in flight.y.T], axis=1)
    whole, gappy = (identify_multirotor([one], 100.0) for one in (flight, replace(flight, y=y, own=~lost)))
    assert gappy[0].samples == whole[0].samples - lost.sum() + lost[[0, -1]].sum()
    assert np.all(gappy[1].relative < 1.5 * whole[1].relative)
    assert np.mean(np.abs(deviations(gappy, 100.0)) < 1.96) > 0.8


def test_an_axis_without_manoeuvres_is_taken_from_geometry_with_its_width() -> None:
    flights = closed_loop(QUAD, 100.0, 42.0, 1, 4, turning=0.0)
    geometry = np.sign(QUAD.effects())
    free, known = identify_multirotor(flights, 100.0)
    assert known.told(free, geometry).tolist() == [True, True, False]
    assert known.told(free, None)[:2].all()
    held, wide = identify_multirotor(flights, 100.0, geometry * [[0.0], [0.0], [1.0]])
    assert held.B[2] / np.abs(held.B[2, 0]) == pytest.approx(geometry[2], rel=0.01)
    assert 0.3 < np.abs(effects(held)[2] / truth(100.0)[2]).max() < 3.0
    assert wide.of_axes[2] > 0.5
    assert effects(held)[:2] == pytest.approx(truth(100.0)[:2], rel=0.1)
    assert wide.drive[2] > 0.0


@pytest.mark.parametrize("flights", [1, pytest.param(2, marks=pytest.mark.long)])
def test_hovering_alone_tells_the_controller_and_not_what_the_motors_do(flights: int) -> None:
    for flight in closed_loop(QUAD, 100.0, 42.0, flights, 1, brisk=0.0):
        fit, uncertainty = identify_multirotor([flight], 100.0)
        assert not uncertainty.told(fit, np.sign(QUAD.effects()))[:2].any()
        assert not uncertainty.told(fit, None)[:2].any()


def test_more_motors_than_controls_are_known_in_the_directions_of_the_controls() -> None:
    flight = closed_loop(QUAD, 100.0, 62.0, 4, 1)[0].part(0, 3000)
    half = Segment(np.hstack([flight.u, flight.u]), flight.y)
    four, eight = (identify_multirotor([one], 100.0)[0] for one in (flight, half))
    assert eight.B[:3, :4] == pytest.approx(eight.B[:3, 4:], rel=1e-3)
    assert 2.0 * eight.B[:3, :4] == pytest.approx(four.B[:3], rel=0.05, abs=1e-4)


def test_vertical_force_is_optional() -> None:
    flight = closed_loop(QUAD, 100.0, 62.0, 4, 1)[1].part(0, 3000)
    force = -9.81 * flight.u.sum(axis=1, keepdims=True) / (4 * HOVER)
    fit, _ = identify_multirotor([replace(flight, y=np.hstack([flight.y, force]))], 100.0)
    assert fit.B.shape == (4, 4)
    assert float(fit.B[3].sum()) * (HOVER * (1.0 - fit.square) + fit.square * HOVER**2) == pytest.approx(
        -9.81, rel=0.03
    )


def test_too_little_flight_is_refused() -> None:
    flight = closed_loop(QUAD, 100.0, 62.0, 4, 1)[0].part(0, 1800)
    with pytest.raises(ModelError, match="only 18 s of healthy flight"):
        identify_multirotor([flight], 100.0)
