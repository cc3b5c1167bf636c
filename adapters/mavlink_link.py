"""Live MAVLink: packets from a UDP, TCP or serial link -> messages. It listens and never sends."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Hashable
from dataclasses import dataclass

from adapters.byte_link import open_byte_link
from adapters.mavlink_message import PacketParser, packet_sender, packet_sequence
from adapters.message import Message

# Senders whose unfinished packets are kept apart; more are unlikely, and none can exhaust memory.
_SENDERS = 64
_BATCH = 1024


@dataclass(frozen=True, slots=True)
class MavlinkLinkStatistics:
    """What came over a link so far.

    Parameters
    ----------
    messages : int
        Messages received.
    lost : int
        Packets missing by the sequence numbers of each sender; a router that filters messages adds to it.
    unknown : int
        Packets of messages that are not in the dialect.
    damaged, skipped_bytes : int
        Places with bytes that belong to no intact packet, and those bytes.
    connections : int
        How often a connection was made.
    """

    messages: int
    lost: int
    unknown: int
    damaged: int
    skipped_bytes: int
    connections: int


class MavlinkLink:
    """An open link.

    Parameters
    ----------
    url : str
        See :func:`adapters.byte_link.open_byte_link`.

    Raises
    ------
    TelemetryError
        The link cannot be opened.
    """

    def __init__(self, url: str) -> None:
        self._link = open_byte_link(url)
        self._parsers: OrderedDict[Hashable, PacketParser] = OrderedDict()
        self._retired = PacketParser()
        self._sequence: dict[tuple[int, int], int] = {}
        self._messages = 0
        self._lost = 0

    def receive(self, timeout_s: float) -> list[Message]:
        """Return all messages that are there; wait for the first one at most ``timeout_s`` seconds."""
        until = time.monotonic() + timeout_s
        messages: list[Message] = []
        while len(messages) < _BATCH:
            piece = self._link.read(0.0 if messages else until - time.monotonic())
            if piece is not None:
                self._take(*piece, messages)
            elif messages or time.monotonic() >= until:
                break
        self._messages += len(messages)
        return messages

    def _take(self, sender: Hashable, data: bytes, messages: list[Message]) -> None:
        received_ns = time.time_ns()
        for kind, packet in self._parser(sender).feed(data):
            key = packet_sender(packet)
            sequence = packet_sequence(packet)
            ahead = (sequence - self._sequence.get(key, sequence - 1)) & 0xFF
            # Half the range ahead is behind: a packet that came late or twice, not a hundred lost ones.
            if 0 < ahead < 128:
                self._lost += ahead - 1
                self._sequence[key] = sequence
            messages.append(kind.decode(packet, received_ns))

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
            lost=self._lost,
            unknown=sum(parser.unknown for parser in parsers),
            damaged=sum(parser.damaged for parser in parsers),
            skipped_bytes=sum(parser.skipped_bytes for parser in parsers),
            connections=self._link.connections,
        )

    def close(self) -> None:
        """Close the link."""
        self._link.close()

    def __enter__(self) -> MavlinkLink:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
