"""The MAVLink fields of each sensor channel of the contract, and how to write another value there.

A quantity is one physical value in one message: ``read`` returns it in the channel's unit, ``write`` returns the
message's fields with another value. A channel has a quantity for each message that carries it, so that an altered
sensor shows the same value in all of them. A position is in metres from latitude and longitude 0 along a plane that
touches the ellipsoid (WGS-84) at the first fix; a pressure is an altitude in the standard atmosphere.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import atan2, cos, degrees, hypot, radians, sin, sqrt
from typing import Any

from adapters.channels import STANDARD_GRAVITY, Channel, follow
from adapters.message import Message

MessageFields = Mapping[str, Any]

_WGS84_A, _WGS84_E2 = 6_378_137.0, 6.694_379_990_14e-3
_SEA_LEVEL_HPA, _ISA_SCALE_M, _ISA_EXPONENT = 1013.25, 44_330.77, 0.190_263
"""Of the international standard atmosphere: T_0 / L = 288.15 K / 6.5 K/km, R L / g."""
_UNKNOWN_U16 = 65535
"""UINT16_MAX: MAVLink's value for an unknown speed or course."""
_SAME_TURN = 1e-9
"""Largest difference of equal angles, rad: the rounding of some operations is 1e-15."""
_DEGE7 = 1e-7
"""Degrees per unit of MAVLink's latitude and longitude."""


@dataclass(slots=True)
class AttackScene:
    """Values of other messages that are needed to read a compass or a position."""

    # newest attitude, radians
    roll: float = 0.0
    pitch: float = 0.0
    # metres per degree of latitude and of longitude at the first GPS fix; None before it
    metres: tuple[float, float] | None = None
    # of each message, the newest magnetic field, the angle by which it was turned, and the turned field
    turned: dict[str, tuple[list[float], float, list[float]]] = field(default_factory=dict)

    def feed(self, message: Message) -> None:
        """Process a message of the vehicle."""
        if message.name == "ATTITUDE":
            self.roll, self.pitch = float(message.fields["roll"]), float(message.fields["pitch"])
        elif message.name == "GPS_RAW_INT" and self.metres is None and _has_fix(message.fields):
            self.metres = metres_per_degree(message.fields["lat"] * _DEGE7)


@dataclass(frozen=True, slots=True)
class Quantity:
    """One physical value in one message."""

    message: str
    # its value in the channel's unit; None if the message does not hold one
    read: Callable[[MessageFields, AttackScene], float | None]
    # all fields of the message, with another value there
    write: Callable[[MessageFields, float, AttackScene], dict[str, Any]]
    path: tuple[str | int, ...] = field(default=())  # path of the field, if it is a plain field
    scale: float = 1.0  # channel's unit per count of that field
    # whether its zero is arbitrary, so that a scale factor acts on the difference from the first value
    from_home: bool = False
    circular: bool = False  # whether it is an angle that wraps


def channel_quantity(channel: Channel, from_home: bool = False) -> Quantity:
    """Return the quantity of a mapped channel; an integer in the message stays an integer."""

    def read(fields: MessageFields, _: AttackScene) -> float | None:
        return channel.value(fields) if channel.selects(fields) else None

    def write(fields: MessageFields, value: float, _: AttackScene) -> dict[str, Any]:
        count = (value - channel.offset) / channel.scale
        whole = isinstance(follow(fields, channel.path), int)
        changed: dict[str, Any] = _replaced(fields, channel.path, round(count) if whole else count)
        return changed

    return Quantity(channel.message, read, write, channel.path, channel.scale, from_home)


def unit_of(name: str) -> str:
    """Return the unit of a channel of the contract, empty for any other."""
    return UNITS.get(name, UNITS.get(name.rpartition("_")[0], ""))


def alike(channel: Channel) -> list[tuple[Quantity, float]]:
    """Return all quantities that show the same sensor as a mapped channel, and their units per unit of the channel."""
    for known in INSTRUMENTS.values():
        for quantity in known:
            if quantity.path and (quantity.message, quantity.path) == (channel.message, channel.path):
                return [(same, quantity.scale / channel.scale) for same in known]
    return [(channel_quantity(channel), 1.0)]


def metres_per_degree(latitude: float) -> tuple[float, float]:
    """Return the length of a degree of latitude and of longitude on the WGS-84 ellipsoid."""
    square = 1.0 - _WGS84_E2 * sin(radians(latitude)) ** 2
    north = _WGS84_A * (1.0 - _WGS84_E2) / (square * sqrt(square))
    return radians(north), radians(_WGS84_A / sqrt(square) * cos(radians(latitude)))


