"""Samples do not depend, to the bit, on how telemetry is cut into batches, nor on whether messages are columns."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sampled import batches, packed, rows

from adapters.batch import Batch
from adapters.channels import Channel
from adapters.logs.recordings import read_recording
from adapters.message import Message
from adapters.source import MAVLINK
from monitor.core.sampling import VehicleClock, sample_batch
from monitor.sampling.sampler import Sampler
from monitor.vehicles.inertial.signals import strapdown_channels

DATA = Path(__file__).parent / "data"
MS = 1_000_000
UNIX = 1_795_251_917_000 * MS
TURN_US = 1 << 32
MOTORS = [Channel(f"motor{i}", "SERVO_OUTPUT_RAW", (f"servo{i}_raw",), 0.001, -1.0, (("port", 0),)) for i in (1, 2)]
RATES = [Channel(name, "ATTITUDE", (name,)) for name in ("rollspeed", "pitchspeed")]


Setup = tuple[Sequence[Channel], Sequence[Channel], float]


class Watch:
    """Samplers on one clock, the samples they gave and with which message."""

    def __init__(self, *setups: Setup) -> None:
        self.clock = VehicleClock()
        self.samplers = [Sampler(inputs, outputs, rate, self.clock) for inputs, outputs, rate in setups]
        self.given: list[list[Any]] = [[] for _ in setups]
        self.newest_ns: list[int] = []

    def run(self, batch: Batch) -> None:
        taken = sample_batch(self.clock, self.samplers, batch)
        before = len(self.newest_ns)
        for samples, position, got in zip(taken.samples, taken.position, self.given, strict=True):
            got.extend(zip((position + before).tolist(), (row.bits for row in rows(samples)), strict=True))
        self.newest_ns.extend(taken.newest_ns.tolist())

    @property
    def counts(self) -> list[dict[str, int]]:
        return [sampler.counts() for sampler in self.samplers]


def compare(
    messages: Sequence[Message], *setups: Setup, cuts: Sequence[int] = (), types: dict[str, Any] | None = None
) -> Watch:
    """Hold batches of columns to the same messages one at a time, none of them a column; return the former's watch."""
    single, watch = Watch(*setups), Watch(*setups)
    for message in messages:
        single.run(Batch(1, (), {0: message}))
    for batch in batches(messages, cuts, partial(packed, types=types)):
        watch.run(batch)
    assert watch.given == single.given
    assert watch.newest_ns == single.newest_ns
    assert watch.counts == single.counts
    return watch


def message(name: str, time_us: int, delay_ns: int = 0, **fields: Any) -> Message:
    return Message(MAVLINK, name, UNIX + time_us * 1_000 + delay_ns, {"time_usec": time_us, **fields}, 1, 1)


WAVES = [Channel("a", "A", ("a",), 0.5, -1.0), Channel("turn", "A", ("turn",), period=6.25)]
HELD = Channel("b", "B", ("b",), 3.0, interpolation="previous")
MEANS = [
    Channel("mean", "B", ("b",), interpolation="mean"),
    Channel("turned", "A", ("turn",), interpolation="mean", period=6.25),
]
SLOW = Channel("c", "C", ("data", 1), 1e-3)
WIND = Channel("wind", "W", ("wind",))
PORTS = [Channel(f"p{port}", "P", ("p",), where=(("port", port),)) for port in (0, 1)]
SETUPS = (
    ([HELD], WAVES, 100.0),
    ([*WAVES, SLOW, WIND], [], 33.3),
    ([HELD, PORTS[0]], [PORTS[1], WAVES[0]], 250.0),
    ([Channel("any", "P", ("port",))], [PORTS[0]], 29.97),
    (MEANS, [WAVES[0]], 4.0),
)


