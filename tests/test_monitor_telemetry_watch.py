"""What the status says of telemetry that is missing, slow, interrupted or another vehicle's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from adapters.batch import pack
from adapters.channels import Channel
from adapters.message import Message
from adapters.source import MAVLINK
from monitor.pipeline import Pipeline
from monitor.profile import Profile
from monitor.sampling.identity import Identity
from monitor.service.telemetry_watch import TelemetryWatch
from monitor.service.vehicle_monitor import VehicleMonitor

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

    def run(self, seconds: int, rates: dict[str, int], *, samples: bool = True, speed: float = 1.0) -> list[str]:
        """Let messages come for a while of the vehicle's time; return what is said in the end."""
        said: list[str] = []
        for _ in range(seconds):
            for name, rate in rates.items():
                for k in range(rate):
                    self.watch.count_messages(name, self.now_ns + round(k * SECOND_NS / rate / speed))
            for _ in range(round(self.observer.rate_hz) if samples and rates else 0):
                self.watch.count_samples(self.observer.name)
            self.now_ns += round(SECOND_NS / speed)
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
    often = telemetry.observer.source.fitted_hz["ATTITUDE"]
    [said] = telemetry.run(12, dict.fromkeys(telemetry.names, rate) | {"ATTITUDE": 4})
    assert said == f"motors watches nothing: ATTITUDE 4 Hz, fitted at {often:g} Hz; fit it to recordings like this one"
    assert telemetry.run(20, dict.fromkeys(telemetry.names, rate)) == []


@pytest.mark.parametrize("hours", [2, -2])
def test_a_clock_that_is_set_is_no_telemetry_that_lacks(telemetry: Telemetry, hours: int) -> None:
    rates = dict.fromkeys(telemetry.names, round(telemetry.observer.rate_hz))
    assert telemetry.run(12, rates) == []
    assert telemetry.watch.lacks(telemetry.now_ns + hours * 3600 * SECOND_NS) == []


@pytest.mark.parametrize("speed", [0.2, 8.0])
def test_a_simulation_may_run_at_any_speed(telemetry: Telemetry, speed: float) -> None:
    rates = dict.fromkeys(telemetry.names, round(telemetry.observer.rate_hz))
    assert telemetry.run(120, rates, speed=speed) == []
    [said] = telemetry.run(240, rates | {"ATTITUDE": 4}, speed=speed)
    assert "ATTITUDE 4 Hz" in said


def test_a_message_that_does_not_come_is_named_and_not_called_slow(telemetry: Telemetry) -> None:
    rates = dict.fromkeys(telemetry.names, round(telemetry.observer.rate_hz)) | {"ATTITUDE": 0}
    assert telemetry.run(12, rates, samples=False) == ["motors watches nothing: no ATTITUDE"]


def test_a_receiver_without_a_fix_is_named(telemetry: Telemetry) -> None:
    gps = Channel("lat", "GPS_RAW_INT", ("lat",), at_least=(("fix_type", 2.0),))
    observer = replace(telemetry.observer, source=replace(telemetry.observer.source, signals=(gps,)))
    watch = TelemetryWatch([observer], {observer.name: frozenset({"GPS_RAW_INT"})}, START_NS)
    at_ns = START_NS + 6 * SECOND_NS
    watch.count_messages("GPS_RAW_INT", START_NS)
    watch.count_messages("GPS_RAW_INT", at_ns, 2, {"fix_type": np.array([3, 1])})
    assert watch.lacks(at_ns) == ["motors watches nothing: GPS_RAW_INT says fix_type 1 and counts from 2 on"]
    watch.count_messages("GPS_RAW_INT", at_ns, 2, {"fix_type": np.array([1, 3])})
    assert watch.lacks(at_ns) == ["motors watches nothing: no times in common"]


def test_a_vehicle_that_comes_late_is_given_time_for_its_first_sample(telemetry: Telemetry) -> None:
    rates = dict.fromkeys(telemetry.names, round(telemetry.observer.rate_hz))
    [said] = telemetry.run(60, {})
    assert said.startswith("motors watches nothing: no ")
    assert telemetry.run(4, rates, samples=False) == []
    assert telemetry.run(2, rates, samples=False) == ["motors watches nothing: no times in common"]
    assert telemetry.run(1, rates) == []


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


def heartbeat(kind: object, at_s: int = 0, autopilot: int = 3, armed: bool = True) -> Message:
    fields = {"type": kind, "autopilot": autopilot, "base_mode": 209 if armed else 81}
    return Message(MAVLINK, "HEARTBEAT", START_NS + at_s * SECOND_NS, fields, 1, 1)


def test_the_status_says_that_the_vehicle_is_another_than_the_profile_s(quad_profile: Profile) -> None:
    monitor = VehicleMonitor(Pipeline(quad_profile, system=1), (), None, lambda _: None, START_NS)
    monitor.process(pack([heartbeat(2, armed=False)]))
    assert monitor.status(START_NS + SECOND_NS)["reasons"] == []
    for at_s, armed, state in ((1, False, "degraded"), (2, True, "blind")):
        monitor.process(pack([heartbeat(1, at_s, armed=armed)]))
        status = monitor.status(START_NS + (at_s + 1) * SECOND_NS)
        assert status["state"] == state
        [said] = status["reasons"]
        assert said == (
            "not watched: another vehicle than the profile's: it says it is a fixed wing, "
            "the profile was fitted to a quadrotor"
        )


@pytest.mark.parametrize("kind", [0, 6, 250, 99_999_999, -1, None, "1", True])
def test_what_says_nothing_of_the_vehicle_is_no_mismatch(quad_profile: Profile, kind: object) -> None:
    pipeline = Pipeline(quad_profile, system=1)
    pipeline.run(pack([heartbeat(kind)]))
    assert pipeline.mismatch is None


def test_a_profile_that_does_not_know_its_vehicle_s_type_takes_any(quad_profile: Profile) -> None:
    pipeline = Pipeline(replace(quad_profile, identity=Identity()), system=1)
    pipeline.run(pack([heartbeat(1)]))
    assert pipeline.mismatch is None
