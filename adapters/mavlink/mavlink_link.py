"""Live MAVLink: packets from a UDP, TCP or serial link -> batches. It sends only if that is allowed."""

from __future__ import annotations

import time
from collections import Counter, OrderedDict
from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass

from adapters.batch import Batch, joined, pack
from adapters.errors import TelemetryError
from adapters.mavlink.byte_link import open_byte_link
from adapters.mavlink.mavlink_columns import SequenceFindings, dialect, wanted_kinds
from adapters.mavlink.message_rates import RateRequests
from adapters.mavlink.packets import PacketList, PacketScanner
from adapters.mavlink.signing import SigningGuard, SigningStatistics

# Senders whose unfinished packets are kept apart; more are unlikely, and the limit bounds the memory.
_SENDERS = 64
_PIECES = 1024
"""Most pieces of one batch: a flood of junk must not keep the caller here."""
_ANSWER_NS = 10_000_000_000
"""How long a silent sender still gets packets. Chosen: as long as a link waits for a heartbeat."""
_SETTLING_NS = 1_000_000_000
"""A larger step back of arrival times is a clock that was set back; threads stamp them in another order by far less."""
_COUNTS = ("unknown", "bad_checksums", "damaged", "skipped_bytes")
# This message carries the secret that packets are signed with, and everything returned here is recorded.
_SECRET = "SETUP_SIGNING"  # noqa: S105 - the name of a message


@dataclass(frozen=True, slots=True)
class MavlinkLinkStatistics:
    """Counts of a link so far."""

    messages: int  # messages received, without refused ones
    # Packets missing by the sequence numbers of each system and component. A router that passes on only some of the
    # messages makes the others count as lost. A gap of more than 127 packets does not count, nor do packets that a
    # ground station sent elsewhere.
    lost: int
    lost_by_system: Mapping[int, int]  # the same for each system that lost any
    unknown: int  # packets of messages that are not in the dialect
    bad_checksums: int  # packets with a wrong checksum, as far as their begin survived the damage
    damaged: int  # places with bytes that belong to no intact packet, and the number of these bytes
    skipped_bytes: int
    connections: int  # how often a connection was made
    # UDP datagrams dropped because they were not read in time, by the kernel or, if a sender floods, by the link
    overruns: int
    signing: SigningStatistics  # packets refused for their signature; all zero without a key


class MavlinkLink:
    """An open link.

    ``url`` is one of :func:`adapters.mavlink.byte_link.open_byte_link`. The ``guard`` refuses packets for their
    signatures, and links of the same vehicles share one; without it signatures are not checked. ``may_send`` says
    whether :meth:`send` is allowed, and whether ``requests`` for message rates are sent.

    ``batch_s`` is the time from one batch to the next while telemetry arrives, seconds: packets that arrive meanwhile
    wait in the kernel, which notes their time of arrival. With 0 everything is returned at once. The first packet after
    a longer silence never waits.
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
        # Done here: it takes half a second, for which the first packet would have to wait.
        self._dialect = dialect()
        self._wanted = wanted_kinds(without=(_SECRET,))
        self._link = open_byte_link(url, may_send)
        self._guard = guard
        self._refused: Counter[str] = Counter()
        self._scanners: OrderedDict[Hashable, PacketScanner] = OrderedDict()
        self._counts = dict.fromkeys(_COUNTS, 0)  # counts of senders that were forgotten
        self._sequences = SequenceFindings()
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
        packets = PacketList(self._dialect)
        due_s = min(self._due_s, until_s)
        if self._link.stamps_arrivals:
            if due_s > now_s:
                time.sleep(due_s - now_s)
            due_s = 0.0
        left = _PIECES
        while left > 0:
            pieces = self._link.read((due_s if packets else until_s) - time.monotonic())
            for sender, data, arrived_ns in pieces:
                self._receive(sender, data, self._arrival(arrived_ns), packets)
            left -= max(len(pieces), 1)
            if time.monotonic() >= (due_s if packets else until_s):
                break
        self._due_s = time.monotonic() + self._batch_s
        batch = self._sequences.decoded(packets, self._wanted)
        self._messages += batch.count
        if self._requests is not None:
            steady_ns = time.monotonic_ns()
            for columns in batch.columns:
                self._requests.count(columns, steady_ns)
            self.send(self._requests.requests(steady_ns, time.time_ns()))
        if self._guard is not None:
            findings = self._guard.findings(self._received_ns if packets else self._arrival(time.time_ns()))
            if findings:
                batch = joined((batch, pack(findings)))
        return batch

    def send(self, packets: Iterable[bytes]) -> None:
        """Send packets to the other side: on a UDP port to all who lately sent telemetry to it.

        Packets that the network does not accept are lost. Another thread than that of :meth:`receive` may call it.

        Raises
        ------
        TelemetryError
            The link was opened only to listen.
        """
        if not self._may_send:
            raise TelemetryError(f"{self._url}: this link was opened only to listen")
        steady_ns = time.monotonic_ns()
        senders = [sender for sender, last_ns in list(self._telemetry_ns.items()) if steady_ns - last_ns < _ANSWER_NS]
        for packet in packets:
            self._link.write(packet, senders)

    def _arrival(self, received_ns: int) -> int:
        """Return a time of arrival that is not before an earlier one, unless the clock was set back."""
        if not 0 < self._received_ns - received_ns < _SETTLING_NS:
            self._received_ns = received_ns
        return self._received_ns

    def _receive(self, sender: Hashable, data: bytes, arrived_ns: int, packets: PacketList) -> None:
        """Append the packets that a piece completes and the guard admits."""
        before = len(packets)
        self._scanner(sender).scan(data, packets, arrived_ns)
        if self._guard is not None:
            refusals = [self._guard.refusal(packet, arrived_ns) for _, packet in packets.items(before)]
            self._refused.update(verdict.name.lower() for verdict in refusals if verdict is not None)
            packets.keep(before, [verdict is None for verdict in refusals])
        if self._may_send and len(packets) > before:
            self._telemetry_ns[sender] = time.monotonic_ns()
            self._telemetry_ns.move_to_end(sender)
            if len(self._telemetry_ns) > _SENDERS:
                self._telemetry_ns.popitem(last=False)

    def _scanner(self, sender: Hashable) -> PacketScanner:
        scanner = self._scanners.get(sender)
        if scanner is None:
            scanner = self._scanners[sender] = PacketScanner(self._dialect)
            if len(self._scanners) > _SENDERS:
                _, forgotten = self._scanners.popitem(last=False)
                self._counts = {name: self._counts[name] + getattr(forgotten, name) for name in _COUNTS}
        else:
            self._scanners.move_to_end(sender)
        return scanner

    def statistics(self) -> MavlinkLinkStatistics:
        """Return the counts so far."""
        lost = self._sequences.lost()
        scanners = list(self._scanners.values())
        counts = {name: self._counts[name] + sum(getattr(scanner, name) for scanner in scanners) for name in _COUNTS}
        return MavlinkLinkStatistics(
            messages=self._messages,
            lost=sum(lost.values()),
            lost_by_system=lost,
            **counts,
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
