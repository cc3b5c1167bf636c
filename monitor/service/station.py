"""The vehicles of a daemon: their services, set up from the configuration, added and reloaded while it runs."""

from __future__ import annotations

import functools
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from adapters.errors import UsageError
from adapters.message import SECOND_NS
from adapters.zenoh.zenoh_session import endpoints
from monitor.alarms.desk import DeskRule
from monitor.bus.status_watch import VehicleStatus
from monitor.configuration.config import Config, Vehicle
from monitor.event import AlarmEvent
from monitor.notify.ground_station import Beat, GroundSender
from monitor.notify.messenger import Messenger
from monitor.pipeline import Pipeline
from monitor.profile import PROFILE_FILE, Profile, newly_watched, read_profile
from monitor.recording.archive import Archive
from monitor.recording.background import BackgroundArchive, BackgroundJournal, wait_for
from monitor.recording.black_box import BlackBox
from monitor.recording.record_encoder import RecordEncoder
from monitor.recording.recorder import Recorder
from monitor.recording.recover import finish_all
from monitor.recording.retention import FileSeries, Together
from monitor.sampling.slow_telemetry import COMMANDS_PER_TICK, motor_gain
from monitor.service.fleet import Fleet
from monitor.service.health import Health, LinkHealth, ProcessHealth, link_health, troubles
from monitor.service.inbox import Inbox
from monitor.service.links import Counting
from monitor.service.log import Level, ServiceLog
from monitor.service.vehicle_monitor import VehicleMonitor
from monitor.service.vehicle_service import VehicleService

if TYPE_CHECKING:
    import zenoh

    from monitor.service.ros_diagnostics import RosDiagnostics
    from monitor.views.live_buffer import VehicleView
    from monitor.views.live_view import LiveView

_MEGABYTE = 1_000_000
_MINUTE_S = 60
"""Time over which drops are counted for status and ``/healthz``, seconds: as long as a scraper may wait between two
requests."""
_SETTLE_S = 0.1
"""How long an alarm waits for the disk. Chosen: a hundred times as long as a commit takes on a healthy disk, and short
beside what people notice; after a wait in vain the next alarm does not wait until the disk has caught up."""


