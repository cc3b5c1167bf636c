"""The daemon's loop: messages come before periodic work, and are processed at the end as far as there is time."""

import pytest

from adapters.batch import pack
from adapters.message import Message
from adapters.source import MAVLINK
from monitor.pipeline import Pipeline
from monitor.profile import Profile
from monitor.service import daemon as module
from monitor.service.daemon import Daemon
from monitor.service.fleet import Fleet
from monitor.service.inbox import Inbox
from monitor.service.vehicle_monitor import VehicleMonitor

WAITING = 2000


@pytest.fixture
def inbox() -> Inbox:
    found = Inbox(10_000)
    for k in range(WAITING):
        found.put(pack([Message(MAVLINK, "HEARTBEAT", k, {"type": 2, "autopilot": 3}, 1, 1)]))
    return found


@pytest.mark.parametrize(("patience_s", "taken"), [(10.0, WAITING), (0.0, 0)])
def test_what_waits_at_the_end_is_taken_within_the_time_there_is(
    quad_profile: Profile, inbox: Inbox, patience_s: float, taken: int
) -> None:
    vehicle = VehicleMonitor(Pipeline(quad_profile, "one", 1), (), None, lambda event: None, 0)
    signs: list[None] = []
    daemon = Daemon(inbox, Fleet([vehicle]), lambda: (), lambda: (), lambda now_ns: False, lambda: signs.append(None))
    daemon.finish(patience_s)
    assert bool(signs) == bool(taken)
    assert vehicle.messages == taken
    assert inbox.statistics().waiting == WAITING - taken


@pytest.mark.parametrize(("patience_ns", "before"), [(1 << 62, WAITING), (50_000_000, 0)])
def test_periodic_work_waits_for_messages_as_long_as_it_has_patience(
    quad_profile: Profile, inbox: Inbox, monkeypatch: pytest.MonkeyPatch, patience_ns: int, before: int
) -> None:
    monkeypatch.setattr(module, "_PATIENCE_NS", patience_ns)
    vehicle = VehicleMonitor(Pipeline(quad_profile, "one", 1), (), None, lambda event: None, 0)
    processed: list[int] = []

    def turn(_: int) -> bool:
        processed.append(vehicle.messages)
        return False

    Daemon(inbox, Fleet([vehicle]), lambda: (), lambda: (), turn, lambda: None).run()
    assert processed == [before]
