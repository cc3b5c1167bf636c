"""Which vehicle a message belongs to: by its own link, by MAVLink system id, or a vehicle nobody has seen before."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from adapters.mavlink.heartbeat import is_autopilot_heartbeat
from adapters.message import Message
from monitor.service.inbox import Arrival
from monitor.service.vehicle_monitor import VehicleMonitor

_AUTOPILOT = 1

NewVehicle = Callable[[int], VehicleMonitor | None]


class Fleet:
    """The vehicles of one monitor.

    Parameters
    ----------
    vehicles : Sequence[VehicleMonitor]
        Vehicles known from the start. One whose pipeline has no system id yet takes the first that fits.
    new_vehicle : NewVehicle | None
        Makes the monitor of a system id that belongs to none of them, or returns None where there shall be none;
        asked once for each. None: there are no others.

    Attributes
    ----------
    foreign : int
        Messages that belong to no vehicle: of ground stations, other components and systems nobody asked for.
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

    def vehicle_of(self, arrival: Arrival) -> VehicleMonitor | None:
        """Return the vehicle that a message belongs to, None (and counted) where it belongs to none."""
        vehicle = None
        message = arrival.message
        if arrival.vehicle is not None:
            vehicle = self._vehicles.get(arrival.vehicle)
        elif message.source.has_ids:
            vehicle = self._by_system.get(message.system) or self._first_seen(message)
        elif len(self._vehicles) == 1:
            vehicle = next(iter(self._vehicles.values()))
        if vehicle is None:
            self.foreign += 1
        return vehicle

    def _first_seen(self, message: Message) -> VehicleMonitor | None:
        """Return the vehicle that a new system id belongs to from now on."""
        if not message.source.is_telemetry or message.system in self._refused:
            return None
        for vehicle in self._vehicles.values():
            if vehicle.pipeline.system == 0 and vehicle.pipeline.accepts(message):
                self._by_system[message.system] = vehicle
                return vehicle
        if self._new_vehicle is None or not (message.component == _AUTOPILOT and is_autopilot_heartbeat(message)):
            return None
        made = self._new_vehicle(message.system)
        if made is None:
            self._refused.add(message.system)
            return None
        self.add(made)
        return made
