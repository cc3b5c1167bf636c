"""Transforms give the same bits and keep the same state over stretches as one by one, however they are mixed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import strapdown_truth as truth
from hypothesis import example, given, settings
from hypothesis import strategies as st
from stretches import in_stretches, one_by_one, partitions

from adapters.sample import Samples, stacked
from monitor.sampling.scaled_inputs import DriveInputs, SurfaceInputs
from monitor.sampling.stretch import first_order, joined, since
from monitor.sampling.transform import Transform
from monitor.vehicles.inertial.strapdown import Strapdown

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
ODD = [0.0, -0.0, 1e-310, 1e200, -1e308, 1e15]


def stretch(values: np.ndarray, first: int = 0, seed: int = 0) -> Samples:
    """Return raw samples restarted at the first, some bridged, some incomplete."""
    count, rng = len(values), np.random.default_rng(seed)
    index = first + np.arange(count)
    return Samples(
        index=index,
        vehicle_time_ns=index * 10_000_000,
        time_ns=index * 10_000_000 + 7,
        u=values,
        y=np.zeros((count, 0)),
        restart=np.arange(count) == 0,
        complete=rng.random(count) < 0.95,
        known_ns=index * 10_000_000 + rng.integers(0, 10**8, count),
        measured=rng.random(count) < 0.97,
    )


def signals(width: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    flown = truth.signals(COUNT / 100.0, start_s=float(rng.uniform(0.0, 60.0)))
    flown = flown + rng.normal(scale=10.0 ** rng.uniform(-4.0, 0.5), size=flown.shape)
    return np.ascontiguousarray(flown[:, :width] if width != 12 else flown[:, [*range(9), 15, 16, 17]])


def compare(make: Callable[[], Transform], raw: Samples, parts: list[tuple[int, int, bool]]) -> None:
    found, expected = in_stretches(make(), raw, parts), one_by_one(make(), raw)
    different = [a for a, b in zip(found, expected, strict=True) if a != b]
    assert not different[:1]


@pytest.mark.parametrize("shape", SHAPES)
@settings(max_examples=40, deadline=None)
@example(parts=[(0, 90, False)], seed=0, first=0, restarts=[], breaks=[], odd=[(0, 16, -1e308)])
@given(
    parts=partitions(COUNT),
    seed=st.integers(0, 10**6),
    first=st.integers(0, 10**6),
    restarts=st.lists(st.integers(0, COUNT - 1), max_size=2),
    breaks=st.lists(st.integers(1, COUNT - 1), max_size=1),
    odd=st.lists(st.tuples(st.integers(0, COUNT - 1), st.integers(0, 17), st.sampled_from(ODD)), max_size=6),
)
def test_stretches_and_single_samples_mix_to_the_bit(
    shape: str,
    parts: list[tuple[int, int, bool]],
    seed: int,
    first: int,
    restarts: list[int],
    breaks: list[int],
    odd: list[tuple[int, int, float]],
) -> None:
    make, width = SHAPES[shape]
    raw = stretch(signals(width, seed), first, seed)
    raw.restart[restarts] = True
    for row in breaks:
        raw.index[row:] += 3
    for row, column, value in odd:
        raw.u[row, column % width] = value
    compare(make, raw, parts)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("parts", [[(0, COUNT, False)], [(k, k + 1, False) for k in range(COUNT)]])
def test_a_number_that_is_none_spoils_what_it_spoils_one_by_one(shape: str, parts: list[tuple[int, int, bool]]) -> None:
    make, width = SHAPES[shape]
    raw = stretch(signals(width, 3))
    raw.u[40, 0] = np.nan
    with np.errstate(invalid="ignore"):
        compare(make, raw, parts)


def test_an_attitude_that_is_reset_again_and_again_is_taken_as_one_by_one() -> None:
    make, width = SHAPES["strapdown"]
    raw = stretch(signals(width, 4))
    raw.u[20:, 6] += 0.3
    raw.u[40:45, 8] += np.arange(5) * 0.5
    raw.u[60:66:2, 7] -= 1.0
    for cut in range(COUNT):
        compare(make, raw, [(0, cut, False), (cut, COUNT, False)])


def test_a_recursion_is_that_of_single_steps() -> None:
    values = np.array([1.0, -0.0, 3.0, np.inf, 1.0])
    y, found = 0.5, []
    for value in values.tolist():
        y = 0.3 * y + value
        found.append(y)
    assert first_order(0.3, values, 0.5).tobytes() == np.array(found).tobytes()


def test_rows_are_counted_from_the_last_event() -> None:
    events = np.array([False, False, True, False, False])
    assert since(events, 6).tolist() == [7, 8, 0, 1, 2]


def test_raw_samples_have_no_outputs_when_stacked_either() -> None:
    raw = stretch(signals(9, 1))
    again = stacked([raw.one(row) for row in range(len(raw))], 9, 0)
    assert (again.u.tobytes(), again.y.shape) == (raw.u.tobytes(), (COUNT, 0))


def test_nothing_joined_is_nothing() -> None:
    samples, rows = joined((), (3, 2))
    assert (samples.u.shape, samples.y.shape, len(samples), len(rows)) == ((0, 3), (0, 2), 0, 0)
