"""Alarms of the link: wrong signatures and a missing heartbeat, by messages and their times alone."""

import math
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from adapters.message import Message
from adapters.source import LINK, MAVLINK
from monitor.alarms.link_alarms import LinkAlarms
from monitor.event import AlarmEvent

SECOND = 1_000_000_000
T0 = 1_795_251_917 * SECOND


def signing(seconds: float, **counts: Any) -> Message:
    fields = {"forged": 0, "replayed": 0, "unsigned": 0} | counts
    return Message(LINK, "signing", T0 + round(seconds * SECOND), fields, 1)


def telemetry(seconds: float, name: str = "ATTITUDE", **fields: Any) -> Message:
    return Message(MAVLINK, name, T0 + round(seconds * SECOND), fields, 1, 1)


def fed(alarms: LinkAlarms, *messages: Message) -> list[AlarmEvent]:
    return [event for message in messages for event in alarms.process(message, 5 * SECOND)]


def test_one_forged_packet_is_a_critical_security_alarm_that_clears_after_ten_seconds_without_another() -> None:
    alarms = LinkAlarms("copter-1")
    (raised,) = fed(alarms, signing(0, forged=1))
    assert (raised.kind, raised.state, raised.severity, raised.estimate) == ("security", "raised", "critical", 1.0)
    assert raised.vehicle_time_ms == 5000
    assert alarms.quiet(T0 + 10 * SECOND - 1) == []
    (cleared,) = alarms.quiet(T0 + 13 * SECOND)
    assert (cleared.state, cleared.id, cleared.time_ns) == ("cleared", raised.id, T0 + 10 * SECOND)
    assert alarms.quiet(T0 + 20 * SECOND) == []


def test_unsigned_packets_are_a_warning_until_one_is_forged() -> None:
    alarms = LinkAlarms("copter-1")
    raised, worse = fed(alarms, signing(0, unsigned=1), signing(2, unsigned=1, forged=1))
    assert (raised.severity, worse.severity) == ("warning", "critical")


def test_an_attack_is_told_once_a_second_and_counts_from_its_beginning() -> None:
    alarms = LinkAlarms("copter-1")
    told = fed(alarms, *(signing(k / 100, forged=k + 1) for k in range(1000)))
    assert [event.state for event in told] == ["raised", *["updated"] * 9]
    assert told[-1].estimate == 901.0
    later = fed(alarms, signing(60, forged=1003))
    assert [(event.state, event.estimate) for event in later] == [("cleared", 901.0), ("raised", 3.0)]
    assert later[0].id != later[1].id


def test_a_link_that_was_opened_anew_counts_from_zero() -> None:
    alarms = LinkAlarms("copter-1")
    fed(alarms, signing(0, forged=50))
    (told,) = fed(alarms, signing(2, forged=2))
    assert told.estimate == 2.0


def test_counts_that_no_float_holds_are_an_attack_like_any_other() -> None:
    alarms = LinkAlarms("copter-1")
    [raised] = fed(alarms, signing(0.0, forged=10**400, replayed=1))
    assert (raised.state, raised.severity) == ("raised", "critical")
    assert raised.estimate is not None
    assert math.isfinite(raised.estimate)


def test_a_heartbeat_that_stops_while_telemetry_goes_on_is_an_alarm_until_it_is_back() -> None:
    alarms = LinkAlarms("copter-1")
    assert fed(alarms, telemetry(0, "HEARTBEAT", type=2, autopilot=3), telemetry(9.9)) == []
    (raised,) = fed(alarms, telemetry(10))
    assert (raised.kind, raised.channel, raised.severity) == ("stale", "link", "warning")
    # The heartbeats of a ground station and of a camera are not the autopilot's.
    assert fed(alarms, telemetry(11), telemetry(12, "HEARTBEAT", type=6), telemetry(13, "HEARTBEAT", autopilot=8)) == []
    (cleared,) = fed(alarms, telemetry(14, "HEARTBEAT", type=2, autopilot=3))
    assert (cleared.state, cleared.id) == ("cleared", raised.id)


def test_a_vehicle_that_never_sent_a_heartbeat_or_is_silent_lacks_none() -> None:
    assert fed(LinkAlarms("copter-1"), *(telemetry(k) for k in range(60))) == []
    alarms = LinkAlarms("copter-1")
    fed(alarms, telemetry(0, "HEARTBEAT"))
    alarms.silent()
    assert fed(alarms, telemetry(30)) == []


def test_an_adopted_alarm_goes_on_under_its_id_and_clears() -> None:
    old, new = LinkAlarms("copter-1"), LinkAlarms("copter-1")
    (raised,) = fed(old, signing(0, forged=3))
    new.adopt(raised)
    (told,) = fed(new, signing(5, forged=1))
    assert (told.state, told.id) == ("updated", raised.id)
    assert [event.state for event in new.quiet(T0 + 15 * SECOND)] == ["cleared"]


ANY = st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=3), st.lists(st.integers()))


@given(st.lists(st.tuples(st.floats(0, 30), st.sampled_from(("signing", "HEARTBEAT", "ATTITUDE")), ANY), max_size=40))
def test_whatever_a_link_says_alarms_are_raised_and_cleared_in_turn(found: list[tuple[float, str, Any]]) -> None:
    alarms, seconds = LinkAlarms("copter-1"), 0.0
    told: list[AlarmEvent] = []
    for wait, name, value in found:
        seconds += wait
        message = (
            signing(seconds, forged=value, unsigned=value)
            if name == "signing"
            else telemetry(seconds, name, type=value, autopilot=value)
        )
        told += fed(alarms, message)
    for channel in ("signing", "link"):
        states = [event.state for event in told if event.channel == channel and event.state != "updated"]
        assert states == (["raised", "cleared"] * len(states))[: len(states)]
