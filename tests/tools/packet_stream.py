"""The packets in a stream of bytes, for tests that look at them one by one."""

from __future__ import annotations

from collections.abc import Iterable

from adapters.batch import messages
from adapters.mavlink.mavlink_columns import decoded, dialect, wanted_kinds
from adapters.mavlink.mavlink_message import MAGIC_2
from adapters.mavlink.packets import PacketList, PacketScanner
from adapters.message import Message


class PacketStream:
    """A stream that comes piece by piece; ``scanner`` counts what is in it."""

    def __init__(self) -> None:
        self.scanner = PacketScanner(dialect())

    def packets(self, data: bytes) -> list[bytes]:
        """Take the next bytes; return the packets that they complete."""
        return [packet for _, packet in self._scan(data, 0).items()]

    def messages(self, data: bytes, received_ns: int = 0) -> list[Message]:
        """Take the next bytes; return the messages that they complete."""
        return [*messages(decoded(self._scan(data, received_ns), wanted_kinds()))]

    def _scan(self, data: bytes, received_ns: int) -> PacketList:
        packets = PacketList(dialect())
        self.scanner.scan(data, packets, received_ns)
        return packets


def messages_of(packets: Iterable[tuple[int, bytes]]) -> list[Message]:
    """Return the messages in packets that come at certain times."""
    scanner, found = PacketScanner(dialect()), PacketList(dialect())
    for received_ns, packet in packets:
        scanner.scan(packet, found, received_ns)
    return [*messages(decoded(found, wanted_kinds()))]


def packet_sequence(packet: bytes) -> int:
    """Return the sequence number of a packet, which its sender counts modulo 256."""
    return packet[4 if packet[0] == MAGIC_2 else 2]
