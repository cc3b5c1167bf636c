"""Fault estimates in command units: where a fault scales an input, at its smoothed command, one by one or at once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from stretches import bits, partitions

from monitor.command_units import CommandUnits
from monitor.profile import ObserverProfile, Profile, read_profile

COUNT = 40
Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def quad() -> Profile:
    return read_profile(Path(__file__).parent.parent / "replay" / "data" / "quad")


def observer(profile: Profile, name: str, curve: list[float], smoothing_s: float) -> ObserverProfile:
    """Return an observer of the profile with another curve for all inputs and other smoothing."""
    (found,) = (one for one in profile.observers if one.name == name)
    curves = np.tile(curve, (len(found.gains[0].inputs), 1))
    gains = tuple(replace(one, input_curves=curves) for one in found.gains)
    return replace(found, gains=gains, isolation=replace(found.isolation, smoothing_s=smoothing_s))


def singly(units: CommandUnits, indices: list[int], u: Array, restart: NDArray[np.bool_], *rows: Array) -> list[bytes]:
    """Return what each sample gives one by one, as the chain does it."""
    said = []
    for k in range(len(u)):
        if restart[k]:
            units.restart(u[k])
        units.follow(u[k])
        fault, evidence, sd = (row[k] for row in rows)
        found, isolated, upper = units.convert(np.stack([fault, evidence, fault + sd]))
        commands = [units.command(index) for index in indices]
        said.append(bits([*found, *isolated, *np.abs(upper - found), *(np.nan if c is None else c for c in commands)]))
    return said


def at_once(units: CommandUnits, indices: list[int], u: Array, restart: NDArray[np.bool_], *rows: Array) -> list[bytes]:
    found = units.run(u, restart, *rows)
    none = np.full(len(u), np.nan)
    commands = np.array([found.commands.get(index, none) for index in indices]).T
    return [bits(row) for row in np.hstack([found.fault, found.isolated, found.sd, commands])]


@pytest.mark.parametrize("curve", [[0.4], [0.4, 0.6], [0.3, 0.2, 0.5]], ids=len)
@pytest.mark.parametrize("name", ["motors", "inertial"])
@settings(max_examples=25, deadline=None)
@given(
    parts=partitions(COUNT),
    seed=st.integers(0, 10**6),
    restarts=st.lists(st.integers(0, COUNT - 1), max_size=3),
    smoothing_s=st.sampled_from([0.0, 0.001, 0.05]),
    odd=st.lists(
        st.tuples(st.integers(0, 3), st.integers(0, COUNT - 1), st.sampled_from([-0.0, np.nan, np.inf, 1e200, 1e-310])),
        max_size=4,
    ),
)
def test_stretches_and_single_samples_mix_to_the_bit(
    quad: Profile,
    curve: list[float],
    name: str,
    parts: list[tuple[int, int, bool]],
    seed: int,
    restarts: list[int],
    smoothing_s: float,
    odd: list[tuple[int, int, float]],
) -> None:
    profile, rng = observer(quad, name, curve, smoothing_s), np.random.default_rng(seed)
    indices = list(range(len(profile.faults)))
    u = rng.uniform(-0.1, 1.0, (COUNT, len(profile.gains[0].inputs)))
    fault, evidence, sd = rng.normal(scale=0.3, size=(3, COUNT, len(indices)))
    restart = np.zeros(COUNT, np.bool_)
    restart[restarts] = True
    for which, row, value in odd:
        (u, fault, evidence, sd)[which][row, row % 3] = value
    given_in = u, restart, fault, evidence, np.abs(sd)
    before = [one.tobytes() for one in given_in]
    with np.errstate(all="ignore"):
        expected = singly(CommandUnits(profile), indices, *given_in)
        units, found = CommandUnits(profile), []
        for start, stop, by_one in parts:
            take = singly if by_one else at_once
            found += take(units, indices, *(one[start:stop] for one in given_in))
    assert found == expected
    assert [one.tobytes() for one in given_in] == before


def test_what_scales_no_input_keeps_its_unit(quad: Profile) -> None:
    profile = observer(quad, "inertial", [2.0], 0.0)
    ones = np.ones((2, len(profile.faults)))
    found = CommandUnits(profile).run(
        np.ones((2, len(profile.gains[0].inputs))), np.ones(2, np.bool_), ones, ones, ones
    )
    assert found.commands == {}
    assert np.array_equal(found.fault, ones)
    assert np.array_equal(found.sd, ones)
