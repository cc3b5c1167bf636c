"""The service around one vehicle's monitor: active or standby, operators' commands, status, flushing, clips."""

from __future__ import annotations

import functools
import logging
import queue
import threading
import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from adapters.batch import pack
from adapters.errors import UsageError
from adapters.mavlink.signing import read_key
from monitor.alarms.desk import DeskRule
from monitor.bus.keys import vehicle_root
from monitor.bus.operators import Operators
from monitor.bus.publisher import Publisher
from monitor.bus.seal import Seal
from monitor.bus.subscriber import AlarmSubscriber
from monitor.configuration.config import Config
from monitor.event import AlarmEvent
from monitor.pipeline import rules_message
from monitor.profile import Profile
from monitor.recording.background import BackgroundArchive, BackgroundJournal
from monitor.service.election import Election, term_of
from monitor.service.health import LinkHealth, VehicleHealth
from monitor.service.vehicle_monitor import VehicleMonitor

if TYPE_CHECKING:
    import zenoh

STATUS_NS = 1_000_000_000
"""Time between statuses: a second, as the interface promises."""
_FLUSH_NS = 500_000_000
"""Time between flushes. Chosen: a kill loses at most that much of a recording; flushing more often makes small
chunks."""
_AWAY_NS = 1_000_000_000
"""A loop that did not run for longer may have been taken for dead: another monitor may be active."""
_PEER_EVENTS_AT_ONCE = 500
"""Largest number of the active monitor's events in one turn of the loop. Chosen: telemetry does not wait for them."""
_REMEMBER_S = 0.5
"""How long the loop waits for the journal when it becomes active. Chosen: an index is read in milliseconds, 16 vehicles
that wait for a disk that hangs stay below the watchdog's 10 s, and the events that the other monitor published are
known without the journal."""
_PAST_EVENTS = 4096
"""Events at the start of the history: as many as the publisher keeps."""


