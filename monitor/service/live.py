"""Set up the daemon (Zenoh session, journal, links, vehicles, signals), and shut it down in order."""

from __future__ import annotations

import contextlib
import gc
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING

from adapters.errors import OtherVehicleError
from adapters.mavlink.signing import read_key
from adapters.zenoh.zenoh_session import open_session
from monitor.configuration.config import Config
from monitor.notify.ground_station import GroundSender
from monitor.notify.messenger import Messenger
from monitor.notify.outlets import make_outlets
from monitor.recording.background import BackgroundJournal
from monitor.recording.journal import Journal
from monitor.service.caught_signals import caught_signals
from monitor.service.daemon import Daemon
from monitor.service.inbox import OLDEST_S, Inbox
from monitor.service.links import Counting, FirstLook, open_links, signing_guard
from monitor.service.log import ServiceLog
from monitor.service.station import Station
from monitor.service.systemd import Notifier
from monitor.service.watchdog import Watchdog

if TYPE_CHECKING:
    from monitor.views.live_view import LiveView

_SYNC_S = 1.0
"""Chosen: a crash loses at most this much of the signatures' time stamps."""
_NEW_OBJECTS = 10_000
"""New objects after which garbage is searched for. Chosen: a search after each 700, Python's default, takes 1.4 % of
the instructions of a batch and finds nothing, as nothing in the pipeline refers to itself; one of 10,000 takes a
millisecond."""
_SWITCH_S = 0.001
"""How long a thread that needs Python's lock waits before another one has to release it; Python's default is 5 ms. An
alarm needs the lock five times on its way (link, loop, journal, journal after the disk, loop), at worst each time
while a recording is encoded."""
_FINISH_S = 1.0
"""Time for the messages that still wait at the end: a monitor that could not keep up may have too many of them."""


def run_live(config: Config, read_again: Callable[[], Config], *, as_json: bool = False, refuse: bool = False) -> int:
    """Monitor vehicles until SIGINT or SIGTERM; return the exit status, 130 after SIGINT.

    ``read_again`` reads the configuration anew when SIGHUP asks for it; ``as_json`` asks for log lines as JSON objects,
    whatever the configuration says. With ``refuse`` the daemon ends if the first vehicle that identifies itself is not
    the profile's. Without, such a vehicle is not watched, its status says so, and the daemon goes on.

    Raises
    ------
    UsageError, TelemetryError
        A profile, a link, a file or the session cannot be used; or, with ``refuse``, the vehicle is another.
    """
    json_lines = {"auto": not sys.stderr.isatty(), "json": True, "text": False}[config.log_format]
    # signals first: the default action of SIGHUP ends a process
    with ExitStack() as stack, caught_signals() as received:
        log = ServiceLog(as_json or json_lines)
        stack.callback(log.close)
        inbox = Inbox(config.inbox, OLDEST_S)
        station, links = _open_station(config, read_again, inbox, log, stack)
        if config.metrics.listen is not None:
            from monitor.service.metrics_server import MetricsServer

            stack.callback(MetricsServer(config.metrics.listen, station.health).close)
        notifier = Notifier()
        stack.callback(notifier.close)
        station.announce()
        notifier.ready(f"monitoring {len(station.services)} vehicles")
        # Objects that live for weeks need no repeated search for garbage, which takes longer than an alarm.
        gc.collect()
        gc.freeze()
        gc.set_threshold(_NEW_OBJECTS)
        sys.setswitchinterval(_SWITCH_S)
        watchdog = Watchdog()
        stack.callback(watchdog.close)
        turns = _Turns(received, station, inbox, notifier, watchdog, FirstLook(links, log), undecided=refuse)
        daemon = Daemon(
            inbox,
            station.fleet,
            lambda: station.services,
            lambda: station.troubles,
            turns.turn,
            turns.alive,
            config.batch_ms / 1e3,
        )
        daemon.run()
        watchdog.close()
        notifier.stopping()
        inbox.close()
        daemon.finish(_FINISH_S)
        for service in station.services:
            monitor = service.monitor
            log.say("stopped", vehicle=monitor.name, messages=monitor.messages, samples=monitor.samples)
        if turns.other is not None:
            raise OtherVehicleError(f"{turns.other}; take its own profile, or go on with --force")
        return 130 if signal.SIGINT in received else 0


