"""An alarm over stretches of samples says what it says sample by sample."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from adapters.sample import Sample
from monitor.alarms.alarm import Alarm, AlarmRule
from monitor.alarms.alarm_stretch import AlarmStretch
from monitor.event import AlarmEvent

STEP_NS = 10_000_000


def rule(slow: float = math.inf) -> AlarmRule:
    return AlarmRule("motors", "motor1", "actuator", "1", 1.0, 0.6, 3.0, 0.05, 0.1, fast=2.0, slow=slow, slow_s=0.5)


def sample(row: int, restart: bool) -> Sample:
    nothing = np.zeros(0)
    return Sample(row, row * STEP_NS, 10**18 + row * STEP_NS, nothing, nothing, restart, complete=True)


def one_by_one(
    alarm: Alarm, evidence: Sequence[float], speaking: Sequence[bool], restart: Sequence[bool], first: int = 0
) -> list[AlarmEvent]:
    events = []
    for row, (size, speaks, anew) in enumerate(zip(evidence, speaking, restart, strict=True), first):
        if not speaks:
            alarm.pause()
        elif (event := alarm.update(sample(row, anew), size, None)) is not None:
            events.append(event)
    return events


def as_stretch(
    alarm: Alarm, evidence: NDArray[np.float64], speaking: NDArray[np.bool_], restart: NDArray[np.bool_], first: int
) -> list[AlarmEvent]:
    times = (first + np.arange(len(evidence))) * STEP_NS
    stretch = AlarmStretch(alarm, times, restart, evidence, speaking)
    events = []
    while stretch.row < len(stretch):
        if not stretch.due:
            stretch.go_on()
            continue
        row = stretch.row
        stretch.pass_to(row)
        event = alarm.update(sample(first + row, bool(restart[row])), float(evidence[row]), None)
        if event is not None:
            events.append(event)
        stretch.update_done()
    stretch.pass_to(len(stretch))
    return events


def streams(count: int) -> st.SearchStrategy[tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_]]]:
    def build(seed: int, loudness: float) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_]]:
        rng = np.random.default_rng(seed)
        evidence = loudness * np.repeat(rng.normal(0, 1, count // 20 + 1), 20)[:count] + rng.normal(0, 0.2, count)
        evidence[rng.random(count) < 0.002] = rng.choice([np.nan, np.inf, -np.inf])
        speaking = np.repeat(rng.random(count // 10 + 1) < 0.9, 10)[:count]
        return evidence, speaking, rng.random(count) < 0.005

    return st.builds(build, st.integers(0, 2**32 - 1), st.sampled_from([0.1, 0.5, 1.0, 2.0]))


@settings(max_examples=60, deadline=None)
@given(
    stream=streams(600),
    cuts=st.lists(st.integers(0, 600), max_size=6),
    slow=st.sampled_from([0.2, 0.6, math.inf]),
)
def test_stretches_of_any_length_give_the_events_and_the_state_of_single_samples(
    stream: tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_]], cuts: list[int], slow: float
) -> None:
    evidence, speaking, restart = stream
    plain, stretched = Alarm(rule(slow), "copter"), Alarm(rule(slow), "copter")
    expected = one_by_one(plain, evidence.tolist(), speaking.tolist(), restart.tolist())
    edges = [0, *sorted(cuts), len(evidence)]
    found = []
    for number, (a, b) in enumerate(pairwise(edges)):
        part = slice(a, b)
        if number % 3 == 2:
            found += one_by_one(
                stretched, evidence[part].tolist(), speaking[part].tolist(), restart[part].tolist(), first=a
            )
        else:
            found += as_stretch(stretched, evidence[part], speaking[part], restart[part], a)
    assert repr(found) == repr(expected)
    assert (stretched.mean, stretched.last_ns, stretched.idle) == (plain.mean, plain.last_ns, plain.idle)


def test_the_mean_is_the_same_to_the_last_bit_after_a_long_quiet_stretch() -> None:
    evidence = np.random.default_rng(3).normal(0, 0.1, 5000)
    always, never = np.ones(5000, np.bool_), np.zeros(5000, np.bool_)
    plain, stretched = Alarm(rule(0.5), "copter"), Alarm(rule(0.5), "copter")
    one_by_one(plain, evidence.tolist(), always.tolist(), never.tolist())
    as_stretch(stretched, evidence, always, never, 0)
    assert stretched.mean == plain.mean != 0.0
