"""Simulated planes and rovers with exact truth, as the transforms give their samples."""

import numpy as np
from numpy.typing import NDArray

from gains.identification.regression import lagged
from gains.identification.segment import Segment
from monitor.vehicles.plane.transform import SurfaceInputs
from monitor.vehicles.rover.transform import DriveInputs

RATE_HZ = 50.0
ROLL, PITCH, YAW, THRUST = (0.8, 0.9), (0.85, 0.6), (0.75, 0.4), (0.0, 12.0)
STEERING, DRIVE = (0.5, 1.6), (0.0, 10.0)
LAG_S, DELAY_S = 0.1, 0.04
SIDE_FORCE = 0.01


def wandering(rng: np.random.Generator, count: int, size: float, memory: float = 0.95) -> NDArray[np.float64]:
    """Return a signal that holds still for a while: steps of random size at random times, smoothed a little."""
    value, signal = 0.0, np.empty(count)
    for k in range(count):
        if rng.random() < 1.0 - memory:
            value = rng.normal(scale=size)
        signal[k] = value
    return signal


def follow(
    dynamics: tuple[float, float], effect: NDArray[np.float64], rest: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return y of y+ = a y + b lagged(effect) + rest."""
    a, b = dynamics
    drive = b * lagged(effect, DELAY_S, LAG_S, RATE_HZ) + rest
    y = np.zeros(len(effect))
    for k in range(len(effect) - 1):
        y[k + 1] = a * y[k] + drive[k]
    return y


def flight(seed: int, *, noise: float = 0.0, mixed: bool = False, idle: str = "", count: int = 2400) -> Segment:
    """Return a flight of a plane; ``mixed`` moves the rudder with the aileron only, ``idle`` is not moved at all."""
    rng = np.random.default_rng(seed)
    u = {name: rng.normal(scale=0.3, size=count) for name in SurfaceInputs.inputs}
    u["pressure"] = np.ones(count)
    for name in SurfaceInputs.actuators:
        u[name] = wandering(rng, count, 0.0 if name == idle else 0.1)
    if mixed:
        u["rudder"] = 0.5 * u["aileron"]
    forces = SIDE_FORCE * u["side_force"]
    disturbance = rng.normal(scale=0.002, size=(4, count))
    y = [
        follow(ROLL, u["aileron"], forces + disturbance[0]),
        follow(PITCH, u["elevator"], disturbance[1] - 0.02 * u["pressure"]),
        follow(YAW, u["rudder"], -forces + disturbance[2]),
        follow(THRUST, u["throttle"], 0.05 * u["normal_force"] - 1.0 + disturbance[3]),
    ]
    measured = np.stack(y, axis=1) + rng.normal(scale=1.0, size=(count, 4)) * noise
    return Segment(np.stack([u[name] for name in SurfaceInputs.inputs], axis=1), measured)


def ride(
    seed: int,
    *,
    cubic: float = 0.0,
    noise: float = 0.0,
    straight: bool = False,
    differential: bool = False,
    count: int = 2400,
) -> Segment:
    """Return a ride of a rover, also in reverse; ``straight`` without steering, ``differential`` on two sides."""
    rng = np.random.default_rng(seed)
    speed = 1.5 + wandering(rng, count, 1.0, 0.99)
    speed = np.where(np.abs(speed) < 0.3, 0.3, speed)
    steering = np.zeros(count) if straight else np.clip(wandering(rng, count, 0.5), -1.0, 1.0)
    throttle = wandering(rng, count, 0.2)
    rolls = np.ones(count) if differential else speed
    y = [
        follow(STEERING, (steering + cubic * steering**3) * rolls, np.zeros(count)),
        follow(DRIVE, throttle, -1.5 * speed),
    ]
    u = {"steering": steering * rolls, "throttle": throttle, "speed": speed}
    measured = np.stack(y, axis=1) + rng.normal(scale=1.0, size=(count, 2)) * noise
    return Segment(np.stack([u[name] for name in DriveInputs.inputs], axis=1), measured)
