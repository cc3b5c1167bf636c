"""Fuzz targets of a vehicle's whole monitor: messages, times that pass, operators and journals through pipelines."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from fuzz_adapters import DATA, START_NS
from fuzz_input import Draw, random_inputs
from fuzz_target import Run, Target

from adapters.batch import Batch, pack
from adapters.logs.recordings import read_recording
from adapters.message import Message, silence
from adapters.simulation.arm import SCENARIOS, simulate_arm
from adapters.simulation.arm_source import arm_messages
from adapters.source import CLOCK, JOURNAL, LINK, OPERATOR, ZENOH
from monitor.bus.alarm_text import alarm_line
from monitor.bus.operators import VERBS
from monitor.bus.payload import estimate_json, to_json
from monitor.estimate import Estimates
from monitor.event import AlarmEvent, valid_event
from monitor.pipeline import Pipeline
from monitor.profile import Profile, read_profile
from monitor.recording.record_encoder import RecordEncoder
from monitor.service.vehicle_monitor import VehicleMonitor
from replay.demonstration.arm_profile import write_arm_profile

ROOT = Path(__file__).parents[1]
QUAD = ROOT / "replay" / "data" / "quad"
VEHICLE = "copter-1"
EVENT = AlarmEvent(
    id="01J0000000000000000000ABCD",
    vehicle=VEHICLE,
    observer="motors",
    channel="motor1",
    kind="actuator",
    state="raised",
    severity="warning",
    estimate=-0.02,
    relative=None,
    unit="m",
    threshold=0.015,
    time_ns=START_NS,
    vehicle_time_ms=1,
    since_ns=START_NS,
    peak=-0.03,
    message="motor1 delivers less",
    seq=1,
)


class Sink:
    """Takes all that a vehicle's monitor says: encodes it as recording and publisher do."""

    def __init__(self, profile: Profile) -> None:
        pipeline = Pipeline(profile)
        self._encoder = RecordEncoder(pipeline.layouts)
        self._layouts = {layout.observer: layout for layout in pipeline.layouts}

    def batch(self, batch: Batch) -> None:
        """Record messages."""
        self._encoder.batch(batch)

    def estimates(self, estimates: Estimates) -> None:
        """Record and publish estimates."""
        self._encoder.estimates(estimates)
        for row in range(len(estimates)):
            json.loads(to_json(estimate_json(self._layouts[estimates.observer], estimates, row)))

    def event(self, event: AlarmEvent) -> None:
        """Record, publish and print an event."""
        self._encoder.event(event)
        json.loads(to_json(event.to_json()))
        alarm_line(event)

    def status(self, status: Any) -> None:
        """Publish a status."""
        json.loads(to_json(status))

    def write(self, event: AlarmEvent, frame: Any = None) -> None:
        """Keep an event as the journal does."""
        to_json(event.to_json())
        to_json(frame or {})

    def shelve(self, vehicle: str, channels: Mapping[str, int]) -> None:
        """Keep what is shelved as the journal does."""
        to_json(channels)

    def flush(self) -> None:
        """Keep nothing back."""

    def close(self) -> None:
        """Close nothing."""


def silent_monitor(profile: Profile, sink: Sink) -> VehicleMonitor:
    pipeline = Pipeline(profile, VEHICLE)
    return VehicleMonitor(pipeline, [sink], sink, sink.event, START_NS)


def flight() -> list[Message]:
    found = list(itertools.islice(read_recording(DATA / "copter_5s.tlog.xz"), 1500))
    shift = START_NS - found[0].received_ns
    return [replace(message, received_ns=message.received_ns + shift) for message in found]


def changed(draw: Draw, message: Message) -> Message:
    """Return a message with a field that is odd, gone or new, or from another time or sender."""
    how = draw.number() % 8
    if how == 0:
        return replace(message, received_ns=draw.choice((0, 1, (1 << 64) - 1, 1 << 63, message.received_ns)))
    if how == 1:
        return replace(message, received_ns=max(0, message.received_ns + draw.number(5) - (1 << 39)))
    if how == 2:
        return replace(message, system=draw.number(), component=draw.number())
    if how == 3:
        return replace(message, fields=draw.fields())
    fields = dict(message.fields)
    name = draw.choice([*fields, "time_boot_ms", "time_usec"])
    if how == 4:
        fields.pop(name, None)
    else:
        fields[name] = draw.value()
    return replace(message, fields=fields)


