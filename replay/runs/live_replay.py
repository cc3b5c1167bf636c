"""Replay as if live: messages at their times, a monitor's output on Zenoh, the packets themselves over UDP."""

from __future__ import annotations

import heapq
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from itertools import pairwise
from operator import itemgetter
from typing import TYPE_CHECKING, Any, Self, cast

import numpy as np

from adapters.batch import Batch, arrival_times, cut
from adapters.errors import UsageError
from adapters.logs.recordings import read_batches, recording_kind
from adapters.logs.tlog import TlogReader
from adapters.mavlink.byte_link import Address, udp_address
from adapters.simulation.pacing import paced
from monitor.bus.keys import alarm_key, vehicle_root
from monitor.pipeline import Pipeline
from monitor.profile import Profile
from monitor.service.vehicle_monitor import VehicleMonitor
from monitor.service.vehicle_service import STATUS_NS
from replay.player import interests
from replay.runs.one_log import LogTask

if TYPE_CHECKING:
    import zenoh

_BATCH_NS = 20_000_000
"""Time over which a daemon's links collect a batch, by default: ``batch_ms``."""
_SUBSCRIBER_S = 2.0
"""Longest wait for subscribers, seconds. Chosen: Zenoh has to discover them before the first event, which takes part of
a second on a network."""


class LiveReplay:
    """Sends a replay to the network; it is a context, for one log after the other.

    ``speed`` is relative to real time, by the arrival times; None: as fast as possible. Without Zenoh endpoints to
    connect to or to listen on, nothing is published. Packets of telemetry logs go to ``udp``, ``udp:HOST:PORT``. Raises
    UsageError if the speed is not positive, TelemetryError if an address is malformed or the Zenoh session cannot be
    opened.
    """

    def __init__(
        self,
        speed: float | None = None,
        *,
        connect: Sequence[str] = (),
        listen: Sequence[str] = (),
        prefix: str = "fauio",
        udp: str | None = None,
    ) -> None:
        if speed is not None and not speed > 0.0:
            raise UsageError(f"--speed {speed:g}: has to be positive")
        self._speed = speed
        self._prefix = prefix
        self._session: zenoh.Session | None = None
        self._socket: socket.socket | None = None
        self._to: Address | None = None
        with ExitStack() as stack:
            if udp is not None:
                self._to = udp_address(udp, f"--udp {udp}")
                self._socket = stack.enter_context(socket.socket(self._to[0], socket.SOCK_DGRAM))
            if connect or listen:
                from adapters.zenoh.zenoh_session import open_session

                self._session = stack.enter_context(open_session(connect, listen))
            self._closers = stack.pop_all()

    def batches(self, profile: Profile, task: LogTask, vehicle: str | None) -> Iterator[Batch]:
        """Return all messages of a log in batches of 20 ms, each when its last message is due and its results are out.

        A separate monitor processes them first: its output is published with the keys and payloads of the daemon, the
        status once a second of the log's time. The replay begins when somebody subscribes to alarms, at the latest
        after 2 s. Raises UsageError if the log cannot be read, or packets are to be sent and the log has none.
        """
        only = None if task.record else interests(profile)
        source: Iterable[tuple[int, Batch | bytes]] = _as_links_collect(read_batches(task.path, only))
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

    def _sent(self, items: Iterable[Batch | bytes]) -> Iterator[Batch]:
        """Send the packets among the items, return the batches."""
        for item in items:
            if not isinstance(item, bytes):
                yield item
            elif self._socket is not None and self._to is not None:
                self._socket.sendto(item, self._to[1])

    def _monitored(self, batches: Iterator[Batch], pipeline: Pipeline) -> Iterator[Batch]:
        """Yield batches after a monitor of their vehicle has processed them and published the results."""
        if self._session is None:
            yield from batches
            return
        from monitor.bus.publisher import Publisher

        outlet = Publisher(self._session, pipeline.vehicle, pipeline.layouts, self._prefix)
        _await_subscriber(self._session, alarm_key(vehicle_root(self._prefix, pipeline.vehicle), "replay", "begins"))
        monitor: VehicleMonitor | None = None
        status_ns = now_ns = 0
        try:
            for batch in batches:
                now_ns = int(arrival_times(batch)[-1])
                if monitor is None:
                    monitor = VehicleMonitor(pipeline, (), None, lambda _: None, now_ns)
                    monitor.activate(outlet, now_ns)
                    status_ns = now_ns
                monitor.process(batch, _since(now_ns))
                if now_ns - status_ns >= STATUS_NS:
                    status_ns = now_ns
                    monitor.status(now_ns)
                yield batch
            if monitor is not None and now_ns > status_ns:
                monitor.status(now_ns)
        finally:
            outlet.close()


def _as_links_collect(batches: Iterable[Batch]) -> Iterator[tuple[int, Batch]]:
    """Return batches as a daemon receives them, each with the arrival time of its last message."""
    for batch in batches:
        times_ns = arrival_times(batch)
        ends = np.flatnonzero(np.diff(times_ns // _BATCH_NS)) + 1
        for start, stop in pairwise((0, *ends.tolist(), batch.count)):
            yield int(times_ns[stop - 1]), cut(batch, start, stop)


def _await_subscriber(session: zenoh.Session, key: str) -> None:
    """Wait until a subscriber has connected to this session, for a limited time."""
    until = time.monotonic() + _SUBSCRIBER_S
    with session.declare_publisher(key) as probe:
        # Zenoh's type stub calls the status a bool; it is an object
        while not cast("Any", probe.matching_status).matching and time.monotonic() < until:
            time.sleep(0.01)


def _since(received_ns: int) -> Callable[[Sequence[int]], list[int]]:
    """Return a function that computes ages on a clock that now shows a log's time and continues from there."""
    behind_ns = received_ns - time.monotonic_ns()
    return lambda times_ns: [time.monotonic_ns() + behind_ns - one for one in times_ns]
