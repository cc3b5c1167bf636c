"""The moments of each motor of a multirotor about its axes: from its parameters, or from a standard frame.

A motor at (x, y) forward and right of the centre of gravity that pushes up turns the vehicle by -y about the roll axis,
by x about the pitch axis and, by its drag, about the yaw axis against its own rotation. The effects of a frame are
these numbers, relative to the largest of each axis. The thrust of a command, and the response of the vehicle to a
torque, follow from the flights.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import cos, radians, sin

import numpy as np
from numpy.typing import NDArray

_PX4_ROTORS = 12
"""Names of PX4's rotor parameters, ``CA_ROTOR0`` to ``CA_ROTOR11``: as many as its control allocation has."""
MOTOR_FUNCTIONS = {**{33 + i: i for i in range(8)}, **{82 + i: 8 + i for i in range(4)}}
"""ArduPilot's SERVOn_FUNCTION of motors 1 to 12, and their index from 0."""
_PX4_FUNCTIONS = {101 + i: i for i in range(_PX4_ROTORS)}
"""PX4's PWM_MAIN_FUNCn (and those of other drivers) of motors 1 to 12, and their index from 0."""

_OUTPUTS = 16
"""Number of outputs in a SERVO_OUTPUT_RAW."""

_PX4_QUAD_X = 4
"""Thousands of PX4's SYS_AUTOSTART for quads in x, the only information on the frame in logs before version 1.13."""

_TRI = 7
"""ArduPilot's FRAME_CLASS of tricopters."""
_HELICOPTERS = (6, 11, 13)
"""ArduPilot's FRAME_CLASS of helicopters with one main rotor, with two, and with four."""
_TRI_MOTORS = (0, 1, 3)
"""Indices from 0 of a tricopter's motors: the function of motor 7 drives the tail servo."""

CCW, CW = 1.0, -1.0
"""Yaw by the drag of a motor that turns counter-clockwise or clockwise, seen from above."""

