"""Set up the daemon: Zenoh session, journal, links, vehicles, signals; and take it down in order."""

from __future__ import annotations

import contextlib
import gc
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from types import FrameType
from typing import TYPE_CHECKING, Any, NamedTuple

import zenoh

from adapters.mavlink.mavlink_link import MavlinkLink
from adapters.mavlink.message_rates import RateRequests
from adapters.mavlink.requesting_link import RequestingLink
from adapters.mavlink.signing import SigningKey, read_key
from adapters.zenoh.zenoh_link import ZenohLink
from adapters.zenoh.zenoh_payload import PayloadDecoder
from adapters.zenoh.zenoh_session import open_session
from monitor.configuration.config import Config, Vehicle
from monitor.errors import ProfileError
from monitor.recording.journal import Journal
from monitor.service.daemon import Daemon
from monitor.service.inbox import Inbox, Link
from monitor.service.log import Log
from monitor.service.metrics_server import MetricsServer
from monitor.service.station import Station
from monitor.service.station_health import Counting
from monitor.service.systemd import Notifier

if TYPE_CHECKING:
    from monitor.views.live_view import LiveView

_SYNC_S = 1.0
_FIRST_NS = 5_000_000_000


def run_live(config: Config, read_again: Callable[[], Config], *, as_json: bool = False) -> int:
    """Monitor vehicles until SIGINT or SIGTERM.

    Parameters
    ----------
    config : Config
        Where telemetry comes from and where results go.
    read_again : Callable[[], Config]
        Reads the configuration anew when SIGHUP asks for it.
    as_json : bool
        Whether log lines on stderr are JSON objects, whatever the configuration says.

    Returns
    -------
    int
        Exit status: 0 after SIGTERM, 130 after SIGINT.

    Raises
    ------
    ProfileError, TelemetryError
        A profile, a link, a file or the session cannot be used.
    """
    if not (config.mavlink or config.zenoh or any(vehicle.zenoh for vehicle in config.vehicles)):
        raise ProfileError("no telemetry to listen to: give --mavlink URL or --zenoh KEYEXPR, or set it in --config")
    if not config.vehicles and config.new_vehicles.profile is None:
        raise ProfileError("no vehicle to monitor: give a PROFILE, or name vehicles in --config")
    json_lines = {"auto": not sys.stderr.isatty(), "json": True, "text": False}[config.log_format]
    # signals first: the default action of SIGHUP is to end a process
    with ExitStack() as stack, _signals() as received:
        log = Log(as_json or json_lines)
        stack.callback(log.close)
        session = stack.enter_context(
            open_session(config.connect, config.listen, config.zenoh_config, config.zenoh_mode)
        )
        journal = _open_journal(config, log, stack)
        inbox = Inbox(config.inbox)
        links = _open_links(config, session, stack)
        view = _open_view(config, log, stack)
        station = Station(config, read_again, session, inbox, journal, log, {one.name: one.link for one in links}, view)
        stack.callback(station.close)
        # before the links are closed, which their threads read
        stack.callback(inbox.close)
        for one in links:
            inbox.listen(one.name, one.reader, None if one.vehicle is None else station.name_of(one.vehicle))
        if config.metrics.listen is not None:
            stack.callback(MetricsServer(config.metrics.listen, station.health).close)
        notifier = Notifier()
        stack.callback(notifier.close)
        heeded = 0

        first_look = _FirstLook({one.name: one.link for one in links}, log)

        def every_turn(now_ns: int) -> None:
            nonlocal heeded
            new = received[heeded:]
            heeded += len(new)
            if signal.SIGHUP in new:
                notifier.reloading()
                station.reload()
            if signal.SIGINT in new or signal.SIGTERM in new:
                daemon.stop()
            reloads = station.reloads
            station.turn(now_ns)
            if station.reloads != reloads:
                notifier.ready(f"monitoring {len(station.posts)} vehicles")
            notifier.feed(not inbox.stuck())
            first_look.turn(now_ns)

        daemon = Daemon(inbox, station.fleet, lambda: station.posts, station.troubles, every_turn)
        station.announce()
        notifier.ready(f"monitoring {len(station.posts)} vehicles")
        # What stands for weeks need not be searched for garbage again and again, which takes longer than an alarm.
        gc.collect()
        gc.freeze()
        daemon.run()
        notifier.stopping()
        for post in station.posts:
            monitor = post.monitor
            log.say("stopped", vehicle=monitor.name, messages=monitor.messages, samples=monitor.samples)
        return 130 if signal.SIGINT in received else 0


