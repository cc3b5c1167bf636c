"""Finds the topics of ROS 2 with the raw signals of the strapdown transform, and converts their axes.

By REP 103, body axes of ROS 2 point forward, left, up and those of the world east, north, up; the transform's point
forward, right, down and north, east, down. So y and z of vectors in body axes and the pitch change sign, roll does not,
and the heading counts clockwise from north where yaw counts anticlockwise from east.
"""

from collections.abc import Mapping
from math import pi, radians
from typing import Any

from adapters.channels import Channel
from adapters.errors import TelemetryError
from monitor.vehicles.inertial.strapdown import BODY_SPEED, GPS, IMU

TYPES = frozenset({"sensor_msgs/Imu", "sensor_msgs/NavSatFix", "nav_msgs/Odometry"})
"""Types of ROS 2 messages that are read; their topics are recognised by their fields."""
BARE_POSITIONS, BODY_VELOCITY = 2.0, 3.0
"""Values of the transform's ``gps``: positions without a velocity, and with a velocity in body axes."""

_IMU_FIELDS = ("orientation", "angular_velocity", "linear_acceleration")
_AHEAD_RIGHT_DOWN = (("x", 1.0), ("y", -1.0), ("z", -1.0))
"""Fields of vectors in body axes, and their signs in the transform's axes (REP 103)."""
# Odometry counts metres from its start. As degrees near the point of no latitude and longitude, where the transform
# takes them back to metres: lengths of a degree of latitude and of longitude there, by WGS-84.
_METRES_NORTH = radians(6_378_137.0 * (1.0 - 6.694_379_990_14e-3))
_METRES_EAST = radians(6_378_137.0)


def ros_channels(
    examples: Mapping[str, Mapping[str, Any]], rates: Mapping[str, float]
) -> tuple[tuple[Channel, ...], dict[str, float], tuple[str, ...]] | None:
    """Choose the channels; of several topics of a type the one that comes most often.

    Attitude is the IMU's orientation, else that of the odometry. Position is the NavSatFix, which brings no velocity,
    else the odometry, which does.

    Parameters
    ----------
    examples : Mapping[str, Mapping[str, Any]]
        Fields of one message for each topic.
    rates : Mapping[str, float]
        Messages per second of each topic.

    Returns
    -------
    tuple | None
        Channels, parameters of the transform, and topics that come less often than the IMU; None without an Imu.

    Raises
    ------
    TelemetryError
        Nothing tells the attitude.
    """

    def topic(*fields: str) -> str | None:
        found = [
            name for name, example in examples.items() if all(isinstance(example.get(key), Mapping) for key in fields)
        ]
        return max(sorted(found), key=lambda name: rates.get(name, 0.0), default=None)

    imu, odometry = topic(*_IMU_FIELDS), topic("pose", "twist")
    if imu is None:
        return None
    fixes = [name for name, example in examples.items() if {"latitude", "longitude", "altitude"} <= example.keys()]
    fix = max(sorted(fixes), key=lambda name: rates.get(name, 0.0), default=None)
    vectors = zip(IMU[:6], [(what, *axis) for what in _IMU_FIELDS[:0:-1] for axis in _AHEAD_RIGHT_DOWN], strict=True)
    channels = [Channel(name, imu, (what, axis), scale=sign) for name, (what, axis, sign) in vectors]
    attitude, place = _attitude(imu, odometry, examples)
    channels += [
        Channel("roll", attitude, place, angle="roll", period=2.0 * pi),
        Channel("pitch", attitude, place, angle="pitch", scale=-1.0),
        Channel("yaw", attitude, place, angle="yaw", scale=-1.0, offset=0.5 * pi, period=2.0 * pi),
    ]
    gps = 0.0
    if fix is not None:
        gps = BARE_POSITIONS
        channels += [Channel(name, fix, (field,)) for name, field in zip(GPS, _NAV_SAT_FIX, strict=False)]
    elif odometry is not None:
        gps = BODY_VELOCITY
        where = (("y", 1.0 / _METRES_NORTH), ("x", 1.0 / _METRES_EAST), ("z", 1.0))
        channels += [
            Channel(name, odometry, ("pose", "pose", "position", axis), scale=scale)
            for name, (axis, scale) in zip(GPS, where, strict=False)
        ]
        channels += [
            Channel(name, odometry, ("twist", "twist", "linear", axis), scale=sign)
            for name, (axis, sign) in zip(BODY_SPEED, _AHEAD_RIGHT_DOWN, strict=True)
        ]
    seldom = tuple({name for name in (fix, odometry) if name is not None} - {imu, attitude})
    return tuple(channels), {"gps": gps, "barometer": 0.0, "magnetometer": 0.0}, seldom


_NAV_SAT_FIX = ("latitude", "longitude", "altitude")


def _attitude(
    imu: str, odometry: str | None, examples: Mapping[str, Mapping[str, Any]]
) -> tuple[str, tuple[str | int, ...]]:
    """Return topic and index of the quaternion."""
    places: list[tuple[str, tuple[str | int, ...]]] = [(imu, ("orientation",))]
    if odometry is not None:
        places.append((odometry, ("pose", "pose", "orientation")))
    covariance = examples[imu].get("orientation_covariance")
    if isinstance(covariance, list) and covariance and covariance[0] == _NO_ORIENTATION:
        del places[0]
    for name, place in places:
        if Channel("roll", name, place, angle="roll").value(examples[name]) is not None:
            return name, place
    raise TelemetryError(
        f"{imu} holds no orientation, which the inertial observer needs; record an Imu that does (imu_filter_madgwick "
        "makes one), or an Odometry"
    )


_NO_ORIENTATION = -1.0
"""First element of Imu.orientation_covariance if the driver has no orientation (sensor_msgs/msg/Imu)."""
