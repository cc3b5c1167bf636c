"""Fuzz targets of the monitor: what reaches the pipeline, operators and other monitors; files that users are given."""

from __future__ import annotations

import contextlib
import copy
import itertools
import json
import shutil
import socket
import sqlite3
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from fuzz_adapters import DATA, START_NS
from fuzz_input import ODD_VALUES, Draw, random_inputs
from fuzz_target import Run, Target, only

from adapters.logs.tlog import TlogReader
from adapters.message import Message, silence
from adapters.simulation.arm import SCENARIOS, simulate_arm
from adapters.simulation.arm_source import arm_messages
from gains.errors import ModelError
from gains.plants.model_file import read_model
from gains.synthesis.gains_file import read_gains
from monitor.bus.alarm_text import alarm_line
from monitor.bus.operators import VERBS, Operators
from monitor.bus.payload import estimate_json, to_json
from monitor.configuration.config import read_config
from monitor.configuration.toml_lines import key_lines
from monitor.errors import ProfileError
from monitor.event import AlarmEvent, valid_event
from monitor.pipeline import Pipeline, standing_message
from monitor.profile import Profile, read_profile
from monitor.recording.journal import Journal
from monitor.recording.record_encoder import RecordEncoder
from monitor.service.health import Health, ProcessHealth
from monitor.service.metrics_server import MetricsServer
from monitor.service.vehicle_monitor import VehicleMonitor
from replay.demonstration.arm_profile import write_arm_profile

ROOT = Path(__file__).parents[1]
QUAD = ROOT / "replay" / "data" / "quad"
_VEHICLE = "copter-1"
_EVENT = AlarmEvent(
    id="01J0000000000000000000ABCD",
    vehicle=_VEHICLE,
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


class _Sink:
    """Takes all that a vehicle's monitor says: encodes it as recording and publisher do."""

    def __init__(self, profile: Profile) -> None:
        pipeline = Pipeline(profile)
        self._encoder = RecordEncoder(pipeline.layouts)
        self._layouts = {layout.observer: layout for layout in pipeline.layouts}

    def message(self, message: Message) -> None:
        self._encoder.message(message)

    def estimate(self, estimate: Any) -> None:
        self._encoder.estimate(estimate)
        json.loads(to_json(estimate_json(self._layouts[estimate.observer], estimate)))

    def event(self, event: AlarmEvent) -> None:
        self._encoder.event(event)
        json.loads(to_json(event.to_json()))
        alarm_line(event)

    def status(self, status: Any) -> None:
        json.loads(to_json(status))

    def write(self, event: AlarmEvent, frame: Any = None) -> None:
        to_json(event.to_json())
        to_json(frame or {})

    def shelve(self, vehicle: str, channels: Mapping[str, int]) -> None:
        to_json(channels)

    def flush(self) -> None:
        """Keep nothing back."""

    def close(self) -> None:
        """Close nothing."""


def _monitor(profile: Profile, sink: _Sink) -> VehicleMonitor:
    pipeline = Pipeline(profile, _VEHICLE)
    return VehicleMonitor(pipeline, [sink], sink, sink.event, START_NS)


def flight() -> list[Message]:
    found = list(itertools.islice(TlogReader(DATA / "copter_5s.tlog.xz"), 1500))
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
            *(("operator", verb) for verb in (*VERBS, "rules", "x")),
            ("journal", "standing"),
            ("journal", "standing"),
            ("link", "signing"),
            ("clock", "silence"),
            ("zenoh", "a/b"),
        )
    )
    fields = draw.fields(3)
    if name == "standing":
        fields["alarms"] = [_event_json(draw) for _ in range(draw.number() % 4)]
    elif name == "rules" and draw.number() % 2:
        fields["alarms"] = {"motors": {"motor1": _numbers(draw)}, "arm": {"f_a": _numbers(draw), "f_s": draw.value()}}
    elif draw.number() % 2:
        fields["channel"] = draw.choice(("motors/motor1", "arm/f_a", "link/telemetry", "a/b/c", "/", ""))
    return Message(source, name, now_ns, fields, draw.number() % 2, 1)


def _numbers(draw: Draw) -> dict[str, Any]:
    keys = ("threshold", "clear", "critical", "raise_s", "clear_s", "fast", "slow", "slow_s", "latch_s")
    return {draw.choice(keys): draw.value() for _ in range(draw.number() % 5)}


