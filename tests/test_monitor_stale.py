"""Silence becomes stale after its limit, once, at the same moment live and replayed."""

from monitor.alarms.link_alarms import StaleAlarm

SECOND = 1_000_000_000
T0 = 1_795_251_917 * SECOND


def stale() -> StaleAlarm:
    return StaleAlarm("rover", 2.0)


def test_nothing_is_stale_before_the_first_message() -> None:
    assert stale().silence(T0) == []


def test_silence_is_reported_once_with_the_time_it_became_stale() -> None:
    alarm = stale()
    assert alarm.follow(T0, 5 * SECOND) == []
    assert alarm.silence(T0 + SECOND) == []
    (event,) = alarm.silence(T0 + 9 * SECOND)
    assert (event.kind, event.state, event.channel) == ("stale", "raised", "telemetry")
    assert event.time_ns == T0 + 2 * SECOND
    assert event.vehicle_time_ms == 7000
    assert alarm.silence(T0 + 10 * SECOND) == []
    assert alarm.active


def test_a_replay_that_only_sees_messages_gives_the_same_events_as_a_live_clock() -> None:
    live, replayed = stale(), stale()
    live.follow(T0, 0)
    replayed.follow(T0, 0)
    live_events = live.silence(T0 + 2 * SECOND + 1) + live.follow(T0 + 5 * SECOND, 5 * SECOND)
    assert replayed.follow(T0 + 5 * SECOND, 5 * SECOND) == live_events
    assert [event.state for event in live_events] == ["raised", "cleared"]
    assert live_events[0].id == live_events[1].id
    assert live_events[1].message == "telemetry is back after 5.0 s"
    assert not live.active


def test_silence_counts_from_where_a_clock_was_set_back() -> None:
    alarm = stale()
    alarm.follow(T0, 0)
    hour = 3600 * SECOND
    assert alarm.silence(T0 - hour) == []
    (event,) = alarm.silence(T0 - hour + 3 * SECOND)
    assert (event.state, event.time_ns) == ("raised", T0 - hour + 2 * SECOND)


def test_a_silence_ends_after_it_began_by_both_clocks() -> None:
    alarm = stale()
    alarm.follow(T0, 10 * SECOND)
    raised, cleared = alarm.follow(T0 + 5 * SECOND, 10 * SECOND)
    assert (raised.time_ns, raised.vehicle_time_ms) == (T0 + 2 * SECOND, 12_000)
    assert (cleared.time_ns, cleared.vehicle_time_ms) == (T0 + 5 * SECOND, 15_000)


def test_it_does_not_clear_before_it_was_raised_though_the_next_message_came_before_and_waited() -> None:
    alarm = stale()
    alarm.follow(T0, 0)
    (raised,) = alarm.silence(T0 + 3 * SECOND)
    (cleared,) = alarm.follow(T0 + SECOND, SECOND)
    assert cleared.time_ns == raised.time_ns == T0 + 2 * SECOND
