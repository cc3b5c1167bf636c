"""Which vehicle a message belongs to: its own link, its system id, one that is new, or none."""

import pytest

from adapters.batch import messages, pack
from adapters.message import Message
from adapters.source import LINK, MAVLINK, ZENOH
from monitor.pipeline import Pipeline
from monitor.profile import Profile
from monitor.service.fleet import Fleet
from monitor.service.inbox import Arrival
from monitor.service.vehicle_monitor import VehicleMonitor


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


def heartbeat(system: int, component: int = 1, **fields: int) -> Arrival:
    return arrival(Message(MAVLINK, "HEARTBEAT", 0, {"type": 2, "autopilot": 3} | fields, system, component))


def channel(profile: Profile, system: int) -> Arrival:
    name = min(min(names) for names in Pipeline(profile).needs.values())
    return arrival(Message(MAVLINK, name, 0, {"a": 1.0}, system, 1))


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


def test_a_vehicle_without_a_system_id_takes_the_first_that_sends_its_channels(profile: Profile) -> None:
    one = monitor(profile, "one", 0)
    fleet = Fleet([one])
    assert route(fleet, heartbeat(255, type=6, autopilot=8)) is None
    assert route(fleet, channel(profile, 7)) is one
    assert route(fleet, heartbeat(7)) is one
    assert route(fleet, channel(profile, 8)) is None
    assert one.pipeline.system == 7


def test_a_channel_in_a_message_with_text_tells_the_system_too(arm_profile: Profile) -> None:
    arm = monitor(arm_profile, "arm", 0)
    fields = {"time_usec": 1, "name": "arm", "array_id": 0, "data": [0.0] * 4}
    assert route(Fleet([arm]), arrival(Message(MAVLINK, "DEBUG_FLOAT_ARRAY", 0, fields, 5, 1))) is arm
    assert arm.pipeline.system == 5


def test_an_unknown_autopilot_is_asked_about_once_and_nobody_else_is(profile: Profile) -> None:
    asked: list[int] = []

    def new(system: int) -> VehicleMonitor | None:
        asked.append(system)
        return monitor(profile, f"copter-{system}", system) if system == 5 else None

    fleet = Fleet([], new)
    for arrived in (
        heartbeat(255, type=6),
        heartbeat(4, component=154),
        heartbeat(4, autopilot=8),
        channel(profile, 4),
    ):
        assert route(fleet, arrived) is None
    assert asked == []
    assert [route(fleet, heartbeat(6)) for _ in range(3)] == [None] * 3
    found = {route(fleet, heartbeat(5)) for _ in range(3)}
    assert {vehicle.name for vehicle in found if vehicle} == {"copter-5"}
    assert asked == [6, 5]


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