def _event_json(draw: Draw) -> Any:
    """Return an event as it comes over a network: right, with odd fields, or none."""
    how = draw.number() % 8
    if how == 0:
        return draw.value()
    found = _EVENT.to_json()
    found["observer"], found["channel"] = draw.choice(
        (("motors", "motor1"), ("arm", "f_a"), ("link", "telemetry"), ("link", "signing"), ("monitor", "flood"))
    )
    found["vehicle"] = _VEHICLE
    for _ in range(draw.number() % 5):
        found[draw.choice(list(found))] = draw.value()
    return found


def _pipeline(profile: Profile, telemetry: Sequence[Message]) -> Run:
    sink = _Sink(profile)

    def run(data: bytes) -> None:
        draw = Draw(data)
        monitor = _monitor(profile, sink)
        at, now_ns = draw.number(2) % len(telemetry), START_NS
        if draw.number() % 2:
            monitor.speak(sink, START_NS)
        while draw.more:
            how = draw.number() % 16
            if how < 4:
                for _ in range((1, 4, 16, 64)[how]):
                    now_ns = max(now_ns, telemetry[at].received_ns)
                    monitor.take(telemetry[at])
                    at = (at + 1) % len(telemetry)
            elif how < 10:
                message = changed(draw, telemetry[at])
                for _ in range(1 + 4 * (draw.number() % 3)):
                    monitor.take(message)
                at = (at + 1) % len(telemetry)
            elif how == 10:
                now_ns += draw.number(5)
                monitor.take(silence(now_ns))
            elif how == 11:
                monitor.status(now_ns)
            elif how == 12:
                event = valid_event(_event_json(draw))
                if event is not None:
                    monitor.hear(event)
            elif how == 13:
                if monitor.speaks:
                    monitor.hush()
                else:
                    monitor.speak(sink, now_ns)
            else:
                monitor.take(own(draw, now_ns))
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


class _Query:
    """A query as Zenoh hands it over."""

    def __init__(self, verb: str, payload: bytes | None) -> None:
        self.key_expr = f"fauio/{_VEHICLE}/command/{verb}"
        self.payload = None if payload is None else _Payload(payload)
        self.answers: list[bytes] = []

    def reply(self, key: str, payload: bytes, encoding: object = None) -> None:
        self.answers.append(payload)

    def reply_err(self, payload: bytes) -> None:
        self.answers.append(payload)

    def __enter__(self) -> _Query:
        return self

    def __exit__(self, *_: object) -> None:
        """End the query."""


class _Payload(bytes):
    def to_bytes(self) -> bytes:
        return bytes(self)


def _commands(folder: Path) -> Run:
    profile = read_profile(QUAD)
    sink = _Sink(profile)
    asked: list[Callable[[Any], None]] = []
    session = SimpleNamespace(
        declare_queryable=lambda key, handler, complete: (
            asked.append(handler) or SimpleNamespace(undeclare=lambda: None)
        )
    )
    operators = Operators(session, f"fauio/{_VEHICLE}", VERBS)  # type: ignore[arg-type]

    def run(data: bytes) -> None:
        monitor = _monitor(profile, sink)
        monitor.speak(sink, START_NS, [_EVENT, replace(_EVENT, id="02", channel="motor2", latched=True)], 2)
        desk = monitor.pipeline.desk
        for now_ns, part in enumerate(data.split(b"\0"), START_NS):
            query = _Query((*VERBS, "none", "*")[part[0] % 6] if part else "ack", part[1:] or None)
            asked[0](query)
            for command in operators.pending():
                message = operators.message(command, now_ns)
                reason = desk.refusal(message.name, message.fields)
                if reason is not None:
                    operators.refuse(command, reason)
                    continue
                events = monitor.take(message)
                operators.accept(command, events[-1] if events else None)
            assert len(query.answers) == 1
            json.loads(query.answers[0])
            monitor.take(silence(now_ns + 1))
        monitor.status(START_NS)

    return run


def _command_seeds() -> list[bytes]:
    bodies = [
        b'{"id": "01J0000000000000000000ABCD", "by": "me", "reason": "\\ud800\\u001b[31m"}',
        b'{"channel": "motors/motor1", "minutes": 1e308}',
        b'{"channel": "motors/motor1", "minutes": ' + b"9" * 400 + b"}",
        b'{"channel": "motor2", "minutes": NaN}',
        b'{"channel": "/"}',
        b"[" * 4000,
    ]
    return [bytes([k]) + one for k in range(6) for one in bodies] + [
        b"\1" + bodies[1] + b"\0\2" + bodies[1] + b"\0\3" + bodies[3]
    ]


