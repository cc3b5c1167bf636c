"""The vehicle's clock: stamps that are believed, jumps that are not, and Unix time without the jitter."""

from __future__ import annotations

import random
from collections.abc import Callable
from itertools import accumulate

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monitor.core.sampling import VehicleClock

MS = 1_000_000
SECOND = 1_000 * MS
UNIX = 1_795_251_917 * SECOND


def running(until_s: float = 100.0, delay_ns: int = 5 * MS) -> VehicleClock:
    """Return a clock that has followed a vehicle at 100 Hz for a second."""
    clock = VehicleClock()
    end = round(until_s * SECOND)
    for stamp in range(end - SECOND, end + 1, 10 * MS):
        assert clock.observe(stamp, UNIX + stamp + delay_ns)
    return clock


def test_the_least_delayed_packet_defines_the_offset() -> None:
    clock = VehicleClock()
    for stamp, delay in ((0, 30), (10, 12), (20, 25), (30, 40)):
        clock.observe(stamp * MS, UNIX + (stamp + delay) * MS)
    assert clock.to_unix(50 * MS) == UNIX + 62 * MS


@given(st.lists(st.integers(0, 50), min_size=1, max_size=200))
def test_unix_time_is_never_further_off_than_the_smallest_delay_seen(delays_ms: list[int]) -> None:
    clock = VehicleClock()
    for k, delay in enumerate(delays_ms):
        clock.observe(k * 10 * MS, UNIX + (k * 10 + delay) * MS)
    assert clock.to_unix(0) == UNIX + min(delays_ms) * MS