def own(draw: Draw, now_ns: int) -> Message:
    """Return a message that is no telemetry, with arbitrary fields."""
    source, name = draw.choice(
        (
            *((OPERATOR, verb) for verb in (*VERBS, "rules", "x")),
            (JOURNAL, "standing"),
            (JOURNAL, "standing"),
            (LINK, "signing"),
            (CLOCK, "silence"),
            (ZENOH, "a/b"),
        )
    )
    fields = draw.fields(3)
    if name == "standing":
        fields["alarms"] = [event_json(draw) for _ in range(draw.number() % 4)]
    elif name == "rules" and draw.number() % 2:
        fields["alarms"] = {"motors": {"motor1": _numbers(draw)}, "arm": {"f_a": _numbers(draw), "f_s": draw.value()}}
    elif draw.number() % 2:
        fields["channel"] = draw.choice(("motors/motor1", "arm/f_a", "link/telemetry", "a/b/c", "/", ""))
    return Message(source, name, now_ns, fields, draw.number() % 2, 1)


def _numbers(draw: Draw) -> dict[str, Any]:
    keys = ("threshold", "clear", "critical", "raise_s", "clear_s", "fast", "slow", "slow_s", "lasting", "latch_s")
    return {draw.choice(keys): draw.value() for _ in range(draw.number() % 5)}


def event_json(draw: Draw) -> Any:
    """Return an event as it comes over a network: right, with odd fields, or none."""
    how = draw.number() % 8
    if how == 0:
        return draw.value()
    found = EVENT.to_json()
    found["observer"], found["channel"] = draw.choice(
        (("motors", "motor1"), ("arm", "f_a"), ("link", "telemetry"), ("link", "signing"), ("monitor", "flood"))
    )
    found["vehicle"] = VEHICLE
    for _ in range(draw.number() % 5):
        found[draw.choice(list(found))] = draw.value()
    return found


def _pipeline(profile: Profile, telemetry: Sequence[Message]) -> Run:
    sink = Sink(profile)

    def run(data: bytes) -> None:
        draw = Draw(data)
        monitor = silent_monitor(profile, sink)
        at, now_ns = draw.number(2) % len(telemetry), START_NS
        if draw.number() % 2:
            monitor.activate(sink, START_NS)
        while draw.more:
            how = draw.number() % 16
            if how < 4:
                for _ in range((1, 4, 16, 64)[how]):
                    now_ns = max(now_ns, telemetry[at].received_ns)
                    monitor.process(pack([telemetry[at]]))
                    at = (at + 1) % len(telemetry)
            elif how < 10:
                message = changed(draw, telemetry[at])
                for _ in range(1 + 4 * (draw.number() % 3)):
                    monitor.process(pack([message]))
                at = (at + 1) % len(telemetry)
            elif how == 10:
                now_ns += draw.number(5)
                monitor.process(pack([silence(now_ns)]))
            elif how == 11:
                monitor.status(now_ns)
            elif how == 12:
                event = valid_event(event_json(draw))
                if event is not None:
                    monitor.on_peer_event(event)
            elif how == 13:
                if monitor.active:
                    monitor.deactivate()
                else:
                    monitor.activate(sink, now_ns)
            else:
                monitor.process(pack([own(draw, now_ns)]))
        monitor.status(now_ns)

    return run


def _quad(folder: Path) -> Run:
    return _pipeline(read_profile(QUAD), flight())


def _arm(folder: Path) -> Run:
    run = simulate_arm(SCENARIOS["case2"], 3.0, 100.0, "zero")
    return _pipeline(write_arm_profile(folder / "arm"), list(arm_messages(run, START_NS)))


def _pipeline_seeds() -> list[bytes]:
    long = [bytes([k, 0, 1, 3, 3, 3, 5, k % 8]) + one for k, one in enumerate(random_inputs(40))]
    return [*long, *random_inputs(40, seed=2)]


TARGETS = (
    Target(
        "pipeline-quad",
        "messages with arbitrary fields, times and senders through a quadrotor's monitor",
        _quad,
        _pipeline_seeds,
        256,
        slow_s=5.0,
    ),
    Target("pipeline-arm", "the same through the reference arm's", _arm, _pipeline_seeds, 256, 5.0),
)
