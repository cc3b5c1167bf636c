"""What transforms give does not depend, to the bit, on how the raw samples are cut into batches."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import strapdown_truth as truth
from hypothesis import given
from hypothesis import strategies as st
from sampled import raw_samples, rows

from adapters.sample import Samples
from monitor.sampling.transform import Transform
from monitor.vehicles.inertial.strapdown import Strapdown
from monitor.vehicles.plane.transform import SurfaceInputs
from monitor.vehicles.rover.transform import DriveInputs

COUNT = 90
DELAYS = {"gps_delay_s": 0.074, "baro_delay_s": 0.045, "compass_delay_s": 0.099}
SPEEDS = {"reference_speed": 15.0, "minimum_speed": 8.0, "rudder_delay_s": 0.033, "rudder_lag_s": 0.15}
CRAWL = {"reference_speed": 2.0, "minimum_speed": 0.5, "steering_cubic": -0.2, "steering_lag_s": 0.3}
SHAPES: dict[str, tuple[Callable[[], Transform], int]] = {
    "strapdown": (lambda: Strapdown(DELAYS, 100.0, 25.0), 18),
    "pressure": (lambda: Strapdown({"barometer": 2.0, "magnetometer": 0.0, **DELAYS}, 100.0, 50.0), 15),
    "bare": (lambda: Strapdown({"gps": 0.0, "barometer": 0.0, "magnetometer": 0.0, **DELAYS}, 100.0, 100.0), 9),
    "compass": (lambda: Strapdown({"gps": 0.0, "barometer": 0.0, "compass_delay_s": 0.3}, 100.0, 20.0), 12),
    "surfaces": (lambda: SurfaceInputs(SPEEDS, 100.0, 50.0), 13),
    "ungrouped": (lambda: SurfaceInputs(SPEEDS, 100.0, 100.0), 13),
    "drive": (lambda: DriveInputs(CRAWL, 100.0, 20.0), 7),
    "slow": (lambda: DriveInputs(CRAWL, 100.0, 10.0), 7),
}
ODD = [0.0, -0.0, 1e-310, 1e200, -1e308, 1e15, np.nan]


def telemetry(values: np.ndarray, first: int = 0, seed: int = 0) -> Samples:
    """Return raw samples restarted at the first, some bridged, some incomplete."""
    samples, rng = raw_samples(values, first), np.random.default_rng(seed)
    samples.complete[:] = rng.random(len(values)) < 0.95
    samples.known_ns[:] += rng.integers(0, 10**8, len(values))
    samples.measured[:] = rng.random(len(values)) < 0.97
    return samples


def signals(width: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    flown = truth.signals(COUNT / 100.0, start_s=float(rng.uniform(0.0, 60.0)))
    flown = flown + rng.normal(scale=10.0 ** rng.uniform(-4.0, 0.5), size=flown.shape)
    return np.ascontiguousarray(flown[:, :width] if width != 12 else flown[:, [*range(9), 15, 16, 17]])


def given_out(transform: Transform, raw: Samples, cuts: Sequence[int]) -> list[tuple[Any, ...]]:
    """Return all samples to the bit, each with the row that completed it."""
    found = []
    for start, stop in pairwise([0, *sorted(cuts), len(raw)]):
        given = transform.run(raw.part(start, stop))
        assert len(given.samples) == len(given.rows)
        found += [(row + start, one.bits) for row, one in zip(given.rows.tolist(), rows(given.samples), strict=True)]
    return found


@pytest.mark.parametrize("shape", SHAPES)
@given(
    cuts=st.lists(st.integers(0, COUNT), max_size=6),
    seed=st.integers(0, 10**6),
    first=st.integers(0, 10**6),
    restarts=st.lists(st.integers(0, COUNT - 1), max_size=2),
    odd=st.lists(st.tuples(st.integers(0, COUNT - 1), st.integers(0, 17), st.sampled_from(ODD)), max_size=6),
)
def test_batches_of_any_length_give_the_bits_of_single_samples(
    shape: str,
    cuts: list[int],
    seed: int,
    first: int,
    restarts: list[int],
    odd: list[tuple[int, int, float]],
) -> None:
    make, width = SHAPES[shape]
    raw = telemetry(signals(width, seed), first, seed)
    raw.restart[restarts] = True
    for row, column, value in odd:
        raw.u[row, column % width] = value
    found, expected = given_out(make(), raw, cuts), given_out(make(), raw, range(COUNT))
    assert not [one for one, other in zip(found, expected, strict=True) if one != other][:1]


@pytest.mark.parametrize("shape", SHAPES)
def test_a_restart_forgets_all_that_came_before(shape: str) -> None:
    make, width = SHAPES[shape]
    raw = telemetry(signals(width, 4))
    raw.restart[40] = True
    raw.u[:40] = np.nan
    fresh = [(row + 40, bits) for row, bits in given_out(make(), raw.part(40, COUNT), [])]
    assert [one for one in given_out(make(), raw, []) if one[0] >= 40] == fresh


def test_the_index_of_the_row_that_completed_a_sample_tells_when_it_was_known() -> None:
    make, width = SHAPES["drive"]
    raw = telemetry(signals(width, 1))
    given = make().run(raw)
    assert given.samples.known_ns.tolist() == raw.known_ns[given.rows].tolist()
