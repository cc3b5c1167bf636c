"""What a person should look at first where a channel had an alarm."""

from __future__ import annotations

import re
from collections.abc import Mapping

_CHECKS: Mapping[str, str] = {
    r"motor\d+": "that motor's propeller (chipped, loose, wrong way up), its ESC and connectors, then its bearings; a "
    "payload off the middle, or an arm bent, looks alike on every flight",
    r"esc\d+": "that ESC: its desynchronisation and temperature messages, connectors, firmware settings",
    r"prop\d+": "that propeller: chipped, loose, of another size, or the wrong way up",
    r"gps_(north|east|down)|motion_(north|east)": "whether the place is where GPS says; satellites and noise of the "
    "receiver; jammers or spoofers near by; buildings that reflect",
    r"gps_velocity_\w+": "the receiver: satellites, noise, reflections; a spoofer that moves slowly shows here first",
    r"baro": "the barometer's hole (wind, rotor wash, light, water), and whether the temperature changed fast",
    r"compass": "currents and metal near the compass, its calibration, whether it is turned in its mount",
    r"gyro_\w+": "that gyro: its temperature, its calibration, vibration; compare the vehicle's other gyros",
    r"accel_\w+": "that accelerometer: clipping, vibration, its mount; compare the vehicle's other accelerometers",
    r"attitude_\w+": "the autopilot's attitude estimate: its innovations, resets, and the sensors behind it",
    r"aileron|elevator|rudder|flap": "that surface's servo, horn, rod and hinge, and that nothing blocks it",
    r"throttle": "the drive: propeller, ESC, battery, and in a ground vehicle the wheels' grip",
    r"steering": "the steering servo and linkage, wheels and tyres",
    r"airspeed": "the pitot tube: blocked, iced, or its hose leaking",
    r"battery": "the battery's cells, age and temperature, and its connectors",
    r"prop\d+_imbalance": "that propeller's balance: chips, cracks, dirt, a blade that sits askew; the motor's shaft",
    r"vibration|clipping": "propellers for balance, mounts of the autopilot, loose parts",
    r"impostor|signing|heartbeat": "who else sends on this link: a second vehicle of the same id, a ground station, "
    "an attacker; sign the link",
    r"command": "who sent it: a second ground station, a companion computer, an attacker; sign the link",
    r"telemetry": "the radio, its aerials and range, and whether the autopilot rebooted",
    r"unexplained": "what the other charts show at that time: a gust, a collision, two faults at once, or a vehicle "
    "changed since its profile was fitted",
}


def what_to_check(channel: str) -> str:
    """Return what to look at first where a channel had an alarm; empty where nobody can say."""
    return next((words for pattern, words in _CHECKS.items() if re.fullmatch(pattern, channel)), "")
