"""Which vehicle a message belongs to: by its own link, by MAVLink system id, or a vehicle nobody has seen before."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from adapters.batch import Batch, Columns, gathered, joined
from adapters.mavlink.heartbeat import AUTOPILOT, autopilot_heartbeats
from adapters.message import Message
from monitor.service.inbox import Arrival
from monitor.service.vehicle_monitor import VehicleMonitor

NewVehicle = Callable[[int], VehicleMonitor | None]


class Fleet:
    """The vehicles of one monitor.

    A vehicle whose pipeline has no system id yet takes the first that fits. ``new_vehicle`` makes the monitor of a
    system id that belongs to none of them, or returns None where there shall be none; it is asked once for each.
    ``foreign`` counts messages that belong to no vehicle: of ground stations, other components and systems nobody asked
    for.
    """

    def __init__(self, vehicles: Sequence[VehicleMonitor], new_vehicle: NewVehicle | None = None) -> None:
        self._vehicles = {vehicle.name: vehicle for vehicle in vehicles}
        self._by_system = {vehicle.pipeline.system: vehicle for vehicle in vehicles if vehicle.pipeline.system}
        self._new_vehicle = new_vehicle
        self._refused: set[int] = set()
        self.foreign = 0

    def __iter__(self) -> Iterator[VehicleMonitor]:
        return iter(tuple(self._vehicles.values()))

    def __len__(self) -> int:
        return len(self._vehicles)

    def get(self, name: str) -> VehicleMonitor | None:
        """Return the vehicle of a name."""
        return self._vehicles.get(name)

    def add(self, vehicle: VehicleMonitor) -> None:
        """Add a vehicle while the monitor runs."""
        self._vehicles[vehicle.name] = vehicle
        if vehicle.pipeline.system:
            self._by_system[vehicle.pipeline.system] = vehicle

    def routed(self, arrivals: Sequence[Arrival]) -> list[tuple[VehicleMonitor, Batch]]:
        """Return each vehicle with its messages of these arrivals as one batch; messages of none are counted."""
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
        entries: list[Columns | Message] = [*batch.columns, *batch.others.values()]
        systems = {entry.system if entry.source.has_ids else None for entry in entries}
        if len(systems) == 1:
            vehicle = self._vehicle_of(systems.pop(), batch)
            return [(vehicle, batch)] if vehicle is not None else self._discard(batch.count)
        parts = []
        for system in systems:
            part = gathered(
                [columns for columns in batch.columns if _is_of(columns, system)],
                {index: message for index, message in batch.others.items() if _is_of(message, system)},
            )
            vehicle = self._vehicle_of(system, part)
            parts += [(vehicle, part)] if vehicle is not None else self._discard(part.count)
        return parts

    def _discard(self, count: int) -> list[tuple[VehicleMonitor, Batch]]:
        self.foreign += count
        return []

    def _vehicle_of(self, system: int | None, batch: Batch) -> VehicleMonitor | None:
        """Return the vehicle of a batch of one system; None for the system stands for messages without ids."""
        if system is None:
            return next(iter(self._vehicles.values())) if len(self._vehicles) == 1 else None
        return self._by_system.get(system) or self._first_seen(system, batch)

    def _first_seen(self, system: int, batch: Batch) -> VehicleMonitor | None:
        """Return the vehicle that a new system id belongs to from now on."""
        if system in self._refused:
            return None
        for vehicle in self._vehicles.values():
            entries: list[Columns | Message] = [*batch.columns, *batch.others.values()]
            if vehicle.pipeline.system == 0 and any(vehicle.pipeline.accepts(entry) for entry in entries):
                self._by_system[system] = vehicle
                return vehicle
        if self._new_vehicle is None or not any(
            columns.component == AUTOPILOT and autopilot_heartbeats(columns).any() for columns in batch.columns
        ):
            return None
        made = self._new_vehicle(system)
        if made is None:
            self._refused.add(system)
            return None
        self.add(made)
        return made


def _is_of(entry: Columns | Message, system: int | None) -> bool:
    return not entry.source.has_ids if system is None else entry.source.has_ids and entry.system == system
