"""The sampler's rules, one by one, and against shuffled, repeated and lost messages."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sampled import Row, feed, rows

from adapters.batch import pack
from adapters.channels import Channel
from adapters.message import Message
from adapters.source import MAVLINK, ZENOH
from monitor.core.sampling import VehicleClock, sample_batch
from monitor.sampling.sampler import Sampler

MS = 1_000_000
UNIX = 1_795_251_917_000 * MS
SPEED = Channel("speed", "A", ("speed",))
COMMAND = Channel("command", "B", ("command",))


def sampler(inputs: list[Channel] | None = None, outputs: list[Channel] | None = None, rate: float = 100.0) -> Sampler:
    return Sampler([COMMAND] if inputs is None else inputs, outputs or [SPEED], rate, VehicleClock())


def message(name: str, time_us: int, **fields: Any) -> Message:
    return Message(MAVLINK, name, UNIX + time_us * 1_000, {"time_usec": time_us, **fields}, 1, 1)


def line(time_us: int) -> float:
    return 3.0 + 0.25 * time_us / 1e6


def telemetry(start_us: int, stop_us: int, step_a: int = 10_000, step_b: int = 10_000) -> list[Message]:
    """Return two messages on their own schedules, both linear in time, in order of time."""
    both = [message("A", t, speed=line(t)) for t in range(start_us + 1_700, stop_us, step_a)]
    both += [message("B", t, command=-line(t)) for t in range(start_us + 400, stop_us, step_b)]
    return sorted(both, key=lambda m: m.received_ns)


def values(samples: list[Row]) -> list[tuple[int, float, float]]:
    return [(sample.index, float(sample.u[0]), float(sample.y[0])) for sample in samples]


def test_ticks_lie_at_whole_multiples_of_the_period_on_the_vehicles_clock() -> None:
    samples = feed(sampler(), telemetry(1_000_000, 2_000_000))
    assert [sample.index for sample in samples] == list(range(101, 199 + 1))
    assert all(sample.vehicle_time_ns == sample.index * 10 * MS for sample in samples)
    assert [sample.restart for sample in samples] == [True] + [False] * (len(samples) - 1)
    assert all(sample.complete for sample in samples)


def test_motors_that_are_all_stopped_do_not_count_as_commands_of_flight() -> None:
    motors = [Channel(name, "B", (name,), scale=0.001, offset=-1.0, stopped_as=0.5) for name in ("left", "right")]
    for pulses, commands in (((900, 1600), (0.5, 0.6)), ((900, 900), (-0.1, -0.1)), ((1000, 900), (0.0, 0.5))):
        sent = dict(zip(("left", "right"), pulses, strict=True))
        messages = [message(n, t, speed=3.0, **sent) for t in range(1_000_000, 1_300_000, 10_000) for n in "AB"]
        found = feed(sampler(motors), messages)
        assert found and all(sample.u == pytest.approx(commands) for sample in found)


@pytest.mark.parametrize("rate", [3.0, 29.97, 33.3, 60.0, 400.0])
def test_periods_that_are_no_whole_nanoseconds_do_not_drift(rate: float) -> None:
    samples = feed(sampler(rate=rate), telemetry(0, 3_000_000))
    assert [sample.index for sample in samples] == list(range(samples[0].index, samples[0].index + len(samples)))
    for sample in samples:
        assert abs(sample.vehicle_time_ns - sample.index * 1e9 / rate) < 1


def test_linear_signals_are_interpolated_exactly() -> None:
    for sample in feed(sampler(), telemetry(500_000, 1_500_000, 7_000, 13_000)):
        truth = line(sample.vehicle_time_ns // 1_000)
        assert sample.y[0] == pytest.approx(truth, abs=1e-12)
        assert sample.u[0] == pytest.approx(-truth, abs=1e-12)


def test_a_held_channel_keeps_its_newest_value() -> None:
    held = Channel("command", "B", ("command",), interpolation="previous")
    messages = sorted(
        [message("A", t, speed=1.0) for t in range(10_000, 400_000, 10_000)]
        + [message("B", t, command=float(t // 50_000)) for t in range(13_000, 400_000, 50_000)],
        key=lambda m: m.received_ns,
    )
    samples = feed(sampler([held]), messages)
    assert len(samples) > 30
    for sample in samples:
        newest = (sample.vehicle_time_ns // 1_000 - 13_000) // 50_000 * 50_000 + 13_000
        assert sample.u[0] == newest // 50_000


def test_a_channel_with_a_period_is_interpolated_the_shorter_way_round() -> None:
    course = Channel("course", "A", ("speed",), period=360.0)
    messages = [message("A", t, speed=(350.0 + 0.1 * t / 1_000.0) % 360.0) for t in range(7_000, 400_000, 70_000)]
    samples = feed(sampler([], [course]), messages)
    assert len(samples) > 30
    for sample in samples:
        truth = 350.0 + 0.1 * sample.vehicle_time_ns / 1e6
        assert (sample.y[0] - truth + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=1e-9)


def test_between_two_velocities_over_ground_lies_a_vector_and_no_turn_at_speed() -> None:
    # braking from 3 m/s to the north to as much to the south, drifting east with 0.1 m/s
    over_ground = [Channel("gps_speed", "A", ("v",)), Channel("gps_course", "A", ("course",), period=360.0)]
    times = range(7_000, 3_100_000, 200_000)
    north, east = [3.0 - 2.0 * t / 1e6 for t in times], 0.1
    messages = [
        message("A", t, v=math.hypot(v, east), course=math.degrees(math.atan2(east, v)) % 360.0)
        for t, v in zip(times, north, strict=True)
    ]
    samples = feed(sampler([], over_ground), messages)
    assert len(samples) > 200
    for sample in samples:
        speed, course = sample.y[0], math.radians(sample.y[1])
        assert speed * math.cos(course) == pytest.approx(3.0 - 2.0 * sample.vehicle_time_ns / 1e9, abs=1e-9)
        assert speed * math.sin(course) == pytest.approx(east, abs=1e-9)


MEAN = Channel("command", "B", ("command",), interpolation="mean")
COURSE = Channel("course", "B", ("command",), interpolation="mean", period=360.0)


def commands(times_us: Sequence[int], values: Sequence[float]) -> list[Message]:
    """Return messages of a speed at 2 Hz and of commands at given times, in order of time."""
    speeds = [message("A", t, speed=1.0) for t in range(0, times_us[-1] + 1, 500_000)]
    found = [message("B", t, command=value) for t, value in zip(times_us, values, strict=True)]
    return sorted(speeds + found, key=lambda one: one.received_ns)


@given(
    st.lists(st.tuples(st.integers(1_000, 900_000), st.floats(-100.0, 100.0)), min_size=20, max_size=60),
    st.sampled_from([0.2, 0.7, 1.0, 2.0]),
)
def test_a_mean_is_that_of_the_lines_between_measurements_until_the_next_tick(
    measured: list[tuple[int, float]], rate: float
) -> None:
    times = np.cumsum([step for step, _ in measured])
    values = np.array([value for _, value in measured])
    samples = feed(sampler([MEAN], rate=rate), commands(times.tolist(), values.tolist()))
    assert all(sample.complete for sample in samples) or np.diff(times).max() > 1.75 * np.median(np.diff(times))
    for sample in (one for one in samples if not any(one.lost)):
        begin, end = (round(k * 1e9 / rate) / 1e3 for k in (sample.index, sample.index + 1))
        assert times[0] <= begin
        at = np.unique([begin, *times[(begin < times) & (times < end)], end])
        expected = np.trapezoid(np.interp(at, times, values), at) / (end - begin)
        assert sample.u[0] == pytest.approx(expected, abs=1e-9)


def test_the_mean_of_an_angle_goes_the_shorter_way_round() -> None:
    times = list(range(50_000, 9_000_000, 100_000))
    samples = feed(sampler([COURSE], rate=0.5), commands(times, [(0.04 * t / 1_000.0) % 360.0 for t in times]))
    assert len(samples) == 3
    for sample in samples:
        truth = 0.04 * (sample.vehicle_time_ns / 1e6 + 1_000.0)
        assert (sample.u[0] - truth + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("lost", "incomplete"), [(range(0), []), (range(24, 25), [2]), (range(24, 33), [2, 3])])
def test_a_mean_is_complete_where_no_measurement_is_missing_until_the_next_tick(
    lost: range, incomplete: list[int]
) -> None:
    times = [50_000 + 100_000 * i for i in range(80) if i not in lost]
    samples = feed(sampler([MEAN], rate=1.0), commands(times, [1.0] * len(times)))
    assert [sample.index for sample in samples if not sample.complete] == incomplete
    assert [sample.index for sample in samples] == list(range(1, 7))
    assert all(sample.u[0] == 1.0 for sample in samples)


def test_a_mean_over_long_lines_is_no_measurement() -> None:
    times = [50_000 + 100_000 * i for i in range(80) if i not in range(24, 36)]
    samples = feed(sampler([MEAN], rate=1.0), commands(times, [1.0] * len(times)))
    assert [sample.index for sample in samples if not sample.measured] == [2, 3]
    assert [sample.index for sample in samples] == list(range(1, 7))


def test_a_sample_comes_as_soon_as_every_channel_has_reached_its_tick() -> None:
    to = sampler()
    feed(to, telemetry(0, 200_000))
    assert feed(to, [message("A", 210_000, speed=0.0)]) == []
    assert [sample.index for sample in feed(to, [message("B", 210_000, command=0.0)])] == [20, 21]


def test_channels_of_one_message_keep_their_places_in_u_and_y() -> None:
    inputs = [Channel("b", "M", ("b",)), Channel("a", "M", ("a",))]
    outputs = [Channel("c", "N", ("c",)), Channel("d", "M", ("d",), scale=2.0)]
    messages = []
    for t in range(10_000, 100_000, 10_000):
        messages += [message("M", t, a=1.0, b=2.0, d=4.0), message("N", t, c=3.0)]
    samples = feed(Sampler(inputs, outputs, 100.0, VehicleClock()), messages)
    assert samples
    for sample in samples:
        assert sample.u.tolist() == [2.0, 1.0]
        assert sample.y.tolist() == [3.0, 8.0]


def test_a_sampler_may_be_without_inputs() -> None:
    samples = feed(sampler([]), telemetry(0, 100_000))
    assert samples
    assert samples[0].u.shape == (0,)


@given(
    st.integers(0, 2**32),
    st.lists(st.integers(0, 4), min_size=300, max_size=300),
    st.integers(0, 30),
    st.integers(3, 12),
)
def test_loss_repetition_and_reordering_never_break_the_grid(
    seed: int, copies: list[int], loss: int, reach: int
) -> None:
    rng = np.random.default_rng(seed)
    arriving = []
    for place, one in enumerate(telemetry(2_000_000, 3_500_000)):
        if rng.random() * 100 < loss:
            continue
        repeats = 2 if copies[place % len(copies)] == 0 else 1
        arriving += [(place + rng.integers(0, reach), one) for _ in range(repeats)]
    arriving.sort(key=lambda pair: pair[0])
    to = sampler()
    samples = feed(to, [one for _, one in arriving])
    indices = [sample.index for sample in samples]
    assert indices == sorted(set(indices))
    assert [sample.time_ns for sample in samples] == sorted({sample.time_ns for sample in samples})
    for before, sample in zip([None, *samples], samples, strict=False):
        truth = line(sample.vehicle_time_ns // 1_000)
        assert sample.y[0] == pytest.approx(truth, abs=1e-12)
        assert sample.u[0] == pytest.approx(-truth, abs=1e-12)
        assert sample.restart == (before is None or sample.index != before.index + 1)
    counts = to.statistics()
    assert counts.samples == len(samples)
    assert counts.incomplete == sum(not sample.complete for sample in samples)
    assert counts.restarts == sum(sample.restart for sample in samples)
    if samples:
        assert counts.skipped == indices[-1] - indices[0] + 1 - len(samples)


@given(st.integers(0, 2**32), st.integers(2, 6))
def test_reordering_and_repetition_within_the_time_to_wait_lose_nothing(seed: int, reach: int) -> None:
    rng = np.random.default_rng(seed)
    slow = [message("C", t, slow=0.0) for t in range(2_000_000, 3_000_000, 100_000)]
    fast = telemetry(2_000_000, 3_000_000)
    outputs = [SPEED, Channel("slow", "C", ("slow",))]
    ordered = sorted([*fast, *slow], key=lambda m: m.received_ns)
    places = np.arange(len(ordered)) + rng.integers(0, reach, len(ordered))
    shuffled = [ordered[i] for i in np.argsort(places, kind="stable")]
    expected = {index: (u, y) for index, u, y in values(feed(sampler(outputs=outputs), ordered))}
    got = {index: (u, y) for index, u, y in values(feed(sampler(outputs=outputs), [*shuffled, *shuffled[-5:]]))}
    # A fast message may be overtaken by the slow one that releases its ticks: that tick's value may come from
    # wider neighbours, which on a straight line is the same value.
    assert sorted(got) == sorted(expected)
    for index, pair in expected.items():
        assert got[index] == pytest.approx(pair, abs=1e-12)


@given(st.integers(1, 400), st.integers(0, 2**32))
def test_a_late_start_gives_the_same_samples(cut: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    messages = telemetry(1_000_000, 6_000_000, 10_000, 20_000)
    messages = [
        message(one.name, one.fields["time_usec"], speed=rng.normal(), command=rng.normal()) for one in messages
    ]
    whole = {sample.index: sample for sample in feed(sampler(), messages)}
    part = feed(sampler(), messages[cut:])
    assert len(part) > 200
    for sample in part:
        twin = whole[sample.index]
        assert np.array_equal(sample.u, twin.u)
        assert np.array_equal(sample.y, twin.y)
        assert (sample.vehicle_time_ns, sample.complete) == (twin.vehicle_time_ns, twin.complete)


def test_a_repeated_message_with_unchanged_sensor_time_is_one_measurement() -> None:
    fix = Channel("fix", "GPS_RAW_INT", ("lat",))
    messages = []
    for t in range(100_000, 3_000_000, 100_000):
        measured = t // 200_000 * 200_000
        messages.append(
            Message(MAVLINK, "GPS_RAW_INT", UNIX + t * 1000, {"time_usec": measured, "lat": line(measured)})
        )
    to = sampler([], [fix], rate=20.0)
    samples = feed(to, messages)
    assert to.statistics().duplicates == 14
    assert to.statistics().untimed == 1
    assert len(samples) > 40
    assert all(sample.complete for sample in samples)
    for sample in samples:
        assert sample.y[0] == pytest.approx(line(sample.vehicle_time_ns // 1_000), abs=1e-12)


def test_a_stamp_of_zero_is_no_time_on_mavlink_and_the_start_on_zenoh() -> None:
    channel = Channel("c", "A", ("speed",))
    to = sampler([], [channel])
    assert feed(to, [message("A", 0, speed=1.0)]) == []
    assert to.statistics().untimed == 1
    json = Sampler([], [Channel("c", "arm", ("v",))], 100.0, VehicleClock())
    samples = feed(
        json,
        [Message(ZENOH, "arm", UNIX + t, {"time_ns": t, "v": 1.0}) for t in range(0, 50 * MS, 10 * MS)],
    )
    assert [sample.index for sample in samples] == [0, 1, 2, 3, 4]


def test_a_channel_without_a_clock_of_its_own_takes_the_newest_time() -> None:
    wind = Channel("wind", "WIND", ("speed",))
    to = sampler([wind], [SPEED])
    assert feed(to, [Message(MAVLINK, "WIND", UNIX, {"speed": 5.0})]) == []
    assert to.statistics().untimed == 1
    messages = []
    for t in range(10_000, 300_000, 10_000):
        messages += [message("A", t, speed=1.0), Message(MAVLINK, "WIND", UNIX, {"speed": 5.0})]
    samples = feed(to, messages)
    assert len(samples) == 29
    assert all(sample.u[0] == 5.0 for sample in samples)


@pytest.mark.parametrize(("late_ms", "known"), [(0, True), (40, True), (200, False)])
def test_a_channel_without_a_clock_is_lost_while_others_come_too_late_to_tell_its_time(
    late_ms: int, known: bool
) -> None:
    wind = Channel("wind", "WIND", ("speed",), interpolation="previous")
    messages = telemetry(0, 30_000_000)
    messages += [Message(MAVLINK, "WIND", UNIX + t * MS, {"speed": 5.0}) for t in range(0, 30_000, 100)]
    late = np.random.default_rng(1).uniform(0.0, late_ms * MS, len(messages))
    late[[message.received_ns > UNIX + 9_500 * MS for message in messages]] = 0.0
    arrival = [message.received_ns + by for message, by in zip(messages, late, strict=True)]
    samples = feed(sampler([COMMAND, wind]), [messages[i] for i in np.argsort(arrival, kind="stable")])
    assert not any(sample.lost[0] for sample in samples)
    assert all(sample.lost[1] != known for sample in samples if 200 < sample.index < 900)
    assert not any(sample.lost[1] for sample in samples if sample.index > 2_100)


def test_messages_of_one_name_are_told_apart_by_their_fields() -> None:
    inputs = [
        Channel("motor1", "SERVO", ("servo1",), where=(("port", 0),)),
        Channel("gimbal", "SERVO", ("servo1",), where=(("port", 1),)),
    ]
    messages = []
    for t in range(10_000, 200_000, 10_000):
        messages += [message("SERVO", t, port=port, servo1=100.0 + port) for port in (0, 1, 2)]
        messages.append(message("A", t, speed=0.0))
    samples = feed(sampler(inputs), messages)
    assert len(samples) == 19
    assert all(sample.u.tolist() == [100.0, 101.0] for sample in samples)


def test_one_lost_message_is_bridged_and_marked() -> None:
    messages = [m for m in telemetry(0, 1_000_000) if m.fields["time_usec"] != 501_700]
    samples = feed(sampler(), messages)
    assert [sample.index for sample in samples if not sample.complete] == [50, 51]
    assert sum(sample.restart for sample in samples) == 1


@pytest.mark.parametrize(("name", "lost", "coasted"), [("A", 2, 0), ("A", 3, 4), ("A", 6, 7), ("B", 6, 7)])
def test_channels_that_lost_three_measurements_or_more_are_marked_as_not_measured(
    name: str, lost: int, coasted: int
) -> None:
    end = 500_000 + lost * 10_000
    cut = [m for m in telemetry(0, 1_000_000) if not (m.name == name and 500_000 <= m.fields["time_usec"] < end)]
    samples = feed(sampler(), cut)
    assert sum(not sample.measured for sample in samples) == coasted
    assert sum(sample.lost == (b"\0\1" if name == "A" else b"\1\0") for sample in samples) == coasted
    assert all(sample.measured for sample in samples if sample.complete)
    assert sum(not sample.complete for sample in samples) == lost + 1


@pytest.mark.parametrize(("lost", "bridged"), [(3, 0), (9, 0), (10, 11)])
def test_raw_signals_of_a_transform_bear_longer_lines(lost: int, bridged: int) -> None:
    end = 500_000 + lost * 10_000
    cut = [m for m in telemetry(0, 1_000_000) if not (m.name == "A" and 500_000 <= m.fields["time_usec"] < end)]
    samples = feed(Sampler([SPEED, COMMAND], [], 100.0, VehicleClock()), cut)
    assert sum(not sample.measured for sample in samples) == bridged


@pytest.mark.parametrize(
    ("channel", "rate", "step_us", "lost"),
    [
        (COMMAND, 100.0, 100_000, True),
        (COMMAND, 100.0, 25_000, False),
        (COMMAND, 10.0, 100_000, False),
        (MEAN, 1.0, 1_000_000, True),
        (MEAN, 1.0, 100_000, False),
    ],
)
def test_what_comes_far_more_seldom_than_in_the_fitted_flights_is_not_measured(
    channel: Channel, rate: float, step_us: int, lost: bool
) -> None:
    messages = telemetry(0, 20_000_000, step_b=step_us)
    for fitted_hz, expected in (({"B": 100.0}, lost), ({}, False)):
        one = Sampler([channel], [SPEED], rate, VehicleClock(), fitted_hz=fitted_hz)
        samples = feed(one, messages)
        assert len(samples) > 15
        assert {sample.measured for sample in samples} == {not expected}
        assert one.seldom == ("B",) * expected


def test_a_slow_output_that_loses_measurements_does_not_make_the_fast_ones_coast() -> None:
    messages = telemetry(0, 6_000_000, step_b=200_000)
    cut = [m for m in messages if not (m.name == "B" and 3_000_000 < m.fields["time_usec"] < 3_900_000)]
    samples = feed(sampler([], [SPEED, COMMAND]), cut)
    assert any(not sample.complete for sample in samples)
    assert all(sample.measured for sample in samples)


def test_jitter_of_a_fifth_of_the_period_is_no_loss() -> None:
    messages = [message("A", t + (2_000 if t % 20_000 else 0), speed=0.0) for t in range(10_000, 2_000_000, 10_000)]
    samples = feed(sampler([]), messages)
    assert len(samples) > 190
    assert all(sample.complete for sample in samples)


def test_the_steps_of_a_loop_at_250_hz_are_no_loss() -> None:
    steps_us = [8_000, 12_000, 16_000, 4_000, 8_000, 12_000, 12_000, 8_000] * 40  # as PX4 streams at 100 Hz
    messages = [message("A", 10_000 + int(t), speed=0.0) for t in np.cumsum(steps_us)]
    samples = feed(sampler([]), messages)
    assert len(samples) > 310
    assert all(sample.measured for sample in samples)
    assert sum(sample.restart for sample in samples) == 1
    assert np.mean([sample.complete for sample in samples]) > 0.8


@pytest.mark.parametrize("lost_s", [1.4, 1.6])
def test_a_long_gap_is_skipped_and_its_end_is_a_restart(lost_s: float) -> None:
    end = 1_000_000 + round(1e6 * lost_s)
    messages = [m for m in telemetry(0, 3_000_000) if not (m.name == "A" and 1_000_000 < m.fields["time_usec"] < end)]
    to = sampler()
    samples = feed(to, messages)
    missing = list(range(100, 101 + round(100 * lost_s)))
    if lost_s < 1.5:
        assert [sample.index for sample in samples if not sample.measured] == missing
        assert [sample.index for sample in samples if sample.restart] == [1]
    else:
        assert [sample.index for sample in samples if not sample.measured] == missing[:150]
        assert [sample.index for sample in samples if sample.restart] == [1, missing[-1] + 1]
        assert to.statistics().skipped == len(missing) - 150


def test_raw_signals_go_on_without_one_that_stops_and_skip_what_none_of_them_has() -> None:
    to = Sampler([SPEED, COMMAND], [], 100.0, VehicleClock())
    messages = [m for m in telemetry(0, 9_000_000) if not 6_000_000 < m.fields["time_usec"] < 8_000_000]
    cut = [m for m in messages if m.name == "A" or not 1_000_000 < m.fields["time_usec"] < 4_000_000]
    samples = feed(to, cut)
    assert [sample.index for sample in samples if sample.restart] == [1, 801]
    assert [sample.index for sample in samples if sample.lost == b"\0\1"] == list(range(100, 401))
    assert not {sample.index for sample in samples} & set(range(600, 801))


def test_a_raw_signal_that_stops_holds_up_the_others_for_half_a_second_once() -> None:
    to = Sampler([SPEED, COMMAND], [], 100.0, VehicleClock())
    feed(to, telemetry(0, 1_000_000))
    given = [[s.index for s in feed(to, [message("A", t, speed=0.0)])] for t in range(1_000_000, 2_000_000, 10_000)]
    assert not any(given[:50])
    assert given[50] == list(range(100, 151))
    assert all(some == [151 + k] for k, some in enumerate(given[51:]))


def test_a_slow_channel_is_bridged_over_ten_of_its_periods() -> None:
    slow = Channel("slow", "C", ("slow",))
    lost = range(2_000_000, 3_300_000)
    messages = telemetry(0, 6_000_000) + [
        message("C", t, slow=line(t)) for t in range(10_000, 6_000_000, 200_000) if t not in lost
    ]
    messages.sort(key=lambda m: m.received_ns)
    samples = feed(sampler(outputs=[SPEED, slow]), messages)
    assert sum(sample.restart for sample in samples) == 1
    assert {sample.index for sample in samples if not sample.complete} == set(range(182, 341))


def test_a_channel_that_stops_holds_up_neither_memory_nor_the_restart() -> None:
    to = sampler()
    feed(to, telemetry(0, 1_000_000))
    longest, given = 0, []
    for t in range(1_000_000, 8_000_000, 10_000):
        news = [message("A", t + more, speed=0.0) for more in range(0, 10_000, 1_000)]
        given += feed(to, news)
        longest = max(longest, to.waiting)
    assert [sample.index for sample in given if not sample.measured] == list(range(100, 250))
    assert longest <= 510
    samples = feed(to, telemetry(8_000_000, 9_000_000))
    assert [sample.index for sample in samples if sample.restart] == [801]
    assert samples[-1].index == 899


@given(st.integers(0, 2**32), st.integers(0, 240_000))
def test_late_measurements_are_waited_for_once_some_were_late(seed: int, most_us: int) -> None:
    messages = telemetry(0, 5_000_000)
    late_us = np.random.default_rng(seed).uniform(0.0, most_us, len(messages))
    arrival = [one.received_ns + 1_000 * by for one, by in zip(messages, late_us, strict=True)]
    late = [messages[i] for i in np.argsort(arrival, kind="stable")]
    expected = {sample.index: sample.u[0] for sample in feed(sampler(), messages)}
    samples = feed(sampler(), late)
    assert len(samples) > 400
    for sample in samples:
        assert not sample.complete or sample.u[0] == pytest.approx(expected[sample.index], abs=1e-9)
    # Before that the lateness was learned; one that is later than all before is lost.
    assert sum(not sample.complete for sample in samples[100:]) <= 40


def test_nothing_waits_again_once_measurements_keep_their_order() -> None:
    messages = telemetry(0, 30_000_000)
    messages[41], messages[47] = messages[47], messages[41]
    lossy = [m for m in messages if not (m.name == "A" and m.fields["time_usec"] % 1_000_000 == 501_700)]
    whole, late = sampler(), sampler()
    delays = []
    for to, some in ((whole, telemetry(0, 30_000_000)), (late, lossy)):
        known = [(message.fields["time_usec"], feed(to, [message])) for message in some]
        delays.append({sample.index: at - sample.index * 10_000 for at, given in known for sample in given})
    extra = {index: delays[1][index] - delays[0][index] for index in delays[1] if 500 < index < 2_900}
    assert max(more for index, more in extra.items() if index < 1_000) > 10_000
    assert max(more for index, more in extra.items() if index > 2_100) == 10_000


def test_a_channel_that_never_comes_costs_bounded_memory() -> None:
    to = sampler()
    assert feed(to, [message("A", t, speed=0.0) for t in range(1_000, 20_000_000, 1_000)]) == []
    assert to.waiting <= 510


def test_a_flood_of_stamps_costs_bounded_memory() -> None:
    to = sampler()
    feed(to, [Message(ZENOH, "A", UNIX, {"time_ns": t, "speed": 0.0}) for t in range(1, 60_000)])
    feed(to, [Message(ZENOH, "A", UNIX, {"time_ns": 1_000_000 - 10 * t, "speed": 0.0}) for t in range(1, 60_000)])
    assert to.waiting <= 1 << 14


def test_a_reboot_starts_all_buffers_anew_without_losing_a_message() -> None:
    to = sampler()
    feed(to, telemetry(50_000_000, 51_000_000))
    samples = feed(
        to,
        [Message(m.source, m.name, m.received_ns + 60_000 * MS, m.fields) for m in telemetry(2_000_000, 3_000_000)],
    )
    assert samples[0].index == 201
    assert samples[0].restart
    assert [sample.index for sample in samples] == list(range(201, 300))
    assert to.statistics().clock_restarts == 1


def test_single_damaged_stamps_cost_only_their_own_message() -> None:
    messages = telemetry(20_000_000, 21_000_000)
    clean = values(feed(sampler(), messages))
    for damaged in (1_000, 15_000_000, 28_000_000, 4_000_000_000_000):
        to = sampler()
        spoiled = messages.copy()
        spoiled.insert(100, message("A", damaged, speed=1e6))
        assert values(feed(to, spoiled)) == clean
        counts = to.statistics()
        assert (counts.doubted, counts.clock_restarts) == (1, 0)


def test_two_samplers_may_share_a_clock() -> None:
    clock = VehicleClock()
    first, second = Sampler([COMMAND], [SPEED], 100.0, clock), Sampler([], [SPEED], 50.0, clock)
    messages = telemetry(50_000_000, 51_000_000) + telemetry(2_000_000, 3_000_000)
    messages.insert(120, message("A", 7_000_000, speed=1e6))
    got = [rows(samples) for samples in sample_batch(clock, [first, second], pack(messages)).samples]
    assert clock.boot == 1
    assert [s.index for s in got[0] if s.restart] == [5001, 201]
    assert [s.index for s in got[1] if s.restart] == [2501, 101]
    assert all(abs(s.y[0]) < 100 for s in (*got[0], *got[1]))


def test_a_32_bit_clock_that_turns_over_does_not_interrupt() -> None:
    turn_us = 1 << 32
    messages = telemetry(turn_us - 500_000, turn_us + 500_000)
    wrapped = [
        Message(m.source, m.name, m.received_ns, {**m.fields, "time_usec": m.fields["time_usec"] % turn_us})
        if m.name == "B"
        else m
        for m in messages
    ]
    assert values(feed(sampler(), wrapped)) == values(feed(sampler(), messages))


@pytest.mark.parametrize("bad", [math.nan, math.inf, None, "1.0", True, [1.0], 10**400])
def test_a_value_that_is_no_number_is_ignored_and_counted(bad: Any) -> None:
    to = sampler()
    messages = telemetry(0, 1_000_000)
    spoiled = [
        Message(m.source, m.name, m.received_ns, {**m.fields, "speed": bad}) if m.fields["time_usec"] == 501_700 else m
        for m in messages
    ]
    samples = feed(to, spoiled)
    assert to.statistics().invalid == 1
    assert [sample.index for sample in samples if not sample.complete] == [50, 51]
    assert all(np.isfinite(sample.y).all() for sample in samples)


def test_one_bad_value_does_not_take_the_rest_of_its_message_along() -> None:
    outputs = [Channel("p", "A", ("p",)), Channel("q", "A", ("q",))]
    to = sampler([], outputs)
    messages = [
        message("A", t, p=line(t), q=-line(t) if t != 500_000 else math.nan) for t in range(10_000, 1_000_000, 10_000)
    ]
    samples = feed(to, messages)
    assert [sample.index for sample in samples] == list(range(1, 100))
    assert [sample.index for sample in samples if not sample.complete] == [50]
    assert to.statistics().invalid == 1
    for sample in samples:
        truth = line(sample.vehicle_time_ns // 1_000)
        assert sample.y == pytest.approx([truth, -truth], abs=1e-12)


def test_channels_that_come_in_turns_under_one_name_are_all_taken() -> None:
    outputs = [Channel("p", "A", ("p",)), Channel("q", "A", ("q",))]
    messages = [
        message("A", t, **({"p": line(t)} if t % 20_000 else {"q": -line(t)})) for t in range(10_000, 1_000_000, 10_000)
    ]
    samples = feed(sampler([], outputs), messages)
    assert [sample.index for sample in samples] == list(range(2, 99))
    assert all(sample.complete for sample in samples)


def test_unix_time_goes_on_while_the_offset_is_being_learned() -> None:
    to = sampler([])
    delays = [80, 80, 80, 60, 20, 1, 1, 1, 1, 1] + [1] * 90
    messages = [
        Message(MAVLINK, "A", UNIX + (t + delay) * MS, {"time_boot_ms": t, "speed": 0.0})
        for t, delay in zip(range(10, 1010, 10), delays, strict=True)
    ]
    samples = feed(to, messages)
    steps = np.diff([sample.time_ns for sample in samples])
    assert (steps >= 5 * MS).all()
    assert samples[-1].time_ns == UNIX + samples[-1].vehicle_time_ns + 1 * MS


def test_the_same_messages_give_the_same_samples() -> None:
    messages = telemetry(0, 2_000_000, 7_000, 11_000)
    first, second = (feed(sampler(), messages) for _ in range(2))
    assert values(first) == values(second)
    assert [s.time_ns for s in first] == [s.time_ns for s in second]


def test_messages_of_no_interest_are_passed_over() -> None:
    to = sampler()
    assert to.interests == {"A", "B"}
    assert feed(to, [message("C", 1_000)]) == []
    assert to.statistics().messages == 0


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.sampled_from(["speed", "x"]), inner, max_size=2),
    max_leaves=4,
)
FIELDS = st.dictionaries(
    st.sampled_from(["time_usec", "time_boot_ms", "time_ns", "speed", "command"]), ANYTHING | st.integers(0, 10**6)
)


@given(st.lists(st.tuples(st.sampled_from("AB"), FIELDS, st.integers(-(10**18), 10**19)), max_size=60))
def test_no_message_makes_the_sampler_fail(messages: list[tuple[str, dict[str, Any], int]]) -> None:
    to = sampler(rate=1000.0)
    for name, fields, received_ns in messages:
        for sample in feed(to, [Message(ZENOH, name, received_ns, fields)]):
            assert np.isfinite(sample.u).all()
            assert np.isfinite(sample.y).all()
    assert len(feed(to, telemetry(10_000_000_000, 10_001_000_000))) > 800


@pytest.mark.parametrize(
    ("restless", "idles", "still"), [(True, False, ("B", "A")), (True, True, ("A",)), (False, False, ())]
)
def test_rates_that_stand_still_are_lost_and_commands_where_wings_never_carry(
    restless: bool, idles: bool, still: tuple[str, ...]
) -> None:
    commands = [Channel(f"command{k}", "B", (f"command{k}",)) for k in range(3)]
    rates = [Channel(f"rate{k}", "A", (f"rate{k}",)) for k in range(3)]
    both = Sampler(commands, rates, 100.0, VehicleClock(), restless=restless, idles=idles)
    for stop_us, found in ((1_000_000, ()), (2_000_000, still)):
        for t in range(stop_us - 1_000_000, stop_us, 10_000):
            value = math.sin(min(t, 1_000_000) / 1e5)
            feed(both, [message("B", t, **{c.name: value for c in commands})])
            feed(both, [message("A", t, **{c.name: value for c in rates})])
        assert tuple(both.still) == found


def test_no_line_joins_frozen_values_to_those_that_come_after_them() -> None:
    rates = [Channel(f"rate{k}", "A", (f"rate{k}",)) for k in range(3)]
    to = Sampler([], rates, 100.0, VehicleClock(), restless=True)
    values = [*np.sin(np.arange(50) / 5.0), *[0.5] * 150, *(5.0 + 0.01 * np.sin(np.arange(50)))]
    given = []
    for k, value in enumerate(values):
        given += feed(to, [message("A", 20_000 * k, **{rate.name: float(value) for rate in rates})])
    assert all(one.y[0] < 1.1 or one.y[0] > 4.9 for one in given)
    (again,) = [one for one in given if one.restart and one.y[0] > 1.1]
    assert again.vehicle_time_ns >= 4_000_000_000
