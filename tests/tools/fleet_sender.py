"""Sends recorded flights as if live, several vehicles at once, each under a system id of its own, again and again.

    python tests/tools/fleet_sender.py udp:HOST:PORT 1=FLIGHT 2=FLIGHT ... [--seconds S] [--key FILE]

A log that has ended begins anew, like a vehicle that was switched off and on: in each turn its clock starts at zero.
Each vehicle has a socket of its own, as vehicles do. At the end the number of packets sent for each is printed as JSON.
"""

from __future__ import annotations

import argparse
import contextlib
import heapq
import itertools
import json
import os
import signal
import socket
import sys
import threading
import time
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from packet_edit import readdressed, set_back, signed, stamp_ns_of

from adapters.errors import FauioError, TelemetryError
from adapters.logs.tlog import TlogReader
from adapters.mavlink.byte_link import resolve
from adapters.mavlink.mavlink_message import mavlink_types, message_number, packet_sender
from adapters.mavlink.signing import SigningKey, read_key, unix_stamp
from adapters.simulation.pacing import paced

_PAUSE_NS = 10_000_000
"""Between the end of a flight and its next turn: a sample of 100 Hz."""
_CATCH_UP_S = 0.5
"""A sender that was stopped for longer goes on in real time, in place of a burst that no vehicle sends."""
_BOOT_NS = 500_000_000
"""What the clock of a vehicle shows that has just been switched on; in flight any other step back is no reboot."""

Due = tuple[int, bytes]


@dataclass(frozen=True, slots=True)
class SentFlight:
    """What one vehicle sends.

    Parameters
    ----------
    system : int
        Its system id.
    packets : Sequence[Due]
        When each packet is due, nanoseconds after the first one, and the packet.
    """

    system: int
    packets: Sequence[Due]


def read_flight(
    path: str | os.PathLike[str], system: int, start_s: float = 0.0, stop_s: float | None = None
) -> SentFlight:
    """Return the packets of the vehicle that a log is of, which is the one that most packets are from.

    Parameters
    ----------
    path : str | PathLike
        Telemetry log, plain or compressed.
    system : int
        System id to send them under.
    start_s, stop_s : float, float | None
        Part of the log, seconds after its first packet.

    Raises
    ------
    TelemetryError
        The log cannot be read, or that part of it holds nothing.
    """
    if not 1 <= system <= 255:
        raise TelemetryError(f"system {system}: MAVLink ids are 1 to 255")
    records = [record for record in TlogReader(path).packets() if message_number(record[1]) in mavlink_types()]
    own = Counter(packet_sender(packet)[0] for _, packet in records).most_common(1)[0][0]
    first_ns = records[0][0] + round(start_s * 1e9)
    stop_ns = first_ns + round((stop_s - start_s) * 1e9) if stop_s is not None else None
    chosen = [
        (due_ns - first_ns, readdressed(packet, system, 0))
        for due_ns, packet in records
        if packet_sender(packet)[0] == own and first_ns <= due_ns and (stop_ns is None or due_ns < stop_ns)
    ]
    if not chosen:
        raise TelemetryError(f"{path}: holds nothing between {start_s:g} s and {stop_s or 0:g} s")
    return SentFlight(system, chosen)


def fleet_packets(
    flights: Iterable[SentFlight], seconds: float | None = None
) -> Iterator[tuple[int, tuple[int, bytes]]]:
    """Return what several vehicles send, in the order of time.

    Parameters
    ----------
    flights : Iterable[SentFlight]
        The vehicles; they begin together.
    seconds : float | None
        Repeat each flight until then; None sends each once.

    Yields
    ------
    tuple[int, tuple[int, bytes]]
        Nanoseconds after the beginning, system id and packet. Each system and component counts its packets.
    """
    sequence: Counter[tuple[int, int]] = Counter()
    for due_ns, (system, packet) in heapq.merge(*(_repeated(one, seconds) for one in flights)):
        sender = packet_sender(packet)
        yield due_ns, (system, readdressed(packet, system, sequence[sender] & 0xFF))
        sequence[sender] += 1


def _repeated(flight: SentFlight, seconds: float | None) -> Iterator[tuple[int, tuple[int, bytes]]]:
    loop_ns = flight.packets[-1][0] + _PAUSE_NS
    packets = flight.packets if seconds is None else _switched_on(flight.packets)
    for loop in itertools.count() if seconds is not None else (0,):
        for due_ns, packet in packets:
            if seconds is not None and loop * loop_ns + due_ns >= seconds * 1e9:
                return
            yield loop * loop_ns + due_ns, (flight.system, packet)


def _switched_on(packets: Sequence[Due]) -> Sequence[Due]:
    """Return the packets as of a vehicle that was switched on just before the first of them."""
    first_ns = next((stamp for _, packet in packets if (stamp := stamp_ns_of(packet)) is not None), _BOOT_NS)
    return [(due_ns, set_back(packet, first_ns - _BOOT_NS)) for due_ns, packet in packets]


