"""What the compensation does when something is wrong: estimates that come late, a wrong model, a wrong estimate."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from closed_loop import ACTUATOR, SENSOR, Estimates, Exchange, Plant, alone, close_loop, in_process
from numpy.typing import NDArray
from run import BOTH, SETTLED_S, WITHOUT, controller, rms

from adapters.simulation.arm import SCENARIOS

DELAYS = (0, 1, 2, 5, 8, 12)
EFFECTIVENESS = (0.3, 0.5, 0.7, 1.0, 1.3, 1.6, 1.8, 1.9, 2.1, 2.3)
_DURATION_S = 37.0
_ABSURD = 1000.0


def delays(samples: Sequence[int]) -> list[tuple[int, float, float]]:
    """Return, by delay of the estimates in samples, RMS and largest tracking error in case 2, rad."""
    found = []
    for delay in samples:
        run = close_loop(Plant(SCENARIOS["case2"], _DURATION_S), in_process(controller(BOTH), delay))
        found.append((delay, *_errors(run.t, run.error)))
    return found


def mismatches(shares: Sequence[float]) -> list[tuple[float, float, float, float]]:
    """Return, by the share of its torque that the motor delivers, errors (rad) without and with, and largest torque.

    The monitor's model says 1: what differs is a fault to it, and grows with the torque that takes it out.
    """
    found = []
    for share in shares:
        plant = Plant(SCENARIOS["healthy"], _DURATION_S, share)
        without = close_loop(plant, alone(controller(WITHOUT)))
        run = close_loop(plant, in_process(controller(BOTH)))
        settled = run.t >= SETTLED_S
        found.append(
            (share, rms(without.error[settled]), rms(run.error[settled]), float(np.abs(run.torque[settled]).max()))
        )
    return found


def stuck(channel: str) -> tuple[float, float]:
    """Return RMS and largest tracking error (rad) of the healthy arm when the monitor insists on an absurd fault."""
    run = close_loop(Plant(SCENARIOS["healthy"], _DURATION_S), _insisting(channel))
    return _errors(run.t, run.error)


def _insisting(channel: str) -> Exchange:
    law = controller(BOTH)

    def exchange(now_s: float, torque: float, y: NDArray[np.float64]) -> tuple[float, Estimates]:
        estimate = {
            "vehicle_time_ms": round(1000.0 * now_s),
            "armed": now_s >= SETTLED_S,
            "coasted_s": 0.0,
            "fault": dict.fromkeys((ACTUATOR, SENSOR), 0.0) | {channel: _ABSURD},
            "sd": dict.fromkeys((ACTUATOR, SENSOR), 0.1),
        }
        return law.step(now_s, y, estimate), estimate

    return exchange


def _errors(t: NDArray[np.float64], error: NDArray[np.float64]) -> tuple[float, float]:
    settled = t >= SETTLED_S
    return rms(error[settled]), float(np.abs(error[settled]).max())


def main() -> None:
    """Print the three tables."""
    print("estimates late by (samples of 10 ms), case 2: RMS and largest error, rad")
    for delay, size, largest in delays(DELAYS):
        print(f"{delay:4d} {size:10.4f} {largest:10.4f}")
    print("motor delivers (share), no other fault: RMS error without and with, rad; largest torque, N m")
    for share, without, size, torque in mismatches(EFFECTIVENESS):
        print(f"{share:4.1f} {without:10.4f} {size:10.4f} {torque:10.2f}")
    print("monitor insists on an absurd fault, arm healthy: RMS and largest error, rad")
    for channel in (ACTUATOR, SENSOR):
        size, largest = stuck(channel)
        print(f"{channel:8} {size:6.4f} {largest:10.4f}")


if __name__ == "__main__":
    main()
