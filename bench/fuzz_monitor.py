"""Fuzz targets of what the monitor hears from others: operators' commands, alarm events, a journal, HTTP."""

from __future__ import annotations

import contextlib
import json
import socket
import sqlite3
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from fuzz_adapters import START_NS
from fuzz_input import ODD_VALUES, Draw, random_inputs
from fuzz_pipeline import EVENT, QUAD, VEHICLE, Sink, event_json, silent_monitor
from fuzz_target import Run, Target, only

from adapters.batch import pack
from adapters.errors import StorageError, printable
from adapters.message import silence
from monitor.bus.alarm_text import alarm_line
from monitor.bus.operators import VERBS, Operators
from monitor.bus.payload import to_json
from monitor.bus.status_watch import valid_status
from monitor.event import AlarmEvent, valid_event
from monitor.pipeline import handover_message
from monitor.profile import read_profile
from monitor.recording.journal import Journal
from monitor.service.health import Health, ProcessHealth
from monitor.service.metrics_server import MetricsServer


class _Query:
    """A query as Zenoh hands it over."""

    def __init__(self, verb: str, payload: bytes | None) -> None:
        self.key_expr = f"fauio/{VEHICLE}/command/{verb}"
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
    sink = Sink(profile)
    asked: list[Callable[[Any], None]] = []
    session = SimpleNamespace(
        declare_queryable=lambda key, handler, complete: (
            asked.append(handler) or SimpleNamespace(undeclare=lambda: None)
        )
    )
    operators = Operators(session, f"fauio/{VEHICLE}", VERBS)  # type: ignore[arg-type]

    def run(data: bytes) -> None:
        monitor = silent_monitor(profile, sink)
        monitor.activate(sink, START_NS, [EVENT, replace(EVENT, id="02", channel="motor2", latched=True)], 2)
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
                events = monitor.process(pack([message]))
                operators.accept(command, events[-1] if events else None)
            assert len(query.answers) == 1
            json.loads(query.answers[0])
            monitor.process(pack([silence(now_ns + 1)]))
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
    sink = Sink(profile)

    def run(data: bytes) -> None:
        if data[:1] == b"\0":
            draw = Draw(data[1:])
            payloads = [event_json(draw) for _ in range(3)]
        else:
            try:
                found = json.loads(data)
            except (ValueError, RecursionError):
                return
            payloads = found if isinstance(found, list) else [found]
        monitor = silent_monitor(profile, sink)
        for payload in payloads:
            event = valid_event(payload)
            if event is None:
                continue
            alarm_line(event)
            journal.write(event, payload)
            monitor.on_peer_event(replace(event, vehicle=VEHICLE))
        monitor.activate(sink, START_NS, journal.active(VEHICLE), journal.last_seq(VEHICLE))
        monitor.process(pack([silence(START_NS + 10**12)]))
        monitor.status(START_NS)

    return run


def _event_seeds() -> list[bytes]:
    right = EVENT.to_json()
    odd = [{**right, name: value} for name in right for value in ODD_VALUES[7:40:3]]
    return [
        to_json(right),
        to_json([right, right]),
        *(json.dumps(one).encode() for one in odd),
        *(b"\0" + one for one in random_inputs(40)),
    ]


def _status(folder: Path) -> Run:
    def run(data: bytes) -> None:
        try:
            found = Draw(data[1:]).fields() if data[:1] == b"\0" else json.loads(data)
        except (ValueError, RecursionError):
            return
        status = valid_status(VEHICLE, found)
        if status is not None:
            assert len(status.line()) < 4000
            assert len(status.kind) < 20
            printable(status.line()).encode(errors="replace")

    return run


def _status_seeds() -> list[bytes]:
    right: dict[str, Any] = {"state": "degraded", "reasons": ["motors watches nothing: no HIGHRES_IMU", "2.5 s behind"]}
    odd = [{**right, name: value} for name in right for value in ODD_VALUES]
    return [*(json.dumps(one).encode() for one in (right, [right], *odd)), *(b"\0" + one for one in random_inputs(40))]


def _journal(folder: Path) -> Run:
    base = folder / "base.sqlite"
    journal = Journal(base)
    for seq in range(1, 30):
        journal.write(replace(EVENT, seq=seq, id=f"id{seq % 5}"), {"u": {"a": 1.0}})
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
        with only(StorageError):
            damaged = Journal(path)
            with only(OSError):
                profile_alarms = damaged.active(VEHICLE)
                assert all(isinstance(event, AlarmEvent) for event in profile_alarms)
                handover_message(profile_alarms, damaged.last_seq(VEHICLE), START_NS)
                damaged.events()
                damaged.frame("id1")
            damaged.write(replace(EVENT, seq=1000))
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


TARGETS = (
    Target("commands", "operators' commands: queries with any payload", _commands, _command_seeds),
    Target("subscriber", "alarm events from other monitors", _subscriber, _event_seeds),
    Target("status", "how other vehicles' monitors are doing", _status, _status_seeds),
    Target("journal", "a damaged journal", _journal, lambda: random_inputs(60)),
    Target("metrics", "HTTP requests", _metrics, _http_seeds, 1 << 14),
)
