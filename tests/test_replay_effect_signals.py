"""Which messages feed planes and rovers: choices, fallbacks, rates, and what is said where one is missing."""

from dataclasses import replace

import pytest

from adapters.errors import TelemetryError
from monitor.fitting.survey import Survey
from monitor.vehicles.plane.signals import plane_signals
from monitor.vehicles.plane.transform import SurfaceInputs
from monitor.vehicles.rover.signals import rover_signals
from monitor.vehicles.rover.transform import DriveInputs

RATES = {"ATTITUDE": 100.0, "SERVO_OUTPUT_RAW": 100.2, "HIGHRES_IMU": 99.8, "LOCAL_POSITION_NED": 50.0}
FULL = Survey({"VFR_HUD": 100, **dict.fromkeys(RATES, 1000)}, RATES, {})


def with_rates(**rates: float) -> Survey:
    return replace(FULL, rate_hz={name: rate for name, rate in (RATES | rates).items() if rate})


def test_every_signal_has_its_channel_in_the_transforms_order() -> None:
    assert tuple(channel.name for channel in plane_signals([FULL]).channels) == SurfaceInputs.signals
    assert tuple(channel.name for channel in rover_signals([FULL]).channels) == DriveInputs.signals


def test_pulses_become_deflections() -> None:
    plane = {channel.name: channel for channel in plane_signals([FULL]).channels}
    rover = {channel.name: channel for channel in rover_signals([FULL]).channels}
    pulses = {f"servo{n}_raw": pulse for n, pulse in ((1, 1750), (2, 1000), (3, 1400), (4, 2000))}
    found = [plane[name].value(pulses) for name in ("aileron", "elevator", "throttle", "rudder")]
    assert found == pytest.approx([0.5, -1.0, 0.4, 1.0])
    assert [rover[name].value(pulses) for name in ("steering", "throttle")] == pytest.approx([0.5, -0.2])


def test_angles_wrap() -> None:
    wrapping = {channel.name for channel in plane_signals([FULL]).channels if channel.period}
    assert wrapping == {"roll", "pitch"}
    assert {channel.name for channel in rover_signals([FULL]).channels if channel.period} == {"yaw"}


def test_other_messages_stand_in() -> None:
    poor = with_rates(HIGHRES_IMU=0.0, RAW_IMU=50.0, LOCAL_POSITION_NED=0.0, GLOBAL_POSITION_INT=10.0)
    channels = {channel.name: channel for channel in rover_signals([poor]).channels}
    assert channels["forward_acceleration"].message == "RAW_IMU"
    assert channels["forward_acceleration"].value({"xacc": 1000}) == pytest.approx(9.80665)
    assert channels["velocity_north"].value({"vx": 250}) == pytest.approx(2.5)


@pytest.mark.parametrize(("slowest", "rate"), [(100.0, 100.0), (92.0, 100.0), (60.0, 50.0), (25.4, 25.0), (9.5, 10.0)])
def test_the_slowest_message_sets_the_rate(slowest: float, rate: float) -> None:
    assert rover_signals([FULL, with_rates(SERVO_OUTPUT_RAW=slowest)]).rate_hz == rate


@pytest.mark.parametrize("name", ["ATTITUDE", "SERVO_OUTPUT_RAW", "HIGHRES_IMU", "LOCAL_POSITION_NED"])
def test_a_missing_message_is_named(name: str) -> None:
    with pytest.raises(TelemetryError, match=f"record .*{name}"):
        rover_signals([FULL, with_rates(**{name: 0.0})])


def test_a_message_that_comes_too_seldom_is_named() -> None:
    with pytest.raises(TelemetryError, match=r"ATTITUDE comes 4\.0 times a second"):
        plane_signals([with_rates(ATTITUDE=4.0)])


def test_a_plane_needs_airspeed() -> None:
    with pytest.raises(TelemetryError, match="VFR_HUD"):
        plane_signals([FULL, replace(FULL, counts={})])
