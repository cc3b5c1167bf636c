"""Fault estimates in command units: where a fault scales an input, at its smoothed command."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cuts import cuts, same_bits
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from monitor.chain import CommandRun, CommandUnits
from monitor.core.observers import CommandScale
from monitor.profile import ObserverProfile, Profile

COUNT = 40
Array = NDArray[np.float64]


def observer(profile: Profile, name: str, curve: list[float], smoothing_s: float) -> ObserverProfile:
    """Return an observer of the profile with another curve for all inputs and other smoothing."""
    (found,) = (one for one in profile.observers if one.name == name)
    curves = np.tile(curve, (len(found.gains[0].inputs), 1))
    gains = tuple(replace(one, input_curves=curves) for one in found.gains)
    return replace(found, gains=gains, isolation=replace(found.isolation, smoothing_s=smoothing_s))


CURVES = {1: [0.4], 2: [0.4, 0.6], 3: [0.3, 0.2, 0.5]}


def converted(curve: list[float], u: float, fault: float, sd: float = 0.0) -> tuple[float, float, float]:
    """Return fault, evidence and sd of one channel in command units."""
    scale = CommandScale(np.array([curve]), np.zeros(1, np.intp), np.zeros(1, np.intp), 0.0)
    rows = (np.array([[value]]) for value in (fault, fault, sd))
    one, evidence, deviation, *_ = scale.run(np.array([[u]]), np.ones(1, np.uint8), *rows)
    return float(one[0, 0]), float(evidence[0, 0]), float(deviation[0, 0])


@given(degree=st.integers(1, 3), u=st.floats(0.1, 1.0), loss=st.floats(-0.9, 0.3))
def test_a_loss_of_command_is_recovered_from_its_effect(degree: int, u: float, loss: float) -> None:
    curve = CURVES[degree]
    with_loss, without = np.polyval([*curve[::-1], 0.0], [u * (1.0 + loss), u])
    fault, evidence, _ = converted(curve, u, with_loss - without)
    assert fault == pytest.approx(loss * u, abs=1e-6)
    assert evidence == fault


@pytest.mark.parametrize("degree", CURVES)
def test_more_loss_than_there_is_effect_stays_finite(degree: int) -> None:
    assert np.isfinite([converted(CURVES[degree], 0.5, size) for size in (-5.0, 5.0)]).all()


def test_a_linear_input_only_changes_units() -> None:
    assert converted([2.0], 0.3, 1.0, 0.2) == pytest.approx((0.5, 0.5, 0.1))


@pytest.mark.parametrize("curve", CURVES.values(), ids=len)
@pytest.mark.parametrize("name", ["motors", "inertial"])
@given(
    parts=cuts(COUNT),
    seed=st.integers(0, 10**6),
    restarts=st.lists(st.integers(0, COUNT - 1), max_size=3),
    smoothing_s=st.sampled_from([0.0, 0.001, 0.05]),
    odd=st.lists(
        st.tuples(st.integers(0, 3), st.integers(0, COUNT - 1), st.sampled_from([-0.0, np.nan, np.inf, 1e200, 1e-310])),
        max_size=4,
    ),
)
def test_cuts_do_not_change_a_bit(
    bundled_quad: Profile,
    curve: list[float],
    name: str,
    parts: list[slice],
    seed: int,
    restarts: list[int],
    smoothing_s: float,
    odd: list[tuple[int, int, float]],
) -> None:
    profile, rng = observer(bundled_quad, name, curve, smoothing_s), np.random.default_rng(seed)
    count = len(profile.faults)
    u = rng.uniform(-0.1, 1.0, (COUNT, len(profile.gains[0].inputs)))
    fault, evidence, sd = rng.normal(scale=0.3, size=(3, COUNT, count))
    restart = np.zeros(COUNT, np.bool_)
    restart[restarts] = True
    for which, row, value in odd:
        (u, fault, evidence, sd)[which][row, row % 3] = value
    rows = u, restart, fault, evidence, np.abs(sd)
    before = [column.tobytes() for column in rows]
    whole, cut = CommandUnits(profile).run(*rows), CommandUnits(profile)
    runs = [cut.run(*(column[part] for column in rows)) for part in parts]
    for field in CommandRun._fields:
        assert same_bits(np.concatenate([getattr(run, field) for run in runs]), getattr(whole, field))
    assert [column.tobytes() for column in rows] == before


def test_what_scales_no_input_keeps_its_unit(bundled_quad: Profile) -> None:
    profile = observer(bundled_quad, "inertial", [2.0], 0.0)
    ones = np.ones((2, len(profile.faults)))
    found = CommandUnits(profile).run(
        np.ones((2, len(profile.gains[0].inputs))), np.ones(2, np.bool_), ones, ones, ones
    )
    assert np.isnan(found.commands).all()
    assert np.array_equal(found.fault, ones)
    assert np.array_equal(found.sd, ones)


def test_a_loss_of_a_command_that_moves_is_known_as_well_as_the_estimate_follows_it() -> None:
    rng = np.random.default_rng(5)
    u = 0.5 + np.convolve(0.05 * rng.normal(size=400), np.ones(5) / 5.0, mode="same")
    u[:100] = 0.5
    smoothed = np.empty_like(u)
    for k, now in enumerate(u):
        smoothed[k] = 0.8 * smoothed[k - 1] + 0.2 * now if k else now
    fault = -0.15 * smoothed[:, None]
    scale = CommandScale(np.ones((1, 1)), np.zeros(1, np.intp), np.zeros(1, np.intp), 0.8)
    _, isolated, sd, *_ = scale.run(u[:, None], np.arange(len(u)) == 0, fault, fault, np.full_like(fault, 1e-4))
    assert sd[:90] == pytest.approx(1e-4)
    error = np.abs(isolated[:, 0] + 0.15 * u)[100:]
    assert error.max() > 1e-3
    assert np.mean(error <= 2.0 * sd[100:, 0]) > 0.95


def test_a_fault_of_what_is_driven_both_ways_is_no_share_of_its_command() -> None:
    u = np.sin(0.05 * np.arange(400.0))
    fault = np.full((400, 1), 2.0)
    scale = CommandScale(np.ones((1, 1)), np.zeros(1, np.intp), np.zeros(1, np.intp), 0.8)
    _, _, sd, *_ = scale.run(u[:, None], np.arange(len(u)) == 0, fault, fault, np.full_like(fault, 1e-4))
    assert sd[70:] == pytest.approx(1e-4)
