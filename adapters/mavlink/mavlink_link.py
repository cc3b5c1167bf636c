"""Live MAVLink: packets from a UDP, TCP or serial link -> batches. It sends only where it may."""

from __future__ import annotations

import time
from array import array
from collections import Counter, OrderedDict
from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass

from adapters.batch import Batch, joined, pack
from adapters.errors import TelemetryError
from adapters.mavlink.byte_link import open_byte_link
from adapters.mavlink.mavlink_columns import decoded
from adapters.mavlink.mavlink_message import MavlinkType, PacketParser, mavlink_types, packet_sender, packet_sequence
from adapters.mavlink.message_rates import RateRequests
from adapters.mavlink.signing import SigningGuard, SigningStatistics

# Senders whose unfinished packets are kept apart; more are unlikely, and none can exhaust memory.
_SENDERS = 64
_PIECES = 1024
"""Pieces of one batch: a flood of junk must not keep the caller here."""
_ANSWER_NS = 10_000_000_000
# Further behind than networks reorder, a packet is the first after a restart or a long gap.
_REORDERED = 32
_SETTLING_NS = 1_000_000_000
# It carries the secret that packets are signed with, and everything given out here is recorded.
_SECRET = "SETUP_SIGNING"  # noqa: S105 - the name of a message


@dataclass(frozen=True, slots=True)
class MavlinkLinkStatistics:
    """What came over a link so far.

    Parameters
    ----------
    messages : int
        Messages received, refused ones not among them.
    lost : int
        Packets missing by the sequence numbers of each system and component. A router that passes on only some of
        the messages makes the others count as lost; a gap of more than 127 packets counts as none.
    lost_by_system : Mapping[int, int]
        The same of each system that lost any.
    unknown : int
        Packets of messages that are not in the dialect.
    damaged, skipped_bytes : int
        Places with bytes that belong to no intact packet, and those bytes.
    connections : int
        How often a connection was made.
    overruns : int
        UDP datagrams that the kernel dropped because they were not read in time.
    signing : SigningStatistics
        Packets refused for their signature; all zero without a key.
    """

    messages: int
    lost: int
    lost_by_system: Mapping[int, int]
    unknown: int
    damaged: int
    skipped_bytes: int
    connections: int
    overruns: int
    signing: SigningStatistics


