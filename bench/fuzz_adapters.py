"""Fuzz targets of live telemetry: links, payloads, definitions, keys."""

from __future__ import annotations

import contextlib
import itertools
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from unittest import mock

import zenoh
from fuzz_input import Draw, random_inputs
from fuzz_target import Run, Target, only
from pymavlink.dialects.v20 import ardupilotmega
from pymavlink.generator.mavcrc import x25crc

from adapters.batch import messages
from adapters.channels import parse_channel
from adapters.encoding.cdr import CdrDecoder
from adapters.encoding.message_definition import SHIPPED, find_definition
from adapters.encoding.message_record import decoder, encode
from adapters.errors import PayloadError, TelemetryError, UndefinedTypeError
from adapters.logs.tlog import TlogReader
from adapters.mavlink import mavlink_link
from adapters.mavlink.mavlink_columns import dialect
from adapters.mavlink.packets import PacketList, PacketScanner
from adapters.mavlink.signing import SigningGuard, SigningKey, read_key
from adapters.message import Message
from adapters.source import ZENOH
from adapters.zenoh.zenoh_payload import PayloadDecoder

DATA = Path(__file__).parents[1] / "tests" / "data"
START_NS = 1_795_251_917_000_000_000
_KEY = SigningKey(bytes(range(32)))
_NUMBERS = sorted(ardupilotmega.mavlink_map)
_SHIPPED = sorted(f"{path.parent.name}/msg/{path.stem}" for path in SHIPPED.rglob("*.msg"))
_OWN_DEFINITION = """bool flag
uint8 a
uint64 b
int16[3] c
string e
Inner[] inner
Inner[2] pair
string[] texts
int64[<=4] few
Empty empty
===
MSG: x_msgs/Inner
uint8 id
float64 value
===
MSG: x_msgs/Empty
"""


_CHANNELS = [
    parse_channel("c", {"message": "m", "field": field, **more}, "")
    for field, more in (
        ("data[1]", {}),
        ("position[elbow]", {"scale": 2.0}),
        ("linear_acceleration.x", {"clock": "header.stamp"}),
        ("roll", {"clock": "time_usec", "where": {"name": "arm", "port": 0}}),
    )
]


def packet(draw: Draw) -> bytes:
    """Return a MAVLink packet whose checksum is right and whose content is anything."""
    number, flags = draw.choice(_NUMBERS), draw.number()
    table = ardupilotmega.mavlink_map[number]
    length = table.unpacker.size if flags & 4 else draw.number()
    ids = draw.take(3).ljust(3, b"\1")
    payload = draw.take(length).ljust(length, b"\0")
    if flags & 1 and number < 256:
        head = bytes([length]) + ids + bytes([number])
        magic = b"\xfe"
    else:
        signed = flags >> 1 & 1
        head = bytes([length, signed, 0]) + ids + number.to_bytes(3, "little")
        magic = b"\xfd"
    crc = x25crc(head + payload + bytes([table.crc_extra])).crc
    whole = magic + head + payload + struct.pack("<H", crc)
    if magic == b"\xfd" and head[1]:
        whole += bytes([flags >> 6]) + draw.take(6).ljust(6, b"\0")
        whole += _KEY.signature(whole) if flags & 8 else draw.take(6).ljust(6, b"\0")
    return whole


def stream(draw: Draw) -> bytes:
    """Return a stream of bytes: whatever comes, or packets with right checksums and something between them."""
    if draw.number() & 1:
        return draw.rest()
    parts = []
    while draw.more:
        parts += [packet(draw), draw.take(draw.number() % 8)]
    return b"".join(parts)


def cut(draw: Draw, data: bytes) -> list[bytes]:
    """Return bytes in pieces, cut anywhere."""
    places = sorted(draw.number(2) % (len(data) + 1) for _ in range(draw.number() % 6))
    return [data[a:b] for a, b in itertools.pairwise([0, *places, len(data)])]


