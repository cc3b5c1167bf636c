"""A robot with exact truth as ROS 2 records it: Imu, NavSatFix and Odometry of a banked, breathing circle."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import strapdown_truth as truth
from foreign_logs import START_NS, stamp
from mcap_ros2.writer import Writer as Ros2Writer
from numpy.typing import NDArray

from adapters.encoding.message_definition import find_definition

Rows = list[tuple[int, dict[str, Any]]]
IMU, FIX, ODOMETRY = "robot/imu", "robot/fix", "robot/odometry"
TYPES = {IMU: "sensor_msgs/msg/Imu", FIX: "sensor_msgs/msg/NavSatFix", ODOMETRY: "nav_msgs/msg/Odometry"}
_FLIPPED = np.array([1.0, -1.0, -1.0])
_NONE = [0.0] * 9


def robot(
    seconds: float,
    seed: int,
    *,
    north_m: Callable[[float], float] = lambda _: 0.0,
    gyro_x: Callable[[float], float] = lambda _: 0.0,
    oriented: bool = True,
) -> dict[str, Rows]:
    """Return times and fields of each topic: an IMU at 50 Hz, fixes at 5 Hz, odometry at 25 Hz.

    Parameters
    ----------
    seconds : float
        How long it moves.
    seed : int
        Of the noise; each seed begins elsewhere on the circle.
    north_m, gyro_x : Callable[[float], float]
        Faults over time: metres that positions are too far north, rad/s that the rate about x is too large.
    oriented : bool
        Whether the IMU knows its orientation.
    """
    random = np.random.default_rng(seed)
    raw = truth.signals(seconds, start_s=50.0 * seed)
    t = 50.0 * seed + np.arange(len(raw)) / truth.SIGNAL_HZ
    raw[:, :3] += 0.05 * random.normal(size=(len(raw), 3))
    raw[:, 3:6] += 0.002 * random.normal(size=(len(raw), 3))
    north, east, down = truth.position(t)
    h = 1e-4
    speed = (truth.position(t + h) - truth.position(t - h)) / (2.0 * h)
    body = np.einsum("tji,jt->ti", truth.rotation(t), speed) * _FLIPPED + 0.05 * random.normal(size=(len(t), 3))
    found: dict[str, Rows] = {IMU: [], FIX: [], ODOMETRY: []}
    for k in range(0, len(raw), 2):
        at = k / truth.SIGNAL_HZ
        time_ns = START_NS + round(at * 1e9)
        roll, pitch, yaw = raw[k, 6:9] + 0.002 * random.normal(size=3)
        turned = _quaternion(roll, -pitch, 0.5 * np.pi - yaw)
        force, rate = raw[k, :3] * _FLIPPED, raw[k, 3:6] * _FLIPPED
        rate[0] += gyro_x(at)
        header = {"stamp": stamp(time_ns), "frame_id": "base"}
        imu = {
            "header": header,
            "orientation": turned if oriented else _vector(np.zeros(4)),
            "orientation_covariance": _NONE if oriented else [-1.0, *_NONE[1:]],
            "angular_velocity": _vector(rate),
            "angular_velocity_covariance": _NONE,
            "linear_acceleration": _vector(force),
            "linear_acceleration_covariance": _NONE,
        }
        found[IMU].append((time_ns, imu))
        if k % 4 == 0:
            place = np.array([east[k], north[k] + north_m(at), -down[k]]) + 0.02 * random.normal(size=3)
            pose = {"position": _vector(place), "orientation": turned}
            twist = {"linear": _vector(body[k]), "angular": _vector(rate)}
            covariance = [0.0] * 36
            odometry = {
                "header": header,
                "child_frame_id": "base",
                "pose": {"pose": pose, "covariance": covariance},
                "twist": {"twist": twist, "covariance": covariance},
            }
            found[ODOMETRY].append((time_ns, odometry))
        if k % 20 == 0:
            lengths = truth.metres_per_degree(truth.HOME[0])
            noise = 0.1 * random.normal(size=3)
            fix = {
                "header": header,
                "status": {"status": 0, "service": 1},
                "latitude": float(raw[k, 9] + (north_m(at) + noise[0]) / lengths[0]),
                "longitude": float(raw[k, 10] + noise[1] / lengths[1]),
                "altitude": float(raw[k, 11] + noise[2]),
                "position_covariance": _NONE,
                "position_covariance_type": 0,
            }
            found[FIX].append((time_ns, fix))
    return found


def bag(path: Path, topics: dict[str, Rows], *names: str) -> Path:
    """Write some of a robot's topics as rosbag2 does, in the order of time."""
    with path.open("wb") as stream:
        writer = Ros2Writer(stream)
        schemas = {name: writer.register_msgdef(TYPES[name], find_definition(TYPES[name], ())) for name in names}
        for time_ns, name, fields in in_order(topics, *names):
            writer.write_message(f"/{name}", schemas[name], fields, log_time=time_ns)
        writer.finish()
    return path


def in_order(topics: dict[str, Rows], *names: str) -> Iterator[tuple[int, str, dict[str, Any]]]:
    """Yield time, topic and fields of some topics as they are published."""
    yield from sorted(
        ((time_ns, name, fields) for name in names for time_ns, fields in topics[name]), key=lambda row: row[:2]
    )


def _vector(values: NDArray[np.float64]) -> dict[str, float]:
    return dict(zip("xyzw", values.tolist(), strict=False))


def _quaternion(roll: float, pitch: float, yaw: float) -> dict[str, float]:
    (cr, cp, cy), (sr, sp, sy) = np.cos(np.array([roll, pitch, yaw]) / 2), np.sin(np.array([roll, pitch, yaw]) / 2)
    return {
        "x": float(sr * cp * cy - cr * sp * sy),
        "y": float(cr * sp * cy + sr * cp * sy),
        "z": float(cr * cp * sy - sr * sp * cy),
        "w": float(cr * cp * cy + sr * sp * sy),
    }
