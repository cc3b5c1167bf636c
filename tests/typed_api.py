"""The library as its users write it: strict mypy reads this file, test_public_api.py runs it.

What stands here is what is kept: a change that breaks it breaks users.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from numpy import float64
from numpy.typing import NDArray

import fauio
from fauio import AlarmEvent, AlarmSubscriber, Batch, Estimates, Gains, Message, Pipeline, Plant, Profile, Replay


def rates_of(log: Path) -> dict[str, int]:
    """Count what a recording holds."""
    counts: dict[str, int] = {}
    message: Message
    for message in fauio.read_recording(log, only=("ATTITUDE", "HIGHRES_IMU")):
        roll: object = message.fields.get("roll")
        assert message.received_ns > 0 and (roll is None or message.name == "ATTITUDE")
        counts[message.name] = counts.get(message.name, 0) + 1
    return counts


def alarms_of(folder: Path, log: Path) -> Sequence[AlarmEvent]:
    """Replay a recording."""
    profile: Profile = fauio.read_profile(folder)
    found: Replay = fauio.replay(profile, log, keep_traces=True)
    assert found.watched_s > 0.0 and found.traces
    return found.events


def estimates_of(folder: Path, log: Path, observer: str) -> Iterator[tuple[NDArray[float64], list[AlarmEvent]]]:
    """Run a pipeline over batches, as they come; yield what an observer estimates, and the alarms of each batch."""
    pipeline = Pipeline(fauio.read_profile(folder), vehicle="mine")
    batch: Batch
    for batch in fauio.read_batches(log, pipeline.interests):
        alarms: list[AlarmEvent] = []
        for output in pipeline.run(batch):
            if isinstance(output, AlarmEvent):
                assert output.vehicle == "mine"
                alarms.append(output)
                continue
            estimates: Estimates = output
            if estimates.observer == observer:
                yield estimates.fault, alarms


def gains_of(model: str | Path, rate_hz: float, out: Path) -> Gains:
    """Design certified gains for a plant, and read them back from their file."""
    if not fauio.check(model, rate_hz).estimable:
        raise fauio.InfeasibleError(f"{model}: not all faults can be estimated together")
    fauio.write_gains(fauio.design(model, rate_hz, h2=0.01), out)
    return fauio.read_gains(out)


def faster(plant: Plant, out: Path) -> Plant:
    """Change a plant, write and read it."""
    faults = tuple(replace(fault, rate=2.0 * fault.rate) for fault in plant.faults)
    fauio.write_model(replace(plant, faults=faults), out)
    return fauio.read_model(out)


def listen(endpoint: str, seconds: float) -> AlarmEvent | None:
    """Wait for one alarm of any vehicle."""
    with fauio.open_session(connect=[endpoint]) as session:
        subscriber = AlarmSubscriber(session, vehicle="*", history=True)
        event = subscriber.receive(seconds)
        subscriber.close()
    return event
