"""A simulated cart as a ROS 2 robot: its topics into a bag, or as CDR on the keys of rmw_zenoh.

    python simulate.py -o cart.mcap --fault gps                            # then: fauio replay cart/ cart.mcap
    python simulate.py --zenoh tcp/127.0.0.1:7448 --fault drive            # beside: fauio run --config monitor.toml

It needs mcap-ros2-support (in fauio's extra "dev"), which encodes the messages; no ROS.
"""

from __future__ import annotations

import argparse
import math
import random
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import zenoh

try:
    from mcap_ros2._dynamic import serialize_dynamic
    from mcap_ros2.writer import Writer
except ModuleNotFoundError:
    raise SystemExit("simulate.py needs mcap-ros2-support: pip install mcap-ros2-support") from None

from adapters.encoding.message_definition import find_definition

TYPES = {
    "cart/command": "std_msgs/msg/Float64MultiArray",
    "cart/gps": "sensor_msgs/msg/NavSatFix",
    "cart/joints": "sensor_msgs/msg/JointState",
    "cart/imu": "sensor_msgs/msg/Imu",
}
FAULTS = ("none", "drive", "gps")
FAULT_S = (10.0, 20.0)
DRIVE_LOSS = 0.4
GPS_WALK = 0.5

START_NS = 1_795_251_917_000_000_000
_STEP_S = 0.005
_LATITUDE, _DEGREE_M, _WHEEL_M = 48.5085, 111_194.92664455873, 0.1
_SUBSCRIBER_S = 5.0

Record = tuple[int, str, dict[str, Any]]


def drive(duration_s: float, fault: str) -> Iterator[Record]:
    """Yield time (ns), topic and fields of each message of a drive; the noise is the same every time.

    Parameters
    ----------
    duration_s : float
        Length of the drive.
    fault : {"none", "drive", "gps"}
        From 10 s to 20 s the motor delivers 40 % less than commanded, or the GPS walks away at 0.5 m/s.
    """
    chance = random.Random(1)  # noqa: S311 - noise, no secret
    position = speed = push = 0.0
    for k in range(round(duration_s / _STEP_S)):
        now_s = k * _STEP_S
        time_ns = START_NS + round(now_s * 1e9)
        stamp = {"sec": time_ns // 1_000_000_000, "nanosec": time_ns % 1_000_000_000}
        acts = FAULT_S[0] <= now_s < FAULT_S[1]
        command = 1.0 * math.sin(0.5 * now_s) + 0.5
        if k % 4 == 0:
            yield time_ns, "cart/command", {"layout": {"dim": [], "data_offset": 0}, "data": [command]}
            wheel = position + chance.gauss(0.0, 0.01), speed + chance.gauss(0.0, 0.02)
            joints = {
                "header": {"stamp": stamp, "frame_id": "base"},
                "name": ["steering", "wheel"],
                "position": [0.0, wheel[0] / _WHEEL_M],
                "velocity": [0.0, wheel[1] / _WHEEL_M],
                "effort": [],
            }
            yield time_ns, "cart/joints", joints
        if k % 2 == 0:
            forward = push - 0.4 * speed + chance.gauss(0.0, 0.1)
            yield time_ns, "cart/imu", _imu(stamp, forward)
        if k % 20 == 0:
            off = GPS_WALK * (now_s - FAULT_S[0]) if acts and fault == "gps" else 0.0
            north = position + off + chance.gauss(0.0, 0.05)
            yield time_ns, "cart/gps", _fix(stamp, _LATITUDE + north / _DEGREE_M)
        delivered = command * (1.0 - DRIVE_LOSS) if acts and fault == "drive" else command
        position += _STEP_S * speed
        speed += _STEP_S * (push - 0.4 * speed)
        push += _STEP_S * 5.0 * (delivered - push)


def _imu(stamp: dict[str, int], forward: float) -> dict[str, Any]:
    unknown = [0.0] * 9
    return {
        "header": {"stamp": stamp, "frame_id": "base"},
        "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
        "orientation_covariance": unknown,
        "angular_velocity": {"x": 0.0, "y": 0.0, "z": 0.0},
        "angular_velocity_covariance": unknown,
        "linear_acceleration": {"x": forward, "y": 0.0, "z": 9.81},
        "linear_acceleration_covariance": unknown,
    }


def _fix(stamp: dict[str, int], latitude: float) -> dict[str, Any]:
    return {
        "header": {"stamp": stamp, "frame_id": "gps"},
        "status": {"status": 0, "service": 1},
        "latitude": latitude,
        "longitude": 9.0,
        "altitude": 300.0,
        "position_covariance": [0.0] * 9,
        "position_covariance_type": 0,
    }


def write_bag(path: Path, duration_s: float, fault: str) -> int:
    """Write a drive as a bag (MCAP, as ROS 2 records it); return the number of messages."""
    count = 0
    with path.open("wb") as stream:
        writer = Writer(stream)
        schemas = {topic: writer.register_msgdef(kind, find_definition(kind, ())) for topic, kind in TYPES.items()}
        for time_ns, topic, fields in drive(duration_s, fault):
            writer.write_message(f"/{topic}", schemas[topic], fields, log_time=time_ns)
            count += 1
        writer.finish()
    return count


def publish(endpoint: str, duration_s: float, fault: str, speed: float = 1.0) -> int:
    """Publish a drive as nodes of ROS 2 under rmw_zenoh do, in real time; return the number of messages."""
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", "[]")
    config.insert_json5("connect/endpoints", f'["{endpoint}"]')
    count = 0
    with zenoh.open(config) as session:
        publishers = {topic: session.declare_publisher(_rmw_key(topic)) for topic in TYPES}
        encoders = {topic: serialize_dynamic(kind, find_definition(kind, ()))[kind] for topic, kind in TYPES.items()}
        until = time.monotonic() + _SUBSCRIBER_S
        while not all(_has_subscriber(one) for one in publishers.values()) and time.monotonic() < until:
            time.sleep(0.01)
        began = time.monotonic()
        for time_ns, topic, fields in drive(duration_s, fault):
            time.sleep(max(began + (time_ns - START_NS) / 1e9 / speed - time.monotonic(), 0.0))
            publishers[topic].put(bytes(encoders[topic](fields)))
            count += 1
    return count


def _has_subscriber(publisher: Any) -> bool:
    return bool(publisher.matching_status.matching)


def _rmw_key(topic: str) -> str:
    """Return the key of a topic in domain 0; the type's hash is of no matter to fauio."""
    package, _, name = TYPES[topic].split("/")
    return f"0/{topic}/{package}::msg::dds_::{name}_/RIHS01_0"


def main() -> int:
    """Run the simulation."""
    parser = argparse.ArgumentParser(description="A simulated cart as a ROS 2 robot.")
    target = parser.add_mutually_exclusive_group(required=True)
    target.add_argument("-o", "--output", type=Path, metavar="BAG.mcap", help="write a bag")
    target.add_argument("--zenoh", metavar="ENDPOINT", help="publish at this endpoint")
    parser.add_argument("--fault", choices=FAULTS, default="none", help="from 10 s to 20 s (none)")
    parser.add_argument("--duration", type=float, default=25.0, metavar="S", help="seconds (25)")
    parser.add_argument("--speed", type=float, default=1.0, metavar="X", help="times real time (1)")
    args = parser.parse_args()
    if args.output:
        count = write_bag(args.output, args.duration, args.fault)
    else:
        count = publish(args.zenoh, args.duration, args.fault, args.speed)
    print(f"{count} messages to {args.output or args.zenoh}, fault: {args.fault}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