class _FirstLook:
    """Says once which links have brought nothing in their first seconds: a wrong port looks like a quiet vehicle."""

    def __init__(self, links: Mapping[str, Any], log: Log) -> None:
        self._links = links
        self._log = log
        self._due_ns: int | None = 0

    def turn(self, now_ns: int) -> None:
        """Look once, when it is due."""
        if self._due_ns is None or now_ns < self._due_ns:
            return
        if self._due_ns == 0:
            self._due_ns = now_ns + _FIRST_NS
            return
        self._due_ns = None
        for name, link in self._links.items():
            if not link.statistics().messages:
                advice = "is the vehicle on, and does it send to this address? See 'fauio doctor'"
                self._log.say("no telemetry yet", level="warning", link=name, advice=advice)


def _open_journal(config: Config, log: Log, stack: ExitStack) -> Journal | None:
    if config.journal.path is None:
        return None
    # where it cannot be made the journal says what is wrong
    with contextlib.suppress(OSError):
        config.journal.path.parent.mkdir(parents=True, exist_ok=True)
    journal = Journal(config.journal.path, config.journal.max_events)
    stack.callback(journal.close)
    if journal.set_aside is not None:
        log.say("journal damaged", level="error", set_aside=str(journal.set_aside), now="a new one was begun")
    done = threading.Event()

    def sync() -> None:
        while not done.wait(_SYNC_S):
            journal.sync()

    thread = threading.Thread(target=sync, name="journal sync", daemon=True)
    thread.start()
    stack.callback(thread.join, 5.0)
    stack.callback(done.set)
    return journal


def _open_view(config: Config, log: Log, stack: ExitStack) -> LiveView | None:
    """Open the live view; where it cannot be shown, monitoring goes on without it."""
    if config.rerun.mode == "off":
        return None
    from monitor.views.live_view import LiveView

    try:
        view = LiveView(config.rerun.mode, memory_mb=config.rerun.memory_mb)
    except ValueError as error:
        log.say("no live view", level="error", reason=str(error))
        return None
    stack.callback(view.close)
    log.say("live view", url=view.url)
    return view


class _Opened(NamedTuple):
    """An open link, what reads it, and the vehicle whose own it is."""

    name: str
    link: Counting
    reader: Link
    vehicle: Vehicle | None = None


def _open_links(config: Config, session: zenoh.Session, stack: ExitStack) -> list[_Opened]:
    """Open all links; nobody reads them yet."""
    key = read_key(config.signing.key_file) if config.signing.key_file is not None else None
    opened = []
    for url in config.mavlink:
        link = MavlinkLink(url, key, config.signing.require, may_send=config.send.allow)
        stack.callback(link.close)
        opened.append(_Opened(url, link, _requesting(link, config, key)))
    folders = () if config.definitions is None else (config.definitions,)
    shared = [(keyexpr, None) for keyexpr in config.zenoh]
    own = [(vehicle.zenoh, vehicle) for vehicle in config.vehicles if vehicle.zenoh is not None]
    for keyexpr, vehicle in (*shared, *own):
        zenoh_link = ZenohLink(session, keyexpr, PayloadDecoder(config.zenoh_types, folders))
        stack.callback(zenoh_link.close)
        opened.append(_Opened(keyexpr, zenoh_link, zenoh_link, vehicle))
    return opened


def _requesting(link: MavlinkLink, config: Config, key: SigningKey | None) -> Link:
    """Return what reads a link: itself, or with requests for message rates where the config allows them."""
    send = config.send
    if not (send.allow and send.rates):
        return link
    named = {vehicle.system for vehicle in config.vehicles}
    systems = () if 0 in named or config.new_vehicles.profile is not None else named
    requests = RateRequests(key, (send.source_system, send.source_component))
    return RequestingLink(link, requests, send.rates, systems, send.target_component)


@contextmanager
def _signals() -> Iterator[list[int]]:
    """Note SIGINT, SIGTERM and SIGHUP instead of what they do by themselves; yield the list of those received."""
    received: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        del frame
        received.append(number)

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
