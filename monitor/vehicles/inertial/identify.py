"""Strapdown kinematics as a plant of any vehicle: GPS, barometer, compass and gyro compared with each other.

The transform gives mean rates u and washed-out integrals y by name. Over one period T, with phi = exp(-T/tau) and gain
= tau (1 - phi), each block is a discrete plant of its own without a parameter of the vehicle:

    position   p+ = phi p + gain s v_gps                   y = p + f_position       v_gps the GPS's own velocity, s ~ 1
    velocity   v+ = phi v + gain a                         y = v + f_velocity       a = R f + g from the accelerometers
    vertical   d+ = phi d + gain (w + T a/2), w+ = w + T (a + f_accel)    y = d + f_gps, d - f_baro
    rotation   r+ = phi r + gain (omega - f_gyro)          y = r                    from the autopilot's attitude
    heading    h+ = phi h + gain (h' - f_gyro_z)           y = h + f_compass

    accel      f_accel_x, f_accel_y while the navigation holds them responsible (:mod:`monitor.core.navigation`)

    position   p+ = phi p + gain (w + w+)/2, w+ = phi w + gain a        y = p + f_position   without a GPS velocity

A GPS position that leaves its own velocity is a fault of the position alone. A spoofed GPS whose position and velocity
agree contradicts only the accelerometers, in the velocity. The cause of a growing difference there may be any of a set
called "motion": the GPS's velocity, an accelerometer, a gyro, or the autopilot's attitude, whose tilt turns gravity
into the horizontal. Only a jump names its cause: tilts and accelerometers are integrated, so only f_velocity makes
edges, for which there are hypotheses. All other faults are estimated together except the vertical ones: from two
altitudes and one accelerometer one fault can be named, so each has a hypothesis. The scale s covers that the earth of
simulators is flat, not an ellipsoid.
"""

from collections.abc import Sequence

import numpy as np

from adapters.channels import STANDARD_GRAVITY
from gains.analysis.estimability import restricted
from gains.plants.plant import Disturbance, Fault, FloatArray, Noise, Plant, on_each
from gains.synthesis.bank import Hypothesis
from gains.synthesis.blocks import design_blocks
from monitor.vehicles.inertial.sensor_fit import (
    BODY,
    HORIZONTAL,
    Chain,
    InertialFit,
    bare_positions,
    chains_of,
    washout,
)
from monitor.vehicles.inertial.strapdown import ACCELEROMETERS

VERTICAL_CULPRITS = ("baro", "gps_down", "accel_z")
GPS_VELOCITY = ("gps_velocity_north", "gps_velocity_east")
"""Faults that are watched for edges, in place of the faults of motion."""
MOTION = ("motion_north", "motion_east")
WASHED_FAULTS = ("gps_north", "gps_east", "gps_down", "baro", "compass")
"""Faults whose estimate fades with ``washout_s`` although the fault lasts; the monitor undoes the washout.

The velocity is not among them: its washout lets the error of a tilted attitude fade.
"""

SMALLEST_GYRO = 0.015
"""Smallest bias of a gyro that is worth an alarm, rad/s: see :func:`smallest_faults`."""
_SMALLEST = 1e-4
"""Smallest error of a state, in its unit: it keeps the design finite if a simulator has no noise."""
_H2_SHARE = 0.9
"""Weight of the mean square of errors against their worst case. Chosen: these observers receive healthy noise nearly
all the time."""
_FORGETS = 0.5
"""Share of a judged accelerometer's error that is left one sample later. Without a fault the error is zero."""
_TILT = 0.01
"""Attitude error of good autopilots, rad."""


_GYRO_BANDWIDTH = 0.15
"""Rate at which a gyro's bias may change, per second, as a share of the random walk of the attitude (rad/s): the
bandwidth of its estimate, the same for a calm and for a noisy axis."""
_ACCEL_RATE = 0.1
"""Rate at which the bias of the vertical accelerometer may change, m/s^2 per second. The other faults are sensor
faults, which may jump."""


