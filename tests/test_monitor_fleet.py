"""Which vehicle a message belongs to: its own link, its system id, one that is new, or none."""

from itertools import pairwise

import pytest

from adapters.batch import messages, pack
from adapters.message import Message
from adapters.source import LINK, MAVLINK, ZENOH
from monitor.pipeline import Pipeline
from monitor.profile import Profile
from monitor.service.fleet import Fleet
from monitor.service.inbox import Arrival
from monitor.service.vehicle_monitor import VehicleMonitor

T0 = 1_795_251_917_000_000_000


@pytest.fixture
def profile(quad_profile: Profile) -> Profile:
    return quad_profile


def monitor(profile: Profile, name: str, system: int) -> VehicleMonitor:
    return VehicleMonitor(Pipeline(profile, name, system), (), None, lambda event: None, 0)


def arrival(message: Message, vehicle: str | None = None) -> Arrival:
    return Arrival(vehicle, pack([message]))


def route(fleet: Fleet, arrived: Arrival) -> VehicleMonitor | None:
    """Return the vehicle that a batch of one message is for."""
    routed = fleet.routed([arrived])
    assert all(batch.count == 1 for _, batch in routed)
    return routed[0][0] if routed else None


def heartbeat(system: int, component: int = 1, at_s: float = 0.0, **fields: int) -> Arrival:
    return arrival(
        Message(MAVLINK, "HEARTBEAT", T0 + round(at_s * 1e9), {"type": 2, "autopilot": 3} | fields, system, component)
    )


def channel(profile: Profile, system: int, at_s: float = 0.0) -> Arrival:
    name = min(channel.message for observer in profile.observers for channel in observer.source.channels)
    return arrival(Message(MAVLINK, name, T0 + round(at_s * 1e9), {"a": at_s}, system, 1))


def test_vehicles_are_told_apart_by_system_id_and_by_their_own_links(profile: Profile) -> None:
    one, two = monitor(profile, "one", 1), monitor(profile, "two", 2)
    fleet = Fleet([one, two])
    assert [route(fleet, heartbeat(system)) for system in (1, 2)] == [one, two]
    assert route(fleet, heartbeat(9)._replace(vehicle="two")) is two
    assert route(fleet, arrival(Message(LINK, "signing", 0, {}, 2))) is two
    assert fleet.foreign == 0
    assert route(fleet, heartbeat(3)) is None
    assert route(fleet, heartbeat(1)._replace(vehicle="three")) is None
    assert route(fleet, arrival(Message(ZENOH, "a", 0, {}))) is None
    assert fleet.foreign == 3
    assert (list(fleet), len(fleet), fleet.get("two")) == ([one, two], 2, two)


def test_a_vehicle_without_a_system_id_takes_the_first_that_goes_on_sending_its_channels(profile: Profile) -> None:
    one = monitor(profile, "one", 0)
    fleet = Fleet([one])
    assert route(fleet, heartbeat(255, type=6, autopilot=8)) is None
    sent = [channel(profile, 7, 0.03 * k) for k in range(6)]
    assert fleet.routed(sent) == []
    assert fleet.routed([channel(profile, 66, 0.1), channel(profile, 66, 0.11), channel(profile, 66, 0.12)]) == []
    [(vehicle, batch)] = fleet.routed([channel(profile, 7, 0.25)])
    assert vehicle is one
    assert [message.fields["a"] for message in messages(batch)] == [0.03 * k for k in range(6)] + [0.25]
    assert route(fleet, heartbeat(7)) is one
    assert [route(fleet, channel(profile, 66, 0.1 * k)) for k in range(10)] == [None] * 10
    assert one.pipeline.system == 7


def test_what_a_link_held_back_comes_at_once_and_is_a_vehicle(profile: Profile) -> None:
    one = monitor(profile, "one", 0)
    [(vehicle, batch)] = Fleet([one]).routed([channel(profile, 7, 1e-5 * k) for k in range(60)])
    assert (vehicle, batch.count, one.pipeline.system) == (one, 60, 7)


def test_one_forged_packet_now_and_then_takes_no_vehicle(profile: Profile) -> None:
    one = monitor(profile, "one", 0)
    fleet = Fleet([one])
    assert [route(fleet, channel(profile, 66, 3.0 * k)) for k in range(20)] == [None] * 20
    assert one.pipeline.system == 0
    routed = [found for k in range(4) for found in fleet.routed([channel(profile, 7, 60.0 + 0.1 * k)])]
    assert {vehicle.name for vehicle, _ in routed} == {"one"}
    assert sum(batch.count for _, batch in routed) == 4
    assert one.pipeline.system == 7


