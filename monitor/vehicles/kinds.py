"""All kinds of vehicle. A new kind is a folder beside this module and an entry here."""

from collections.abc import Mapping
from pathlib import Path

from monitor.vehicles.base import VehicleKind, load

KINDS = (
    VehicleKind(
        "multirotor",
        watches="each motor, three gyros",
        fit="monitor.vehicles.multirotor.fit:fit_multirotor",
        preview="monitor.vehicles.multirotor.signals:preview",
        messages="monitor.vehicles.multirotor.signals:MESSAGES",
        transforms={
            "esc": "monitor.vehicles.multirotor.transform:EscInputs",
            "battery": "monitor.vehicles.multirotor.battery:BatteryInputs",
            "vibration": "monitor.vehicles.multirotor.vibration:VibrationInputs",
            "imbalance": "monitor.vehicles.multirotor.imbalance:ImbalanceInputs",
        },
        further=(
            "monitor.vehicles.multirotor.fit:fit_trim",
            "monitor.vehicles.multirotor.esc:fit_esc",
            "monitor.vehicles.multirotor.fit:fit_props",
            "monitor.vehicles.multirotor.vibration:fit_vibration",
            "monitor.vehicles.multirotor.imbalance:fit_imbalance",
            "monitor.vehicles.multirotor.battery:fit_battery",
        ),
        type_words=("rotor", "copter", "vtol"),
    ),
    VehicleKind(
        "plane",
        watches="aileron, elevator, rudder, throttle, airspeed",
        fit="monitor.vehicles.plane.fit:fit_plane",
        preview="monitor.vehicles.plane.signals:preview",
        messages="monitor.vehicles.plane.signals:MESSAGES",
        transforms={
            "surfaces": "monitor.vehicles.plane.transform:SurfaceInputs",
            "airspeed": "monitor.vehicles.plane.airspeed:AirspeedInputs",
        },
        further=("monitor.vehicles.plane.airspeed:fit_airspeed",),
        type_words=("fixed_wing", "vtol"),
    ),
    VehicleKind(
        "rover",
        watches="steering, throttle",
        fit="monitor.vehicles.rover.fit:fit_rover",
        preview="monitor.vehicles.rover.signals:preview",
        messages="monitor.vehicles.rover.signals:MESSAGES",
        transforms={"drive": "monitor.vehicles.rover.transform:DriveInputs"},
        type_words=("rover", "boat"),
        flies=False,
    ),
    VehicleKind(
        "inertial",
        watches="GPS, barometer, compass, gyros, vertical accelerometer",
        fit="monitor.vehicles.inertial.fit:fit_alone",
        preview="monitor.vehicles.inertial.signals:preview",
        messages="monitor.vehicles.inertial.signals:MESSAGES",
        types="monitor.vehicles.inertial.ros_signals:TYPES",
        wanted_hz=25.0,  # faults of these sensors are slower than those of motors
        transforms={"strapdown": "monitor.vehicles.inertial.strapdown:Strapdown"},
        inertial_too=False,
    ),
    VehicleKind(
        "custom",
        watches="faults of your model",
        fit="monitor.vehicles.custom.fit:fit_custom",
        inertial_too=False,
        needs_model=True,
    ),
)
TRANSFORMS: Mapping[str, str] = {name: place for kind in KINDS for name, place in kind.transforms.items()}
"""Where the class of each transform stands, by its name in profiles: only a profile that names it loads it."""


def kind_named(name: str) -> VehicleKind:
    """Return the kind with a name; raise StopIteration if there is none."""
    return next(kind for kind in KINDS if kind.name == name)


def fit_messages() -> frozenset[str]:
    """Return the names of all messages that a fit without a model reads: a filter for recordings."""
    return frozenset[str]().union(*(load(kind.messages) for kind in KINDS if kind.messages))


def fit_reading(model: Path | None = None) -> tuple[frozenset[str], frozenset[str]]:
    """Return names of messages, and types of ROS 2, that a fit reads: a filter for recordings."""
    if model is not None:
        messages: frozenset[str] = load("monitor.vehicles.custom.fit:custom_messages")(model)
        return messages, frozenset()
    return fit_messages(), frozenset[str]().union(*(load(kind.types) for kind in KINDS if kind.types))
