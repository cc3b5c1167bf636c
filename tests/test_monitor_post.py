"""A vehicle's monitor at its place in a daemon: beside a younger one, on real sessions."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
from loopback import Endpoint, until

from monitor.alarms.desk_rule import DeskRule
from monitor.pipeline import Pipeline
from monitor.profile import Profile
from monitor.service.election import Election
from monitor.service.post import Post, PostRule
from monitor.service.vehicle_monitor import VehicleMonitor

VEHICLE = "copter-1"
SECOND_NS = 1_000_000_000


@pytest.fixture
def endpoint() -> Iterator[Endpoint]:
    one = Endpoint()
    yield one
    one.close()


@pytest.fixture
def post(endpoint: Endpoint, arm_profile: Profile) -> Iterator[Post]:
    monitor = VehicleMonitor(Pipeline(arm_profile, VEHICLE), (), None, lambda _: None, time.time_ns())
    one = Post(monitor, DeskRule(), endpoint.session, PostRule("fauio", 10.0, standby_s=0.5))
    yield one
    one.close()


def works(post: Post) -> bool:
    """Let a post do what is due, return whether it speaks."""
    post.work(time.time_ns(), ())
    return post.monitor.speaks


def test_one_that_was_frozen_gives_way_before_it_says_anything_to_one_that_may_have_replaced_it(
    endpoint: Endpoint, post: Post
) -> None:
    until(lambda: works(post))
    assert post.last_status["role"] == "active"
    other = Election(endpoint.client(), f"fauio/{VEHICLE}")
    until(lambda: other.others == 1)
    assert works(post)
    post.work(time.time_ns() + 2 * SECOND_NS, ())
    assert not post.monitor.speaks
    until(lambda: other.leads)
    assert not works(post)
    other.close()
    until(lambda: works(post))


def test_one_that_stands_by_makes_a_status_of_its_own_and_publishes_none(endpoint: Endpoint, post: Post) -> None:
    with endpoint.client().declare_subscriber(f"fauio/{VEHICLE}/status") as statuses:
        post.work(time.time_ns() + SECOND_NS, ())
        assert post.last_status["role"] == "standby"
        assert statuses.try_recv() is None
        until(lambda: works(post))
        assert b'"active"' in statuses.recv().payload.to_bytes()
