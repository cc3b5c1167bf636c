"""A vehicle's monitor at its place in a daemon: beside a younger one, on real sessions."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
from loopback import Endpoint, until

from monitor.alarms.desk import DeskRule
from monitor.configuration.config import Config, Standby
from monitor.pipeline import Pipeline
from monitor.profile import Profile
from monitor.service.election import Election
from monitor.service.vehicle_monitor import VehicleMonitor
from monitor.service.vehicle_service import VehicleService

VEHICLE = "copter-1"
SECOND_NS = 1_000_000_000


@pytest.fixture
def endpoint() -> Iterator[Endpoint]:
    one = Endpoint()
    yield one
    one.close()


@pytest.fixture
def service(endpoint: Endpoint, arm_profile: Profile) -> Iterator[VehicleService]:
    monitor = VehicleMonitor(Pipeline(arm_profile, VEHICLE), (), None, lambda _: None, time.time_ns())
    one = VehicleService(monitor, DeskRule(), endpoint.session, Config(standby=Standby(True, 0.5)))
    yield one
    one.close()


def works(service: VehicleService) -> bool:
    """Let a service do what is due, return whether it speaks."""
    service.work(time.time_ns(), ())
    return service.monitor.active


def test_one_that_was_frozen_gives_way_before_it_says_anything_to_one_that_may_have_replaced_it(
    endpoint: Endpoint, service: VehicleService
) -> None:
    until(lambda: works(service))
    assert service.last_status["role"] == "active"
    other = Election(endpoint.client(), f"fauio/{VEHICLE}")
    until(lambda: other.others == 1)
    assert works(service)
    service.work(time.time_ns() + 2 * SECOND_NS, ())
    assert not service.monitor.active
    until(lambda: other.leads)
    assert not works(service)
    other.close()
    until(lambda: works(service))


def test_a_standby_makes_a_status_of_its_own_and_publishes_none(endpoint: Endpoint, service: VehicleService) -> None:
    with endpoint.client().declare_subscriber(f"fauio/{VEHICLE}/status") as statuses:
        service.work(time.time_ns() + SECOND_NS, ())
        assert service.last_status["role"] == "standby"
        assert statuses.try_recv() is None
        until(lambda: works(service))
        assert b'"active"' in statuses.recv().payload.to_bytes()
