"""The library as its users write it: strict mypy reads this file, test_public_api.py runs it.

What stands here is what is kept: a change that breaks it breaks users.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from numpy import float64
from numpy.typing import NDArray

from adapters.errors import InfeasibleError
from adapters.logs.recordings import Recording, read_recording
from adapters.message import Message
from adapters.zenoh.zenoh_session import open_session
from gains.analysis.check import Check, check_plant
from gains.plants.model_file import load_model, read_model, write_model
from gains.plants.plant import Plant
from gains.synthesis.certificate import Certificate, certify
from gains.synthesis.compilation import compile_gains
from gains.synthesis.convex import design_convex
from gains.synthesis.design import Design
from gains.synthesis.gains_file import Gains, read_gains, write_gains
from monitor.bus.subscriber import AlarmSubscriber
from monitor.estimate import Estimate
from monitor.estimation.affine import AffineObserver
from monitor.event import AlarmEvent
from monitor.pipeline import Pipeline
from monitor.profile import Profile, read_profile
from replay.player import Replay, play


def rates_of(log: Path) -> dict[str, int]:
    """Count what a recording holds, and what of it is damaged."""
    recording = Recording(log, only=("ATTITUDE", "HIGHRES_IMU"))
    counts: dict[str, int] = {}
    message: Message
    for message in recording:
        roll: object = message.fields.get("roll")
        assert message.received_ns > 0 and (roll is None or message.name == "ATTITUDE")
        counts[message.name] = counts.get(message.name, 0) + 1
    assert [one.line() for one in recording.damage()] == []
    return counts


def alarms_of(folder: Path, log: Path) -> Sequence[AlarmEvent]:
    """Replay a recording."""
    profile: Profile = read_profile(folder)
    found: Replay = play(profile, read_recording(log), keep_traces=True)
    assert found.watched_s > 0.0 and found.traces
    return found.events


def estimates_of(folder: Path, log: Path, observer: str) -> Iterator[tuple[int, NDArray[float64]]]:
    """Feed a pipeline message by message, as a link would; yield what one of its observers estimates."""
    pipeline = Pipeline(read_profile(folder), vehicle="mine")
    for message in read_recording(log):
        for output in pipeline.feed(message):
            if isinstance(output, AlarmEvent):
                assert output.vehicle == "mine"
                continue
            estimate: Estimate = output
            if estimate.observer == observer:
                yield estimate.sample.time_ns, estimate.fault


def gains_of(name_or_path: str | Path, rate_hz: float, out: Path) -> Gains:
    """Design certified gains for a plant, and read them back from their file."""
    plant: Plant = load_model(name_or_path)
    check: Check = check_plant(plant, rate_hz)
    if not check.estimable:
        raise InfeasibleError(f"{plant.name}: not all faults can be estimated together")
    design: Design = design_convex(plant, rate_hz, h2=0.01)
    certificate: Certificate = certify(plant, design)
    assert certificate.holds
    write_gains(compile_gains(plant, design, certificate), out)
    return read_gains(out)


def faster(plant: Plant, out: Path) -> Plant:
    """Change a plant, write and read it."""
    faults = tuple(replace(fault, rate=2.0 * fault.rate) for fault in plant.faults)
    write_model(replace(plant, faults=faults), out)
    return read_model(out)


def step_by_step(gains: Gains, u: NDArray[float64], y: NDArray[float64]) -> list[float]:
    """Run an observer over samples of one's own: commands (k, s) and measurements (k, p)."""
    observer = AffineObserver([gains])
    return [float(observer.run(u[k : k + 1], y[k : k + 1]).fault[0, 0]) for k in range(len(u))]


def listen(endpoint: str, seconds: float) -> AlarmEvent | None:
    """Wait for one alarm of any vehicle."""
    with open_session(connect=[endpoint]) as session:
        subscriber = AlarmSubscriber(session, vehicle="*", history=True)
        event = subscriber.receive(seconds)
        subscriber.close()
    return event
