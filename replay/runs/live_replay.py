"""Replay as if live: messages when they are due, a monitor's output on Zenoh, the packets themselves over UDP."""

from __future__ import annotations

import heapq
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from operator import itemgetter
from typing import TYPE_CHECKING, Any, Self

from adapters.batch import pack
from adapters.errors import UsageError
from adapters.logs.recordings import read_recording, recording_kind
from adapters.logs.tlog import TlogReader
from adapters.mavlink.byte_link import Address, resolve
from adapters.message import Message
from adapters.simulation.pacing import paced
from monitor.bus.keys import alarm_key, vehicle_root
from monitor.event import AlarmEvent
from monitor.pipeline import Pipeline
from monitor.profile import Profile
from monitor.service.vehicle_monitor import VehicleMonitor
from monitor.service.vehicle_service import STATUS_NS
from replay.player import interests
from replay.runs.one_log import LogTask

if TYPE_CHECKING:
    import zenoh

_SUBSCRIBER_S = 2.0
"""Chosen: subscribers have to be discovered before the first event; on a network that takes part of a second."""


class LiveReplay:
    """Lets a replay out into the world: use it as a context, for one log after the other.

    ``speed`` is in times real time, by the times of arrival; None: as fast as possible. Without Zenoh endpoints to
    connect to or to listen on nothing is published. Packets of telemetry logs go to ``udp``, ``udp:HOST:PORT``;
    ``on_event`` is called with each event when it is published. Raises UsageError where the speed is not positive, an
    address is not understood, or the Zenoh session cannot be opened.
    """

    def __init__(
        self,
        speed: float | None = None,
        *,
        connect: Sequence[str] = (),
        listen: Sequence[str] = (),
        prefix: str = "fauio",
        udp: str | None = None,
        on_event: Callable[[AlarmEvent], None] | None = None,
    ) -> None:
        if speed is not None and not speed > 0.0:
            raise UsageError(f"--speed {speed:g}: has to be positive")
        self._speed = speed
        self._prefix = prefix
        self._on_event = on_event or _nothing
        self._session: zenoh.Session | None = None
        self._socket: socket.socket | None = None
        self._to: Address | None = None
        with ExitStack() as stack:
            if udp is not None:
                self._to = _address(udp)
                self._socket = stack.enter_context(socket.socket(self._to[0], socket.SOCK_DGRAM))
            if connect or listen:
                from adapters.zenoh.zenoh_session import open_session

                self._session = stack.enter_context(open_session(connect, listen))
            self._closers = stack.pop_all()

    def messages(self, profile: Profile, task: LogTask, vehicle: str | None) -> Iterator[Message]:
        """Return all messages of a log, each when it is due, after what it led to was published.

        A monitor of its own takes them first: what it says is published with the keys and payloads of the daemon, the
        status once a second of the log's time. It begins when somebody subscribes to alarms, at the latest after 2 s.
        Raises UsageError where the log cannot be read, or packets are to be sent and it holds none.
        """
        only = None if task.record else interests(profile)
        source: Iterable[tuple[int, Message | bytes]] = (
            (message.received_ns, message) for message in read_recording(task.path, only)
        )
        if self._to is not None:
            if recording_kind(task.path) != "tlog":
                raise UsageError(f"{task.log}: --udp sends packets as they came, which only .tlog files hold")
            source = heapq.merge(TlogReader(task.path).packets(), source, key=itemgetter(0))
        due = (item for _, item in source) if self._speed is None else paced(source, self._speed)
        return self._monitored(self._sent(due), Pipeline(profile, vehicle, force=task.force))

    def close(self) -> None:
        """Close session and socket."""
        self._closers.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _sent(self, items: Iterable[Message | bytes]) -> Iterator[Message]:
        """Send the packets among items, return the messages."""
        for item in items:
            if not isinstance(item, bytes):
                yield item
            elif self._socket is not None and self._to is not None:
                self._socket.sendto(item, self._to[1])

    def _monitored(self, messages: Iterator[Message], pipeline: Pipeline) -> Iterator[Message]:
        """Yield messages after a monitor of their vehicle has processed them and published the results."""
        if self._session is None:
            yield from messages
            return
        from monitor.bus.publisher import Publisher

        outlet = Publisher(self._session, pipeline.vehicle, pipeline.layouts, self._prefix)
        _await_subscriber(self._session, alarm_key(vehicle_root(self._prefix, pipeline.vehicle), "replay", "begins"))
        monitor: VehicleMonitor | None = None
        status_ns = now_ns = 0
        try:
            for message in messages:
                now_ns = message.received_ns
                if monitor is None:
                    monitor = VehicleMonitor(pipeline, (), None, self._on_event, now_ns)
                    monitor.activate(outlet, now_ns)
                    status_ns = now_ns
                monitor.process(pack([message]), _since(now_ns))
                if now_ns - status_ns >= STATUS_NS:
                    status_ns = now_ns
                    monitor.status(now_ns)
                yield message
            if monitor is not None and now_ns > status_ns:
                monitor.status(now_ns)
        finally:
            outlet.close()


def _await_subscriber(session: zenoh.Session, key: str) -> None:
    """Give those who wait for this session to come up the time to connect."""
    until = time.monotonic() + _SUBSCRIBER_S
    with session.declare_publisher(key) as probe:
        while not _matches(probe) and time.monotonic() < until:
            time.sleep(0.01)


def _matches(publisher: Any) -> bool:
    # Zenoh's type stub calls it a bool; it is an object.
    return bool(publisher.matching_status.matching)


def _since(received_ns: int) -> Callable[[], int]:
    """Return a clock that shows a message's time of arrival now: what it says later is how long the monitor took."""
    started_ns = time.monotonic_ns()
    return lambda: received_ns + time.monotonic_ns() - started_ns


def _address(url: str) -> Address:
    kind, _, rest = url.partition(":")
    if kind not in ("udp", "udpout"):
        raise UsageError(f"--udp {url}: use udp:HOST:PORT")
    return resolve(f"--udp {url}", rest)


def _nothing(event: AlarmEvent) -> None:
    del event