def _subscriber(folder: Path) -> Run:
    journal = Journal(folder / "events.sqlite", max_events=500)
    profile = read_profile(QUAD)
    sink = _Sink(profile)

    def run(data: bytes) -> None:
        if data[:1] == b"\0":
            draw = Draw(data[1:])
            payloads = [_event_json(draw) for _ in range(3)]
        else:
            try:
                found = json.loads(data)
            except (ValueError, RecursionError):
                return
            payloads = found if isinstance(found, list) else [found]
        monitor = _monitor(profile, sink)
        for payload in payloads:
            event = valid_event(payload)
            if event is None:
                continue
            alarm_line(event)
            journal.write(event, payload)
            monitor.hear(replace(event, vehicle=_VEHICLE))
        monitor.speak(sink, START_NS, journal.active(_VEHICLE), journal.last_seq(_VEHICLE))
        monitor.take(silence(START_NS + 10**12))
        monitor.status(START_NS)

    return run


def _event_seeds() -> list[bytes]:
    right = _EVENT.to_json()
    odd = [{**right, name: value} for name in right for value in ODD_VALUES[7:40:3]]
    return [
        to_json(right),
        to_json([right, right]),
        *(json.dumps(one).encode() for one in odd),
        *(b"\0" + one for one in random_inputs(40)),
    ]


def _journal(folder: Path) -> Run:
    base = folder / "base.sqlite"
    journal = Journal(base)
    for seq in range(1, 30):
        journal.write(replace(_EVENT, seq=seq, id=f"id{seq % 5}"), {"u": {"a": 1.0}})
    journal.close()
    with contextlib.closing(sqlite3.connect(base)) as connection:
        connection.execute("PRAGMA journal_mode = DELETE")
    content = base.read_bytes()

    def run(data: bytes) -> None:
        draw = Draw(data)
        for old in folder.glob("one.sqlite*"):
            old.unlink()
        path = folder / "one.sqlite"
        path.write_bytes(draw.edited(content, 30) if draw.number() % 4 else draw.rest())
        with only(ProfileError):
            damaged = Journal(path)
            with only(OSError):
                profile_alarms = damaged.active(_VEHICLE)
                assert all(isinstance(event, AlarmEvent) for event in profile_alarms)
                standing_message(profile_alarms, damaged.last_seq(_VEHICLE), START_NS)
                damaged.events()
                damaged.frame("id1")
            damaged.write(replace(_EVENT, seq=1000))
            damaged.retry()
            damaged.statistics()
            damaged.close()

    return run


def _metrics(folder: Path) -> Run:
    server = MetricsServer("127.0.0.1:0", lambda: Health(ProcessHealth()))

    def run(data: bytes) -> None:
        with socket.create_connection(("127.0.0.1", server.port), timeout=5.0) as client, contextlib.suppress(OSError):
            client.sendall(data)
            client.shutdown(socket.SHUT_WR)
            answer = b""
            while piece := client.recv(1 << 16):
                answer += piece
            assert not answer or answer.startswith(b"HTTP/1.1 ")

    return run


def _http_seeds() -> list[bytes]:
    lines = (
        "GET /metrics HTTP/1.1",
        "HEAD /healthz HTTP/1.0",
        "POST / HTTP/1.1",
        "GET  HTTP/1.1",
        "x",
        "GET /metrics?a=b HTTP/1.1",
    )
    more = "\r\nHost: x\r\nAccept: application/openmetrics-text;version=1.0.0;q=0.5,*/*;q=0.1\r\n\r\n"
    return [*((line + more).encode() for line in lines), b"GET " + b"x" * 9000, b"", b"\r\n\r\n", b"\xff\r\n\r\n"]


def _toml(folder: Path) -> Run:
    path = folder / "config.toml"

    def run(data: bytes) -> None:
        path.write_bytes(data)
        key_lines(data.decode(errors="replace"))
        try:
            read_config(path)
        except ProfileError as error:
            assert all(line.startswith(("/", "command line")) for line in str(error).split("\n")), str(error)

    return run


