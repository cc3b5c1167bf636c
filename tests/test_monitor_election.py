"""Who speaks for a vehicle: real sessions at a router; the next leads when the leader closes, is killed or hangs."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from loopback import free_port, until

from monitor.bus.seal import Seal
from monitor.service.election import DEADLINE_S, Election, first_number, term_of

ROOT = "fauio/copter-1"
TAKEN_OVER_S = 2.0
SEAL = Seal(bytes(32))
CANDIDATE = """
import sys, time, zenoh
from monitor.bus.seal import Seal
from monitor.service.election import Election
session = zenoh.open(zenoh.Config.from_json5(sys.argv[1]))
election = Election(session, sys.argv[2], Seal(bytes(32)))
said = False
while True:
    if election.turn() and not said:
        said = True
        print("leads", flush=True)
    time.sleep(0.01)
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
        self.election = Election(self.session, ROOT, SEAL, takeover_s)

    @property
    def leads(self) -> bool:
        return self.election.turn()

    def close(self) -> None:
        self.session.close()


def leaders(candidates: list[Candidate]) -> list[bool]:
    return [candidate.leads for candidate in candidates]


def know_each_other(candidates: list[Candidate]) -> bool:
    """Let each do its turn; return whether each knows all the others."""
    leaders(candidates)
    return all(candidate.election.others == len(candidates) - 1 for candidate in candidates)


def test_the_oldest_leads_the_next_follows_and_one_that_returns_waits(router: str) -> None:
    three = [Candidate(router) for _ in range(3)]
    until(lambda: any(leaders(three)) and know_each_other(three))
    assert leaders(three) == [True, False, False]
    first, second, third = three
    first.close()
    since = time.monotonic()
    until(lambda: leaders([second, third]) == [True, False])
    assert time.monotonic() - since < TAKEN_OVER_S
    back = Candidate(router)
    until(lambda: know_each_other([second, third, back]))
    until(lambda: leaders([second, third, back]) and time.monotonic() - since > TAKEN_OVER_S)
    assert leaders([second, third, back]) == [True, False, False]
    second.election.close()
    until(lambda: leaders([third, back]) == [True, False])
    for candidate in (second, third, back):
        candidate.close()


def test_one_whose_clock_was_set_back_waits_like_any_other(router: str, monkeypatch: pytest.MonkeyPatch) -> None:
    leader = Candidate(router)
    until(lambda: leader.leads)
    with monkeypatch.context() as clock:
        clock.setattr(time, "time_ns", lambda: 0)
        other = Candidate(router)
    until(lambda: know_each_other([leader, other]))
    end = time.monotonic() + 0.5
    while time.monotonic() < end:
        assert leaders([leader, other]) == [True, False]
    leader.election.close()
    until(lambda: other.leads)
    leader.close()
    other.close()


def test_the_next_leads_within_two_seconds_after_the_leader_was_killed(router: str) -> None:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    arguments = [sys.executable, "-c", CANDIDATE, router, ROOT]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, env=environment) as leader:
        assert leader.stdout is not None
        assert leader.stdout.readline() == b"leads\n"
        two = [Candidate(router) for _ in range(2)]
        until(lambda: not any(leaders(two)) and all(candidate.election.others == 2 for candidate in two))
        leader.send_signal(signal.SIGKILL)
        since = time.monotonic()
        until(lambda: leaders(two) == [True, False])
        assert time.monotonic() - since < TAKEN_OVER_S
    for candidate in two:
        candidate.close()


def test_the_next_leads_where_only_the_main_loop_of_the_leader_stands_still_and_that_yields_afterwards(
    router: str,
) -> None:
    hung, other = Candidate(router), Candidate(router)
    until(lambda: leaders([hung, other]) == [True, False] and know_each_other([hung, other]))
    hung.election.term, since = 7, time.monotonic()
    until(lambda: other.leads)
    assert 1.5 < time.monotonic() - since < DEADLINE_S + 1.0
    other.election.term = 8
    until(lambda: leaders([hung, other]) == [False, True])
    until(lambda: know_each_other([hung, other]))
    assert leaders([hung, other]) == [False, True]
    hung.close()
    other.close()


def test_a_silent_leader_is_waited_for_where_its_token_is_lost_and_not_where_it_resigns(router: str) -> None:
    three = [Candidate(router, takeover_s=30.0) for _ in range(3)]
    first, second, third = three
    until(lambda: any(leaders(three)) and know_each_other(three))
    first.election.close()
    until(lambda: leaders([second, third]) == [True, False])
    second.close()
    since = time.monotonic()
    until(lambda: third.leads)
    assert time.monotonic() - since > 1.5
    first.close()
    third.close()


def test_without_the_key_nobody_has_a_say(router: str, caplog: pytest.LogCaptureFixture) -> None:
    two = [Candidate(router) for _ in range(2)]
    until(lambda: leaders(two) == [True, False] and know_each_other(two))
    stranger = zenoh.open(zenoh.Config.from_json5(router))
    everything: list[zenoh.Sample] = []
    spy = stranger.declare_subscriber(f"{ROOT}/candidate/*", everything.append)
    # the token of the oldest there can be, an own candidate with another key, and what the two say, sent again
    token = stranger.liveliness().declare_token(f"{ROOT}/candidate/{0:020d}-00000000")
    forger = Election(stranger, ROOT, Seal(b"another secret"))
    forger.name = f"{0:020d}-00000000"
    forger.term = 1 << 32
    copies = [stranger.liveliness().declare_token(f"{ROOT}/candidate/{one.election.name}") for one in two]
    until(lambda: forger.turn() or len(everything) > 20)
    until(forger.turn)
    for sample in list(everything):
        payload, proof = sample.payload.to_bytes(), sample.attachment
        assert proof is not None
        stranger.put(str(sample.key_expr), payload, attachment=proof.to_bytes())
        stranger.put(str(sample.key_expr), payload.replace(b"false", b"true"), attachment=proof.to_bytes())
    for copy in copies:
        copy.undeclare()
    end = time.monotonic() + DEADLINE_S + 0.5
    while time.monotonic() < end:
        forger.turn()
        assert leaders(two) == [True, False]
        time.sleep(0.01)
    until(lambda: leaders(two) == [True, False] and know_each_other(two))
    assert "without the standby key" in caplog.text
    spy.undeclare()
    token.undeclare()
    forger.close()
    stranger.close()
    for one in two:
        one.close()


def test_a_candidate_of_another_vehicle_changes_nothing(router: str) -> None:
    older = zenoh.open(zenoh.Config.from_json5(router))
    other = Election(older, "fauio/rover-1", SEAL)
    one = Candidate(router)
    until(lambda: one.leads and other.turn())
    assert one.election.others == 0
    one.close()
    older.close()


@given(st.integers(0, 1 << 52), st.integers(0, 1 << 62))
def test_numbers_of_a_new_term_are_above_all_that_are_known(last: int, now_ns: int) -> None:
    number = first_number(last, now_ns)
    assert number > last
    assert term_of(number) > term_of(last)
    assert number >= (now_ns // 10**9) << 20
