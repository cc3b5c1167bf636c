"""More motors than can be told apart together: a bank names the motor, and takes itself back when the fault ends."""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from conftest import plain_fits
from hexacopter import hexacopter_flight

from adapters.logs.recordings import packed
from adapters.message import Message
from monitor.estimation.isolation_rule import BankRule
from monitor.event import AlarmEvent
from monitor.profile import Profile, read_profile
from replay.fit import fit_profile
from replay.player import play

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def profile(tmp_path_factory: pytest.TempPathFactory) -> Profile:
    folder = tmp_path_factory.mktemp("hexa") / "hexa"
    first, second = (list(hexacopter_flight(seed, 60.0)) for seed in (1, 2))
    with plain_fits():
        fit_profile("multirotor", [lambda: packed(first), lambda: packed(second)], folder, "hexa")
    return read_profile(folder)


def at_rates(messages: Iterable[Message], **every: int) -> Iterator[Message]:
    """Yield messages, of those named only each n-th."""
    counts = Counter[str]()
    for message in messages:
        counts[message.name] += 1
        if counts[message.name] % every.get(message.name, 1) == 0:
            yield message


LOG = {"SERVO_OUTPUT_RAW": 10, "ATTITUDE": 4, "HIGHRES_IMU": 4}
RADIO = {"SERVO_OUTPUT_RAW": 100, "ATTITUDE": 20, "HIGHRES_IMU": 10**9}


@pytest.mark.parametrize(("every", "lost", "within_s"), [(LOG, 0.15, 3.0), (RADIO, 0.25, 15.0)])
def test_a_failing_motor_is_named_at_the_rates_of_logs_and_radios(
    tmp_path: Path, every: dict[str, int], lost: float, within_s: float
) -> None:
    flights = [list(at_rates(hexacopter_flight(seed, 120.0), **every)) for seed in (1, 2)]
    with plain_fits():
        report = fit_profile("multirotor", [partial(packed, flight) for flight in flights], tmp_path / "hexa", "hexa")
    assert "hexa x (from the motion)" in "\n".join(report.text())
    slow = read_profile(tmp_path / "hexa")
    events = play(slow, at_rates(hexacopter_flight(7, 80.0, {3: lost}, 30.0, 60.0), **every)).events
    named = [event for event in events if event.kind == "actuator"]
    assert {event.channel for event in named} == {"motor3"}
    assert 0.0 < seconds_after(named[0], 30.0) < within_s
    assert named[-1].state == "cleared"
    for observer in slow.observers:
        for alarm in observer.alarms:
            if alarm.channel == "unexplained" and isinstance(observer.isolation, BankRule):
                # Nothing that no motor explains goes unsaid.
                assert alarm.threshold == pytest.approx(observer.isolation.score_floor, rel=1e-3)


def test_a_hover_alone_makes_a_profile_that_takes_no_turn_for_a_lost_motor(tmp_path: Path) -> None:
    hover = list(hexacopter_flight(1, 45.0, lively=0.08))
    for name, value in (("FRAME_CLASS", 2.0), ("FRAME_TYPE", 1.0)):
        fields = {"param_id": name, "param_value": value, "param_type": 9}
        hover.insert(0, replace(hover[0], name="PARAM_VALUE", fields=fields))
    with plain_fits():
        report = fit_profile("multirotor", [lambda: packed(hover)], tmp_path / "hexa", "hexa")
    assert "too few manoeuvres" in "\n".join(report.text())
    profile = read_profile(tmp_path / "hexa")
    assert not alarms(profile, 2, {}, 25.0)
    flight = hexacopter_flight(3, 26.0, {3: 0.15}, lively=0.3)
    named = [event for event in play(profile, flight).events if event.kind == "actuator"]
    assert {event.channel for event in named} == {"motor3"}
    assert 0.0 < seconds_after(named[0], 20.0) < 3.0


def alarms(profile: Profile, seed: int, loss: dict[int, float], duration_s: float = 50.0) -> list[AlarmEvent]:
    flight = hexacopter_flight(seed, duration_s, loss)
    return [event for event in play(profile, flight).events if event.kind != "stale"]


def seconds_after(event: AlarmEvent, moment_s: float) -> float:
    return event.vehicle_time_ms / 1000 - 5.0 - moment_s


def test_the_profile_holds_one_observer_for_each_motor(profile: Profile) -> None:
    observer, trim = profile.observers
    assert trim.name == "trim"
    motors, gyros = [f"motor{i}" for i in range(1, 7)], ["gyro_x", "gyro_y", "gyro_z"]
    assert [gains.faults for gains in observer.gains] == [(name,) for name in (*motors, *gyros)]
    assert {f"motors.motor{i}.gains.json" for i in range(1, 7)} < set(profile.files)


@pytest.mark.parametrize(
    ("motor", "lost"),
    [
        (1, 0.1),
        (4, 0.3),
        *(pytest.param(*case, marks=pytest.mark.long) for case in ((2, 0.2), (3, 0.15), (5, 0.1), (6, 0.15))),
    ],
)
def test_the_failing_motor_alone_is_named_and_cleared_when_it_recovers(
    profile: Profile, motor: int, lost: float
) -> None:
    events = alarms(profile, 10 + motor, {motor: lost})
    assert {event.channel for event in events} == {f"motor{motor}"}
    raised, *_, cleared = events
    assert (raised.state, cleared.state) == ("raised", "cleared")
    assert 0.0 < seconds_after(raised, 20.0) < 0.5
    assert 0.0 < seconds_after(cleared, 40.0) < 5.0
    # the first size is rough, and says so; each later one is right until the motor recovers
    assert raised.relative is not None and raised.estimate is not None and raised.sd is not None
    assert raised.estimate * -lost / raised.relative == pytest.approx(raised.estimate, abs=2.0 * raised.sd)
    for event in events[1:-1]:
        if seconds_after(event, 40.0) < 0.0:
            assert event.relative == pytest.approx(-lost, abs=0.25 * lost)


def test_a_healthy_flight_raises_nothing(profile: Profile) -> None:
    assert alarms(profile, 30, {}) == []


def test_what_no_single_motor_explains_is_said_to_be_unexplained(profile: Profile) -> None:
    events = alarms(profile, 31, {1: 0.3, 3: 0.3, 6: 0.2}, 26.0)
    first = next(event for event in events if event.channel == "unexplained")
    assert (first.state, first.kind) == ("raised", "residual")
    assert 2.0 < seconds_after(first, 20.0) < 4.0
    assert "no known fault explains" in first.message


def test_a_push_that_no_motor_could_make_is_no_fault(profile: Profile) -> None:
    events = play(profile, hexacopter_flight(32, 20.0, push=(3.0, -2.0, 4.0))).events
    assert [event for event in events if event.kind != "stale"] == []