def pressure_altitude(pressure_hpa: float) -> float:
    """Return the altitude in the standard atmosphere, metres."""
    return float(_ISA_SCALE_M * (1.0 - (pressure_hpa / _SEA_LEVEL_HPA) ** _ISA_EXPONENT))


def altitude_pressure(altitude: float) -> float:
    """Return the pressure in the standard atmosphere, hPa; zero above the atmosphere's end."""
    return float(_SEA_LEVEL_HPA * max(0.0, 1.0 - altitude / _ISA_SCALE_M) ** (1.0 / _ISA_EXPONENT))


def _replaced(here: Any, path: Sequence[str | int], value: Any) -> Any:
    """Return a copy of nested fields with another value at a path that exists."""
    if not path:
        return value
    copied: Any = dict(here) if isinstance(here, Mapping) else list(here)
    copied[path[0]] = _replaced(here[path[0]], path[1:], value)
    return copied


def _plain(message: str, name: str, scale: float = 1.0, from_home: bool = False) -> Quantity:
    return channel_quantity(Channel(name, message, (name,), scale), from_home)


def _imu(letter: str, what: str, scaled: float) -> list[Quantity]:
    """Return one axis in the three messages that show it; two of them use other units."""
    name = letter + what
    return [_plain("HIGHRES_IMU", name), _plain("SCALED_IMU", name, scaled), _plain("RAW_IMU", name, scaled)]


def _has_fix(fields: MessageFields) -> bool:
    return bool(fields["fix_type"] >= 2 and (fields["lat"] or fields["lon"]))


def _gps_place(axis: int) -> Quantity:
    name, turn = ("lat", "lon")[axis], 360.0

    def read(fields: MessageFields, scene: AttackScene) -> float | None:
        return fields[name] * _DEGE7 * scene.metres[axis] if scene.metres and _has_fix(fields) else None

    def write(fields: MessageFields, value: float, scene: AttackScene) -> dict[str, Any]:
        angle = value / scene.metres[axis] if scene.metres else 0.0
        angle = (angle + turn / 2) % turn - turn / 2 if axis else min(90.0, max(-90.0, angle))
        return {**fields, name: round(angle / _DEGE7)}

    return Quantity("GPS_RAW_INT", read, write, from_home=True)


def _gps_down() -> Quantity:
    def read(fields: MessageFields, _: AttackScene) -> float | None:
        return -fields["alt"] / 1000.0 if _has_fix(fields) else None

    def write(fields: MessageFields, value: float, _: AttackScene) -> dict[str, Any]:
        risen = round(-value * 1000.0) - fields["alt"]
        ellipsoid = fields.get("alt_ellipsoid")
        above = {"alt_ellipsoid": ellipsoid + risen} if ellipsoid else {}
        return {**fields, "alt": fields["alt"] + risen, **above}

    return Quantity("GPS_RAW_INT", read, write, from_home=True)


def _gps_velocity(axis: int) -> Quantity:
    def both(fields: MessageFields) -> list[float]:
        speed, course = fields["vel"] / 100.0, radians(fields["cog"] / 100.0)
        return [speed * cos(course), speed * sin(course)]

    def read(fields: MessageFields, _: AttackScene) -> float | None:
        known = _has_fix(fields) and _UNKNOWN_U16 not in (fields["vel"], fields["cog"])
        return both(fields)[axis] if known else None

    def write(fields: MessageFields, value: float, _: AttackScene) -> dict[str, Any]:
        velocity = both(fields)
        velocity[axis] = value
        course = degrees(atan2(velocity[1], velocity[0]))
        return {
            **fields,
            "vel": min(round(hypot(*velocity) * 100.0), _UNKNOWN_U16 - 1),
            "cog": round(course * 100.0) % 36000,
        }

    return Quantity("GPS_RAW_INT", read, write)


def _pressure(message: str, name: str) -> Quantity:
    def read(fields: MessageFields, _: AttackScene) -> float | None:
        return pressure_altitude(fields[name]) if fields[name] > 0.0 else None

    def write(fields: MessageFields, value: float, _: AttackScene) -> dict[str, Any]:
        return {**fields, name: altitude_pressure(value)}

    return Quantity(message, read, write, from_home=True)


