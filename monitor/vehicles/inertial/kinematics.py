"""Strapdown kinematics: rotations, headings and heights of one tick or, with arrays for numbers, of many at once.

What takes sines and cosines takes them as numbers: NumPy's own are not those of ``math`` to the last bit.
"""

from __future__ import annotations

from math import cos, pi, radians, sin, sqrt
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

STANDARD_GRAVITY = 9.80665
_WGS84_A, _WGS84_E2 = 6_378_137.0, 6.694_379_990_14e-3

Real = TypeVar("Real", float, NDArray[np.float64])


def rotation_matrix(cr: Real, sr: Real, cp: Real, sp: Real, cy: Real, sy: Real) -> tuple[Real, ...]:
    """Return R (body to north, east, down), row by row, of the cosines and sines of roll, pitch and yaw."""
    return (
        cp * cy,
        sr * sp * cy - cr * sy,
        cr * sp * cy + sr * sy,
        cp * sy,
        sr * sp * sy + cr * cy,
        cr * sp * sy - sr * cy,
        -sp,
        sr * cp,
        cr * cp,
    )


def small_rotation(before: tuple[Real, ...], after: tuple[Real, ...]) -> tuple[Real, Real, Real]:
    """Return the rotation from one attitude to the next about the body's axes (right to third order), radians."""

    def turned(i: int, j: int) -> Real:
        return 0.0 + before[i] * after[j] + before[3 + i] * after[3 + j] + before[6 + i] * after[6 + j]

    x, y, z = (
        0.5 * (turned(2, 1) - turned(1, 2)),
        0.5 * (turned(0, 2) - turned(2, 0)),
        0.5 * (turned(1, 0) - turned(0, 1)),
    )
    stretch = 1.0 + (x * x + y * y + z * z) / 6.0
    return x * stretch, y * stretch, z * stretch


def acceleration(R: tuple[Real, ...], x: Real, y: Real, z: Real) -> tuple[Real, Real, Real]:
    """Return the acceleration north, east and down, R f + g, of the specific force in body axes."""
    return (
        R[0] * x + R[1] * y + R[2] * z,
        R[3] * x + R[4] * y + R[5] * z,
        R[6] * x + R[7] * y + R[8] * z + STANDARD_GRAVITY,
    )


def levelled_field(cr: Real, sr: Real, cp: Real, sp: Real, x: Real, y: Real, z: Real) -> tuple[Real, Real]:
    """Return what is left and forward of a magnetic field in body axes after roll and pitch are taken back.

    The heading from magnetic north, clockwise, is the angle atan2(left, forward).
    """
    across = y * cr - z * sr
    along = x * cp + (y * sr + z * cr) * sp
    return -across, along


def metres_per_degree(latitude: float) -> tuple[float, float]:
    """Return the length of a degree of latitude and of longitude on the WGS-84 ellipsoid."""
    square = 1.0 - _WGS84_E2 * sin(radians(latitude)) ** 2
    north = _WGS84_A * (1.0 - _WGS84_E2) / (square * sqrt(square))
    return radians(north), radians(_WGS84_A / sqrt(square) * cos(radians(latitude)))


def pressure_altitude(pressure_hpa: float) -> float:
    """Return the altitude in the standard atmosphere, metres."""
    return 44_330.77 * (1.0 - float((max(pressure_hpa, 0.0) / 1013.25) ** 0.190_263))


def wrapped(angle: Real) -> Real:
    """Return an angle in radians between -pi and pi."""
    return (angle + pi) % (2.0 * pi) - pi


def wrapped_degrees(angle: Real) -> Real:
    """Return an angle in degrees between -180 and 180."""
    return (angle + 180.0) % 360.0 - 180.0