class _Pieces:
    """A byte link that gives what it was given."""

    connections, overruns, stamps_arrivals = 1, 0, True

    def __init__(self) -> None:
        self.waiting: list[Any] = []

    def read(self, timeout_s: float) -> Any:
        return [self.waiting.pop(0)] if self.waiting else []

    def write(self, data: bytes, to: Iterable[Any]) -> None:
        """Send nothing."""

    def close(self) -> None:
        """Close nothing."""


def _mavlink(folder: Path) -> Run:
    links = []
    for guard in (None, SigningGuard(_KEY, require_signed=False), SigningGuard(_KEY)):
        pieces = _Pieces()
        with mock.patch.object(mavlink_link, "open_byte_link", return_value=pieces):
            links.append((mavlink_link.MavlinkLink("udpin:", guard, may_send=True), pieces))

    def run(data: bytes) -> None:
        draw = Draw(data)
        link, pieces = links[draw.number() % 3]
        step_ns = draw.number(4) * (draw.number(2) - 1000)
        sender = draw.number(2)
        places = draw.take(8)
        content = stream(draw)
        parts = cut(Draw(places), content)
        whole, apart = PacketScanner(dialect()), PacketScanner(dialect())
        packets, packets_apart = PacketList(dialect()), PacketList(dialect())
        whole.scan(content, packets)
        for part in parts:
            apart.scan(part, packets_apart)
        assert packets_apart.items() == packets.items()
        assert (apart.skipped_bytes, apart.unknown) == (whole.skipped_bytes, whole.unknown)
        pieces.waiting = [(sender, part, START_NS + step_ns) for part in parts]
        for message in messages(link.receive(0.0)):
            record = encode(message)
            decode = decoder(record.topic, record.encoding, record.schema)
            decode(record.data, record.time_ns)
        link.statistics()

    return run


def _stream_seeds() -> list[bytes]:
    log = itertools.islice(TlogReader(DATA / "copter_5s.tlog.xz").packets(), 400)
    flight = [one for _, one in log]
    head = bytes(17)
    cuts = bytes([2, 0, 0, 0, 0, 0, 0, 5, 3, 0, 60, 0, 99, 0, 0, 0, 0])
    junk = (b"\xfe", b"\xfd\xff\0\0\0", b"\xfe\0", b"\xfe\xfe\xfe\xfe\xfe\x6e")
    long = [head + b"\1" + (one * 4_000)[:4_000] for one in junk]
    return [
        *long,
        *(cuts + b"\1" + b"".join(flight[k : k + 12]) for k in range(0, 400, 12)),
        *(cuts + b"\0" + one for one in random_inputs(60)),
    ]


def _key(folder: Path) -> Run:
    path = folder / "key"
    path.touch(mode=0o600)

    def run(data: bytes) -> None:
        path.write_bytes(data)
        with only(TelemetryError):
            read_key(path)

    return run


def _zenoh(folder: Path) -> Run:
    payloads = PayloadDecoder({"typed/**": "sensor_msgs/msg/JointState"})
    keys = ("arm/telemetry", "typed/a", "0/chatter/sensor_msgs::msg::dds_::Imu_/RIHS01_ab", "@x")
    encodings = ("application/json", "application/cdr", "application/cdr;nav_msgs/msg/Odometry", "zenoh/bytes", "")

    def run(data: bytes) -> None:
        draw = Draw(data)
        key, encoding = draw.choice(keys), draw.choice(encodings)
        if draw.number() % 4 == 0:
            key, encoding = draw.block().decode(errors="replace"), draw.block().decode(errors="replace")
            try:
                zenoh.KeyExpr(key)
            except zenoh.ZError:
                return
        with only(UndefinedTypeError, PayloadError):
            name, fields = payloads.decode(key, encoding, draw.rest())
            _read_channels(fields)
            with contextlib.suppress(ValueError):
                encode(Message(ZENOH, name, START_NS, fields))

    return run


def _read_channels(fields: dict[str, Any]) -> None:
    for channel in _CHANNELS:
        channel.selects(fields)
        channel.value(fields)
        channel.stamp_ns(fields)


