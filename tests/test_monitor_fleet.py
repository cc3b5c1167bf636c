"""Which vehicle a message belongs to: its own link, its system id, one that is new, or none."""

from dataclasses import replace

import pytest

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


def heartbeat(system: int, component: int = 1, **fields: int) -> Arrival:
    return Arrival(None, Message(MAVLINK, "HEARTBEAT", 0, {"type": 2, "autopilot": 3} | fields, system, component))


def channel(profile: Profile, system: int) -> Arrival:
    name = min(min(names) for names in Pipeline(profile).needs.values())
    return Arrival(None, Message(MAVLINK, name, 0, {}, system, 1))


def test_vehicles_are_told_apart_by_system_id_and_by_their_own_links(profile: Profile) -> None:
    one, two = monitor(profile, "one", 1), monitor(profile, "two", 2)
    fleet = Fleet([one, two])
    assert [fleet.vehicle_of(heartbeat(system)) for system in (1, 2)] == [one, two]
    assert fleet.vehicle_of(heartbeat(9)._replace(vehicle="two")) is two
    assert fleet.vehicle_of(Arrival(None, Message(LINK, "signing", 0, {}, 2))) is two
    assert fleet.foreign == 0
    assert fleet.vehicle_of(heartbeat(3)) is None
    assert fleet.vehicle_of(heartbeat(1)._replace(vehicle="three")) is None
    assert fleet.vehicle_of(Arrival(None, Message(ZENOH, "a", 0, {}))) is None
    assert fleet.foreign == 3
    assert (list(fleet), len(fleet), fleet.get("two")) == ([one, two], 2, two)


def test_a_vehicle_without_a_system_id_takes_the_first_that_sends_its_channels(profile: Profile) -> None:
    one = monitor(profile, "one", 0)
    fleet = Fleet([one])
    assert fleet.vehicle_of(heartbeat(255, type=6, autopilot=8)) is None
    assert fleet.vehicle_of(channel(profile, 7)) is one
    assert fleet.vehicle_of(heartbeat(7)) is one
    assert fleet.vehicle_of(channel(profile, 8)) is None
    assert one.pipeline.system == 7


def test_an_unknown_autopilot_is_asked_about_once_and_nobody_else_is(profile: Profile) -> None:
    asked: list[int] = []

    def new(system: int) -> VehicleMonitor | None:
        asked.append(system)
        return monitor(profile, f"copter-{system}", system) if system == 5 else None

    fleet = Fleet([], new)
    for arrival in (
        heartbeat(255, type=6),
        heartbeat(4, component=154),
        heartbeat(4, autopilot=8),
        channel(profile, 4),
    ):
        assert fleet.vehicle_of(arrival) is None
    assert asked == []
    assert [fleet.vehicle_of(heartbeat(6)) for _ in range(3)] == [None] * 3
    found = {fleet.vehicle_of(heartbeat(5)) for _ in range(3)}
    assert {vehicle.name for vehicle in found if vehicle} == {"copter-5"}
    assert asked == [6, 5]


def test_a_single_vehicle_takes_what_has_no_system_id(profile: Profile) -> None:
    fleet = Fleet([])
    one = monitor(profile, "one", 1)
    fleet.add(one)
    message = heartbeat(1).message
    assert fleet.vehicle_of(Arrival(None, replace(message, source=ZENOH, system=0))) is one