def _compass(message: str) -> Quantity:
    """Heading of the levelled field; to write another heading, the field is turned about the vertical.

    Messages between two measurements repeat the field. They repeat the turned one, too, although the attitude moves on.
    """

    def read(fields: MessageFields, scene: AttackScene) -> float | None:
        x, y, z = fields["xmag"], fields["ymag"], fields["zmag"]
        if not (x or y or z):
            return None
        across = y * cos(scene.roll) - z * sin(scene.roll)
        along = x * cos(scene.pitch) + (y * sin(scene.roll) + z * cos(scene.roll)) * sin(scene.pitch)
        return atan2(-across, along)

    def write(fields: MessageFields, value: float, scene: AttackScene) -> dict[str, Any]:
        heading = read(fields, scene)
        turn = 0.0 if heading is None else heading - value
        vector = [fields[name] for name in ("xmag", "ymag", "zmag")]
        before, angle, turned = scene.turned.get(message, ([], 0.0, []))
        if vector != before or abs(turn - angle) > _SAME_TURN:
            turned = _turned(vector, _down(scene), turn)
            scene.turned[message] = vector, turn, turned
        whole = isinstance(vector[0], int)
        return {
            **fields,
            **{n: round(v) if whole else v for n, v in zip(("xmag", "ymag", "zmag"), turned, strict=True)},
        }

    return Quantity(message, read, write, circular=True)


def _down(scene: AttackScene) -> tuple[float, float, float]:
    """Return the unit vector downwards in body axes."""
    return (-sin(scene.pitch), sin(scene.roll) * cos(scene.pitch), cos(scene.roll) * cos(scene.pitch))


def _turned(vector: Sequence[float], axis: Sequence[float], angle: float) -> list[float]:
    """Return a vector rotated about a unit axis (Rodrigues' formula)."""
    (x, y, z), (a, b, c) = vector, axis
    along = (1.0 - cos(angle)) * (a * x + b * y + c * z)
    cross = (b * z - c * y, c * x - a * z, a * y - b * x)
    return [cos(angle) * v + sin(angle) * w + along * n for v, w, n in zip(vector, cross, axis, strict=True)]


def _gyro(axis: str, name: str) -> tuple[Quantity, ...]:
    return (_plain("ATTITUDE", name), _plain("ATTITUDE_QUATERNION", name), *_imu(axis, "gyro", 0.001))


INSTRUMENTS: Mapping[str, tuple[Quantity, ...]] = {
    "gps_north": (_gps_place(0),),
    "gps_east": (_gps_place(1),),
    "gps_down": (_gps_down(),),
    "gps_velocity_north": (_gps_velocity(0),),
    "gps_velocity_east": (_gps_velocity(1),),
    "baro": (
        _pressure("SCALED_PRESSURE", "press_abs"),
        _pressure("HIGHRES_IMU", "abs_pressure"),
        _plain("HIGHRES_IMU", "pressure_alt", from_home=True),
        _plain("VFR_HUD", "alt", from_home=True),
    ),
    "compass": tuple(_compass(message) for message in ("HIGHRES_IMU", "SCALED_IMU", "RAW_IMU")),
    "gyro_x": _gyro("x", "rollspeed"),
    "gyro_y": _gyro("y", "pitchspeed"),
    "gyro_z": _gyro("z", "yawspeed"),
    "accel_x": tuple(_imu("x", "acc", STANDARD_GRAVITY / 1000.0)),
    "accel_y": tuple(_imu("y", "acc", STANDARD_GRAVITY / 1000.0)),
    "accel_z": tuple(_imu("z", "acc", STANDARD_GRAVITY / 1000.0)),
    "airspeed": (_plain("VFR_HUD", "airspeed"),),
    "attitude_roll": (_plain("ATTITUDE", "roll"),),
    "attitude_pitch": (_plain("ATTITUDE", "pitch"),),
}
"""The sensor channels of the contract and the quantities that show them."""

UNITS: Mapping[str, str] = {
    "gps": "m",
    "gps_velocity": "m/s",
    "baro": "m",
    "compass": "rad",
    "gyro": "rad/s",
    "accel": "m/s^2",
    "airspeed": "m/s",
    "attitude": "rad",
}
"""Units of the channels, by their names without the axis."""

SPOOFED: Mapping[str, str] = {"gps_north": "gps_velocity_north", "gps_east": "gps_velocity_east"}
"""Positions of the GPS and the velocities that have to change with them."""
