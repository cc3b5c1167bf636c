"""Live telemetry over Zenoh: JSON objects and CDR under a key expression -> batches.

A callback receives each sample from the network thread at once, notes its time of arrival and queues it; a full queue
drops its oldest sample. So neither a slow reader nor a flood of telemetry can stall the session, and both show in the
counts. A lost connection is restored by itself (:func:`adapters.zenoh.zenoh_session.open_session`), and the
subscription with it.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from adapters.batch import Batch, pack
from adapters.errors import PayloadError, TelemetryError, UndefinedTypeError
from adapters.message import Message
from adapters.source import ZENOH
from adapters.zenoh.zenoh_payload import PayloadDecoder

if TYPE_CHECKING:
    import zenoh

MAX_PAYLOAD_BYTES = 1 << 20
"""Largest payload, bytes. Telemetry has some kilobytes at most. Chosen: a payload a thousand times as large was sent to
the wrong key."""

_QUEUE = 4096
"""Most messages that wait to be read: 8 s of a vehicle at 530 a second."""
_QUEUE_BYTES = 1 << 24
"""Most memory of the waiting messages, bytes: 16 of the largest payloads."""
_MAX_LOGGED = 1000
"""Most keys that are reported, once each. Names come from the network, so their list has to be bounded."""


@dataclass(slots=True)
class ZenohLinkStatistics:
    """Counts of a link so far."""

    messages: int = 0  # messages received
    dropped: int = 0  # samples dropped because the queue was full
    oversized: int = 0  # samples of more than :data:`MAX_PAYLOAD_BYTES`
    malformed: int = 0  # samples that are not a JSON object, or not CDR of their type
    undefined: int = 0  # samples in CDR whose type is unknown, or has no definition
    connected: int = 0  # other Zenoh nodes (routers, peers) to which the session is connected now
    reconnections: int = 0  # how often the session found a node after losing all


class ZenohLink:
    """A subscription to telemetry. The caller closes the session.

    The ``decoder`` knows the types of CDR payloads; None: only types that samples name themselves, with built-in
    definitions. ``batch_s`` is the time from one batch to the next while telemetry arrives, seconds; with 0 everything
    is returned at once.

    Raises
    ------
    TelemetryError
        The key expression is not valid.
    """

    def __init__(
        self, session: zenoh.Session, keyexpr: str, decoder: PayloadDecoder | None = None, batch_s: float = 0.0
    ) -> None:
        import zenoh

        self._decoder = decoder or PayloadDecoder()
        self._queue: deque[tuple[str, str, bytes, int]] = deque()
        self._queued_bytes = 0
        self._arrived = threading.Condition()
        self._batch_s = batch_s
        self._due_s = 0.0
        self._counts = ZenohLinkStatistics()
        self._lost_all = False
        self._logged: set[str] = set()
        try:
            self._subscriber: Any = session.declare_subscriber(keyexpr, self._take)
        except zenoh.ZError as error:
            raise TelemetryError(f"'{keyexpr}' is not a Zenoh key expression") from error
        self._transports: Any = session.info.declare_transport_events_listener(self._count_transport, history=True)

    def _take(self, sample: zenoh.Sample) -> None:
        received_ns = time.time_ns()
        size = len(sample.payload)
        with self._arrived:
            if size > MAX_PAYLOAD_BYTES:
                self._counts.oversized += 1
                return
            self._queue.append((str(sample.key_expr), str(sample.encoding), sample.payload.to_bytes(), received_ns))
            self._queued_bytes += size
            while len(self._queue) > _QUEUE or self._queued_bytes > _QUEUE_BYTES:
                self._queued_bytes -= len(self._queue.popleft()[2])
                self._counts.dropped += 1
            self._arrived.notify()

    def _count_transport(self, event: zenoh.TransportEvent) -> None:
        import zenoh

        with self._arrived:
            if event.kind == zenoh.SampleKind.PUT:
                self._counts.connected += 1
                self._counts.reconnections += self._lost_all
                self._lost_all = False
            else:
                self._counts.connected -= 1
                self._lost_all = self._counts.connected == 0

    def receive(self, timeout_s: float) -> Batch:
        """Return what has arrived once a batch is due; wait for the first sample at most ``timeout_s`` seconds."""
        wait_s = min(self._due_s - time.monotonic(), timeout_s)
        if wait_s > 0.0:
            time.sleep(wait_s)
            timeout_s -= wait_s
        with self._arrived:
            if not self._queue:
                self._arrived.wait(timeout_s)
            arrived = tuple(self._queue)
            self._queue.clear()
            self._queued_bytes = 0
        messages = []
        for key, encoding, payload, received_ns in arrived:
            try:
                name, fields = self._decoder.decode(key, encoding, payload)
            except UndefinedTypeError as error:
                self._counts.undefined += 1
                self._say_once(key, error)
            except PayloadError as error:
                self._counts.malformed += 1
                self._say_once(key, error)
            else:
                messages.append(Message(ZENOH, name, received_ns, fields))
        self._counts.messages += len(messages)
        self._due_s = time.monotonic() + self._batch_s
        return pack(messages)

    def _say_once(self, key: str, error: ValueError) -> None:
        """Log why a payload was discarded: only the first of each key, since its sender will send more of them."""
        if key not in self._logged and len(self._logged) < _MAX_LOGGED:
            self._logged.add(key)
            logging.getLogger(__name__).warning("payload of %s skipped, and more like it: %s", key, error)

    def statistics(self) -> ZenohLinkStatistics:
        """Return the counts so far."""
        return replace(self._counts)

    def close(self) -> None:
        """End the subscription."""
        self._transports.undeclare()
        self._subscriber.undeclare()

    def __enter__(self) -> ZenohLink:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
