"""The daemon's loop: what had arrived when it was told to end is taken, as far as there is time."""

import pytest

from adapters.batch import pack
from adapters.message import Message
from adapters.source import MAVLINK
from monitor.pipeline import Pipeline
from monitor.profile import Profile
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
