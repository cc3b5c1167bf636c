"""The wind triangle: a wrong airspeed stands out against GPS and wind, a wind that changes or a turn does not."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest

from adapters.batch import Batch
from adapters.errors import ModelError, TelemetryError
from adapters.logs.recordings import packed
from adapters.message import Message
from adapters.sample import Given, Samples, joined_samples
from adapters.source import MAVLINK
from monitor.fitting.fitted import FitRequest, Fitted
from monitor.fitting.survey import Survey, survey
from monitor.profile import Profile
from monitor.sampling.gate import GateRule
from monitor.vehicles.plane.airspeed import AirspeedInputs, fit_airspeed
from monitor.vehicles.plane.signals import has_airspeed_sensor, preview
from replay.player import play

HZ = 10.0
PARAMETERS = {"scale": 1.0, "noise": 0.4, "level": 1.0, "minimum_speed": 10.0}
SPEED, TURN_S, LEG_S = 20.0, 15.0, 25.0
WIND = np.array([5.0, -3.0])
Change = Callable[[np.ndarray], np.ndarray]


def flown(
    seconds: float = 240.0, *, fault: Change = lambda t: 0.0 * t, wind: Change = lambda t: 0.0 * t, seed: int = 1
) -> Samples:
    """Return legs of a square at sea level; ``fault`` is added to the airspeed, ``wind`` to that from the south."""
    t = np.arange(0.0, seconds, 1.0 / HZ)
    part = t % (LEG_S + TURN_S)
    quarters = np.floor(t / (LEG_S + TURN_S)) + np.clip((part - LEG_S) / TURN_S, 0.0, 1.0)
    heading = 0.5 * np.pi * quarters
    north = SPEED * np.cos(heading) + WIND[0] + wind(t)
    east = SPEED * np.sin(heading) + WIND[1]
    gusts = np.convolve(np.random.default_rng(seed).normal(0.0, 0.9, len(t) + 9), np.ones(10) / 10.0, "valid")
    course = np.degrees(np.arctan2(east, north))
    u = np.column_stack([SPEED + gusts + fault(t), np.hypot(north, east), course, np.zeros(len(t)), heading])
    stamps = np.round(1e9 * t).astype(np.int64)
    good, start = np.ones(len(t), np.bool_), np.arange(len(t)) == 0
    index = np.arange(len(t), dtype=np.int64)
    return Samples(index, stamps, stamps, u, u[:, :0], start, good, stamps, good, np.zeros(u.shape, np.bool_))


def watched(samples: Samples) -> Given:
    return AirspeedInputs(PARAMETERS, HZ, HZ).run(samples)


def differences(given: Given) -> np.ndarray:
    """Return by how much the airspeed reads too much at each sample (n,), not a number where that is not known."""
    samples = given.samples
    found = np.append(samples.y[1:, 0] - samples.u[:-1, 0], np.nan)
    return np.where(np.append(samples.lost[1:].any(axis=1), True), np.nan, found)


def at(t_s: float) -> int:
    return round(t_s * HZ)


def test_the_wind_is_soon_known_and_nothing_stands_out() -> None:
    off = differences(watched(flown()))
    assert np.isnan(off[: at(5.0)]).all()
    assert np.isfinite(off[at(80.0) : -1]).all()
    assert np.nanmax(np.abs(off)) < 1.8


@pytest.mark.parametrize("size", [-6.0, -3.0, 8.0, 180.0])
def test_a_step_shows_its_size_at_once_through_turns_and_goes_with_the_fault(size: float) -> None:
    off = differences(watched(flown(fault=lambda t: np.where((t >= 100.0) & (t < 180.0), size, 0.0))))
    during, after = off[at(100.2) : at(179.8)], off[at(180.5) : -1]
    assert np.isfinite(during).all()
    assert np.mean(during[: at(1.0)]) == pytest.approx(size, abs=0.6)
    assert np.mean(during) == pytest.approx(size, abs=0.8)
    assert np.abs(during - size).max() < 2.0
    assert np.nanmax(np.abs(after)) < 2.0
    assert np.isfinite(after[: at(2.0)]).all()


def test_a_leak_that_grows_is_not_taken_for_wind() -> None:
    off = differences(watched(flown(300.0, fault=lambda t: -0.2 * np.clip(t - 100.0, 0.0, 40.0))))
    assert np.mean(off[at(110.0) : at(115.0)]) < -1.2
    assert np.mean(off[at(220.0) : at(260.0)]) == pytest.approx(-8.0, abs=1.5)


def test_a_reading_that_jumps_about_leaves_the_wind_as_it_was() -> None:
    off = differences(watched(flown(fault=lambda t: ((t > 100.0) & (t < 180.0)) * 150.0 * np.round(t / 7.0 % 2.0))))
    assert np.nanmax(np.abs(off[at(185.0) :])) < 2.0


def test_a_tube_that_was_covered_from_the_start_is_seen() -> None:
    off = differences(watched(flown(fault=lambda t: 2.0 - SPEED + 0.0 * t)))
    assert np.nanmean(off[at(150.0) :]) < -10.0


def test_a_wind_that_changes_within_a_leg_is_followed_as_the_plane_turns() -> None:
    off = differences(watched(flown(600.0, wind=lambda t: 5.0 * np.clip((t - 200.0) / 20.0, 0.0, 1.0))))
    assert np.nanmax(np.abs(off[at(400.0) :])) < 2.0


def test_the_result_does_not_depend_on_how_the_stream_is_cut() -> None:
    samples = flown(fault=lambda t: np.where(t > 120.0, -5.0, 0.0))
    whole, transform = watched(samples), AirspeedInputs(PARAMETERS, HZ, HZ)
    cuts = [0, 1, 2, 700, 701, len(samples)]
    parts = [transform.run(samples.part(a, b)) for a, b in pairwise(cuts)]
    again = joined_samples([part.samples for part in parts])
    assert again.u.tobytes() == whole.samples.u.tobytes()
    assert again.y.tobytes() == whole.samples.y.tobytes()
    beyond = [part.beyond for part in parts if part.beyond is not None]
    assert whole.beyond is not None
    assert np.concatenate(beyond).tobytes() == whole.beyond.tobytes()


def test_what_lacks_is_lost_and_what_is_not_known_yet_is_not_called_lost_telemetry() -> None:
    samples = flown()
    lost = samples.lost.copy()
    lost[at(100.0) : at(102.0), 1] = True
    given = watched(replace(samples, lost=lost))
    assert given.samples.lost[at(100.5)].all()
    assert given.unflown is not None
    assert given.unflown[at(1.0)] and not given.unflown[at(101.0)]
    assert np.isfinite(differences(given)[at(104.0)])


def test_rougher_air_than_in_the_fitted_flights_asks_for_more() -> None:
    calm = flown()
    rough = replace(calm, u=calm.u + (calm.u[:, :1] - SPEED) * [3.0, 0.0, 0.0, 0.0, 0.0])
    found = [watched(samples).beyond for samples in (calm, rough)]
    assert all(beyond is not None for beyond in found)
    assert np.median(found[0]) == pytest.approx(1.0, abs=0.1)
    assert np.median(found[1][at(60.0) :]) > 1.5


GATE = GateRule(require_airborne=False)


def told(samples: Samples, airspeed_hz: float = HZ, present: int = 0x10) -> Iterator[Message]:
    """Yield the telemetry of a flight: GPS at 5 Hz, airspeed so often."""
    for k, (airspeed, speed, course, altitude, yaw) in enumerate(samples.u.tolist()):
        ms, now_ns = 5_000 + 100 * k, 1_800_000_000_000_000_000 + 100_000_000 * k
        if k % 10 == 0:
            mode = {"type": 1, "autopilot": 3, "base_mode": 0x81, "custom_mode": 10, "system_status": 4}
            yield Message(MAVLINK, "HEARTBEAT", now_ns, mode, 1, 1)
            yield Message(MAVLINK, "SYS_STATUS", now_ns, {"onboard_control_sensors_present": present}, 1, 1)
        attitude = {"time_boot_ms": ms, "roll": 0.0, "pitch": 0.0, "yaw": (yaw + np.pi) % (2.0 * np.pi) - np.pi}
        rates = {"rollspeed": 0.0, "pitchspeed": 0.0, "yawspeed": 0.0}
        yield Message(MAVLINK, "ATTITUDE", now_ns, attitude | rates, 1, 1)
        if k % 2 == 0:
            fix = {"time_usec": 1000 * ms, "fix_type": 3, "lat": 470_000_000, "lon": 80_000_000}
            fix |= {"alt": round(1000.0 * altitude), "vel": round(100.0 * speed), "cog": round(100.0 * course) % 36_000}
            yield Message(MAVLINK, "GPS_RAW_INT", now_ns, fix, 1, 1)
        if k % round(HZ / airspeed_hz) == 0:
            yield Message(MAVLINK, "VFR_HUD", now_ns, {"airspeed": airspeed}, 1, 1)


def imu(k: int) -> dict[str, float]:
    force = {"xacc": 0.0, "yacc": 0.0, "zacc": -9.81, "xgyro": 0.0, "ygyro": 0.0, "zgyro": 0.0}
    return {"time_usec": 5_000_000 + 1_000 * k, **force}


def request(log: list[Batch]) -> FitRequest:
    return FitRequest("plane", [partial(iter, log)], (survey(iter(log)),))


@pytest.fixture(scope="module")
def fitted() -> Fitted:
    found = fit_airspeed(request(list(packed(told(flown(300.0))))), GATE)
    assert found is not None
    return found


def test_healthy_flights_tell_scale_and_gusts(fitted: Fitted) -> None:
    assert fitted.findings["scale"] == pytest.approx(1.0, abs=0.01)
    assert fitted.findings["noise"] == pytest.approx(0.28, abs=0.1)
    assert fitted.alarms[0].rule.threshold == pytest.approx(0.1 * SPEED, abs=0.2)


@pytest.mark.parametrize("airspeed_hz", [HZ, 2.0])
def test_a_fault_is_one_alarm_that_says_its_size(fitted: Fitted, airspeed_hz: float) -> None:
    profile = Profile("plane", "plane", 0, GATE, 2.0, (fitted.profile(),), (), {}, "")
    wrong = flown(seed=2, fault=lambda t: np.where((t >= 120.0) & (t < 170.0), -6.0, 0.0))
    found = [event for event in play(profile, told(wrong, airspeed_hz)).events if event.state != "updated"]
    assert [(event.channel, event.state) for event in found] == [("airspeed", "raised"), ("airspeed", "cleared")]
    assert found[0].kind == "sensor"
    assert found[0].estimate == pytest.approx(-6.0, abs=1.5)
    assert found[0].message.endswith(" m/s too slow")
    assert 0.0 < found[0].vehicle_time_ms / 1000.0 - 125.0 < 1.5
    assert 0.0 < found[1].vehicle_time_ms / 1000.0 - 175.0 < 5.0


def test_healthy_flight_raises_nothing(fitted: Fitted) -> None:
    profile = Profile("plane", "plane", 0, GATE, 2.0, (fitted.profile(),), (), {}, "")
    assert play(profile, told(flown(400.0, seed=3))).events == ()


def test_it_explains_what_surfaces_show_and_a_wrong_gps_explains_it(fitted: Fitted) -> None:
    surfaces, airspeed = fitted.excuses
    assert (surfaces.channels, surfaces.by) == (("aileron", "elevator", "rudder", "throttle"), ("airspeed",))
    assert airspeed.channels == ("airspeed",)
    assert {"gps_velocity_north", "gps_east", "motion_north"} <= set(airspeed.by)
    assert airspeed.for_s == 30.0
    assert surfaces.precedes and airspeed.precedes


def test_a_plane_without_a_sensor_or_gps_has_no_such_observer() -> None:
    def says(present: int | None) -> bool:
        fields = {} if present is None else {"SYS_STATUS": {"onboard_control_sensors_present": present}}
        return has_airspeed_sensor(Survey({}, {}, {}, fields))

    assert says(0x0000_0010 | 0x1) and says(None)
    assert not says(0x1)
    with pytest.raises(ModelError, match="has no airspeed sensor"):
        fit_airspeed(request(list(packed(told(flown(60.0), present=0x1)))), GATE)
    without = [message for message in told(flown(60.0)) if message.name != "GPS_RAW_INT"]
    hears = [Message(MAVLINK, "HIGHRES_IMU", m.received_ns, imu(k), 1, 1) for k, m in enumerate(without)]
    with pytest.raises(ModelError, match="record GPS_RAW_INT"):
        fit_airspeed(request(list(packed([*without, *hears]))), GATE)


@pytest.mark.parametrize(
    ("parameters", "has"), [({}, True), ({"SYS_HAS_NUM_ASPD": 0.0}, False), ({"FW_ARSP_MODE": 1.0}, False)]
)
def test_onboard_logs_tell_of_the_sensor_by_parameters(parameters: dict[str, float], has: bool) -> None:
    battery = {"SYS_STATUS": {"onboard_control_sensors_present": 0}}  # made from the battery's records
    assert has_airspeed_sensor(Survey({}, {}, {}, battery, parameters=parameters, onboard=True)) is has


@pytest.mark.parametrize("deviation", [0.9, 7.0])
def test_gusts_widen_the_alarm_and_do_not_end_the_watch(deviation: float) -> None:
    samples = flown(300.0)
    rough = np.random.default_rng(2).normal(0.0, deviation, len(samples.u) + 9)
    samples.u[:, 0] += np.convolve(rough, np.ones(10) / 10.0, "valid")
    found = fit_airspeed(request(list(packed(told(samples)))), GATE)
    assert found.flight_s > 100.0
    assert found.alarms[0].rule.threshold > 3.0 * 0.3 * deviation


def test_flights_that_climb_and_dive_all_the_time_tell_nothing() -> None:
    samples = flown(60.0)
    samples.u[:, 3] = 200.0 * np.abs((np.arange(len(samples.u)) / 100.0) % 2.0 - 1.0)
    with pytest.raises(ModelError, match="s of flight with evidence for airspeed; 20 s are needed"):
        fit_airspeed(request(list(packed(told(samples)))), GATE)


@pytest.mark.parametrize(("present", "watched"), [(0x10, True), (0x1, False)])
def test_a_recording_says_whether_the_airspeed_could_be_watched(present: int, watched: bool) -> None:
    log = list(told(flown(60.0), present=present))
    for name, fields in (("SERVO_OUTPUT_RAW", {"port": 0, "servo1_raw": 1500}), ("HIGHRES_IMU", {})):
        log += [Message(MAVLINK, name, m.received_ns, imu(k) | fields, 1, 1) for k, m in enumerate(log)]
    assert ("airspeed" in preview(survey(packed(log))).watches) is watched


@pytest.mark.parametrize(
    ("parameters", "rates"),
    [
        ({"scale": 1.0}, (HZ, HZ)),
        (PARAMETERS | {"noise": 0.0}, (HZ, HZ)),
        (PARAMETERS | {"scale": float("nan")}, (HZ, HZ)),
        (PARAMETERS, (HZ, HZ / 2.0)),
    ],
)
def test_wrong_parameters_and_rates_are_refused(parameters: dict[str, float], rates: tuple[float, float]) -> None:
    with pytest.raises(TelemetryError, match="airspeed"):
        AirspeedInputs(parameters, *rates)