class MavlinkLink:
    """An open link.

    Parameters
    ----------
    url : str
        See :func:`adapters.mavlink.byte_link.open_byte_link`.
    guard : SigningGuard | None
        Refuses packets for their signatures; links of the same vehicles share one. Without it signatures are not
        looked at.
    may_send : bool
        Whether :meth:`send` is allowed.
    batch_s : float
        Time from one batch to the next while telemetry comes, seconds: what arrives meanwhile waits in the kernel,
        which notes its time of arrival. 0 hands on at once whatever is there. The first packet after a longer
        silence never waits.
    requests : RateRequests | None
        Requests for message rates, which go out where sending is allowed.

    Raises
    ------
    TelemetryError
        The link cannot be opened.
    """

    def __init__(
        self,
        url: str,
        guard: SigningGuard | None = None,
        may_send: bool = False,
        batch_s: float = 0.0,
        requests: RateRequests | None = None,
    ) -> None:
        self._url = url
        self._may_send = may_send
        # Half a second of work that the first packet would have to wait for.
        mavlink_types()
        self._link = open_byte_link(url, may_send)
        self._guard = guard
        self._refused: Counter[str] = Counter()
        self._parsers: OrderedDict[Hashable, PacketParser] = OrderedDict()
        self._retired = PacketParser()
        # By system and component id, -1 where nothing came yet: what strangers claim to be costs no memory.
        self._sequence = array("h", [-1]) * (1 << 16)
        self._lost_by_system = [0] * 256
        self._telemetry_ns: OrderedDict[Hashable, int] = OrderedDict()
        self._received_ns = 0
        self._messages = 0
        self._batch_s = batch_s
        self._requests = requests
        self._due_s = 0.0

    def receive(self, timeout_s: float) -> Batch:
        """Return what has arrived once a batch is due; wait for the first packet at most ``timeout_s`` seconds.

        Packets that were refused for their signature are reported by :meth:`SigningGuard.findings
        <adapters.mavlink.signing.SigningGuard.findings>` at the end of the batch.
        """
        now_s = time.monotonic()
        until_s = now_s + timeout_s
        packets: list[tuple[MavlinkType, bytes]] = []
        received_ns: list[int] = []
        due_s = min(self._due_s, until_s)
        if self._link.stamps_arrivals:
            if due_s > now_s:
                time.sleep(due_s - now_s)
            due_s = 0.0
        left = _PIECES
        while left > 0:
            pieces = self._link.read((due_s if packets else until_s) - time.monotonic())
            for sender, data, arrived_ns in pieces:
                self._receive(sender, data, arrived_ns, packets, received_ns)
            left -= max(len(pieces), 1)
            if time.monotonic() >= (due_s if packets else until_s):
                break
        self._due_s = time.monotonic() + self._batch_s
        self._messages += len(packets)
        batch = decoded(packets, received_ns)
        if self._requests is not None:
            for columns in batch.columns:
                self._requests.count(columns)
            self.send(self._requests.requests(time.time_ns()))
        if self._guard is not None:
            findings = self._guard.findings(self._received_ns if packets else self._arrival(time.time_ns()))
            if findings:
                batch = joined((batch, pack(findings)))
        return batch

    def send(self, packets: Iterable[bytes]) -> None:
        """Send packets to the other side: on a UDP port to all who lately sent telemetry to it.

        What the network does not take is lost. Another thread than that of :meth:`receive` may call it.

        Raises
        ------
        TelemetryError
            The link was opened only to listen.
        """
        if not self._may_send:
            raise TelemetryError(f"{self._url}: this link was opened only to listen")
        now_ns = time.time_ns()
        senders = [sender for sender, last_ns in list(self._telemetry_ns.items()) if now_ns - last_ns < _ANSWER_NS]
        for packet in packets:
            self._link.write(packet, senders)

    def _arrival(self, received_ns: int) -> int:
        """Return a time of arrival that is not before an earlier one, unless the clock was set back."""
        if not 0 < self._received_ns - received_ns < _SETTLING_NS:
            self._received_ns = received_ns
        return self._received_ns

    def _receive(
        self,
        sender: Hashable,
        data: bytes,
        arrived_ns: int,
        packets: list[tuple[MavlinkType, bytes]],
        received_ns: list[int],
    ) -> None:
        """Append the packets that a piece completes, and their time of arrival, where they are admitted."""
        arrived_ns = self._arrival(arrived_ns)
        guard = self._guard
        admitted = False
        for kind, packet in self._parser(sender).feed(data):
            if guard is not None and (verdict := guard.refusal(packet, arrived_ns)) is not None:
                self._refused[verdict.name.lower()] += 1
                continue
            admitted = True
            self._count(packet)
            if kind.name != _SECRET:
                packets.append((kind, packet))
                received_ns.append(arrived_ns)
        if admitted and self._may_send:
            self._telemetry_ns[sender] = arrived_ns
            self._telemetry_ns.move_to_end(sender)
            if len(self._telemetry_ns) > _SENDERS:
                self._telemetry_ns.popitem(last=False)

    def _count(self, packet: bytes) -> None:
        system, component = packet_sender(packet)
        place = system << 8 | component
        before = self._sequence[place]
        sequence = packet_sequence(packet)
        ahead = (sequence - before) & 0xFF
        if before < 0 or 128 <= ahead < 256 - _REORDERED:
            self._sequence[place] = sequence
        elif 0 < ahead < 128:
            self._lost_by_system[system] += ahead - 1
            self._sequence[place] = sequence

    def _parser(self, sender: Hashable) -> PacketParser:
        parser = self._parsers.get(sender)
        if parser is None:
            parser = self._parsers[sender] = PacketParser()
            if len(self._parsers) > _SENDERS:
                self._retire(self._parsers.popitem(last=False)[1])
        else:
            self._parsers.move_to_end(sender)
        return parser

    def _retire(self, parser: PacketParser) -> None:
        self._retired.unknown += parser.unknown
        self._retired.damaged += parser.damaged
        self._retired.skipped_bytes += parser.skipped_bytes

    def statistics(self) -> MavlinkLinkStatistics:
        """Return the counts so far."""
        parsers = (self._retired, *self._parsers.values())
        return MavlinkLinkStatistics(
            messages=self._messages,
            lost=sum(self._lost_by_system),
            lost_by_system={system: lost for system, lost in enumerate(self._lost_by_system) if lost},
            unknown=sum(parser.unknown for parser in parsers),
            damaged=sum(parser.damaged for parser in parsers),
            skipped_bytes=sum(parser.skipped_bytes for parser in parsers),
            connections=self._link.connections,
            overruns=self._link.overruns,
            signing=SigningStatistics(**self._refused),
        )

    def close(self) -> None:
        """Close the link."""
        self._link.close()

    def __enter__(self) -> MavlinkLink:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
