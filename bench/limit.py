"""How soon anything could see a fault, by the model that a profile has fitted: the information limit.

A detector that raises alpha false alarms a sample needs ln(1 / alpha) nats (Lorden, Annals of Mathematical Statistics
42(6), 1971; Lai, IEEE Trans. Information Theory 44(7), 1998); those of a fault of known size and onset grow by
|s(k)|^2 / 2 with each sample, s being what it makes of the whitened innovations over their deviation in calm flight.
The motors' lag is in s. What telemetry needs to arrive, and a size or an onset that nobody knows, come on top.

Of a gyro's bias the model of the motors sees the jump in the first sample, which a push on the vehicle makes as well.
Where the attitude on board follows the gyro, what tells the two apart is the tilt that the bias makes.
"""

from __future__ import annotations

from math import log

import numpy as np
from flights import Fault
from numpy.typing import NDArray

from adapters.channels import STANDARD_GRAVITY
from adapters.sample import Samples
from gains.plants.plant import Plant
from monitor.estimation.changes import ChangeRule, ChangeStage
from monitor.estimation.input_curve import effect_of_command
from monitor.fitting.thresholds import FALSE_ALARMS_PER_HOUR
from monitor.profile import ObserverProfile
from monitor.vehicles.inertial.strapdown import FIX_S

_LONGEST_S = 5.0
_BEFORE = 40
"""Samples before the onset: more than lag and whitening remember."""
_SPEED_NOISE = 0.05
_WALKS = (1e-3, 0.05)
"""Noise of a fix's velocity, m/s, and random walks of tilt and velocity, rad and m/s per root of a second: as the
navigation (monitor/core/navigation.pyx) takes them at the least."""
_SETTLED = 200
"""Fixes until the filter's uncertainty no longer depends on its start."""


def information_limit(observer: ObserverProfile, fault: Fault, hover: NDArray[np.float64]) -> float | None:
    """Return the seconds after which an observer's samples tell a fault from health; None where it has no such model.

    ``hover`` are the commands at the onset (s,).
    """
    rule, plant, truth = observer.changes, observer.model, fault.truth
    channels = {channel.name: channel.input for channel in observer.faults}
    if rule is None or plant is None or truth is None or truth.channel not in channels:
        return None
    if truth.unit == "share" and channels[truth.channel] is None:
        return None
    rate_hz = observer.rate_hz
    size = truth.after(np.arange(1, round(_LONGEST_S * rate_hz)) / rate_hz)
    stage = ChangeStage(plant, rate_hz, channels, rule)
    added = np.vstack([np.zeros((_BEFORE, len(plant.outputs))), _added(observer, plant, truth.channel, size, hover)])
    u = np.tile(hover, (len(added), 1))
    faulty, healthy = (stage.innovations(_samples(u, y))[0] for y in (added, np.zeros_like(added)))
    nats = np.cumsum(0.5 * _whitened(faulty - healthy, rule) ** 2)
    enough = np.flatnonzero(nats >= log(3600.0 * rate_hz / FALSE_ALARMS_PER_HOUR))
    return float(enough[0] - _BEFORE) / rate_hz if len(enough) else None


def tilt_limit(bias: float) -> float | None:
    """Return the seconds after which fixes of a GPS tell the bias of a gyro x or y, rad/s, from health in hover.

    The bias tilts the attitude, gravity bends the velocity, and a Kalman filter of both follows it meanwhile.
    """
    tilt, speed = (walk * walk * FIX_S for walk in _WALKS)
    bent = STANDARD_GRAVITY * FIX_S
    F = np.array([[1.0, 0.0], [bent, 1.0]])
    Q = np.array([[tilt, bent * tilt / 2.0], [bent * tilt / 2.0, speed + bent * bent * tilt / 3.0]])
    P, signature, nats = np.eye(2), np.zeros(2), 0.0
    enough = log(3600.0 / FIX_S / FALSE_ALARMS_PER_HOUR)
    for fix in range(_SETTLED + round(_LONGEST_S / FIX_S)):
        P = F @ P @ F.T + Q
        S = P[1, 1] + _SPEED_NOISE * _SPEED_NOISE
        gain = P[:, 1] / S
        P = P - np.outer(gain, P[1])
        if fix >= _SETTLED:
            signature = F @ signature + bias * FIX_S * np.array([1.0, bent / 2.0])
            nats += signature[1] ** 2 / (2.0 * S)
            signature = signature - gain * signature[1]
            if nats >= enough:
                return (fix + 1 - _SETTLED) * FIX_S
    return None


def _added(
    observer: ObserverProfile, plant: Plant, channel: str, size: NDArray[np.float64], hover: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return what a fault of some sizes (n,) adds to the outputs (n, p), from the first sample that has it on."""
    fault = next(fault for fault in plant.faults if fault.name == channel)
    if fault.kind == "sensor":
        return size[:, None] * fault.column
    if fault.input is None:
        pushed = size[:, None] * fault.column
    else:
        j = plant.inputs.index(fault.input)
        u = np.tile(hover, (len(size), 1))
        curves = observer.gains[0].input_curves
        whole = effect_of_command(curves, u)[:, j]
        u[:, j] *= 1.0 - size
        lost = np.convolve(effect_of_command(curves, u)[:, j] - whole, plant.taps)[: len(size)]
        pushed = lost[:, None] * plant.B[:, j]
    state, outputs = np.zeros(len(plant.states)), []
    for push in pushed:
        outputs.append(plant.C @ state)
        state = plant.A @ state + push
    return np.array(outputs)


def _whitened(nu: NDArray[np.float64], rule: ChangeRule) -> NDArray[np.float64]:
    """Return the size of the whitened innovations over their deviation in calm flight (n,)."""
    e = nu.copy()
    for lag, phi in enumerate(rule.whitening, start=1):
        e[lag:] -= nu[:-lag] @ phi.T
    return np.asarray(np.linalg.norm(e / np.sqrt(rule.variance[:, 0]), axis=1))


def _samples(u: NDArray[np.float64], y: NDArray[np.float64]) -> Samples:
    count = len(u)
    index, always, nothing = (
        np.arange(count),
        np.ones(count, np.bool_),
        np.zeros((count, u.shape[1] + y.shape[1]), np.bool_),
    )
    return Samples(index, index, index, u, y, index == 0, always, index, always, nothing)
