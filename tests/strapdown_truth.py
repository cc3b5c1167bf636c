"""A trajectory with exact truth: a banked, breathing circle, and the raw signals that perfect sensors give on it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from sampled import Row, raw_samples, rows

from monitor.vehicles.inertial.strapdown import DEFAULTS, Strapdown

SIGNAL_HZ, RATE_HZ = 100.0, 25.0
HOME = (47.4, 8.5)
FIELD = np.array([0.21, 0.0, 0.43])
Array = NDArray[np.float64]

_GRAVITY = 9.80665
# WGS-84: semi-major axis, squared eccentricity.
_A, _E2 = 6_378_137.0, 6.694_379_990_14e-3


def metres_per_degree(latitude: float) -> tuple[float, float]:
    """Return the radii of curvature along and across the meridian, times a degree."""
    square = 1.0 - _E2 * np.sin(np.radians(latitude)) ** 2
    along = np.radians(_A * (1.0 - _E2) / square**1.5)
    return float(along), float(np.radians(_A / np.sqrt(square) * np.cos(np.radians(latitude))))


def signals(seconds: float, gps_late_s: float = 0.0, baro_late_s: float = 0.0, start_s: float = 0.0) -> Array:
    """Return rows of IMU, GPS, BAROMETER and MAGNETOMETER signals, 100 a second."""
    t = start_s + np.arange(round(seconds * SIGNAL_HZ)) / SIGNAL_HZ
    north, east, down = position(t)
    h = 1e-4
    force = (position(t + h) - 2.0 * position(t) + position(t - h)) / h**2
    force[2] -= _GRAVITY
    R = rotation(t)
    body = np.einsum("tji,jt->ti", R, force)
    W = np.einsum("tji,tjk->tik", R, (rotation(t + h) - rotation(t - h)) / (2.0 * h))
    rate = np.stack([W[:, 2, 1], W[:, 0, 2], W[:, 1, 0]], axis=1)
    mag = np.einsum("tji,j->ti", R, FIELD)
    north, east, down = position(t - gps_late_s)
    speed = (position(t - gps_late_s + h) - position(t - gps_late_s - h)) / (2.0 * h)
    per_degree = metres_per_degree(HOME[0])
    altitude = -position(t - baro_late_s)[2] + 400.0
    return np.column_stack(
        [
            body,
            rate,
            np.stack(angles(t), axis=1),
            HOME[0] + north / per_degree[0],
            HOME[1] + east / per_degree[1],
            -down,
            np.hypot(speed[0], speed[1]),
            np.degrees(np.arctan2(speed[1], speed[0])) % 360.0,
            altitude,
            mag,
        ]
    )


def position(t: Array) -> Array:
    return np.stack([20.0 * np.sin(0.4 * t), 12.0 * np.cos(0.3 * t), -30.0 - 2.0 * np.sin(0.7 * t)])


def angles(t: Array) -> tuple[Array, Array, Array]:
    return 0.3 * np.sin(0.9 * t), 0.2 * np.cos(0.7 * t), 0.5 * t


def rotation(t: Array) -> Array:
    roll, pitch, yaw = angles(t)
    one, zero = np.ones_like(t), np.zeros_like(t)
    cr, sr, cp, sp, cy, sy = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch), np.cos(yaw), np.sin(yaw)
    Z = np.array([[cy, -sy, zero], [sy, cy, zero], [zero, zero, one]])
    Y = np.array([[cp, zero, sp], [zero, one, zero], [-sp, zero, cp]])
    X = np.array([[one, zero, zero], [zero, cr, -sr], [zero, sr, cr]])
    return np.asarray(np.einsum("ijt,jkt,klt->til", Z, Y, X))


def transformed(
    raw: Array, parameters: Mapping[str, float] | None = None, first: int = 0
) -> tuple[Strapdown, list[Row]]:
    """Run the transform over raw signals; the first tick has the given index."""
    transform = Strapdown({**DEFAULTS, **(parameters or {})}, SIGNAL_HZ, RATE_HZ)
    return transform, fed(transform, raw, first)


def fed(transform: Strapdown, raw: Array, first: int = 0, lost: frozenset[int] = frozenset()) -> list[Row]:
    samples = raw_samples(raw, first)
    samples.lost[:] = [[k in lost] for k in range(first, first + len(raw))]
    return rows(transform.run(samples).samples)
