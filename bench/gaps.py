"""What lost measurements do to the estimates of faults: bridged by straight lines, coasted, and coasted and resumed.

    python bench/gaps.py PROFILE LOG [LOG ...] [--seeds N]

Messages of a recording are dropped at random, or in bursts, and what the profile's first observer then estimates is
compared with the run without losses: root of the mean square of the difference, in healthy standard deviations of each
estimate, mean over the channels; and the alarms of both.
"""

from __future__ import annotations

import argparse
import random
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

import numpy as np

from adapters.logs.recordings import read_recording
from adapters.message import Message
from gains.synthesis.gains_file import Gains
from monitor.estimation.coasting import CoastingMaps, StepMap, coasting_maps
from monitor.profile import read_profile
from replay.player import Replay, play

_NEVER = 1_000_000
_KEPT = {"HEARTBEAT", "EXTENDED_SYS_STATE"}
_LOSSES = {
    "2 %": (0.02, 0.0),
    "10 %": (0.1, 0.0),
    "30 %": (0.3, 0.0),
    "bursts 50 ms": (0.0, 0.05),
    "bursts 80 ms": (0.0, 0.08),
    "bursts 95 ms": (0.0, 0.095),
}
_RULES = {
    "straight lines": (_NEVER, True),
    "coasted, not resumed": (1, False),
    "coasted from the 1st": (1, True),
    "coasted from the 2nd": (2, True),
    "coasted from the 3rd": (3, True),
}


def lossy(messages: Sequence[Message], share: float, burst_s: float, seed: int) -> list[Message]:
    """Return messages without a random share of them, or without bursts that come every 0.7 s and more."""
    rng = random.Random(seed)  # noqa: S311 - no secret
    kept, until, following = [], 0, messages[0].received_ns
    for message in messages:
        now = message.received_ns
        if burst_s and now >= following:
            until = now + round(burst_s * 1e9)
            following = until + round((0.2 + rng.expovariate(2.0)) * 1e9)
        if message.name in _KEPT or (now >= until and rng.random() >= share):
            kept.append(message)
    return kept


@contextmanager
def ruled(first: int, resumed: bool) -> Iterator[None]:
    """Let observers coast from the ``first`` lost measurement on, and resume or not."""

    def maps(gains: Gains) -> CoastingMaps:
        coast, resume = coasting_maps(gains)
        if resumed:
            return CoastingMaps(coast, resume)
        more = ((0, 0), (0, resume.step.shape[1] - gains.step_matrix.shape[1]))
        nu = ((0, 0), (0, resume.arguments.shape[1] - gains.argument_matrix.shape[1]))
        return CoastingMaps(coast, StepMap(np.pad(gains.step_matrix, more), np.pad(gains.argument_matrix, nu)))

    with (
        patch("monitor.core.sampling.LINE_PERIODS", first),
        patch("monitor.estimation.stack_layout.coasting_maps", maps),
    ):
        yield


def difference(without: Replay, found: Replay) -> float:
    """Return the difference of the first observer's estimates, in standard deviations without losses."""
    a, b = without.traces[0], found.traces[0]
    _, i, j = np.intersect1d(a.vehicle_ns, b.vehicle_ns, return_indices=True)
    i, j = i[a.armed[i]], j[a.armed[i]]
    error = np.sqrt(np.mean((b.fault[j] - a.fault[i]) ** 2, axis=0))
    return float(np.mean(error / a.fault[a.armed].std(axis=0)))


def raised(replay: Replay) -> str:
    """Return the alarms of a run in short."""
    return " ".join(f"{e.channel}@{e.vehicle_time_ms / 1000:.2f}" for e in replay.events if e.state == "raised") or "-"


def main() -> None:
    """Print a table for each recording."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("profile", type=Path)
    parser.add_argument("logs", type=Path, nargs="+", metavar="LOG")
    parser.add_argument("--seeds", type=int, default=3)
    arguments = parser.parse_args()
    profile = read_profile(arguments.profile)
    run: Callable[[Sequence[Message]], Replay] = lambda messages: play(profile, messages, keep_traces=True)  # noqa: E731
    for log in arguments.logs:
        messages = [message for message in read_recording(log) if message.system == 1]
        without = run(messages)
        print(f"\n{log.name}: without losses {raised(without)}")
        for loss, (share, burst_s) in _LOSSES.items():
            for rule, (first, resumed) in _RULES.items():
                with ruled(first, resumed):
                    runs = [run(lossy(messages, share, burst_s, seed)) for seed in range(arguments.seeds)]
                error = np.mean([difference(without, found) for found in runs])
                print(f"{loss:14s} {rule:22s} {error:10.3f}   {' | '.join(map(raised, runs))}", flush=True)


if __name__ == "__main__":
    main()
