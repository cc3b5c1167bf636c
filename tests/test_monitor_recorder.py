"""The flight recorder: every topic typed inside the file, everything flushed safe from a kill."""

from __future__ import annotations

import json
import math
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

import numpy as np
import pytest
from loopback import START_NS, event
from mcap.reader import NonSeekingReader, make_reader
from mcap_protobuf.decoder import DecoderFactory

from adapters.batch import pack
from adapters.logs.mcap_reader import MessageLogReader, read_mcap_metadata
from adapters.message import Message
from adapters.sample import Samples
from adapters.source import MAVLINK, ZENOH
from monitor.bus.schemas import ALARM_SCHEMA
from monitor.estimate import Estimates, Layout
from monitor.event import event_from_json
from monitor.recording.archive import Archive
from monitor.recording.record_encoder import RecordEncoder
from monitor.recording.recorder import Recorder, RecorderStatistics
from monitor.recording.retention import FileSeries

LAYOUT = Layout(
    observer="motors",
    rate_hz=100.0,
    inputs=("servo1", "servo2"),
    outputs=("rollspeed", "yaw-speed", "yaw_speed"),
    states=("p",),
    faults=("motor1", "motor2"),
    fault_units=("fraction of full command",) * 2,
)


class Log(Archive):
    """An archive of a recorder alone that holds nothing back, whose counts are at hand."""

    def __init__(
        self,
        target: Path | FileSeries,
        layouts: Sequence[Layout] = (LAYOUT,),
        metadata: Mapping[str, str] = MappingProxyType({}),
        files: Mapping[str, bytes] = MappingProxyType({}),
        **options: Any,
    ) -> None:
        encoder = RecordEncoder(layouts)
        self.recorder = Recorder(target, encoder.topics, metadata, files, **options)
        super().__init__(encoder, self.recorder)

    def write(self, *messages: Message) -> None:
        self.batch(pack(messages))
        self.encode()

    def estimates(self, estimates: Estimates) -> None:
        super().estimates(estimates)
        self.encode()

    def counts(self) -> RecorderStatistics:
        return self.recorder.statistics()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def estimates(first: int, count: int = 1, layout: Layout = LAYOUT) -> Estimates:
    """Return the estimates of samples ``first`` and following."""
    index = np.arange(first, first + count)
    samples = Samples(
        index=index,
        vehicle_time_ns=index * 10_000_000,
        time_ns=START_NS + index * 10_000_000,
        u=np.full((count, 2), (0.1, 0.2)),
        y=np.full((count, 3), (1.0, math.nan, -math.inf)),
        restart=index == 0,
        complete=np.full(count, True),
        known_ns=np.zeros(count, np.int64),
        measured=np.full(count, True),
        lost=np.full((count, 5), False),
    )
    return Estimates(
        observer=layout.observer,
        samples=samples,
        x=np.full((count, 1), 0.25),
        fault=np.full((count, 2), (-0.021, 0.5)),
        isolated=np.full((count, 2), (-0.02, 0.4)),
        residual=np.full((count, 3), (0.0, 1e-3, -1e-3)),
        armed=np.full(count, True),
        sd=np.full((count, 2), (0.004, math.nan)),
        coasted_s=np.full(count, 0.03),
    )


def decoded(path: Path, topic: str) -> list[tuple[int, Any]]:
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        return [(m.log_time, d) for _, _, m, d in reader.iter_decoded_messages(topics=[topic])]


