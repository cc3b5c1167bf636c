"""What the status says of telemetry that is missing, slow, interrupted or another vehicle's."""

from __future__ import annotations

import pytest

from monitor.profile import Profile
from monitor.service.telemetry_watch import TelemetryWatch

SECOND_NS = 1_000_000_000
START_NS = 1_800_000_000 * SECOND_NS


class Telemetry:
    """Messages at even times for one observer."""

    def __init__(self, profile: Profile) -> None:
        [observer, *_] = profile.observers
        self.observer = observer
        self.names = frozenset(channel.message for channel in observer.source.channels)
        self.watch = TelemetryWatch([observer], {observer.name: self.names}, START_NS)
        self.now_ns = START_NS

    def run(self, seconds: int, rates: dict[str, int], *, samples: bool = True) -> list[str]:
        """Let messages come for a while; return what is said in the end."""
        said: list[str] = []
        for _ in range(seconds):
            for name, rate in rates.items():
                for k in range(rate):
                    self.watch.hear(name, self.now_ns + k * SECOND_NS // rate)
                    if samples:
                        self.watch.sampled(self.observer.name)
            self.now_ns += SECOND_NS
            said = self.watch.lacks(self.now_ns)
        return said


@pytest.fixture
def telemetry(quad_profile: Profile) -> Telemetry:
    return Telemetry(quad_profile)


def test_messages_as_fast_as_the_observer_samples_give_nothing_to_say(telemetry: Telemetry) -> None:
    rate = round(telemetry.observer.rate_hz)
    assert telemetry.run(30, dict.fromkeys(telemetry.names, rate)) == []


def test_a_message_that_comes_too_seldom_is_named_with_its_rate(telemetry: Telemetry) -> None:
    rate = round(telemetry.observer.rate_hz)
    [said] = telemetry.run(12, dict.fromkeys(telemetry.names, rate) | {"ATTITUDE": 4})
    assert said == f"motors sees faults late or not at all: ATTITUDE 4 Hz for {rate} samples a second"
    assert telemetry.run(20, dict.fromkeys(telemetry.names, rate)) == []


def test_a_message_that_does_not_come_is_named_and_not_called_slow(telemetry: Telemetry) -> None:
    rates = dict.fromkeys(telemetry.names, round(telemetry.observer.rate_hz)) | {"ATTITUDE": 0}
    assert telemetry.run(12, rates, samples=False) == ["motors watches nothing: no ATTITUDE"]


def test_silence_is_not_counted_as_slowness(telemetry: Telemetry) -> None:
    rates = dict.fromkeys(telemetry.names, round(telemetry.observer.rate_hz))
    telemetry.run(9, rates)
    for _ in range(60):
        telemetry.now_ns += SECOND_NS
        telemetry.watch.pause(telemetry.now_ns)
    assert telemetry.run(1, rates) == []
    assert telemetry.run(20, rates) == []


def test_a_clock_that_jumps_back_makes_no_rates(telemetry: Telemetry) -> None:
    rates = dict.fromkeys(telemetry.names, round(telemetry.observer.rate_hz))
    telemetry.run(9, rates)
    telemetry.now_ns -= 3600 * SECOND_NS
    assert telemetry.run(12, rates) == []