def inertial_plant(fit: InertialFit, name: str) -> Plant:
    """Return the blocks whose signals exist as one discrete plant, with the faults that may act in it."""
    chains = chains_of(fit.inputs, fit.outputs, fit.washouts)
    vertical = [output for output in ("gps_down", "baro_down") if output in fit.outputs]
    bare = bare_positions(fit.inputs, fit.outputs)
    states = [chain.state for chain in chains] + [f"{what}_{axis}" for axis in bare for what in ("position", "speed")]
    judged = [name for name in ACCELEROMETERS if name in fit.outputs]
    states += [f"judged_{name}" for name in judged] + (["down", "velocity_down"] if vertical else [])
    n, T = len(states), 1.0 / fit.rate_hz
    A, B = np.zeros((n, n)), np.zeros((n, len(fit.inputs)))
    C = np.zeros((len(fit.outputs), n))
    for k, chain in enumerate(chains):
        keep, gain = washout(chain.tau, fit.rate_hz)
        A[k, k] = keep
        B[k, fit.inputs.index(chain.source)] = gain * fit.speed_scale.get(chain.state, 1.0)
        C[fit.outputs.index(chain.output), k] = 1.0
    for axis in bare:
        keep, gain = washout(fit.washouts.bare, fit.rate_hz)
        p, w, a = (
            states.index(f"position_{axis}"),
            states.index(f"speed_{axis}"),
            fit.inputs.index(f"acceleration_{axis}"),
        )
        A[p, p], A[p, w], A[w, w] = keep, 0.5 * gain * (1.0 + keep), keep
        B[p, a], B[w, a] = 0.5 * gain * gain, gain
        C[fit.outputs.index(f"gps_{axis}"), p] = 1.0
    for output in judged:
        k = states.index(f"judged_{output}")
        A[k, k], C[fit.outputs.index(output), k] = _FORGETS, 1.0
    if vertical:
        keep, gain = washout(fit.washouts.position, fit.rate_hz)
        d, w, a = n - 2, n - 1, fit.inputs.index("acceleration_down")
        A[d, d], A[d, w], A[w, w] = keep, gain, 1.0
        B[d, a], B[w, a] = 0.5 * gain * T, T
        for output in vertical:
            C[fit.outputs.index(output), d] = 1.0
    return Plant(
        name=name,
        domain="discrete",
        rate_hz=fit.rate_hz,
        states=tuple(states),
        inputs=fit.inputs,
        outputs=fit.outputs,
        A=A,
        B=B,
        C=C,
        faults=tuple(_faults(fit, states, B)),
        disturbances=on_each(Disturbance, states, map(fit.disturbance.__getitem__, states)),
        noises=on_each(Noise, fit.outputs, map(fit.noise.__getitem__, fit.outputs)),
        state_errors=np.array([_state_error(fit, state, chains) for state in states]),
        description="Strapdown kinematics: GPS, barometer, compass and gyro against each other",
    )


def inertial_hypotheses(plant: Plant) -> tuple[tuple[str, ...], ...]:
    """Return the sets of faults to design observers for: all that can be told apart, with one vertical fault each.

    With one altitude, only the accelerometer can be held responsible, and there is one such hypothesis. If there is
    motion, the last hypothesis has the velocity of the GPS in its place, for its edges.
    """
    names = tuple(fault.name for fault in plant.faults)
    culprits = tuple(name for name in VERTICAL_CULPRITS if name in names)
    others = tuple(name for name in names if name not in (*culprits, *GPS_VELOCITY))
    compared = tuple((*others, culprit) for culprit in culprits) or ((others,) if others else ())
    edges = tuple(name for name in (*others, *GPS_VELOCITY, *culprits[:1]) if name in names and name not in MOTION)
    return (*compared, edges) if any(name in names for name in GPS_VELOCITY) else compared


def inertial_bank(plant: Plant) -> tuple[Hypothesis, ...]:
    """Return a certified observer for each hypothesis, designed block by block."""
    plants = [(found, restricted(plant, found)) for found in inertial_hypotheses(plant)]
    return tuple(Hypothesis(found, part, design_blocks(part, h2=_H2_SHARE)) for found, part in plants)


