"""Delay, jitter and lost share of a link, from what comes over it."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adapters.batch import Batch, Columns, cut, pack
from adapters.link_figures import LinkFigures, LinkMeter
from adapters.message import Message
from adapters.source import MAVLINK

UNIX_NS = 1_795_251_917_000_000_000


def columns(stamps_ms: np.ndarray, late_ms: np.ndarray, name: str = "ATTITUDE") -> Batch:
    received = UNIX_NS + np.rint(1e6 * (stamps_ms + late_ms)).astype(np.int64)
    position = np.arange(len(stamps_ms))
    fields = {"time_boot_ms": stamps_ms.astype(np.uint32)}
    return Batch(len(position), (Columns(MAVLINK, name, 1, 1, position, received, fields),), {})


def figures(batch: Batch, recent: bool = False) -> LinkFigures:
    meter = LinkMeter(recent)
    meter.count(batch)
    return meter.figures()


def test_a_link_that_delays_nothing_has_no_delay_and_no_jitter() -> None:
    steady = columns(np.arange(1_000, 61_000, 10), np.zeros(6_000))
    assert figures(steady) == figures(steady, recent=True) == (0.0, 0.0, 0.0)


def test_delay_and_jitter_are_means_beyond_the_quickest_message() -> None:
    late = np.tile([5.0, 25.0], 3_000)
    delay_s, jitter_s, lost = figures(columns(np.arange(1_000, 61_000, 10), late))
    assert delay_s == pytest.approx(0.010)
    assert jitter_s == pytest.approx(0.020)
    assert lost == 0.0


def test_a_clock_of_the_receiver_that_was_set_an_hour_forward_and_back_delays_nothing() -> None:
    late = np.zeros(6_000)
    late[2_000:3_000] = 3.6e6
    assert figures(columns(np.arange(1_000, 61_000, 10), late)) == (0.0, 0.0, 0.0)


@given(st.integers(0, 2**32), st.floats(0.0, 0.4))
def test_what_is_lost_is_seen_in_the_stamps(seed: int, share: float) -> None:
    kept = np.random.default_rng(seed).random(6_000) >= share
    kept[[0, -1]] = True
    lost = figures(columns(np.arange(1_000, 61_000, 10)[kept], np.zeros(int(kept.sum())))).lost_share
    assert lost == pytest.approx(1.0 - kept.mean(), abs=0.006)


@given(st.lists(st.integers(0, 3_000), max_size=6))
def test_batches_of_any_length_give_the_same_loss_and_jitter(cuts: list[int]) -> None:
    rng = np.random.default_rng(1)
    stamps = np.arange(1_000, 31_000, 10)[rng.random(3_000) > 0.1]
    batch = columns(stamps, rng.uniform(0.0, 9.0, len(stamps)))
    places = [0, *sorted(min(place, batch.count) for place in cuts), batch.count]
    meter = LinkMeter(recent=False)
    for start, stop in pairwise(places):
        meter.count(cut(batch, start, stop))
    whole, parts = figures(batch), meter.figures()
    assert parts.jitter_s == pytest.approx(whole.jitter_s, rel=1e-9)
    assert parts.lost_share == pytest.approx(whole.lost_share, abs=0.02)


def test_numbered_packets_tell_what_was_lost_in_the_last_minute() -> None:
    meter = LinkMeter()
    for second in range(200):
        stamps = np.arange(second * 1_000 + 10, second * 1_000 + 1_010, 10)
        meter.count(columns(stamps, np.zeros(100)))
        found = meter.figures(received=100 * (second + 1), lost=50 * min(second, 100))
        if second == 100:
            assert found.lost_share == pytest.approx(1.0 / 3.0, abs=0.01)
    assert found.lost_share == 0.0


def test_a_reboot_is_no_delay() -> None:
    stamps = np.concatenate([np.arange(300_000, 330_000, 10), np.arange(10, 20_000, 10)])
    received = np.concatenate([np.zeros(3_000), np.full(len(stamps) - 3_000, 330_000.0)])
    assert figures(columns(stamps, received)).delay_s == pytest.approx(0.0, abs=1e-6)


def test_a_reboot_repeated_and_unstamped_messages_are_no_loss() -> None:
    stamps = np.repeat(np.concatenate([np.arange(5_000, 30_000, 10), np.arange(10, 20_000, 10)]), 2)
    assert figures(columns(stamps, np.zeros(len(stamps)))).lost_share == 0.0
    heartbeat = pack([Message(MAVLINK, "HEARTBEAT", UNIX_NS, {"type": 2}, 1, 1)])
    assert figures(heartbeat) == (None, None, None)


def test_a_clock_that_runs_at_double_speed_is_no_delay() -> None:
    stamps = np.arange(1_000, 21_000, 10)
    assert figures(columns(stamps, -0.5 * stamps)).delay_s == pytest.approx(0.0, abs=1e-6)