def _toml_seeds() -> list[bytes]:
    example = (ROOT / "docs" / "config-example.toml").read_bytes()
    parts = [b"\n".join(example.split(b"\n")[k : k + 12]) for k in range(0, example.count(b"\n"), 8)]
    odd = [
        b"a = " + b"[" * 480 + b"]" * 480,
        b"mavlink = " + b"[" * 300 + b"]" * 300,
        b"a = " + b"[" * 5000,
        b"a = " + b"9" * 5000,
        b"a" + b".a" * 1500 + b" = 1",
        b"x = " + b"{a=" * 300 + b"1" + b"}" * 300,
        b'[[vehicle]]\nname = "a"\n[[vehicle]]\nname = "a"\n',
        b"prefix = 1\nmavlink = [1, 2020-01-01, 0x10, inf, nan]\n[metrics]\n",
        b'"\\ud800" = 1\n',
        b"recording = 5\n[recording.x]\n",
    ]
    return [example, *parts, *odd]


def _profile(folder: Path) -> Run:
    good = folder / "good"
    write_arm_profile(good)
    one = folder / "one"
    shutil.copytree(good, one)
    names = sorted(path.name for path in one.iterdir())
    contents = {name: (good / name).read_bytes() for name in names}

    def run(data: bytes) -> None:
        draw = Draw(data)
        name = draw.choice(names)
        content = draw.edited(contents[name]) if draw.number() % 2 else draw.rest()
        (one / name).write_bytes(content)
        try:
            with only(ProfileError):
                Pipeline(read_profile(one)).feed(silence(START_NS))
        finally:
            (one / name).write_bytes(contents[name])

    return run


def _profile_seeds() -> list[bytes]:
    text = (QUAD / "profile.toml").read_bytes()
    return [bytes([2, 0]) + text[:3000], *(bytes([k % 3, 1]) + one for k, one in enumerate(random_inputs(40, 120)))]


def _model(folder: Path) -> Run:
    model, gains = folder / "one.toml", folder / "one.json"

    def run(data: bytes) -> None:
        path, read = (model, read_model) if data[:1] != b"{" else (gains, read_gains)
        path.write_bytes(data)
        with only(ModelError):
            read(path)

    return run


def _model_seeds() -> list[bytes]:
    models = [(ROOT / "gains" / "models" / f"{name}.toml").read_bytes() for name in ("arm", "arm-disturbed")]
    frame = (
        'name = "m"\nstates = ["x", "y"]\noutputs = ["x"]\nA = [[0.0, 1.0], [0.0, 0.0]]\nC = [[1.0, 0.0]]\n'
        '[[nonlinearity]]\nexpression = "%s"\narguments = { %s }\ninto = "y"\n'
    )
    several = ", ".join(f"{name} = {{ x = 1.0 }}" for name in "abcdefgh")
    texts = [
        frame % ("sin(" * 38 + "a" + ")" * 38, "a = { x = 1.0 }"),
        frame % ("exp(cos(" * 15 + "a*a" + "))" * 15, "a = { x = 1.0 }"),
        frame % ("sin(a*b)*cos(c*d)*tanh(e*f)*atan(g*h)", several),
        frame % ("a**0.5 + 1/a", "a = { x = 1.0 }"),
        frame % ("1/sin(a)", "a = { x = 1.0 }"),
    ]
    gains = json.loads((QUAD / "motors.motor1.gains.json").read_text())
    small = copy.deepcopy(gains) | {"report": {}}
    for key in [key for key, value in gains.items() if isinstance(value, dict) and "rows" in value]:
        small[key] = {"shape": [0, 0], "rows": []}
    odd = [
        json.dumps(small | {key: value}).encode()
        for key in ("rate_hz", "K", "faults", "input_taps")
        for value in ([], None, 10**400, {"shape": [1 << 40, 0], "rows": []}, {"shape": [-1, 1], "rows": [[1]]})
    ]
    return [*models, *(text.encode() for text in texts), json.dumps(small).encode(), *odd]


TARGETS = (
    Target("commands", "operators' commands: queries with any payload", _commands, _command_seeds),
    Target("subscriber", "alarm events from other monitors", _subscriber, _event_seeds),
    Target(
        "pipeline-quad",
        "messages with arbitrary fields, times and senders through a quadrotor's monitor",
        _quad,
        _pipeline_seeds,
        256,
        slow_s=5.0,
    ),
    Target("pipeline-arm", "the same through the reference arm's", _arm, _pipeline_seeds, 256, 5.0),
    Target("journal", "a damaged journal", _journal, lambda: random_inputs(60)),
    Target("metrics", "HTTP requests", _metrics, _http_seeds, 1 << 14),
    Target("config", "the daemon's configuration, and on which line of it keys stand", _toml, _toml_seeds, 1 << 13),
    Target("profile", "a profile's folder", _profile, _profile_seeds),
    Target("model", "model files and gains files", _model, _model_seeds, slow_s=10.0),
)