def telemetry(
    rng: np.random.Generator, seconds: float, start_us: int = 3_000_000, jitter_us: int = 2_000, delay_ms: float = 20.0
) -> list[Message]:
    """Return messages of five names on schedules of their own."""
    stop_us = start_us + round(seconds * 1e6)

    def times(step_us: int) -> list[int]:
        return [int(t) + int(rng.integers(0, jitter_us)) for t in range(start_us, stop_us, step_us)]

    found = [message("A", t, a=rng.normal(), turn=rng.uniform(-3.2, 3.2)) for t in times(10_000)]
    found += [message("B", t, b=int(rng.integers(1000, 2000))) for t in times(20_000)]
    found += [message("C", t // 300_000 * 300_000, data=[0, int(rng.integers(-9, 9))]) for t in times(100_000)]
    found += [message("P", t, port=i % 3, p=rng.normal()) for i, t in enumerate(times(5_000))]
    found += [replace(message("W", t, wind=rng.normal()), fields={"wind": rng.normal()}) for t in times(50_000)]
    found += [message("X", t) for t in times(200_000)]
    found.sort(key=lambda one: one.received_ns)
    return [replace(one, received_ns=one.received_ns + int(rng.exponential(delay_ms) * MS)) for one in found]


HALF_AS_MANY = settings(max_examples=settings().max_examples // 2)
"""Examples: each is seconds of telemetry, message by message."""
CUTS = st.lists(st.integers(0, 800), max_size=6)


@HALF_AS_MANY
@given(st.integers(0, 2**32), CUTS, st.sampled_from([0.0, 0.02, 0.3, 0.7]), st.sampled_from([1.0, 20.0, 2000.0]))
def test_batches_of_any_length_give_the_bits_of_single_messages_whatever_is_lost(
    seed: int, cuts: list[int], loss: float, delay_ms: float
) -> None:
    rng = np.random.default_rng(seed)
    messages = [one for one in telemetry(rng, 2.0, delay_ms=delay_ms) if rng.random() >= loss]
    compare(messages, *SETUPS, cuts=cuts)


@HALF_AS_MANY
@given(st.integers(0, 2**32), CUTS, st.integers(2, 40), st.floats(0.0, 0.05))
def test_so_they_do_with_repeated_and_overtaking_messages(seed: int, cuts: list[int], reach: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    ordered = [one for one in telemetry(rng, 1.5) for _ in range(1 + (rng.random() < share))]
    places = np.arange(len(ordered)) + rng.integers(0, reach, len(ordered)) * (rng.random(len(ordered)) < share)
    compare([ordered[i] for i in np.argsort(places, kind="stable")], *SETUPS, cuts=cuts)


DAMAGE = st.lists(
    st.tuples(
        st.integers(0, 600),
        st.sampled_from(
            ["nan", "inf", "none", "huge", "text", "zero", "far", "back", "reboot", "jump", "gap", "early", "late"]
        ),
    ),
    max_size=4,
)


def damaged(messages: list[Message], at: int, how: str) -> list[Message]:
    """Return the messages with something wrong from a place on, or there."""
    if at >= len(messages):
        return messages
    one = messages[at]
    changes: dict[str, Any] = {
        "nan": {"a": math.nan},
        "inf": {"b": math.inf, "turn": -math.inf},
        "none": {"a": None},
        "huge": {"a": 2e12, "b": 10**400},
        "text": {"b": "2", "turn": "no"},
        "zero": {"time_usec": 0},
        "far": {"time_usec": 9_000_000_000_000_000_000},
        "back": {"time_usec": 100},
    }
    if how in changes:
        wrong = {name: value for name, value in changes[how].items() if name in one.fields}
        return [*messages[:at], replace(one, fields={**one.fields, **wrong}), *messages[at + 1 :]]
    if how == "gap":
        return messages[:at] + messages[at + 200 :]
    if how in ("early", "late"):
        by_ns = 5_000 * MS * (-1 if how == "early" else 1)
        return [*messages[:at], *(replace(m, received_ns=m.received_ns + by_ns) for m in messages[at:])]
    by_us = -2_500_000 if how == "reboot" else 30_000_000
    shifted = [
        replace(m, fields={**m.fields, "time_usec": max(1, m.fields["time_usec"] + by_us)})
        if "time_usec" in m.fields
        else m
        for m in messages[at:]
    ]
    return messages[:at] + shifted


@HALF_AS_MANY
@given(st.integers(0, 2**32), CUTS, DAMAGE)
def test_so_they_do_with_damaged_values_and_stamps_reboots_jumps_and_gaps(
    seed: int, cuts: list[int], damage: list[tuple[int, str]]
) -> None:
    messages = telemetry(np.random.default_rng(seed), 1.5)
    for at, how in damage:
        messages = damaged(messages, at, how)
    compare(messages, *SETUPS, cuts=cuts)


@HALF_AS_MANY
@given(st.integers(0, 2**32), CUTS, st.sampled_from("ABCPW"), st.integers(0, 3), st.integers(0, 5))
def test_so_they_do_where_a_channel_stops_comes_late_or_never(
    seed: int, cuts: list[int], name: str, first: int, last: int
) -> None:
    messages = telemetry(np.random.default_rng(seed), 2.5)
    start, stop = UNIX + (3_000 + 500 * first) * MS, UNIX + (3_000 + 500 * last) * MS
    compare([one for one in messages if one.name != name or start <= one.received_ns < stop], *SETUPS, cuts=cuts)


@pytest.mark.parametrize("name", ["A", "B", "P"])
@pytest.mark.parametrize("stops_s", [4.0, 4.001])
def test_a_channel_that_stops_and_comes_back_is_given_up_with_the_same_message(name: str, stops_s: float) -> None:
    messages = telemetry(np.random.default_rng(7), 6.0)
    start, stop = UNIX + round(stops_s * 1e3) * MS, UNIX + 7_000 * MS
    rest = [one for one in messages if one.name != name or not start <= one.received_ns < stop]
    watch = compare(rest, *SETUPS, cuts=[500, 700, 701, 900, 1_100])
    assert any(sampler.statistics().skipped > 100 for sampler in watch.samplers)


def test_a_negative_zero_at_a_tick_stays_one() -> None:
    channel = Channel("a", "A", ("a",), 1.0, -0.0)
    messages = [message("A", t, a=-0.0 if t % 20_000 else 1.0) for t in range(10_000, 400_000, 10_000)]
    watch = compare(messages, ([], [channel], 100.0))
    assert {bits[4] for _, bits in watch.given[0]} == {np.float64(-0.0).tobytes(), np.float64(1.0).tobytes()}


def test_a_32_bit_clock_that_turns_over_does_not_interrupt() -> None:
    messages = [
        replace(one, fields={**one.fields, "time_usec": one.fields["time_usec"] % TURN_US}) if one.name == "B" else one
        for one in telemetry(np.random.default_rng(3), 10.0, start_us=TURN_US - 4_000_000)
    ]
    watch = compare(messages, *SETUPS, cuts=[1_700, 1_900])
    assert [counts["clock_restarts"] for counts in watch.counts] == [0] * len(SETUPS)


@pytest.mark.parametrize("kind", [np.uint8, np.int16, np.uint32, np.int64, np.uint64, np.float32, np.float64])
def test_fields_of_every_type_on_the_wire_give_the_values_of_their_messages(kind: Any) -> None:
    largest = np.iinfo(kind).max if np.issubdtype(kind, np.integer) else 3e38
    rng = np.random.default_rng(4)
    messages = []
    for t in range(10_000, 600_000, 10_000):
        value = kind(largest - int(rng.integers(0, 100)) if t % 20_000 else int(rng.integers(0, 100))).tolist()
        messages.append(message("A", t, value=value))
    channel = Channel("value", "A", ("value",), scale=0.1, offset=7.0)
    watch = compare(messages, ([], [channel], 70.0), types={"value": kind})
    assert len(watch.given[0]) > 30


@pytest.mark.parametrize(
    "channel",
    [
        Channel("a", "A", ("a",), clock="time_usec", clock_unit_ns=500),
        Channel("a", "A", ("a",), clock="missing"),
        Channel("a", "A", ("a",), clock="a"),
        Channel("a", "A", ("a", 0)),
        Channel("a", "A", ("gone",)),
        Channel("a", "A", ("a",), where=(("turn", 1), ("gone", 0))),
        Channel("c", "C", ("data", 1), clock="data[1]"),
        Channel("c", "C", ("data", 7)),
        Channel("c", "C", ("data", "name")),
        Channel("c", "C", ("time_usec",), where=(("data", 1),)),
        Channel("p", "P", ("p",), where=(("port", "1"),)),
    ],
)
def test_unusual_channels_read_alike_in_columns(channel: Channel) -> None:
    messages = telemetry(np.random.default_rng(5), 2.0)
    compare(messages, ([], [channel], 100.0), ([HELD], [WAVES[1]], 100.0), cuts=[50, 51, 120])


def test_a_flood_of_one_channel_is_dropped_alike() -> None:
    messages = [message("A", 1_000_000 + t, a=float(t), turn=0.0) for t in range(18_000)]
    compare(messages, ([HELD], WAVES, 100.0), cuts=[16_380, 16_381, 16_384, 16_386])


def test_a_mark_to_restart_holds_for_the_next_sample() -> None:
    messages = telemetry(np.random.default_rng(6), 2.0)
    watch = Watch(SETUPS[0])
    for batch in batches(messages, [200, 400]):
        watch.samplers[0].restart()
        watch.run(batch)
    first = [next(k for k, (place, _) in enumerate(watch.given[0]) if place >= start) for start in (0, 200, 400)]
    assert [k for k, (_, bits) in enumerate(watch.given[0]) if bits[5]] == first


def test_a_recorded_flight_gives_the_same_samples() -> None:
    names = {"ATTITUDE", "SERVO_OUTPUT_RAW", "HIGHRES_IMU", "GPS_RAW_INT", "SCALED_PRESSURE"}
    messages = [one for one in read_recording(DATA / "copter_gps_drift05.tlog.xz") if one.name in names][:6_000]
    examples = {one.name: one.fields for one in messages}
    signals = strapdown_channels(examples).channels
    watch = compare(messages, (MOTORS, RATES, 100.0), (signals, [], 100.0), cuts=[1, 3_000, 3_001, 4_500])
    assert sum(map(len, watch.given)) > 1_500