def test_samples_and_estimates_are_typed_by_channel_name(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    with Log(path) as recorder:
        recorder.estimates(estimates(0, 2))
    (_, first), (log_time, sample) = decoded(path, "/fauio/motors/sample")
    assert log_time == sample.time.ToNanoseconds() == START_NS + 10_000_000
    assert (sample.index, sample.vehicle_time_ns, sample.restart, sample.complete) == (
        1,
        10_000_000,
        False,
        True,
    )
    assert first.restart
    assert (sample.u.servo1, sample.u.servo2, sample.y.rollspeed) == (0.1, 0.2, 1.0)
    assert math.isnan(sample.y.yaw_speed)
    assert sample.y.yaw_speed_v2 == -math.inf
    (_, found), _ = decoded(path, "/fauio/motors/estimate")
    assert (found.x.p, found.fault.motor1, found.fault.motor2) == (0.25, -0.021, 0.5)
    assert (found.isolated.motor1, found.residual.rollspeed, found.armed) == (-0.02, 0.0, True)
    assert (found.sd.motor1, found.coasted_s, sample.measured) == (0.004, 0.03, True)
    assert math.isnan(found.sd.motor2)


def test_alarms_are_recorded_as_protobuf_and_as_json_with_its_schema(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    stale = event(18, kind="stale", estimate=None, relative=None, peak=None)
    with Log(path) as recorder:
        recorder.event(event(17, relative=-0.05))
        recorder.event(stale)
    (log_time, alarm), (_, without) = decoded(path, "/fauio/alarm")
    assert (log_time, alarm.channel, alarm.estimate, alarm.relative) == (
        START_NS + 17,
        "motor1",
        -0.02,
        -0.05,
    )
    assert without.kind == "stale"
    assert not without.HasField("estimate")
    assert not without.HasField("relative")
    with path.open("rb") as stream:
        (schema, channel, first), (_, _, second) = make_reader(stream).iter_messages("/fauio/alarm_json")
    assert schema is not None
    assert (channel.message_encoding, schema.encoding) == ("json", "jsonschema")
    assert json.loads(schema.data) == ALARM_SCHEMA
    assert event_from_json(json.loads(first.data)) == event(17, relative=-0.05)
    assert event_from_json(json.loads(second.data)) == stale


def test_the_schema_names_every_field_of_an_event() -> None:
    assert set(ALARM_SCHEMA["properties"]) == set(event(17).to_json()) == set(ALARM_SCHEMA["required"])


def test_numbers_json_cannot_write_become_null(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    with Log(path) as recorder:
        recorder.event(event(17, estimate=math.nan, peak=math.inf))
    with path.open("rb") as stream:
        [(_, _, message)] = make_reader(stream).iter_messages("/fauio/alarm_json")
    assert json.loads(message.data)["estimate"] is None
    assert json.loads(message.data)["peak"] is None


def test_telemetry_comes_back_in_the_order_of_recording_and_nothing_of_ours_with_it(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    messages = [Message(ZENOH, "arm/telemetry", START_NS, {"n": number}) for number in range(50)]
    with Log(path) as recorder:
        for number in range(0, len(messages), 5):
            recorder.write(*messages[number : number + 5])
            recorder.estimates(estimates(number, 5))
            recorder.event(event(17))
    assert list(MessageLogReader(path)) == messages


def test_metadata_and_profile_are_inside(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    files = {"profile.toml": b"x = 1\n", "motors.gains.json": b"{}"}
    with Log(path, [LAYOUT], {"fauio": "0.1.0", "profile": "abc", "clock_offset_ns": " "}, files) as recorder:
        recorder.estimates(estimates(0))
        recorder.add_metadata({"clock_offset_ns": "5"})
    expected = {"fauio": "0.1.0", "profile": "abc", "clock_offset_ns": "5"}
    # ahead of the data, where a reader of the name of the vehicle looks
    assert read_mcap_metadata(path, ahead_only=True)["fauio"] == expected
    with path.open("rb") as stream:
        assert [(record.name, record.metadata) for record in make_reader(stream).iter_metadata()] == [
            ("fauio", expected)
        ]
    with path.open("rb") as stream:
        attachments = {found.name: found for found in make_reader(stream).iter_attachments()}
    assert {name: found.data for name, found in attachments.items()} == {
        f"profile/{name}": data for name, data in files.items()
    }
    assert attachments["profile/profile.toml"].media_type == "application/toml"


def test_two_observers_have_their_own_topics(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    other = Layout("in/ertial", 100.0, LAYOUT.inputs, LAYOUT.outputs, ("p",), ("gps north", "gps_north"), ("m", "m"))
    with Log(path, [LAYOUT, other]) as recorder:
        recorder.estimates(estimates(0))
        recorder.estimates(estimates(0, 1, other))
    [(_, found)] = decoded(path, "/fauio/in/ertial/estimate")
    assert (found.fault.gps_north, found.fault.gps_north_v2) == (-0.021, 0.5)
    assert len(decoded(path, "/fauio/motors/estimate")) == 1


@pytest.mark.parametrize("time_ns", [-1, 2**63, 2**64])
def test_a_clock_gone_mad_costs_its_records_and_not_the_recording(tmp_path: Path, time_ns: int) -> None:
    path = tmp_path / "flight.mcap"
    mad = replace(estimates(0), samples=replace(estimates(0).samples, time_ns=np.array([-1])))
    with Log(path) as recorder:
        recorder.event(event(17, time_ns=time_ns))
        recorder.event(event(17))
        recorder.estimates(mad)
        recorder.estimates(estimates(1))
        recorder.write(Message(MAVLINK, "SYSTEM_TIME", time_ns, {"time_unix_usec": 1, "time_boot_ms": 1}, 1, 1))
        assert recorder.statistics().lost == 4
    assert len(decoded(path, "/fauio/alarm")) == 1
    assert len(decoded(path, "/fauio/motors/estimate")) == 1
    assert list(MessageLogReader(path)) == []


def test_everything_flushed_survives_sigkill_on_every_topic(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    program = """
import sys
sys.path.insert(0, sys.argv[2])
from test_monitor_recorder import LAYOUT, MAVLINK, START_NS, ZENOH, Log, Message, estimates, event
recorder = Log(sys.argv[1], [LAYOUT], {"profile": "abc"}, {"profile.toml": b"x = 1"})
number = 0
while True:
    for _ in range(100):
        recorder.write(Message(ZENOH, "k", START_NS + number, {"n": number}))
        fields = {"time_unix_usec": 1, "time_boot_ms": number}
        recorder.write(Message(MAVLINK, "SYSTEM_TIME", START_NS + number, fields, 1, 1))
        recorder.estimates(estimates(number))
        recorder.event(event(number))
        number += 1
    recorder.flush()
    print(number, flush=True)
"""
    command = [sys.executable, "-c", program, path, Path(__file__).parent]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        flushed = [int(child.stdout.readline()) for _ in range(10)][-1]
        child.send_signal(signal.SIGKILL)
        child.wait()
        flushed = max([flushed, *map(int, child.stdout.read().split())])
    reader = MessageLogReader(path)
    messages = list(reader)
    for name, field in (("k", "n"), ("SYSTEM_TIME", "time_boot_ms")):
        numbers = [message.fields[field] for message in messages if message.name == name]
        assert numbers == list(range(len(numbers)))
        assert len(numbers) >= flushed
    assert reader.scan.stopped_at is not None
    assert reader.scan.damaged_chunks == 0
    assert reader.other_records >= 4 * flushed
    assert read_mcap_metadata(path) == {"fauio": {"profile": "abc"}}
    with path.open("rb") as stream:
        assert next(NonSeekingReader(stream).iter_attachments()).data == b"x = 1"