class Station:
    """The vehicles of one daemon; the session is left open by :meth:`close`.

    ``read_again`` reads the configuration anew, for a reload; the ``links`` return their counts, ``views`` show the
    vehicles, the ``messengers`` tell people of their alarms. ``troubles`` are those that concern all vehicles;
    ``reloads`` counts the finished reloads, failed ones included. Raises UsageError or TelemetryError if a profile
    cannot be used, or a folder cannot be written to.
    """

    def __init__(
        self,
        config: Config,
        read_again: Callable[[], Config],
        session: zenoh.Session,
        inbox: Inbox,
        journal: BackgroundJournal | None,
        log: ServiceLog,
        links: Mapping[str, Counting],
        views: Sequence[LiveView] = (),
        messengers: Sequence[Messenger] = (),
        ground: GroundSender | None = None,
        ros: RosDiagnostics | None = None,
    ) -> None:
        self._config = config
        self._read_again = read_again
        self._session = session
        self._inbox = inbox
        self._journal = journal
        self._log = log
        self._links = links
        self._shared_links = frozenset((*config.mavlink, *config.zenoh))
        self._views = tuple(views)
        self._messengers = tuple(messengers)
        self._ground = ground
        self._ros = ros
        self._shown: dict[str, list[VehicleView]] = {}
        self._said: dict[str, tuple[str, ...]] = {}
        self._profiles: dict[Path, Profile] = {}
        self._services: dict[str, VehicleService] = {}
        self.reloads = 0
        self._new = 0
        self._reloaded: queue.SimpleQueue[tuple[Config, dict[Path, Profile]] | str] = queue.SimpleQueue()
        self._turn_ns = self._second_ns = 0
        self._minute: deque[tuple[int, dict[str, int]]] = deque(maxlen=_MINUTE_S + 1)
        self.troubles: tuple[str, ...] = ()
        self._health = Health(ProcessHealth())
        self._listens = endpoints("listen", config.listen, config.zenoh_config, config.zenoh_mode)
        for folder in {config.recording.folder, config.black_box.folder} - {None}:
            if folder is not None and folder.is_dir():
                finish_all(folder, log.say)
        for vehicle in config.vehicles:
            self._add(vehicle)
        makes_new = config.new_vehicles.profile is not None
        self.fleet = Fleet([service.monitor for service in self._services.values()], self._meet if makes_new else None)

    @property
    def services(self) -> Sequence[VehicleService]:
        """The vehicles' services."""
        return tuple(self._services.values())

    def name_of(self, vehicle: Vehicle) -> str:
        """Return the name of a vehicle of the configuration, which may be that of its profile."""
        folder = vehicle.profile
        return vehicle.name or (self._profiles[folder].name if folder is not None else "")

    def announce(self) -> None:
        """Log which vehicles are monitored from the start, once everything is open."""
        for vehicle in self._config.vehicles:
            self._say_monitoring(vehicle)

    def health(self) -> Health:
        """Return the state of everything, at most a second old; any thread may call it."""
        health = self._health
        age_s = (time.monotonic_ns() - self._turn_ns) / 1e9 if self._turn_ns else 0.0
        return replace(health, process=replace(health.process, loop_age_s=age_s))

    def turn(self, steady_ns: int) -> None:
        """Do what is due for the daemon as a whole; called about ten times a second with the steady time."""
        self._turn_ns = steady_ns
        while not self._reloaded.empty():
            self._apply(self._reloaded.get())
            self.reloads += 1
        if steady_ns - self._second_ns >= SECOND_NS:
            self._second_ns = steady_ns
            if self._journal is not None:
                self._journal.retry()
            dropped, unread = self._dropped_lately()
            journal = None if self._journal is None else self._journal.statistics()
            waiting, stuck = self._inbox.statistics(), self._inbox.stuck()
            self._health = Health(
                ProcessHealth(0.0, waiting.waiting, self._inbox.limit, waiting.dropped, dropped),
                tuple(service.health() for service in self.services),
                tuple(
                    replace(
                        link_health(name, link.statistics(), self._inbox.figures),
                        unread=unread[name],
                        answers=name not in stuck,
                    )
                    for name, link in self._links.items()
                ),
                journal,
                tuple(outlet for messenger in self._messengers for outlet in messenger.health()),
            )
            self.troubles = tuple(troubles(self._health))
            self._beat()
            if self._ros is not None:
                self._ros.publish(self._health, time.time_ns())
            self._say_states()

    def reload(self) -> None:
        """Read configuration and profiles again, in a thread; monitoring continues meanwhile."""
        threading.Thread(target=self._load, name="reload", daemon=True).start()

    def close(self) -> None:
        """Close all services."""
        for service in self.services:
            service.close()

    def _load(self) -> None:
        try:
            config = self._read_again()
            folders = {vehicle.profile for vehicle in config.vehicles} | {config.new_vehicles.profile}
            self._reloaded.put((config, {folder: read_profile(folder) for folder in folders if folder is not None}))
        except (ValueError, OSError) as error:
            self._reloaded.put(str(error))

    def _apply(self, loaded: tuple[Config, dict[Path, Profile]] | str) -> None:
        if isinstance(loaded, str):
            self._log.say("reload failed", level="error", reason=loaded, kept="the configuration in force")
            return
        config, profiles = loaded
        self._config = config
        self._profiles = profiles
        for vehicle in config.vehicles:
            profile = profiles[vehicle.profile or Path()]
            name = self.name_of(vehicle)
            service = self._services.get(name)
            if service is None:
                self.fleet.add(self._add(vehicle).monitor)
                self._say_monitoring(vehicle)
                continue
            if _models(service.monitor.pipeline.profile) != _models(profile):
                self._log.say("restart needed", level="warning", vehicle=name, reason="its models or gains changed")
                continue
            service.retune(self._desk(vehicle), profile)
            for shown in self._shown[name]:
                shown.retune(service.monitor.pipeline.thresholds)
        self._log.say("reloaded", vehicles=len(self._services))

    def _meet(self, system: int) -> VehicleMonitor | None:
        """Return the monitor of a vehicle that the configuration does not name."""
        if self._new >= self._config.new_vehicles.limit:
            self._log.say("vehicle refused", level="warning", system=system, reason="[new_vehicles] limit is reached")
            return None
        vehicle = self._config.new_vehicles.vehicle(system)
        if vehicle.name in self._services:
            return None
        try:
            service = self._add(vehicle)
        except (ValueError, OSError) as error:
            self._log.say("vehicle refused", level="error", system=system, reason=str(error))
            return None
        self._new += 1
        self._say_monitoring(vehicle)
        return service.monitor

    def _add(self, vehicle: Vehicle) -> VehicleService:
        config, folder = self._config, vehicle.profile
        if folder is None:
            raise UsageError(f"vehicle '{vehicle.name}' has no profile: name one, made by 'fauio fit'")
        if folder not in self._profiles:
            self._profiles[folder] = read_profile(folder)
        profile = self._profiles[folder]
        force = vehicle.force or config.force
        pipeline = Pipeline(profile, vehicle.name, vehicle.system or None, vehicle.component, force=force)
        if pipeline.vehicle in self._services:
            raise UsageError(f"two vehicles are called '{pipeline.vehicle}'; give each a name of its own")
        with ExitStack() as stack:
            archive = self._archive(pipeline, profile, stack)
            archives: list[Any] = [] if archive is None else [archive]
            disks = [*archives, *([] if self._journal is None else [self._journal])]
            settle = functools.partial(wait_for, disks, _SETTLE_S)
            needed = frozenset[str]().union(*pipeline.needs.values())
            shown = [
                view.vehicle(pipeline.vehicle, pipeline.layouts, pipeline.thresholds, needed) for view in self._views
            ]
            self._shown[pipeline.vehicle] = shown
            archives += shown
            monitor = VehicleMonitor(pipeline, archives, self._journal, self._on_event, time.time_ns(), settle)
            desk, links, recordings = self._desk(vehicle), functools.partial(self._links_of, vehicle), stack.pop_all()
            service = VehicleService(monitor, desk, self._session, config, self._journal, archive, recordings, links)
        self._services[pipeline.vehicle] = service
        return service

    def _beat(self) -> None:
        """Report to the ground station which vehicles this monitor is active for, and their state."""
        if self._ground is None:
            return
        beats = {}
        for name, service in self._services.items():
            if service.monitor.active:
                pipeline = service.monitor.pipeline
                critical = any(event.severity == "critical" for event in pipeline.desk.active)
                beats[name] = Beat(pipeline.system, critical)
        self._ground.beat(beats, time.time_ns(), self._health.process.resident_bytes)

    def _on_event(self, event: AlarmEvent) -> None:
        self._log.event(event)
        for messenger in self._messengers:
            messenger.event(event)

    def _say_monitoring(self, vehicle: Vehicle) -> None:
        config, name = self._config, self.name_of(vehicle)
        self._log.say(
            "monitoring",
            vehicle=name,
            telemetry=vehicle.zenoh or ", ".join((*config.mavlink, *config.zenoh)),
            zenoh=", ".join(self._listens) or "no listener",
            topics=f"{config.prefix}/{name}/**",
        )
        observers = self._profiles[vehicle.profile].observers if vehicle.profile else ()
        new = newly_watched([fault.name for fault in observer.faults] for observer in observers)
        for observer, faults in zip(observers, new, strict=True):
            if faults and any(channel.interpolation == "mean" for channel in observer.source.inputs):
                gain = motor_gain(COMMANDS_PER_TICK * observer.rate_hz)
                advice = f"{gain}; ask for it with [send] rates, record, fit again"
                self._log.say("slow profile", vehicle=name, observer=observer.name, advice=advice)

    def _say_states(self) -> None:
        """Log each change of a vehicle's status, since not every vehicle has a subscriber."""
        for name, service in self._services.items():
            said = service.last_status
            status = VehicleStatus(name, said.get("state", "starting"), tuple(said.get("reasons", ())))
            if status.kind != self._said.get(name, ("starting",)):
                self._said[name] = status.kind
                why = {"because": "; ".join(status.reasons)} if status.reasons else {}
                level: Level = "info" if status.well else "warning"
                self._log.say("status", level=level, vehicle=name, state=status.state, **why)

    def _links_of(self, vehicle: Vehicle) -> tuple[LinkHealth, ...]:
        """Return the links that all vehicles share, and the vehicle's own."""
        names = self._shared_links | {vehicle.zenoh}
        return tuple(link for link in self._health.links if link.name in names)

    @property
    def _sharers(self) -> int:
        """Return how many vehicles share the room for recordings and clips."""
        new = self._config.new_vehicles
        return max(len(self._config.vehicles) + (0 if new.profile is None else new.limit), 1)

    def _archive(self, pipeline: Pipeline, profile: Profile, stack: ExitStack) -> BackgroundArchive | None:
        config, name = self._config, pipeline.vehicle
        encoder = RecordEncoder(pipeline.layouts)
        common = (encoder.topics, pipeline.metadata(), profile.files)
        recorder = black_box = None
        target: Path | FileSeries | None = config.record
        if config.record is not None:
            config.record.parent.mkdir(parents=True, exist_ok=True)
        elif config.recording.folder is not None:
            table = config.recording
            share = table.budget_mb / self._sharers
            target = FileSeries(
                config.recording.folder / name,
                name,
                # a budget holds two files, the one that is written and the one before it
                file_bytes=int(min(table.file_mb, share / 2) * _MEGABYTE),
                file_s=table.file_minutes * 60.0,
                budget_bytes=round(share * _MEGABYTE),
                together=Together(round(table.budget_mb * _MEGABYTE), self._shown),
            )
        if target is not None:
            recorder = Recorder(target, *common)
        if config.black_box.folder is not None:
            clips = config.black_box
            black_box = BlackBox(
                config.black_box.folder / name,
                name,
                *common,
                before_s=clips.before_s,
                after_s=clips.after_s,
                budget_bytes=round(clips.budget_mb / self._sharers * _MEGABYTE),
                together=Together(round(clips.budget_mb * _MEGABYTE), self._shown),
            )
        if recorder is None and black_box is None:
            return None
        archive = BackgroundArchive(Archive(encoder, recorder, black_box), name, self._sharers)
        stack.callback(self._finish, archive, recorder, pipeline)
        return archive

    def _finish(self, archive: BackgroundArchive, recorder: Recorder | None, pipeline: Pipeline) -> None:
        """End recordings with the clock's mapping, which is only known at their end."""
        archive.close(pipeline.metadata())
        if recorder is not None and (reason := recorder.statistics().failed) is not None:
            self._log.say("recording incomplete", level="error", vehicle=pipeline.vehicle, reason=reason)

    def _desk(self, vehicle: Vehicle) -> DeskRule:
        flood = self._config.flood
        return DeskRule(
            latched=frozenset(vehicle.latched),
            out_of_service=frozenset(vehicle.out_of_service),
            flood_raised=flood.raised,
            flood_s=flood.within_s,
        )

    def _dropped_lately(self) -> tuple[int, dict[str, int]]:
        """Return the messages that the inbox, and each link or its kernel, dropped in the last minute."""
        counts = {name: link.statistics() for name, link in self._links.items()}
        unread = {name: getattr(count, "overruns", 0) + getattr(count, "dropped", 0) for name, count in counts.items()}
        self._minute.append((self._inbox.statistics().dropped, unread))
        dropped_before, unread_before = self._minute[0]
        before = dict.fromkeys(unread, 0) | unread_before
        return self._minute[-1][0] - dropped_before, {name: count - before[name] for name, count in unread.items()}


def _models(profile: Profile) -> dict[str, bytes]:
    """Return the parts of a profile that cannot change while it runs: models and gains."""
    return {name: data for name, data in profile.files.items() if name != PROFILE_FILE}