def test_a_channel_in_a_message_with_text_tells_the_system_too(arm_profile: Profile) -> None:
    arm = monitor(arm_profile, "arm", 0)
    fields = {"time_usec": 1, "name": "arm", "array_id": 0, "data": [0.0] * 4}
    sent = [Message(MAVLINK, "DEBUG_FLOAT_ARRAY", T0 + k * 10**8, fields, 5, 1) for k in range(3)]
    [(vehicle, batch)] = Fleet([arm]).routed([arrival(message) for message in sent])
    assert (vehicle, batch.count) == (arm, 3)
    assert arm.pipeline.system == 5


def test_an_autopilot_that_sends_telemetry_is_asked_about_once_and_nobody_else_is(profile: Profile) -> None:
    asked: list[int] = []

    def new(system: int) -> VehicleMonitor | None:
        asked.append(system)
        return monitor(profile, f"copter-{system}", system) if system == 5 else None

    fleet = Fleet([], new)
    for k in range(50):
        for arrived in (
            heartbeat(255, type=6, at_s=0.1 * k),
            heartbeat(4, component=154, at_s=0.1 * k),
            heartbeat(4, autopilot=8, at_s=0.1 * k),
            channel(profile, 4, 0.1 * k),
            heartbeat(77, at_s=0.1 * k),
        ):
            assert route(fleet, arrived) is None
    assert asked == []
    assert route(fleet, heartbeat(6, at_s=5.0)) is None
    assert [route(fleet, channel(profile, 6, 5.0 + 0.1 * k)) for k in range(20)] == [None] * 20
    fleet.routed([heartbeat(5, at_s=7.0)])
    routed = [found for k in range(20) for found in fleet.routed([channel(profile, 5, 7.0 + 0.1 * k)])]
    assert {vehicle.name for vehicle, _ in routed} == {"copter-5"}
    assert sum(batch.count for _, batch in routed) == 21
    assert asked == [6, 5]


def test_forged_vehicles_come_one_by_one_and_after_those_with_more_telemetry(profile: Profile) -> None:
    asked: list[tuple[float, int]] = []
    now_s = 0.0

    def new(system: int) -> VehicleMonitor | None:
        asked.append((now_s, system))
        return monitor(profile, f"copter-{system}", system)

    fleet = Fleet([], new)
    for k in range(100):
        now_s = 0.02 * k
        for system in range(100, 120):
            if k % 20 == 0:
                fleet.routed([heartbeat(system, at_s=now_s), channel(profile, system, now_s)])
        if now_s >= 0.5:
            fleet.routed([heartbeat(1, at_s=now_s), channel(profile, 1, now_s)])
    times = [time_s for time_s, _ in asked]
    assert all(later - sooner >= 0.25 for sooner, later in pairwise(times))
    assert 1 in {system for _, system in asked[:2]}


def test_what_is_kept_of_nobody_is_bounded(profile: Profile) -> None:
    fleet = Fleet([monitor(profile, "one", 0)])
    burst = [Message(MAVLINK, "STATUSTEXT", T0 + k, {"text": "x"}, 9, 1) for k in range(1000)]
    for _ in range(30):
        assert fleet.routed([Arrival(None, pack(burst))]) == []
    assert fleet.foreign >= 20_000


def test_a_single_vehicle_takes_what_has_no_system_id(profile: Profile) -> None:
    fleet = Fleet([])
    one = monitor(profile, "one", 1)
    fleet.add(one)
    assert route(fleet, arrival(Message(ZENOH, "HEARTBEAT", 0, {}))) is one


def test_a_batch_of_several_systems_is_split_and_what_waits_for_a_vehicle_is_joined(profile: Profile) -> None:
    one, two = monitor(profile, "one", 1), monitor(profile, "two", 2)
    fleet = Fleet([one, two])
    systems = [1, 2, 1, 3, 2, 1, 1, 3]
    sent = [Message(MAVLINK, "ATTITUDE", k, {"roll": 0.5 * k}, system, 1) for k, system in enumerate(systems)]
    texts = [Message(MAVLINK, "STATUSTEXT", 10 + k, {"text": str(k)}, system, 1) for k, system in enumerate((2, 1))]
    routed = fleet.routed([Arrival(None, pack(part)) for part in (sent[:5], sent[5:], texts)])
    for vehicle, system in ((one, 1), (two, 2)):
        (batch,) = [batch for found, batch in routed if found is vehicle]
        assert [*messages(batch)] == [message for message in (*sent, *texts) if message.system == system]
    assert fleet.foreign == 2