def smallest_faults(fit: InertialFit) -> dict[str, float]:
    """Return the smallest size of each fault that is worth an alarm, however calm the healthy flights were.

    - Positions half a metre: more than receivers and barometers drift within the washout.
    - Motion: gravity through an attitude error of 10 mrad, that of good autopilots, within the velocity's washout.
    - Jumps of the GPS's velocity 0.3 m/s: three times the noise of a receiver (0.1 m/s, 50 % circular, in data sheets).
    - Compass 10 degrees: the effect of a power cable.
    - Gyro 0.015 rad/s: a calibrated gyro drifts by two thirds of it while it warms up (0.015 degrees/s per kelvin over
      40 kelvin, BMI088).
    - Accelerometer 0.5 m/s^2: more than the biases that estimators learn.
    """
    motion = STANDARD_GRAVITY * _TILT * fit.washouts.velocity
    sizes = {
        **dict.fromkeys(("gps_north", "gps_east", "gps_down", "baro"), 0.5),
        **dict.fromkeys(MOTION, motion),
        **dict.fromkeys(GPS_VELOCITY, 0.3),
        **dict.fromkeys(("gyro_x", "gyro_y", "gyro_z"), SMALLEST_GYRO),
        "compass": float(np.radians(10.0)),
        "accel_z": 0.5,
        **dict.fromkeys(ACCELEROMETERS, 0.3),
    }
    if bare_positions(fit.inputs, fit.outputs):
        # the same tilt, integrated twice
        least = max(0.5, STANDARD_GRAVITY * _TILT * fit.washouts.bare**2)
        sizes |= dict.fromkeys(("gps_north", "gps_east"), least)
    present = {name for found in inertial_hypotheses(inertial_plant(fit, "inertial")) for name in found}
    return {name: size for name, size in sizes.items() if name in present}


def _faults(fit: InertialFit, states: Sequence[str], B: FloatArray) -> list[Fault]:
    rows = np.eye(len(fit.outputs))
    faults = []

    def sensor(name: str, output: str, unit: str, sign: float = 1.0) -> None:
        if output in fit.outputs:
            column = sign * rows[:, fit.outputs.index(output)]
            faults.append(Fault(name, "sensor", column, error=fit.noise[output], unit=unit))

    for axis in HORIZONTAL:
        sensor(f"gps_{axis}", f"gps_{axis}", "m")
    for name in ("motion", "gps_velocity"):
        for axis in HORIZONTAL:
            sensor(f"{name}_{axis}", f"gps_velocity_{axis}", "m/s")
    if "gps_down" in fit.outputs and "baro_down" in fit.outputs:
        sensor("gps_down", "gps_down", "m")
        sensor("baro", "baro_down", "m", -1.0)
    for name in ACCELEROMETERS:
        sensor(name, name, "m/s^2")
    if "acceleration_down" in fit.inputs:
        column = -B[:, fit.inputs.index("acceleration_down")]
        faults.append(Fault("accel_z", "actuator", column, rate=_ACCEL_RATE, error=0.1, unit="m/s^2"))
    sensor("compass", "heading", "rad")
    for axis in BODY:
        column = -B[:, fit.inputs.index(f"rate_{axis}")]
        if axis == "z" and "heading" in states:
            column = column - B[:, fit.inputs.index("heading_rate")]
        rate = _GYRO_BANDWIDTH * fit.disturbance[f"rotation_{axis}"] * fit.rate_hz
        faults.append(Fault(f"gyro_{axis}", "actuator", column, rate=rate, error=0.01, unit="rad/s"))
    return faults


def _state_error(fit: InertialFit, state: str, chains: Sequence[Chain]) -> float:
    for chain in chains:
        if chain.state == state:
            return fit.noise[chain.output]
    if state.removeprefix("position_") in bare_positions(fit.inputs, fit.outputs):
        return fit.noise[state.replace("position", "gps")]
    if state == "down":
        return min(fit.noise[output] for output in ("gps_down", "baro_down") if output in fit.noise)
    return max(fit.disturbance[state] * fit.rate_hz, _SMALLEST)
