"""A vehicle's monitor at its place in a daemon: beside a younger one, on real sessions."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from loopback import Endpoint, until

from monitor.alarms.desk import DeskRule
from monitor.bus.seal import Seal
from monitor.configuration.config import Config, Standby
from monitor.event import AlarmEvent
from monitor.pipeline import Pipeline
from monitor.profile import Profile
from monitor.service.election import Election
from monitor.service.vehicle_monitor import VehicleMonitor
from monitor.service.vehicle_service import VehicleService

VEHICLE = "copter-1"
SECOND_NS = 1_000_000_000
SECRET = bytes(range(32))


@pytest.fixture
def service(endpoint: Endpoint, arm_profile: Profile, tmp_path: Path) -> Iterator[VehicleService]:
    key = tmp_path / "standby.key"
    key.write_text(SECRET.hex())
    key.chmod(0o600)
    monitor = VehicleMonitor(Pipeline(arm_profile, VEHICLE), (), None, lambda _: None, time.time_ns())
    one = VehicleService(monitor, DeskRule(), endpoint.session, Config(standby=Standby(True, 0.5, key)))
    yield one
    one.close()


def works(service: VehicleService) -> bool:
    """Let a service do what is due, return whether it speaks."""
    service.work(time.monotonic_ns(), time.time_ns(), ())
    return service.monitor.active


def test_one_that_was_frozen_gives_way_before_it_says_anything_to_one_that_may_have_replaced_it(
    endpoint: Endpoint, service: VehicleService
) -> None:
    until(lambda: works(service))
    assert service.last_status["role"] == "active"
    other = Election(endpoint.client(), f"fauio/{VEHICLE}", Seal(SECRET))

    def both_there() -> bool:
        return works(service) and not other.turn() and other.others == 1

    until(both_there)
    service.work(time.monotonic_ns() + 2 * SECOND_NS, time.time_ns(), ())
    assert not service.monitor.active
    until(lambda: not works(service) and other.turn())
    assert not works(service)
    other.close()
    until(lambda: works(service))


def test_a_standby_makes_a_status_of_its_own_and_publishes_none(endpoint: Endpoint, service: VehicleService) -> None:
    with endpoint.client().declare_subscriber(f"fauio/{VEHICLE}/status") as statuses:
        service.work(time.monotonic_ns() + SECOND_NS, time.time_ns(), ())
        assert service.last_status["role"] == "standby"
        assert statuses.try_recv() is None
        until(lambda: works(service))
        assert b'"active"' in statuses.recv().payload.to_bytes()


@pytest.mark.parametrize("step_ns", [-3600 * SECOND_NS, -SECOND_NS, 3600 * SECOND_NS])
def test_a_clock_that_is_set_an_hour_back_or_forth_or_leaps_a_second_delays_neither_status_nor_flush(
    endpoint: Endpoint, arm_profile: Profile, step_ns: int
) -> None:
    flushed: list[int] = []
    archive = SimpleNamespace(batch=str, estimates=str, event=str, flush=lambda: flushed.append(1))
    monitor = VehicleMonitor(Pipeline(arm_profile, VEHICLE), (archive,), None, lambda _: None, time.time_ns())
    service = VehicleService(monitor, DeskRule(), endpoint.session, Config())
    # Afterwards: on a busy machine it takes part of a second to make them.
    start_ns, steady_ns = time.time_ns(), time.monotonic_ns()
    service.work(steady_ns, start_ns, ())
    statuses = [service.last_status]
    for tenth in range(1, 61):
        elapsed_ns = tenth * SECOND_NS // 10
        service.work(steady_ns + elapsed_ns, start_ns + elapsed_ns + (step_ns if tenth > 20 else 0), ())
        if service.last_status is not statuses[-1]:
            statuses.append(service.last_status)
    service.close()
    assert len(statuses) == 1 + 6
    assert statuses[-1]["time_ns"] == pytest.approx(start_ns + step_ns + 5.5 * SECOND_NS, abs=SECOND_NS / 2)
    assert len(flushed) >= 10


def test_one_takes_over_though_its_disk_hangs(
    endpoint: Endpoint, arm_profile: Profile, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("monitor.service.vehicle_service._REMEMBER_S", 0.05)
    answers = threading.Event()

    def hang(_: str) -> list[AlarmEvent]:
        assert answers.wait(30.0)
        return []

    journal: Any = SimpleNamespace(active=hang, last_seq=hang, shelved=hang, events=hang, shelve=str)
    monitor = VehicleMonitor(Pipeline(arm_profile, VEHICLE), (), journal, lambda _: None, time.time_ns())
    service = VehicleService(monitor, DeskRule(), endpoint.session, Config(), journal)
    assert monitor.active
    assert not answers.is_set()
    assert "has not answered for 0.05 s" in caplog.text
    answers.set()
    service.close()