class Signer:
    """Signs packets at the time they are sent, with time stamps that increase.

    Parameters
    ----------
    key : SigningKey
        The key.
    clock : Callable[[], int]
        Unix time, nanoseconds.
    """

    def __init__(self, key: SigningKey, clock: Callable[[], int] = time.time_ns) -> None:
        self._key = key
        self._clock = clock
        self._stamp = 0

    def __call__(self, packet: bytes) -> bytes:
        """Return the packet with its signature."""
        self._stamp = max(self._stamp + 1, unix_stamp(self._clock()))
        return signed(packet, self._key, self._stamp)


def send_fleet(
    packets: Iterable[tuple[int, tuple[int, bytes]]],
    to: str,
    speed: float = 1.0,
    *,
    signer: Signer | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> dict[int, array[int]]:
    """Send packets when they are due, one per datagram; return the Unix time of each, nanoseconds, by system id.

    Where the sender itself is held up for longer than half a second it goes on from there, without a burst.

    Parameters
    ----------
    packets : Iterable[tuple[int, tuple[int, bytes]]]
        As :func:`fleet_packets` returns them.
    to : str
        ``udp:HOST:PORT``.
    speed : float
        Times real time.
    signer : Signer | None
        Signs them.
    stopped : Callable[[], bool]
        Ends it early.

    Raises
    ------
    TelemetryError
        The address is not understood, or the speed is not positive.
    """
    kind, _, host_port = to.partition(":")
    if kind not in ("udp", "udpout"):
        raise TelemetryError(f"{to}: use udp:HOST:PORT")
    family, address = resolve(to, host_port)
    sent: dict[int, array[int]] = {}
    with contextlib.ExitStack() as stack:
        sockets: dict[int, socket.socket] = {}
        for system, packet in paced(packets, speed, _CATCH_UP_S):
            if stopped():
                break
            if system not in sockets:
                sockets[system] = stack.enter_context(socket.socket(family, socket.SOCK_DGRAM))
                sent[system] = array("q")
            data = packet if signer is None else signer(packet)
            sent[system].append(time.time_ns())
            sockets[system].sendto(data, address)
    return sent


def write_times(sent: Mapping[int, array[int]], folder: Path) -> None:
    """Write the Unix times of the packets of each system, eight bytes each, into ``FOLDER/SYSTEM.sent``."""
    folder.mkdir(parents=True, exist_ok=True)
    for system, times in sent.items():
        (folder / f"{system}.sent").write_bytes(times.tobytes())


@contextlib.contextmanager
def _interruptible() -> Iterator[Callable[[], bool]]:
    """Let SIGTERM and SIGINT only be noted; yield what tells whether one came."""
    came = threading.Event()
    before = {number: signal.signal(number, lambda *_: came.set()) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield came.is_set
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def main(argv: Sequence[str] | None = None) -> int:
    """Run from the command line; return the exit status."""
    parser = argparse.ArgumentParser(prog="python tests/tools/fleet_sender.py", description=__doc__)
    parser.add_argument("to", help="udp:HOST:PORT")
    parser.add_argument("flights", nargs="+", metavar="SYSTEM=LOG", help="telemetry log and system id to send it under")
    parser.add_argument("--speed", type=float, default=1.0, help="times real time (default 1)")
    parser.add_argument("--seconds", type=float, metavar="S", help="repeat the flights until then (default: once)")
    parser.add_argument("--start", type=float, default=0.0, metavar="S", help="seconds of each log to leave out")
    parser.add_argument("--stop", type=float, metavar="S", help="second of each log to stop at")
    parser.add_argument("--key", metavar="FILE", help="sign the packets with this key")
    parser.add_argument("--times", type=Path, metavar="FOLDER", help="write the Unix time of each packet there")
    args = parser.parse_args(argv)
    try:
        signer = Signer(read_key(args.key)) if args.key else None
        pairs = [text.partition("=") for text in args.flights]
        if wrong := [text for text, (system, _, _) in zip(args.flights, pairs, strict=True) if not system.isdecimal()]:
            raise TelemetryError(f"{wrong[0]}: use SYSTEM=LOG, like 1=flight.tlog")
        flights = [read_flight(log, int(system), args.start, args.stop) for system, _, log in pairs]
        packets = fleet_packets(flights, args.seconds)
        with _interruptible() as stopped:
            sent = send_fleet(packets, args.to, args.speed, signer=signer, stopped=stopped)
    except FauioError as error:
        print(f"fleet_sender: {error}", file=sys.stderr)  # noqa: T201 - the command line speaks here
        return error.exit_status
    if args.times is not None:
        write_times(sent, args.times)
    counts = {system: len(sent.get(system, ())) for system in sorted(one.system for one in flights)}
    print(json.dumps(counts))  # noqa: T201 - the command line speaks here
    return 0


if __name__ == "__main__":
    sys.exit(main())
