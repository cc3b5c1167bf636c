"""Who speaks for a vehicle: three real sessions at a router; the next leads when the leader closes or is killed."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest
import zenoh
from loopback import free_port, until

from monitor.service.election import Election

ROOT = "fauio/copter-1"
TAKEN_OVER_S = 2.0
CANDIDATE = """
import sys, time, zenoh
from monitor.service.election import Election
session = zenoh.open(zenoh.Config.from_json5(sys.argv[1]))
election = Election(session, sys.argv[2])
while not election.leads:
    time.sleep(0.01)
print("leads", flush=True)
time.sleep(600)
"""


@pytest.fixture
def router() -> Iterator[str]:
    address = f"tcp/127.0.0.1:{free_port()}"
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", json.dumps([address]))
    config.insert_json5("scouting/multicast/enabled", "false")
    session = zenoh.open(config)
    # Sessions in peer mode do not see each other through a router; clients of it do.
    client = {"mode": "client", "connect": {"endpoints": [address]}, "scouting": {"multicast": {"enabled": False}}}
    yield json.dumps(client | {"transport": {"link": {"tx": {"lease": 1000}}}})
    session.close()


class Candidate:
    """A monitor's session with its candidacy."""

    def __init__(self, config: str, takeover_s: float = 0.5) -> None:
        self.session = zenoh.open(zenoh.Config.from_json5(config))
        self.election = Election(self.session, ROOT, takeover_s)

    def close(self) -> None:
        self.session.close()


def leaders(candidates: list[Candidate]) -> list[bool]:
    return [candidate.election.leads for candidate in candidates]


def test_the_oldest_leads_the_next_follows_and_one_that_returns_waits(router: str) -> None:
    three = [Candidate(router) for _ in range(3)]
    until(lambda: any(leaders(three)))
    until(lambda: all(candidate.election.others == 2 for candidate in three))
    assert leaders(three) == [True, False, False]
    first, second, third = three
    first.close()
    since = time.monotonic()
    until(lambda: second.election.leads)
    assert time.monotonic() - since < TAKEN_OVER_S
    assert not third.election.leads
    back = Candidate(router)
    until(lambda: back.election.others == 2)
    until(lambda: time.monotonic() - since > TAKEN_OVER_S)
    assert leaders([second, third, back]) == [True, False, False]
    second.election.close()
    until(lambda: third.election.leads)
    assert not back.election.leads
    for candidate in (second, third, back):
        candidate.close()


def test_the_next_leads_within_two_seconds_after_the_leader_was_killed(router: str) -> None:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    arguments = [sys.executable, "-c", CANDIDATE, router, ROOT]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, env=environment) as leader:
        assert leader.stdout is not None
        assert leader.stdout.readline() == b"leads\n"
        two = [Candidate(router) for _ in range(2)]
        until(lambda: all(candidate.election.others == 2 for candidate in two))
        leader.send_signal(signal.SIGKILL)
        since = time.monotonic()
        until(lambda: two[0].election.leads)
        assert time.monotonic() - since < TAKEN_OVER_S
        assert not two[1].election.leads
    for candidate in two:
        candidate.close()


def test_the_next_waits_for_one_that_is_lost_and_does_not_wait_for_one_that_resigns(router: str) -> None:
    three = [Candidate(router, takeover_s=30.0) for _ in range(3)]
    until(lambda: all(candidate.election.others == 2 for candidate in three))
    first, second, third = three
    until(lambda: first.election.leads)
    first.election.close()
    until(lambda: second.election.leads)
    second.close()
    until(lambda: third.election.others == 0)
    assert not third.election.leads
    first.close()
    third.close()


def test_a_candidate_of_another_vehicle_changes_nothing(router: str) -> None:
    older = zenoh.open(zenoh.Config.from_json5(router))
    other = Election(older, "fauio/rover-1")
    one = Candidate(router)
    until(lambda: one.election.leads and other.leads)
    assert one.election.others == 0
    one.close()
    older.close()