class VehicleService:
    """Runs one vehicle's monitor in the daemon; the session is left open by :meth:`close`.

    ``desk`` is the desk's rule at the start. The journal keeps the alarms that were active before a restart, the
    archive records the vehicle, and ``recordings`` closes it. ``links`` are those that its telemetry may come over.
    """

    def __init__(
        self,
        monitor: VehicleMonitor,
        desk: DeskRule,
        session: zenoh.Session,
        config: Config,
        journal: BackgroundJournal | None = None,
        archive: BackgroundArchive | None = None,
        recordings: ExitStack | None = None,
        links: Callable[[], Sequence[LinkHealth]] = tuple,
    ) -> None:
        self.monitor = monitor
        self.last_status: dict[str, Any] = {}
        self._session = session
        self._config = config
        self._journal = journal
        self.archive = archive
        self._recordings = recordings
        self._links = links
        self._operators: Operators | None = None
        self._seal: Seal | None = None
        self._election: Election | None = None
        self._others: AlarmSubscriber | None = None
        self._root = vehicle_root(config.prefix, monitor.name)
        # All times are those of the monotonic clock. Periodic work of each vehicle is due at a moment of its own, by
        # its name: done at once for all it would keep the loop, and by their threads Python's lock, from alarms.
        self._decided_ns = time.monotonic_ns()
        self._status_ns = self._flushed_ns = self._decided_ns - zlib.crc32(monitor.name.encode()) % STATUS_NS
        now_ns = time.time_ns()
        pipeline = monitor.pipeline
        monitor.process(pack([rules_message(desk, pipeline.profile, now_ns, pipeline.system)]))
        if config.standby.enabled:
            # With history: events published while this monitor was not running belong in its journal too.
            if config.standby.key_file is None:
                raise UsageError("[standby] needs a key_file")
            self._seal = Seal(read_key(config.standby.key_file).secret)
            self._others = AlarmSubscriber(session, monitor.name, config.prefix, history=True, seal=self._seal)
            self._election = Election(session, self._root, self._seal, config.standby.takeover_s)
        else:
            self._activate(now_ns)

    def retune(self, desk: DeskRule, profile: Profile) -> None:
        """Apply another desk's rule and a profile's alarm sizes from now on."""
        self.monitor.process(pack([rules_message(desk, profile, time.time_ns())]))

    def work(self, steady_ns: int, now_ns: int, troubles: Sequence[str]) -> None:
        """Do what is due: activate or deactivate, answer operators, flush, publish the status.

        Due times are steady times (the monotonic clock's), stamps are Unix times.
        """
        self._decide(steady_ns, now_ns)
        if self.archive is not None:
            self.archive.work(now_ns)
        if self._operators is not None:
            self._answer(self._operators)
        if steady_ns - self._flushed_ns >= _FLUSH_NS:
            self._flushed_ns = steady_ns - (steady_ns - self._flushed_ns) % _FLUSH_NS
            self.monitor.flush()
        if steady_ns - self._status_ns >= STATUS_NS:
            self._status_ns = steady_ns - (steady_ns - self._status_ns) % STATUS_NS
            trouble = None if self.archive is None else self.archive.statistics().trouble
            self.last_status = self.monitor.status(now_ns, [*troubles, *([trouble] if trouble else [])], self._links())

    def health(self) -> VehicleHealth:
        """Return the vehicle's health."""
        recorder = None if self.archive is None else self.archive.statistics()
        return self.monitor.health(self.last_status.get("state", "starting"), recorder, time.time_ns())

    def close(self) -> None:
        """Deactivate and finish the recordings."""
        if self._operators is not None:
            self._operators.close()
        self.monitor.deactivate()
        if self._election is not None:
            self._election.close()
        if self._others is not None:
            self._others.close()
        if self._recordings is not None:
            self._recordings.close()

    def _decide(self, steady_ns: int, now_ns: int) -> None:
        if self._election is None or self._others is None or self._seal is None:
            return
        for _ in range(_PEER_EVENTS_AT_ONCE):
            if (event := self._others.receive(0.0)) is None:
                break
            self.monitor.on_peer_event(event)
        else:
            # More events wait; only after the last of them can this monitor continue from them.
            return
        away_ns, self._decided_ns = steady_ns - self._decided_ns, steady_ns
        if away_ns > _AWAY_NS and self.monitor.active:
            # After a freeze of the process another monitor may be active: elect anew before publishing.
            self._election.close()
            self._election = Election(self._session, self._root, self._seal, self._config.standby.takeover_s)
        leads = self._election.turn()
        self.monitor.confirm(steady_ns)
        if leads and not self.monitor.active:
            logging.getLogger(__name__).warning("active for %s from now on", self.monitor.name)
            self._activate(now_ns)
            self._election.term = term_of(self.monitor.pipeline.desk.seq)
            # An immediate status shows the new active monitor.
            self._status_ns = steady_ns - STATUS_NS
        elif not leads and self.monitor.active:
            logging.getLogger(__name__).warning("another monitor is active for %s; on standby", self.monitor.name)
            if self._operators is not None:
                self._operators.close()
                self._operators = None
            self.monitor.deactivate()

    def _activate(self, now_ns: int) -> None:
        monitor, journal = self.monitor, self._journal
        name, layouts = monitor.name, monitor.pipeline.layouts
        past = None if journal is None else functools.partial(journal.events, name, limit=_PAST_EVENTS)
        config, commands = self._config, self._config.commands
        outlet = Publisher(self._session, name, layouts, config.prefix, config.estimate_rate_hz, past, self._seal)
        monitor.activate(outlet, now_ns, *_remembered(journal, name))
        limits = commands.default_shelve_minutes, commands.max_shelve_minutes
        self._operators = Operators(self._session, self._root, commands.allow, *limits)

    def _answer(self, operators: Operators) -> None:
        desk = self.monitor.pipeline.desk
        for command in operators.pending():
            message = operators.message(command, time.time_ns())
            reason = desk.refusal(message.name, message.fields)
            if reason is not None:
                operators.refuse(command, reason)
                continue
            events = self.monitor.process(pack([message]))
            operators.accept(command, events[-1] if events else None)


_Remembered = tuple[Sequence[AlarmEvent], int, Mapping[str, int]]


def _remembered(journal: BackgroundJournal | None, vehicle: str) -> _Remembered:
    """Return the active alarms of the journal, the number of its last event, the shelved channels.

    If it cannot be read, or the disk does not answer in time, there are none: the new term of numbers is above all that
    were used before.
    """
    if journal is None:
        return (), 0, {}
    answer: queue.SimpleQueue[_Remembered | OSError] = queue.SimpleQueue()

    def read() -> None:
        try:
            answer.put((journal.active(vehicle), journal.last_seq(vehicle), journal.shelved(vehicle)))
        except OSError as error:
            answer.put(error)

    threading.Thread(target=read, name=f"journal of {vehicle}", daemon=True).start()
    try:
        found = answer.get(timeout=_REMEMBER_S)
    except queue.Empty:
        found = OSError(f"the disk has not answered for {_REMEMBER_S:g} s")
    if isinstance(found, OSError):
        logging.getLogger(__name__).warning("alarms from before the start are not known: %s", found)
        return (), 0, {}
    return found