# Standard frames as ArduPilot numbers their motors (AP_MotorsMatrix): for each motor its angle from the nose, degrees
# clockwise, and its sense of rotation; PX4 numbers the quad x alike. The keys are FRAME_CLASS and FRAME_TYPE.
_STANDARD: Mapping[tuple[int, int], tuple[str, tuple[tuple[float, float], ...]]] = {
    (1, 1): ("quad x", ((45, CCW), (-135, CCW), (-45, CW), (135, CW))),
    (1, 0): ("quad +", ((90, CCW), (-90, CCW), (0, CW), (180, CW))),
    (1, 3): ("quad h", ((45, CW), (-135, CW), (-45, CCW), (135, CCW))),
    (1, 12): ("quad x, Betaflight's order", ((135, CW), (45, CCW), (-135, CCW), (-45, CW))),
    (1, 18): ("quad x, Betaflight's order reversed", ((135, CCW), (45, CW), (-135, CW), (-45, CCW))),
    (1, 13): ("quad x, DJI's order", ((45, CCW), (-45, CW), (-135, CCW), (135, CW))),
    (1, 14): ("quad x, clockwise order", ((45, CCW), (135, CW), (-135, CCW), (-45, CW))),
    (2, 1): ("hexa x", ((90, CW), (-90, CCW), (-30, CW), (150, CCW), (30, CCW), (-150, CW))),
    (2, 0): ("hexa +", ((0, CW), (180, CCW), (-120, CW), (60, CCW), (-60, CCW), (120, CW))),
    (2, 13): ("hexa x, DJI's order", ((30, CCW), (-30, CW), (-90, CCW), (-150, CW), (150, CCW), (90, CW))),
    (2, 14): ("hexa x, clockwise order", ((30, CCW), (90, CW), (150, CCW), (-150, CW), (-90, CCW), (-30, CW))),
    (3, 1): (
        "octa x",
        ((22.5, CW), (-157.5, CW), (67.5, CCW), (157.5, CCW), (-22.5, CCW), (-112.5, CCW), (-67.5, CW), (112.5, CW)),
    ),
    (3, 0): ("octa +", ((0, CW), (180, CW), (45, CCW), (135, CCW), (-45, CCW), (-135, CCW), (-90, CW), (90, CW))),
    (4, 1): (
        "octa quad x",
        ((45, CCW), (-45, CW), (-135, CCW), (135, CW), (-45, CCW), (45, CW), (135, CCW), (-135, CW)),
    ),
    (4, 0): ("octa quad +", ((0, CCW), (-90, CW), (180, CCW), (90, CW), (-90, CCW), (0, CW), (90, CCW), (180, CW))),
    (4, 14): (
        "octa quad x, clockwise order",
        ((45, CCW), (45, CW), (135, CW), (135, CCW), (-135, CCW), (-135, CW), (-45, CW), (-45, CCW)),
    ),
    (4, 20): (
        "octa quad x, pairs turning alike",
        ((45, CCW), (-45, CW), (-135, CCW), (135, CW), (-45, CW), (45, CCW), (135, CW), (-135, CCW)),
    ),
    (5, 0): ("y6", ((60, CCW), (-60, CW), (-60, CCW), (180, CW), (60, CW), (180, CCW))),
    (5, 10): ("y6b", ((60, CW), (60, CCW), (180, CW), (180, CCW), (-60, CW), (-60, CCW))),
    (5, 11): ("y6f", ((180, CCW), (60, CCW), (-60, CCW), (180, CW), (60, CW), (-60, CW))),
    # A servo at its tail turns it about the vertical; the drag of the motors has no effect on it.
    (_TRI, 0): ("tri", ((60, 0.0), (-60, 0.0), (180, 0.0))),
    (12, 1): ("dodeca hexa x", tuple((30 + 60 * (i // 2), (CCW, CW, CW, CCW)[i % 4]) for i in range(12))),
    (12, 0): ("dodeca hexa +", tuple((60 * (i // 2), (CCW, CW, CW, CCW)[i % 4]) for i in range(12))),
    (14, 1): ("deca x", tuple((18 + 36 * i, (CCW, CW)[i % 2]) for i in range(10))),
    (14, 0): ("deca +", tuple((36 * i, (CCW, CW)[i % 2]) for i in range(10))),
}
_VECTORED_YAW = 2
"""Q_TILT_TYPE of planes that tilt their motors to turn about the vertical: the effect of the motors' drag is lost in
it."""
_ONE_SHAPE = (5, _TRI)
"""Classes whose types, except for those above, are all the same frame."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """How the motors of a vehicle turn it."""

    name: str  # description for people: ``quad x``
    # relative effect of each motor about roll, pitch and yaw (3, s), the largest of an axis 1; zeros for an axis that
    # no motor turns
    effects: NDArray[np.float64]


def lifting_outputs(parameters: Mapping[str, float], tricopter: bool = False) -> frozenset[int]:
    """Return the numbers of the outputs that drive lifting motors, by their functions; none if no parameter tells them.

    Control surfaces, a forward motor and the servos of a tail or of tilting motors are left out. ``tricopter`` says
    whether the vehicle reports to be a tricopter, whose motors are outputs 1, 2 and 4 if no parameter tells them.
    """
    of = {} if is_helicopter(parameters) else _motors(parameters)
    if len(of) < 3:
        return frozenset(index + 1 for index in _TRI_MOTORS) if tricopter else frozenset()
    if tricopter or _class(parameters)[0] == _TRI:
        return frozenset(number for number, index in of.items() if index in _TRI_MOTORS)
    # Other rotors of PX4 push along the nose, according to CA_ROTOR*_AX and AZ; by default all push up.
    up = {
        i for i in of.values() if abs(parameters.get(f"CA_ROTOR{i}_AZ", 1)) > abs(parameters.get(f"CA_ROTOR{i}_AX", 0))
    }
    return frozenset(number for number, index in of.items() if index in up)


def is_helicopter(parameters: Mapping[str, float]) -> bool:
    """Return whether parameters of ArduPilot describe rotors with blades of variable pitch."""
    return _class(parameters)[0] in _HELICOPTERS


def frame_of(parameters: Mapping[str, float], outputs: Sequence[int]) -> Frame | None:
    """Return the frame that an autopilot's parameters describe, None if they describe none.

    The parameters are ``CA_ROTOR*`` of PX4, ``FRAME_CLASS`` and ``FRAME_TYPE`` of ArduPilot (``Q_FRAME_*`` of its
    planes; before ArduCopter 3.5 ``FRAME``, the type alone: of its classes only quads have four motors), and functions
    of outputs of both. ``outputs`` are the numbers of the servo outputs that are motors (s,).
    """
    of = _motors(parameters)
    order = [of.get(number, number - 1) for number in outputs]
    if parameters.get("CA_ROTOR_COUNT", 0) >= len(outputs):
        return _of_px4(parameters, order)
    key = _class(parameters)
    if parameters.get("SYS_AUTOSTART", 0) // 1000 == _PX4_QUAD_X:
        key = (1, 1)
    elif not key[0] and len(outputs) == 4 and "FRAME" in parameters:
        key = (1, int(parameters["FRAME"]))
    standard = _STANDARD.get(key, _STANDARD[key[0], 0] if key[0] in _ONE_SHAPE else None)
    if standard is None:
        return None
    if key[0] == _TRI:
        order = [_TRI_MOTORS.index(index) if index in _TRI_MOTORS else -1 for index in order]
    name, motors = standard
    effects = _effects(motors)
    if parameters.get("Q_TILT_ENABLE", 0) and parameters.get("Q_TILT_TYPE") == _VECTORED_YAW:
        effects[2] = 0.0
    return _chosen(name, effects, order)


def standard_frames(motors: int) -> Iterator[Frame]:
    """Yield the different standard frames with a number of motors whose outputs are in the order of the motors."""
    for name, places in _STANDARD.values():
        if len(places) == len(set(places)) == motors:
            yield Frame(name, _scaled(_effects(places)))


def _class(parameters: Mapping[str, float]) -> tuple[int, int]:
    """Return ArduPilot's class and type of the frame."""
    q = "Q_" if parameters.get("Q_ENABLE", 0) else ""
    return int(parameters.get(f"{q}FRAME_CLASS", 0)), int(parameters.get(f"{q}FRAME_TYPE", 0))


def _motors(parameters: Mapping[str, float]) -> dict[int, int]:
    """Return the numbers of outputs that parameters assign to motors, and the index of each motor from 0."""
    tables = ("SERVO{}_FUNCTION", MOTOR_FUNCTIONS), ("PWM_MAIN_FUNC{}", _PX4_FUNCTIONS)
    said = ((n, int(parameters.get(key.format(n), -1)), of) for key, of in tables for n in range(1, _OUTPUTS + 1))
    return {n: of[function] for n, function, of in said if function in of}


def _of_px4(parameters: Mapping[str, float], order: Sequence[int]) -> Frame | None:
    """Return the frame of PX4's control allocation."""
    rotors = range(int(min(parameters["CA_ROTOR_COUNT"], _PX4_ROTORS)))
    rows = [[parameters.get(f"CA_ROTOR{i}_{key}", default) for i in rotors] for key, default in _PX4_DEFAULTS]
    px, py, km = np.array(rows)
    return _chosen(f"{len(order)} rotors as the parameters place them", np.stack([-py, px, km]), order)


_PX4_DEFAULTS = (("PX", 0.0), ("PY", 0.0), ("KM", 0.05))
"""Parameters of a rotor's moments: metres forward and right, and drag over thrust; PX4's defaults."""


def _chosen(name: str, effects: NDArray[np.float64], order: Sequence[int]) -> Frame | None:
    """Return the frame with its motors in the order of the outputs, each of which the frame has once."""
    if len(set(order)) < len(order) or not all(0 <= index < effects.shape[1] for index in order):
        return None
    return Frame(name, _scaled(effects[:, list(order)]))


def _effects(motors: Sequence[tuple[float, float]]) -> NDArray[np.float64]:
    angles = [radians(angle) for angle, _ in motors]
    return np.array([[-sin(a) for a in angles], [cos(a) for a in angles], [yaw for _, yaw in motors]])


def _scaled(effects: NDArray[np.float64]) -> NDArray[np.float64]:
    largest = np.abs(effects).max(axis=1, keepdims=True)
    return np.asarray(np.round(effects / np.where(largest > 0.0, largest, 1.0), 12))
