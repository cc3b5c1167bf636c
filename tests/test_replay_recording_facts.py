"""Rates and gaps of a recording, however it is cut into batches."""

from __future__ import annotations

import pytest

from adapters.batch import pack
from adapters.message import Message
from adapters.source import MAVLINK
from replay.reports.recording_facts import MOST_GAPS, RecordingFacts, RecordingMeter

S = 1_000_000_000


def stream(name: str, times_s: list[float], system: int = 1) -> list[Message]:
    return [Message(MAVLINK, name, round(time * S), {"value": 1.0}, system, 1) for time in times_s]


def measured(messages: list[Message], block: int | None = None) -> RecordingFacts:
    meter = RecordingMeter()
    size = block or max(len(messages), 1)
    batches = [pack(messages[start : start + size]) for start in range(0, len(messages), size)]
    assert list(meter.watch(batches)) == batches
    return meter.facts()


@pytest.mark.parametrize("block", [None, 1, 7, 600])
def test_a_gap_is_found_where_it_is_and_leaves_the_rate_as_it_was(block: int | None) -> None:
    fast = [100.0 + 0.01 * k for k in range(1500)] + [120.0 + 0.01 * k for k in range(500)]
    facts = measured(stream("ATTITUDE", fast), block)
    [found] = facts.streams
    assert found.count == 2000
    assert found.rate_hz == pytest.approx(100.0, rel=1e-6)
    [gap] = found.gaps
    assert gap.start_ns == round(114.99 * S)
    assert gap.seconds == pytest.approx(5.01)
    assert facts.duration_s == pytest.approx(24.99)
    assert facts.messages == 2000


def test_what_comes_rarely_has_no_gaps(block: int | None = None) -> None:
    [found] = measured(stream("HEARTBEAT", [1.0 * k for k in range(60)]), block).streams
    assert found.gaps == ()
    assert found.rate_hz == pytest.approx(1.0)


def test_messages_of_one_name_are_told_apart_by_their_sender() -> None:
    facts = measured(stream("HEARTBEAT", [0.0, 1.0]) + stream("HEARTBEAT", [5.0], system=255))
    assert [(one.system, one.count, one.rate_hz) for one in facts.streams] == [(1, 2, 1.0), (255, 1, 0.0)]
    assert (facts.first_ns, facts.last_ns) == (0, 5 * S)


def test_a_recording_without_messages_has_no_times() -> None:
    facts = measured([])
    assert (facts.first_ns, facts.last_ns, facts.duration_s, facts.messages) == (None, None, 0.0, 0)


def test_gaps_are_bounded_and_time_that_runs_backwards_is_borne() -> None:
    times = [0.001 * k for k in range(100)]
    times += [1.0 + k + 0.001 * j for k in range(MOST_GAPS + 50) for j in range(3)] + [0.0, 0.0]
    [found] = measured(stream("ATTITUDE", times)).streams
    assert len(found.gaps) == MOST_GAPS