def test_a_slow_crystal_is_followed() -> None:
    clock = VehicleClock()
    for k in range(20_000):
        stamp = k * 20 * MS
        clock.observe(stamp, UNIX + stamp + stamp // 20_000 + 10 * MS)
    drift = stamp // 20_000
    assert 0 <= UNIX + stamp + drift + 10 * MS - clock.to_unix(stamp) <= 65 * SECOND // 20_000


def test_a_single_damaged_stamp_changes_nothing() -> None:
    clock = running()
    before = clock.to_unix(0)
    for damaged in (5 * SECOND, 94 * SECOND, 105 * SECOND, 10_000 * SECOND, 1 << 61):
        assert not clock.observe(damaged, UNIX + 100 * SECOND)
        assert clock.observe(100 * SECOND, UNIX + 100 * SECOND + 9 * MS)
        assert (clock.boot, clock.newest_ns, clock.to_unix(0)) == (0, 100 * SECOND, before)


def test_the_same_damaged_stamp_twice_is_still_not_believed() -> None:
    clock = running()
    assert not clock.observe(5 * SECOND, UNIX)
    assert not clock.observe(5 * SECOND, UNIX)
    assert clock.boot == 0


def test_a_reboot_is_believed_with_the_second_message() -> None:
    clock = running()
    assert not clock.observe(2 * SECOND, UNIX + 200 * SECOND)
    assert clock.observe(2 * SECOND + 10 * MS, UNIX + 200 * SECOND + 10 * MS)
    assert (clock.boot, clock.newest_ns) == (1, 2 * SECOND + 10 * MS)
    assert clock.to_unix(3 * SECOND) == UNIX + 201 * SECOND


def test_silence_of_less_than_ten_seconds_is_no_new_boot() -> None:
    clock = running()
    assert not clock.observe(108 * SECOND, UNIX + 108 * SECOND)
    assert clock.observe(108 * SECOND + 10 * MS, UNIX + 108 * SECOND + 10 * MS)
    assert (clock.boot, clock.newest_ns) == (0, 108 * SECOND + 10 * MS)


def test_what_a_radio_held_up_before_its_link_was_opened_is_no_second_clock() -> None:
    clock = VehicleClock()
    # three of a stamp every half a second, all at once, and then as jitter lets them come
    for k, arrival_ms in enumerate((0, 2, 6, 19, 24, 27, 33, 36, 38, 194, 231, 377, 723, 794, 838, 1109, 1142, 1180)):
        clock.observe(12 * SECOND + k // 3 * 500 * MS, UNIX + 13 * SECOND + arrival_ms * MS)
    assert clock.newest_ns == 12 * SECOND + 2500 * MS
    assert clock.contested_ns == 0


def held(draw: random.Random) -> float:
    """Return how long a poor radio or a mobile network holds a message back, seconds."""
    return min(0.5 + 0.15 * draw.paretovariate(1.1), 2.6)


def in_order(sent: list[float], draw: random.Random) -> list[tuple[float, float]]:
    arrivals = accumulate((s + held(draw) for s in sent), max)
    return list(zip(arrivals, sent, strict=True))


def overtaking(sent: list[float], draw: random.Random) -> list[tuple[float, float]]:
    return [(s + draw.uniform(0.5, 2.6), s) for s in sent]


def over_two_radios(sent: list[float], draw: random.Random) -> list[tuple[float, float]]:
    return [(s + 0.05, s) for s in sent] + in_order(sent, draw)


def by_another_way(sent: list[float], draw: random.Random) -> list[tuple[float, float]]:
    """Let the link become quicker by 2.4 s every 30 s, and slow again; what is on the slower way comes by that."""
    return [(s + (2.5 if s // 30 % 2 else 0.1) + draw.expovariate(20.0), s) for s in sent]


def in_backlogs(sent: list[float], draw: random.Random) -> list[tuple[float, float]]:
    """Bring nothing for up to 3 s again and again, and then all at once."""
    ends = {k: 4 * k + 1.0 + draw.uniform(0.5, 3.0) for k in range(60)}
    return [(max(s + 0.05, ends[k]) if s >= 4 * k + 1.0 else s + 0.05, s) for s in sent for k in [int(s // 4)]]


@pytest.mark.parametrize("rate_hz", [5, 40])
@pytest.mark.parametrize("skew_ppm", [0, 100])
@pytest.mark.parametrize("link", [in_order, overtaking, over_two_radios, by_another_way, in_backlogs])
def test_a_link_that_holds_back_and_overtakes_by_seconds_is_no_second_clock_and_no_reboot(
    link: Callable[[list[float], random.Random], list[tuple[float, float]]], rate_hz: int, skew_ppm: int
) -> None:
    for seed in range(3):
        clock, draw = VehicleClock(), random.Random(seed)
        clock.flies = True
        for arrival_s, sent_s in sorted(link([k / rate_hz for k in range(180 * rate_hz)], draw)):
            clock.observe(round((20.0 + sent_s) * SECOND), UNIX + round(arrival_s * (1e9 + 1e3 * skew_ppm)))
        assert (clock.contested_ns, clock.boot) == (0, 0)
        assert clock.newest_ns > 199 * SECOND


def test_a_jump_ahead_of_more_than_ten_seconds_starts_anew() -> None:
    clock = running()
    clock.observe(200 * SECOND, UNIX + 101 * SECOND)
    assert clock.observe(200 * SECOND + MS, UNIX + 101 * SECOND + MS)
    assert clock.boot == 1
    assert clock.to_unix(200 * SECOND) == UNIX + 101 * SECOND


def test_telemetry_with_seconds_between_messages_is_believed() -> None:
    clock = VehicleClock()
    believed = [clock.observe(k * 3 * SECOND, UNIX + k * 3 * SECOND) for k in range(20)]
    assert sum(believed) >= 10
    assert clock.boot == 0


def test_a_32_bit_microsecond_counter_that_turned_over_is_continued() -> None:
    turn = (1 << 32) * 1_000
    clock = running(until_s=2 * turn / SECOND)
    assert clock.unwrap(7 * MS) == 2 * turn + 7 * MS
    assert clock.unwrap(600 * SECOND) == 600 * SECOND


def test_a_single_early_arrival_time_does_not_pull_unix_time_back() -> None:
    clock = running()
    before = clock.to_unix(0)
    clock.observe(100 * SECOND + 10 * MS, UNIX - 1_000 * SECOND)
    assert clock.to_unix(0) == before
    clock.observe(100 * SECOND + 20 * MS, UNIX + 100 * SECOND + 25 * MS)
    assert clock.to_unix(0) == before


def test_a_host_clock_that_was_set_back_is_followed() -> None:
    clock = running()
    for k in range(1, 4):
        stamp = 100 * SECOND + k * 10 * MS
        clock.observe(stamp, UNIX - 1_000 * SECOND + stamp)
    assert clock.to_unix(0) == UNIX - 1_000 * SECOND


def drifting(
    clock: VehicleClock, skew_ppm: int, jitter_ms: float, seed: int, seconds: range, rate_hz: int = 50, held_ns: int = 0
) -> list[int]:
    """Feed jittered arrivals, the least delay 5 ms and ``held_ns``; return the errors of the newest stamps."""
    rng = random.Random(seed)
    errors = []
    for k in range(seconds.start * rate_hz, seconds.stop * rate_hz):
        stamp = k * SECOND // rate_hz
        truth = UNIX + stamp + stamp * skew_ppm // 1_000_000 + 5 * MS + held_ns
        clock.observe(stamp, truth + round(rng.expovariate(1.0 / jitter_ms) * MS))
        errors.append(clock.to_unix(stamp) - truth)
    return errors


@given(skew=st.integers(-200, 200), jitter_ms=st.floats(2.0, 20.0), seed=st.integers(0, 1000))
@settings(max_examples=15, deadline=None)
def test_after_a_minute_a_drifting_clock_is_mapped_within_half_a_millisecond(
    skew: int, jitter_ms: float, seed: int
) -> None:
    errors = drifting(VehicleClock(), skew, jitter_ms, seed, range(100))[60 * 50 :]
    assert max(map(abs, errors)) < MS // 2


@pytest.mark.parametrize("skew", [-200, -100, 100, 200])
def test_the_skew_is_known_within_20_ppm(skew: int) -> None:
    clock = VehicleClock()
    drifting(clock, skew, 10.0, 0, range(80))
    assert clock.skew * 1e6 == pytest.approx(skew, abs=20.0)


@pytest.mark.parametrize("seed", range(3))
def test_a_drifting_clock_is_mapped_better_than_by_the_least_delay_of_a_minute(seed: int) -> None:
    errors = drifting(VehicleClock(), 100, 10.0, seed, range(120))[60 * 50 :]
    least_of_a_minute = 100 * 60 * SECOND // 1_000_000
    assert max(map(abs, errors)) < least_of_a_minute / 10


@given(speed=st.floats(1.01, 20.0), seed=st.integers(0, 100))
@settings(max_examples=10, deadline=None)
def test_time_that_runs_at_another_speed_falls_back_to_the_least_delay(speed: float, seed: int) -> None:
    clock, rng = VehicleClock(), random.Random(seed)
    delays = []
    for k in range(2_000):
        stamp = k * 50 * MS
        received = UNIX + round(stamp / speed) + rng.randrange(5 * MS)
        clock.observe(stamp, received)
        delays.append(received - stamp)
    assert clock.skew == 0.0
    assert clock.to_unix(stamp) == UNIX + stamp + min(delays) - UNIX


def test_ten_seconds_of_packets_at_once_do_not_move_unix_time() -> None:
    clock = VehicleClock()
    drifting(clock, 50, 5.0, 0, range(100))
    before = clock.to_unix(100 * SECOND)
    for k in range(100 * 50, 110 * 50):
        clock.observe(k * SECOND // 50, UNIX + 110 * SECOND + 20 * MS)
    assert abs(clock.to_unix(100 * SECOND) - before) < MS // 2
    errors = drifting(clock, 50, 5.0, 1, range(110, 200))
    assert max(map(abs, errors)) < MS // 2


def test_duplicates_change_nothing() -> None:
    once, twice = VehicleClock(), VehicleClock()
    rng = random.Random(0)
    for k in range(2_000):
        stamp, delay = k * 20 * MS, rng.randrange(10 * MS)
        once.observe(stamp, UNIX + stamp + delay)
        for again in (0, 3 * MS):
            twice.observe(stamp, UNIX + stamp + delay + again)
        assert once.to_unix(stamp) == twice.to_unix(stamp)


@pytest.mark.parametrize("step_ns", [-10 * SECOND, -SECOND // 2, -20 * MS])
def test_a_unix_clock_that_was_set_back_is_followed_at_once(step_ns: int) -> None:
    clock = VehicleClock()
    drifting(clock, 20, 2.0, 0, range(70))
    errors = drifting(clock, 20, 2.0, 1, range(70, 170), held_ns=step_ns)
    # a step of less than 500 ppm of a minute is taken for skew meanwhile
    assert max(map(abs, errors[50:])) < 15 * MS
    assert max(map(abs, errors[65 * 50 :])) < MS // 2


@pytest.mark.parametrize("step_ns", [20 * MS, SECOND // 2, 10 * SECOND])
def test_a_unix_clock_that_was_set_ahead_is_followed_within_65_seconds(step_ns: int) -> None:
    clock = VehicleClock()
    drifting(clock, 20, 2.0, 0, range(70))
    errors = drifting(clock, 20, 2.0, 1, range(70, 170), held_ns=step_ns)
    assert min(errors) > -step_ns - 4 * MS
    assert max(map(abs, errors[65 * 50 :])) < MS // 2


def test_a_reboot_forgets_offset_and_skew() -> None:
    clock = VehicleClock()
    drifting(clock, 200, 2.0, 0, range(100))
    for k in range(100):
        clock.observe(k * 20 * MS, UNIX + 500 * SECOND + k * 20 * MS)
    assert (clock.boot, clock.skew) == (1, 0.0)
    assert clock.to_unix(2 * SECOND) == UNIX + 502 * SECOND


def test_a_counter_that_turns_over_keeps_offset_and_skew() -> None:
    clock, turn = VehicleClock(), (1 << 32) * 1_000
    for k in range(6_000):
        stamp = turn - 60 * SECOND + k * 20 * MS
        told = stamp % turn
        seen = clock.unwrap(told) if told < clock.newest_ns - SECOND else told
        assert seen == stamp
        clock.observe(seen, UNIX + stamp + stamp // 10_000)
    assert clock.boot == 0
    assert abs(clock.to_unix(stamp) - UNIX - stamp - stamp // 10_000) <= 1_000
