"""The vehicle's clock."""

from monitor.core.sampling import VehicleClock

__all__ = ["VehicleClock"]