def _zenoh_seeds() -> list[bytes]:
    deep = b'{"header":{"stamp":' + b'{"sec":' * 900 + b"1" + b"}" * 902
    telemetry = [
        b'{"time_ns": 5, "data": [1.5, NaN, Infinity, 1e999]}',
        b'{"header":{"stamp":{"sec":1,"nanosec":2}},"name":["elbow"],"position":[1]}',
        b'{"time_usec": 12, "roll": 1, "name": "arm", "port": 0}',
        b'{"a":' + b"[" * 980 + b"]" * 980 + b"}",
        deep,
        b'{"x": ' + b"9" * 5000 + b"}",
        b'{"time_ns": ' + b"9" * 400 + b'.0, "data": [0, ' + b"9" * 400 + b"]}",
        b"\xff\xfe{}",
    ]
    key = b"0/a/" + b"::" * 15_000
    hostile = bytes([0, 0, 0]) + len(key).to_bytes(2, "little") + key + b"\0\0{}"
    imu = b"\0\1\0\0" + bytes(330)
    return [
        hostile,
        *(bytes([0, 0, 1]) + one for one in telemetry),
        *(bytes([2, 1, 1]) + one for one in (imu, imu[:40], b"\0\0\0\0" + bytes(400))),
        *(bytes([1, 1, 1]) + b"\0\1\0\0" + bytes(8) + b"\1\0\0\0\0\0\0\0" + one for one in random_inputs(20)),
    ]


def _cdr(folder: Path) -> Run:
    decoders = [CdrDecoder(name, find_definition(name, [])) for name in _SHIPPED]
    decoders += [
        CdrDecoder("x_msgs/Mixed", _OWN_DEFINITION),
        CdrDecoder("px4_msgs/Mixed", _OWN_DEFINITION.replace("x_", "px4_")),
    ]

    def run(data: bytes) -> None:
        for decode in [Draw(data).choice(decoders)] if data[:1] < b"\xf0" else decoders:
            with only(PayloadError):
                _read_channels(decode.decode(data[1:]))

    return run


def _cdr_seeds() -> list[bytes]:
    bodies = [bytes(4), bytes(64), bytes(800), b"\xff" * 40, b"\1\0\0\0" * 60, *random_inputs(20)]
    return [
        bytes([k]) + order + one
        for k in (*range(20), 0xF0)
        for order in (b"\0\1\0\0", b"\0\0\0\0")
        for one in bodies[:5]
    ] + [b"\xf0\0\1\0\0" + one for one in bodies]


def _definition(folder: Path) -> Run:
    def run(data: bytes) -> None:
        text, _, payload = data.partition(b"\0")
        with only(TelemetryError, PayloadError):
            CdrDecoder("x_msgs/Mixed", text.decode(errors="replace")).decode(b"\0\1\0\0" + payload)

    return run


def _definition_seeds() -> list[bytes]:
    texts = [find_definition(name, []).encode() for name in _SHIPPED]
    empty = b"Inner[] inner\n===\nMSG: x_msgs/Inner\nuint8[0] a\0\xff\xff\xff\xff"
    huge = b"Inner[999999999] inner\n===\nMSG: x_msgs/Inner\nuint8[0] a\0"
    wide = b"A[9999999] a\n===\nMSG: x_msgs/A\nB[9999999] b\n===\nMSG: x_msgs/B\nfloat64[999999999] c\0\0"
    return [*(one + b"\0" + bytes(300) for one in (*texts, _OWN_DEFINITION.encode())), empty, huge, wide]


TARGETS = (
    Target("mavlink", "MAVLink streams cut anywhere, signed or not, to messages and records", _mavlink, _stream_seeds),
    Target("zenoh", "Zenoh payloads of any key and encoding", _zenoh, _zenoh_seeds, 1 << 15),
    Target("cdr", "CDR payloads of every shipped type", _cdr, _cdr_seeds),
    Target("definition", "message definitions, and CDR by them", _definition, _definition_seeds),
    Target(
        "key", "signing key files", _key, lambda: [b"0" * 64, b"pass phrase\n", bytes(32), b"", b"\xff" * 5000], 1 << 13
    ),
)