def _open_station(
    config: Config, read_again: Callable[[], Config], inbox: Inbox, log: ServiceLog, stack: ExitStack
) -> tuple[Station, dict[str, Counting]]:
    """Open everything that vehicles are watched with, and their links by name."""
    session = stack.enter_context(open_session(config.connect, config.listen, config.zenoh_config, config.zenoh_mode))
    journal = _open_journal(config, log, stack)
    guard = signing_guard(config)
    if guard is not None:
        stack.callback(guard.save)
        _each_second(guard.save, "signing state", stack)
    opened = open_links(config, session, stack, guard)
    links = {link.name: link.link for link in opened}
    views = _open_views(config, log, stack)
    ground, messengers = _open_messengers(config, log, stack)
    ros = None
    if config.ros.diagnostics:
        from monitor.service.ros_diagnostics import RosDiagnostics

        ros = RosDiagnostics(session, config.ros.domain)
        stack.callback(ros.close)
    station = Station(config, read_again, session, inbox, journal, log, links, views, messengers, ground, ros)
    stack.callback(station.close)
    # before the links are closed, which their threads read
    stack.callback(inbox.close)
    for name, link, vehicle in opened:
        inbox.listen(name, link, None if vehicle is None else station.name_of(vehicle))
    return station, links


@dataclass(slots=True)
class _Turns:
    """The daemon's work in each turn beside its vehicles: signals, status, signs of life."""

    received: Sequence[int]  # signals received so far
    station: Station
    inbox: Inbox
    notifier: Notifier
    watchdog: Watchdog
    first_look: FirstLook
    undecided: bool  # whether the first vehicle that identifies itself may still end the daemon
    other: str | None = None  # why it is not the profile's vehicle
    handled: int = 0  # signals

    def turn(self, steady_ns: int) -> bool:
        """Do the work of a turn; return whether to go on."""
        new = self.received[self.handled :]
        self.handled += len(new)
        reloads = self.station.reloads
        if signal.SIGHUP in new:
            self.notifier.reloading()
            self.station.reload()
        pipelines = [service.monitor.pipeline for service in self.station.services if self.undecided]
        if (first := next((pipeline for pipeline in pipelines if pipeline.identified), None)) is not None:
            self.undecided, self.other = False, first.refused
        self.station.turn(steady_ns)
        if self.station.reloads != reloads:
            self.notifier.ready(f"monitoring {len(self.station.services)} vehicles")
        self.first_look.turn(steady_ns)
        return self.other is None and signal.SIGINT not in new and signal.SIGTERM not in new

    def alive(self) -> None:
        """Tell both watchdogs that the loop goes on."""
        self.notifier.feed(not self.inbox.stuck())
        self.watchdog.feed()


def _open_journal(config: Config, log: ServiceLog, stack: ExitStack) -> BackgroundJournal | None:
    if config.journal.path is None:
        return None
    # if the folder cannot be made, the journal reports why
    with contextlib.suppress(OSError):
        config.journal.path.parent.mkdir(parents=True, exist_ok=True)
    journal = Journal(config.journal.path, config.journal.max_events)
    background = BackgroundJournal(journal)
    stack.callback(background.close)
    if journal.set_aside is not None:
        log.say("journal damaged", level="error", set_aside=str(journal.set_aside), now="a new one was begun")
    return background


def _each_second(work: Callable[[], None], name: str, stack: ExitStack) -> None:
    """Do work that may wait for a disk once a second, in a thread that ends with the stack."""
    done = threading.Event()

    def repeat() -> None:
        while not done.wait(_SYNC_S):
            work()

    thread = threading.Thread(target=repeat, name=name, daemon=True)
    thread.start()
    stack.callback(thread.join, 5.0)
    stack.callback(done.set)


def _open_messengers(config: Config, log: ServiceLog, stack: ExitStack) -> tuple[GroundSender | None, list[Messenger]]:
    """Open the messengers: the ground station, if any, and everything else that sends notices of alarms."""
    notify, station = config.notify, config.ground_station

    def on_failure(outlet: str, reason: str | None) -> None:
        if reason is None:
            log.say("notifications are delivered again", outlet=outlet)
        else:
            log.say("notification failed", level="warning", outlet=outlet, reason=reason, now="it is tried again")

    messengers = []
    if outlets := make_outlets(notify.urls_file, notify.exec, notify.exec_timeout_s):
        messengers.append(Messenger(outlets, notify.on, notify.per_minute, on_failure))
    ground = None
    if station.url is not None:
        key = None if config.signing.key_file is None else read_key(config.signing.key_file)
        ground = GroundSender(station.url, station.component, key)
        stack.callback(ground.close)
        messengers.append(Messenger([ground], per_minute=station.per_minute))
    for messenger in messengers:
        stack.callback(messenger.close)
    return ground, messengers


def _open_views(config: Config, log: ServiceLog, stack: ExitStack) -> list[LiveView]:
    """Open the views of the configuration; if a view cannot be shown, monitoring continues without it."""
    if config.rerun.mode == "off":
        return []
    from monitor.views.live_view import LiveView

    try:
        view = LiveView(config.rerun.mode, port=config.rerun.port, memory_mb=config.rerun.memory_mb)
    except ValueError as error:
        log.say("no live view", level="error", reason=str(error))
        return []
    stack.callback(view.close)
    log.say("live view", url=view.url)
    return [view]
