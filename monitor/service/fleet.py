"""Which vehicle a message belongs to: by its own link, by MAVLink system id, or a new vehicle.

A system id that belongs to no vehicle becomes a vehicle when its telemetry has come for a while. A forged packet or two
therefore take no vehicle, and heartbeats alone take none of the places for new vehicles. The messages of that while are
kept and then processed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np

from adapters.batch import Batch, Columns, chosen, joined, sender_of
from adapters.mavlink.heartbeat import AUTOPILOT, holds_autopilot_heartbeat
from adapters.message import Message
from monitor.alarms.command_watch import COMMANDS, commanded_systems
from monitor.pipeline import Pipeline
from monitor.service.inbox import Arrival
from monitor.service.vehicle_monitor import VehicleMonitor

_SLOT_NS = 100_000_000
"""Messages within this time are one burst. Chosen: only a link that bunches messages holds them back for a tenth of a
second."""
_LEAST_SLOTS = 3
"""Number of tenths of a second with telemetry that make a vehicle. Chosen: a link with ten messages a second has them
after 0.3 s, and a burst of forged packets does not."""
_LEAST_MESSAGES = 50
"""Number of messages of telemetry in one burst that make a vehicle, too: a link had held them back. Chosen: more than a
forged packet or two."""
_MOST_SLOTS = 50
"""Most bursts that are counted: as many as there are in the time for which messages are kept."""
_KEPT_NS = 5_000_000_000
"""How long messages without a vehicle are kept. Chosen: three messages of a radio at 1 Hz, and the heartbeats between
them."""
_KEPT_MESSAGES = 10_000
"""Most messages without a vehicle that are kept, of all systems together: 20 MB. The system with most of them loses its
oldest."""
_LEAST_APART_NS = 250_000_000
"""Time from one new vehicle to the next. Chosen: 16 vehicles that are switched on together are there after 4 s, and
whoever forges as many can be seen doing it. Of the systems that wait, the one with most telemetry is first."""

NewVehicle = Callable[[int], VehicleMonitor | None]


class Fleet:
    """The vehicles of one monitor.

    A vehicle whose pipeline has no system id yet takes the first system that sends its channels for a while.
    ``new_vehicle`` makes the monitor of a system id that belongs to no vehicle, once an autopilot has sent heartbeats
    and other telemetry; it returns None if there is to be none, and is called once for each id. ``foreign`` counts the
    messages that belong to no vehicle: of ground stations, other components and systems that are not monitored.
    """

    def __init__(self, vehicles: Sequence[VehicleMonitor], new_vehicle: NewVehicle | None = None) -> None:
        self._vehicles = {vehicle.name: vehicle for vehicle in vehicles}
        self._by_system = {vehicle.pipeline.system: vehicle for vehicle in vehicles if vehicle.pipeline.system}
        self._new_vehicle = new_vehicle
        self._refused: set[int] = set()
        self._strangers: dict[int, _Stranger] = {}
        self._made_ns = 0
        self.foreign = 0

    def __iter__(self) -> Iterator[VehicleMonitor]:
        return iter(tuple(self._vehicles.values()))

    def __len__(self) -> int:
        return len(self._vehicles)

    def get(self, name: str) -> VehicleMonitor | None:
        """Return the vehicle with a name."""
        return self._vehicles.get(name)

    def add(self, vehicle: VehicleMonitor) -> None:
        """Add a vehicle while the monitor runs."""
        self._vehicles[vehicle.name] = vehicle
        if vehicle.pipeline.system:
            self._by_system[vehicle.pipeline.system] = vehicle

    def routed(self, arrivals: Sequence[Arrival]) -> list[tuple[VehicleMonitor, Batch]]:
        """Return each vehicle with its messages of these arrivals as one batch.

        Count the messages without a vehicle.
        """
        parts: dict[str, tuple[VehicleMonitor, list[Batch]]] = {}
        for arrival in arrivals:
            for vehicle, batch in self._split(arrival):
                parts.setdefault(vehicle.name, (vehicle, []))[1].append(batch)
        return [(vehicle, joined(batches)) for vehicle, batches in parts.values()]

    def _split(self, arrival: Arrival) -> list[tuple[VehicleMonitor, Batch]]:
        """Return the vehicles that a batch belongs to, each with its part."""
        batch = arrival.batch
        if arrival.vehicle is not None:
            own = self._vehicles.get(arrival.vehicle)
            return [(own, batch)] if own is not None else self._discard(batch.count)
        systems = set(map(sender_of, batch.entries))
        systems |= {system for entry in batch.entries if entry.name in COMMANDS for system in self._commanded(entry)}
        if len(systems) == 1:
            return self._parts_of(systems.pop(), batch)
        parts = []
        for system in systems:
            parts += self._parts_of(system, chosen(batch, partial(self._is_for, system)))
        return parts

    def _commanded(self, entry: Columns | Message) -> set[int]:
        """Return the systems of vehicles that a message commands."""
        targets = commanded_systems(entry)
        return set(self._by_system) if 0 in targets else targets & self._by_system.keys()

    def _is_for(self, system: int | None, entry: Columns | Message) -> bool:
        return sender_of(entry) == system or (entry.source.has_ids and system in self._commanded(entry))

    def _discard(self, count: int) -> list[tuple[VehicleMonitor, Batch]]:
        self.foreign += count
        return []

    def _parts_of(self, system: int | None, batch: Batch) -> list[tuple[VehicleMonitor, Batch]]:
        """Return the vehicle of a batch of one system, with the batch.

        None for the system means messages without ids.
        """
        if system is not None and system not in self._by_system:
            return self._strange(system, batch)
        known = self._by_system.get(system) if system is not None else None
        if system is None and len(self._vehicles) == 1:
            known = next(iter(self._vehicles.values()))
        return [(known, batch)] if known is not None else self._discard(batch.count)

    def _strange(self, system: int, batch: Batch) -> list[tuple[VehicleMonitor, Batch]]:
        """Keep messages that belong to no vehicle yet; return them with the vehicle if they now make one."""
        free = next((vehicle for vehicle in self._vehicles.values() if vehicle.pipeline.system == 0), None)
        if system in self._refused or (free is None and self._new_vehicle is None):
            return self._discard(batch.count)
        stranger = self._strangers.setdefault(system, _Stranger())
        self.foreign += stranger.add(batch, None if free is None else free.pipeline)
        self._bound()
        if not stranger.sends:
            return []
        if free is not None:
            free.pipeline.system = system
            self._by_system[system] = free
            return [(free, self._taken(system))]
        ready = {system: seen.slots for system, seen in self._strangers.items() if seen.heartbeat and seen.sends}
        if not ready or 0 <= stranger.newest_ns - self._made_ns < _LEAST_APART_NS:
            return []
        self._made_ns = stranger.newest_ns
        first = max(ready, key=lambda system: ready[system])
        made = None if self._new_vehicle is None else self._new_vehicle(first)
        kept = self._taken(first)
        if made is None:
            self._refused.add(first)
            return self._discard(kept.count)
        self.add(made)
        return [(made, kept)]

    def _taken(self, system: int) -> Batch:
        return joined([batch for _, batch, _ in self._strangers.pop(system).kept])

    def _bound(self) -> None:
        """Forget the oldest messages without a vehicle if there are too many, those of the system with most of them."""
        while sum(seen.count for seen in self._strangers.values()) > _KEPT_MESSAGES:
            most = max(self._strangers.values(), key=lambda seen: seen.count)
            self.foreign += most.forget(1)


class _Stranger:
    """The latest messages of a system id that belongs to no vehicle."""

    def __init__(self) -> None:
        # time, number of messages, number of telemetry messages
        self.kept: deque[tuple[int, Batch, int]] = deque()
        self._slots: deque[int] = deque()
        self.heartbeat = False  # whether one of an autopilot came
        self.newest_ns = 0

    @property
    def slots(self) -> int:
        """Number of tenths of a second in which its telemetry came."""
        return len(self._slots)

    @property
    def count(self) -> int:
        """Number of messages that are kept."""
        return sum(batch.count for _, batch, _ in self.kept)

    @property
    def sends(self) -> bool:
        """Whether its telemetry has come for long enough."""
        return self.slots >= _LEAST_SLOTS or sum(count for _, _, count in self.kept) >= _LEAST_MESSAGES

    def add(self, batch: Batch, pipeline: Pipeline | None) -> int:
        """Keep a batch; return how many messages were forgotten. A pipeline tells which telemetry it waits for."""
        telemetry = 0
        for entry in batch.entries:
            times = entry.received_ns if isinstance(entry, Columns) else np.array([entry.received_ns])
            self.newest_ns = int(times[-1])
            if isinstance(entry, Columns) and entry.component == AUTOPILOT and holds_autopilot_heartbeat(entry):
                self.heartbeat = True
            elif self._counts(entry, pipeline):
                telemetry += len(times)
                new = sorted({int(slot) for slot in times // _SLOT_NS} - set(self._slots))
                self._slots.extend(new[-_MOST_SLOTS:])
        self.kept.append((self.newest_ns, batch, telemetry))
        oldest = (self.newest_ns - _KEPT_NS) // _SLOT_NS
        self._slots = deque((slot for slot in self._slots if slot > oldest), _MOST_SLOTS)
        return self.forget(sum(self.newest_ns - time_ns >= _KEPT_NS for time_ns, _, _ in self.kept))

    def forget(self, batches: int) -> int:
        """Forget the oldest batches; return how many messages were in them."""
        return sum(self.kept.popleft()[1].count for _ in range(min(batches, len(self.kept))))

    def _counts(self, entry: Columns | Message, pipeline: Pipeline | None) -> bool:
        if pipeline is not None:
            return pipeline.identifies(entry)
        return entry.source.is_telemetry and entry.component == AUTOPILOT and entry.name != "HEARTBEAT"
