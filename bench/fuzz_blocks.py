"""Fuzz target of blocks: a stream of any messages, cut anywhere, against the same messages one by one."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from fuzz_input import Draw, random_inputs
from fuzz_pipeline import QUAD, changed, flight, own
from fuzz_target import Run, Target

from adapters.batch import pack
from adapters.message import LATEST_NS, Message, silence
from monitor.estimate import Estimate, Estimates
from monitor.event import AlarmEvent
from monitor.pipeline import Pipeline
from monitor.profile import read_profile

_SAMPLE = ("index", "vehicle_time_ns", "time_ns", "known_ns", "restart", "complete", "measured", "u", "y")
# Six times as many took 14 s of processor time under the fuzzer: a long flight, no slow parser.
_MOST_MESSAGES = 6_000
_ESTIMATE = ("x", "fault", "isolated", "residual", "armed", "sd", "coasted_s")


def _stream(draw: Draw, telemetry: Sequence[Message]) -> list[Message]:
    """Return long stretches of a flight, and between them messages that are odd, late, early, twice or no telemetry."""
    found: list[Message] = []
    at, ahead_ns = draw.number(2) % len(telemetry), 0
    while draw.more and len(found) < _MOST_MESSAGES:
        how = draw.number() % 16
        here = telemetry[at % len(telemetry)]
        if how < 6:
            count = (1, 20, 70, 150, 300, 600)[how]
            rows = (telemetry[k % len(telemetry)] for k in range(at, at + count))
            found += [replace(one, received_ns=max(0, one.received_ns + ahead_ns)) for one in rows]
            at += count
        elif how < 9:
            found += [changed(draw, here)] * (1 + 4 * (draw.number() % 3))
            at += 1
        elif how == 9:
            ahead_ns += draw.number(5) - (1 << 37)
        elif how == 10:
            found.append(silence(max(0, here.received_ns + ahead_ns + draw.number(5))))
        elif how == 11:
            found.append(own(draw, max(0, here.received_ns + ahead_ns)))
        elif how == 12 and found:
            back = draw.number() % len(found)
            found.append(found[-1 - back])
        elif how == 13 and found:
            place, other = len(found) - 1, len(found) - 1 - draw.number() % len(found)
            found[place], found[other] = found[other], found[place]
        elif how == 14 and found:
            field = draw.value()
            for k in range(max(0, len(found) - 200), len(found)):
                names = [*found[k].fields]
                if found[k].name == here.name and names:
                    fields = {**found[k].fields, names[draw.number() % len(names)]: field}
                    found[k] = replace(found[k], fields=fields)
        else:
            at += draw.number()
    # recordings hold no later times
    return [one for one in found if one.received_ns < LATEST_NS]


def _rows(outputs: Sequence[Any]) -> dict[str, list[tuple[Any, ...]]]:
    """Return the estimates by observer as tuples of bytes."""
    found: dict[str, list[tuple[Any, ...]]] = {}
    for output in outputs:
        many = output if isinstance(output, Estimates) else None
        for one in [output] if many is None else map(many.one, range(len(many))):
            if isinstance(one, Estimate):
                sample = [np.asarray(getattr(one.sample, name)) for name in _SAMPLE]
                values = [np.asarray(getattr(one, name)) for name in _ESTIMATE]
                found.setdefault(one.observer, []).append(tuple(map(_bits, (*sample, *values))))
    return found


def _bits(value: np.ndarray[Any, Any]) -> bytes:
    """Return the bits of numbers; which of the bits that stand for none it is does not matter."""
    return np.where(np.isnan(value), np.nan, value).tobytes()


def _blocks(folder: Path) -> Run:
    profile, telemetry = read_profile(QUAD), flight()

    def run(data: bytes) -> None:
        draw = Draw(data)
        system = draw.choice((1, 0, None))
        places = [draw.number(2) for _ in range(draw.number() % 6)]
        messages = _stream(draw, telemetry)
        edges = [0, *sorted(place % (len(messages) + 1) for place in places), len(messages)]
        plain, whole = Pipeline(profile, system=system), Pipeline(profile, system=system)
        expected = [output for message in messages for output in plain.feed(message)]
        found: list[Any] = []
        for start, stop in itertools.pairwise(edges):
            found += whole.run(pack(messages[start:stop]))
        events = [[repr(one) for one in outputs if isinstance(one, AlarmEvent)] for outputs in (expected, found)]
        assert events[0] == events[1], "other events"
        one_by_one, at_once = _rows(expected), _rows(found)
        assert one_by_one == at_once, "other estimates"
        assert plain.statistics() == whole.statistics(), "other counts"
        assert (plain.foreign, plain.metadata()) == (whole.foreign, whole.metadata()), "another clock"

    return run


def _seeds() -> list[bytes]:
    long = [bytes([k % 3, 1, 9, k, 0, 0, 5, 4, k % 16]) + one for k, one in enumerate(random_inputs(40, 60))]
    return [*long, *random_inputs(20, 100, seed=2)]


TARGETS = (Target("blocks", "messages as blocks cut anywhere, against one by one", _blocks, _seeds, 256, slow_s=10.0),)
