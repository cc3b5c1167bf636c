"""The arm under control with the monitor beside it: in one process, or over Zenoh with the daemon."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from arm_controller import LINK, Controller
from numpy.typing import NDArray

import fauio
from adapters.simulation.arm import ArmScenario, ArmState, fault_size, measure_arm, step_arm, tracking_reference
from monitor.bus.payload import estimate_json

PROFILE = Path(__file__).parent / "arm"
TELEMETRY = "arm/telemetry"
ACTUATOR, SENSOR = "motor", "encoder"
RATE_HZ = 100.0
PERIOD_S = 1.0 / RATE_HZ

Estimates = Mapping[str, Any] | None
"""What the monitor publishes at one sample; None where it has said nothing."""
Exchange = Callable[[float, float, NDArray[np.float64]], tuple[float, Estimates]]
"""Time, torque and measurement of a sample -> the torque of the next, and the estimate it was made with."""


@dataclass(frozen=True, slots=True)
class Run:
    """A run in closed loop, one row per sample.

    Parameters
    ----------
    t, link, wanted, torque : NDArray[np.float64]
        Time (s), link angle and what it should be (rad), commanded torque (N m).
    actuator, sensor : NDArray[np.float64]
        True faults (N m, rad).
    actuator_estimate, sensor_estimate : NDArray[np.float64]
        What the monitor said of them at these samples; not a number where nothing.
    """

    t: NDArray[np.float64]
    link: NDArray[np.float64]
    wanted: NDArray[np.float64]
    torque: NDArray[np.float64]
    actuator: NDArray[np.float64]
    sensor: NDArray[np.float64]
    actuator_estimate: NDArray[np.float64]
    sensor_estimate: NDArray[np.float64]

    @property
    def error(self) -> NDArray[np.float64]:
        """Tracking error of the link, rad."""
        return self.link - self.wanted


@dataclass(frozen=True, slots=True)
class Plant:
    """What is controlled.

    Parameters
    ----------
    scenario : ArmScenario
        Faults and disturbances.
    duration_s : float
        Length of a run.
    effectiveness : float
        Share of the commanded torque that the motor delivers: other than 1 the monitor's model is wrong.
    """

    scenario: ArmScenario
    duration_s: float
    effectiveness: float = 1.0


def close_loop(plant: Plant, exchange: Exchange) -> Run:
    """Run the plant; each sample goes out, the torque for the next one comes back."""
    state, torque = tracking_reference(0.0)
    silent = (np.nan, np.nan)
    rows = []
    for k in range(round(plant.duration_s * RATE_HZ)):
        now_s = k / RATE_HZ
        y = np.array(measure_arm(plant.scenario, state, now_s))
        following, estimate = exchange(now_s, torque, y)
        said = silent if estimate is None else (estimate["fault"][ACTUATOR], estimate["fault"][SENSOR])
        faults = (fault_size(plant.scenario, channel, now_s) for channel in ("f_a", "f_s"))
        rows.append((now_s, state[LINK], tracking_reference(now_s)[0][LINK], torque, *faults, *said))
        state = _next(plant, state, now_s, torque)
        torque = following
    return Run(*np.array(rows, dtype=float).T)


def _next(plant: Plant, state: ArmState, now_s: float, torque: float) -> ArmState:
    return step_arm(plant.scenario, state, now_s, now_s + PERIOD_S, plant.effectiveness * torque)


def alone(controller: Controller) -> Exchange:
    """Return an exchange with a controller that knows of no monitor."""
    return lambda now_s, _, y: (controller.step(now_s, y, None), None)


def in_process(controller: Controller, delay: int = 0) -> Exchange:
    """Return an exchange with the monitor's pipeline in this process.

    Parameters
    ----------
    controller : Controller
        The controller.
    delay : int
        Samples by which estimates come later than over a network without delay.
    """
    pipeline = fauio.Pipeline(fauio.read_profile(PROFILE), "arm")
    layouts = {layout.observer: layout for layout in pipeline.layouts}
    said: list[Estimates] = [None] * delay

    def exchange(now_s: float, torque: float, y: NDArray[np.float64]) -> tuple[float, Estimates]:
        time_ns = round(now_s * 1e9)
        fields = {"time_ns": time_ns, "u": [torque], "y": y.tolist()}
        outputs = pipeline.run(fauio.pack([fauio.Message(fauio.ZENOH, TELEMETRY, 10**18 + time_ns, fields)]))
        found = [
            estimate_json(layouts[output.observer], output, -1)
            for output in outputs
            if isinstance(output, fauio.Estimates)
        ]
        said.append(found[-1] if found else said[-1] if said else None)
        estimate = said.pop(0) if len(said) > delay else None
        return controller.step(now_s, y, estimate), estimate

    return exchange
