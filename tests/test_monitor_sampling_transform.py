"""Derived signals: a sampler of raw signals with a transform behind it gives the observer's samples."""

from collections.abc import Iterator, Sequence

import numpy as np
import pytest
from sampled import Row, rows

from adapters.batch import pack
from adapters.channels import Channel
from adapters.errors import TelemetryError
from adapters.message import Message
from adapters.source import MAVLINK
from monitor.core.sampling import VehicleClock, sample_batch
from monitor.sampling.gate import GatedSampler, GateRule
from monitor.sampling.transform import SampleSource, TransformRule, make_transform
from monitor.vehicles.inertial.strapdown import IMU

SIGNALS = tuple(Channel(name, "HIGHRES_IMU", (name,)) for name in IMU)
RULE = TransformRule("strapdown", 100.0, {"gps": 0.0, "barometer": 0.0, "magnetometer": 0.0})


def still(seconds: float, gap_s: tuple[float, float] = (0.0, 0.0)) -> Iterator[Message]:
    """Yield an IMU at rest, level, at 100 Hz, silent in the gap."""
    fields = dict.fromkeys(IMU, 0.0) | {"zacc": -9.80665}
    for k in range(round(100 * seconds)):
        if not gap_s[0] <= k / 100 < gap_s[1]:
            now_us = 10_000_000 + 10_000 * k
            yield Message(MAVLINK, "HIGHRES_IMU", now_us * 1000, {"time_usec": now_us, **fields}, 1, 1)


def derived() -> GatedSampler:
    return GatedSampler(SampleSource(transform=RULE, signals=SIGNALS), 25.0, VehicleClock(), GateRule())


def given(sampler: GatedSampler, messages: Sequence[Message]) -> list[Row]:
    """Return the observer's samples that messages complete."""
    raw = sample_batch(sampler.sampler.clock, [sampler.sampler], pack(messages)).samples[0]
    return rows(sampler.run(raw).samples)


def test_samples_come_at_the_observers_rate_with_the_transforms_names() -> None:
    sampler = derived()
    assert sampler.sampler.interests == {"HIGHRES_IMU"}
    samples = given(sampler, [*still(4.0)])
    transform = make_transform(RULE, 25.0)
    assert 90 <= len(samples) <= 100
    assert (len(samples[0].u), len(samples[0].y)) == (len(transform.inputs), len(transform.outputs))
    assert np.diff([sample.vehicle_time_ns for sample in samples]).tolist() == [40_000_000] * (len(samples) - 1)
    assert all(sample.known_ns >= sample.vehicle_time_ns for sample in samples)
    assert [sample.restart for sample in samples] == [True] + [False] * (len(samples) - 1)


@pytest.mark.parametrize("by_gap", [True, False])
def test_a_gap_and_a_restart_start_the_transform_anew(by_gap: bool) -> None:
    sampler = derived()
    messages = [*still(5.0, (2.0, 4.0) if by_gap else (0.0, 0.0))]
    samples = given(sampler, messages[:200])
    if not by_gap:
        sampler.sampler.restart()
    samples += given(sampler, messages[200:])
    assert sum(sample.restart for sample in samples) == 2


def test_channels_as_they_are_need_no_transform() -> None:
    source = SampleSource(SIGNALS[:1], SIGNALS[1:2])
    sampler = GatedSampler(source, 50.0, VehicleClock(), GateRule()).sampler
    assert sampler.interests == {"HIGHRES_IMU"}
    assert source.channels == SIGNALS[:2]


def test_an_unknown_kind_and_rates_that_do_not_fit_are_refused_in_one_line() -> None:
    with pytest.raises(TelemetryError, match=r"no transform is called 'magic'; there are .*strapdown"):
        make_transform(TransformRule("magic", 100.0), 25.0)
    with pytest.raises(TelemetryError, match="cannot be grouped to samples at 30 Hz"):
        make_transform(RULE, 30.0)
