"""Outside of what a profile was fitted on sizes grow, people are told, and what was learned is inside."""

from __future__ import annotations

import math

import numpy as np
import pytest
from cuts import cuts, same_bits
from hypothesis import given
from numpy.typing import NDArray
from sampled import raw_samples

from monitor.estimation.envelope import Envelope, EnvelopeStage, reached

SIGNALS = ("xgyro", "ygyro", "zgyro", "roll", "pitch", "gps_speed")
RATE_HZ = 100.0
CALM = Envelope(tilt=math.radians(40.0), rate=1.0, speed=8.0)


def flight(seconds: float, *, roll: float = 0.1, rate: float = 0.2, speed: float = 3.0) -> NDArray[np.float64]:
    rows = np.zeros((round(seconds * RATE_HZ), len(SIGNALS)))
    rows[:, 1], rows[:, 3], rows[:, 5] = rate, roll, speed
    return rows


def factors(stage: EnvelopeStage, rows: NDArray[np.float64]) -> NDArray[np.float64]:
    return stage.run(raw_samples(rows), np.arange(len(rows)))


def test_inside_of_the_fitted_flights_sizes_are_as_fitted() -> None:
    stage = EnvelopeStage(CALM, SIGNALS, RATE_HZ)
    assert np.all(factors(stage, flight(5.0, roll=math.radians(39.0), rate=0.9, speed=8.0)) == 1.0)
    assert stage.outside is None
    assert stage.furthest is None


def test_sizes_grow_with_the_tilt_and_shrink_back_with_the_washout() -> None:
    stage = EnvelopeStage(CALM, SIGNALS, RATE_HZ)
    rows = np.concatenate([flight(2.0), flight(1.0, roll=math.radians(62.0)), flight(90.0)])
    found = factors(stage, rows)
    assert found[250] == pytest.approx(62.0 / 40.0)
    assert found[300 + 3000] == pytest.approx(1.0 + 22.0 / 40.0 / math.e, rel=0.01)
    assert found[-1] < 1.1
    after = "only larger faults are detected there and 30 s after"
    assert stage.furthest == (1.0, f"outside the fitted flights: tilt 62 degrees, fitted to 40; {after}")


def test_the_status_says_by_how_much_while_it_matters() -> None:
    stage = EnvelopeStage(CALM, SIGNALS, RATE_HZ)
    factors(stage, flight(1.0, roll=math.radians(62.0)))
    text = "outside the fitted flights (tilt 62 degrees, fitted to 40): only faults 1.6 times as large are detected"
    assert stage.outside == text
    factors(stage, np.concatenate([flight(90.0)] * 2))
    assert stage.outside is None


def test_a_speed_is_told_and_changes_no_size_as_it_is_the_gps_that_says_it() -> None:
    stage = EnvelopeStage(CALM, SIGNALS, RATE_HZ)
    assert np.all(factors(stage, flight(2.0, speed=40.0)) == 1.0)
    assert (
        stage.outside == "outside the fitted flights (speed 40 m/s, fitted to 8): faults of the usual size are detected"
    )


def test_what_was_learned_is_inside() -> None:
    wild = flight(3.0, roll=1.0, rate=3.0, speed=20.0)
    envelope = reached(SIGNALS, [flight(2.0), wild], RATE_HZ)
    assert envelope == Envelope(tilt=1.0, rate=3.0, speed=20.0)
    stage = EnvelopeStage(envelope, SIGNALS, RATE_HZ)
    assert factors(stage, wild).max() == pytest.approx(1.0, abs=1e-9)


def test_what_is_not_measured_is_never_outside() -> None:
    stage = EnvelopeStage(Envelope(), SIGNALS, RATE_HZ)
    rows = flight(1.0, roll=2.0)
    rows[50:60] = np.nan
    assert np.all(factors(stage, rows) == 1.0)
    assert stage.outside is None


@given(parts=cuts(600))
def test_cuts_do_not_change_a_bit(parts: list[slice]) -> None:
    rng = np.random.default_rng(3)
    rows = flight(6.0)
    rows[:, 3] = np.cumsum(0.05 * rng.normal(size=len(rows)))
    cut, whole = EnvelopeStage(CALM, SIGNALS, RATE_HZ), EnvelopeStage(CALM, SIGNALS, RATE_HZ)
    samples = raw_samples(rows)
    pieces = [cut.run(one, np.arange(len(one))) for one in (samples.part(part.start, part.stop) for part in parts)]
    assert same_bits(np.concatenate(pieces), whole.run(samples, np.arange(len(rows))))


def test_what_any_flight_does_is_inside_of_a_profile_of_a_hover() -> None:
    hover = EnvelopeStage(Envelope(tilt=math.radians(2.0), rate=0.1, speed=0.2), SIGNALS, RATE_HZ)
    assert np.all(factors(hover, flight(2.0, roll=math.radians(29.0), rate=1.0)) == 1.0)
    assert factors(hover, flight(2.0, roll=math.radians(60.0)))[-1] == pytest.approx(2.0)
