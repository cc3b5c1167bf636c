"""Fuzz target of batches: a stream of any messages, cut anywhere, against batches of one message."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from fuzz_input import Draw, random_inputs
from fuzz_pipeline import QUAD, changed, flight, own
from fuzz_target import Run, Target

from adapters.batch import pack
from adapters.message import LATEST_NS, Message, silence
from monitor.estimate import Estimates
from monitor.event import AlarmEvent
from monitor.pipeline import Pipeline
from monitor.profile import read_profile

# Six times as many took 14 s of processor time under the fuzzer: a long flight, no slow parser.
_MOST_MESSAGES = 6_000


def _stream(draw: Draw, telemetry: Sequence[Message]) -> list[Message]:
    """Return long pieces of a flight, and between them messages that are odd, late, early, twice or no telemetry."""
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


def _bits(outputs: Sequence[Any]) -> dict[str, list[bytes]]:
    """Return the bits of all estimates by observer, column by column."""
    found: dict[str, list[Estimates]] = {}
    for output in outputs:
        if isinstance(output, Estimates):
            found.setdefault(output.observer, []).append(output)
    return {
        observer: [
            *(
                _joined([getattr(one.samples, column.name) for one in many])
                for column in fields(many[0].samples)
                if getattr(many[0].samples, column.name) is not None
            ),
            *(_joined([getattr(one, name) for one in many]) for name in _COLUMNS),
        ]
        for observer, many in found.items()
    }


def _joined(parts: Sequence[np.ndarray[Any, Any]]) -> bytes:
    """Return the bits of numbers; which of the bits that stand for none it is does not matter."""
    whole = np.concatenate(parts)
    return np.where(np.isnan(whole), np.nan, whole).tobytes()


_COLUMNS = tuple(column.name for column in fields(Estimates) if column.name not in ("observer", "samples"))


def _cuts(folder: Path) -> Run:
    profile, telemetry = read_profile(QUAD), flight()

    def run(data: bytes) -> None:
        draw = Draw(data)
        system = draw.choice((1, 0, None))
        places = [draw.number(2) for _ in range(draw.number() % 6)]
        messages = _stream(draw, telemetry)
        edges = [0, *sorted(place % (len(messages) + 1) for place in places), len(messages)]
        single, whole = Pipeline(profile, system=system), Pipeline(profile, system=system)
        expected = [output for message in messages for output in single.run(pack([message]))]
        found: list[Any] = []
        for start, stop in itertools.pairwise(edges):
            found += whole.run(pack(messages[start:stop]))
        events = [[repr(one) for one in outputs if isinstance(one, AlarmEvent)] for outputs in (expected, found)]
        assert events[0] == events[1], "other events"
        assert _bits(expected) == _bits(found), "other estimates"
        assert single.statistics() == whole.statistics(), "other counts"
        assert (single.foreign, single.metadata()) == (whole.foreign, whole.metadata()), "another clock"

    return run


def _seeds() -> list[bytes]:
    long = [bytes([k % 3, 1, 9, k, 0, 0, 5, 4, k % 16]) + one for k, one in enumerate(random_inputs(40, 60))]
    return [*long, *random_inputs(20, 100, seed=2)]


TARGETS = (Target("cuts", "messages in batches cut anywhere, against one a batch", _cuts, _seeds, 256, slow_s=10.0),)
