"""The vehicle's clock: stamps that are believed, jumps that are not, and Unix time without the jitter."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from adapters.clock import VehicleClock

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


def test_the_memory_of_the_offset_does_not_grow() -> None:
    clock = VehicleClock()
    for k in range(10_000):
        clock.observe(k * SECOND // 2, UNIX + k * SECOND // 2)
    assert len(clock._buckets) <= 12


def test_a_single_damaged_stamp_changes_nothing() -> None:
    clock = running()
    before = clock.to_unix(0)
    for damaged in (5 * SECOND, 99 * SECOND - 2, 105 * SECOND, 10_000 * SECOND, 1 << 61):
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
