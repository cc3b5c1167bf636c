"""The facts that a log of ArduPilot states."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from adapters.mavlink.heartbeat import ARDUPILOT, mode_name
from monitor.alarms.command_watch import CommandSent
from monitor.vehicles.multirotor.frames import MOTOR_FUNCTIONS
from replay.review.facts.log_facts import (
    ANGLES,
    NO_SIGNAL,
    RATIOS,
    SUBMARINE,
    UNKNOWN_LEVEL,
    Changes,
    LogFacts,
    LogRecords,
    LogSignal,
    Spans,
    Statement,
    first_known,
    inside,
    off_ground,
    overlap,
    state_spans,
    state_statements,
)

TOPICS = frozenset(
    {
        "ARM", "EV", "ERR", "MODE", "MSG", "PARM", "RCOU", "ATT", "BARO", "CTUN", "PSC", "PSCN", "PSCE", "PSCD", "IMU",
        "BAT", "CURR", "GPS", "XKF4", "NKF4", "VIBE", "MAVC", "VER", "ESC", *(f"ESC/{k}" for k in range(1, 12)),
        *(f"{kalman}1{lane}" for kalman in ("XKF", "NKF") for lane in ("", "/1", "/2")),
    }
)  # fmt: skip

# https://github.com/ArduPilot/ardupilot/blob/master/libraries/AP_Logger/AP_Logger.h, LogEvent and LogErrorSubsystem
_ARMED, _DISARMED, _LANDED, _IN_THE_AIR = 10, 11, 18, 28
_SUBSYSTEMS = {
    2: "radio", 3: "compass", 5: "radio failsafe", 6: "battery failsafe", 7: "GPS failsafe",
    8: "ground station failsafe", 9: "fence failsafe", 11: "GPS", 12: "crash check", 15: "parachute",
    16: "EKF check", 17: "EKF failsafe",
    18: "barometer", 19: "CPU", 21: "terrain", 24: "EKF primary changed", 25: "thrust loss check",
    26: "sensors failsafe", 29: "vibration failsafe", 30: "internal error",
}  # fmt: skip
_NO_FAILSAFE = frozenset({10, 13, 20, 22, 23})
"""Subsystems of errors about a refused mode, a flip, other aircraft, navigation and terrain: they tell nothing about
the vehicle's health."""
_VEHICLES = {"Copter": ("multirotor", 2), "Plane": ("plane", 1), "Rover": ("rover", 10), "ArduSub": (SUBMARINE, 12)}
"""By a word in the log's first texts: the kind of vehicle, and a MAV_TYPE with its modes."""
_OWN = {"LAND_SPEED": "Copter", "TECS_CLMB_MAX": "Plane", "CRUISE_SPEED": "Rover", "JS_GAIN_DEFAULT": "ArduSub"}
"""The same words by a parameter that no other vehicle has, for logs whose texts are missing."""
_PWM_FROM, _PWM_TO = 1000.0, 2000.0
"""Defaults of MOT_PWM_MIN and MOT_PWM_MAX, for logs without parameters."""
_THROTTLE_CHANNEL = 3
"""Default of RCMAP_THROTTLE."""
_MOST_VOLTS = 100.0
"""Largest voltage of a vehicle: before version 3.3 logs have hundredths of volts and amperes."""
_OUTPUTS = 14
_OUTPUT_FIELDS = ("C{}", "Ch{}", "Chan{}")
"""Fields of outputs by their numbers: today's, those before ArduPilot 3.4, and those before 3.2."""


def ardupilot_facts(records: LogRecords) -> LogFacts:
    """Return the facts that a log of ArduPilot states."""
    get = records.signal
    end_s = records.duration_s + 1e-3
    arming, landing = _changes(records)
    armed = state_spans(arming, end_s)
    texts = [(at, str(row.get("Message", ""))) for at, row in records.listed("MSG")]
    words = [*(text for _, text in texts), *(word for name, word in _OWN.items() if name in records.parameters)]
    vehicle, kind = next((known for text in words for word, known in _VEHICLES.items() if word in text), ("", 0))
    signals: dict[str, LogSignal] = {}
    lacks: dict[str, str] = {}
    if vehicle in ("", "multirotor"):
        signals["motors"] = output_commands(records, armed, "RCOU", _OUTPUT_FIELDS, 4)
    signals["rpm"] = _rpm(records)
    signals["attitude"] = get("ATT", ["Roll", "Pitch", "Yaw"], ANGLES, "deg")
    signals["attitude_wanted"] = first_known(*(get("ATT", columns, ANGLES, "deg") for columns in _wanted(records)))
    barometers = (("BARO", "Alt"), ("CTUN", "BAlt"), ("CTUN", "BarAlt"))
    heights = (get(name, [column], ["barometer"], "m") for name, column in barometers)
    signals["height"] = first_known(*heights).above_begin()
    motors = signals.get("motors", NO_SIGNAL).each_sample("throttle", np.max)
    signals["throttle"] = first_known(motors, _throttle(records))
    kalman = "XKF" if ("XKF4", 0) in set(records.names()) else "NKF"
    signals["height_estimate"] = get(f"{kalman}1", ["PD"], ["estimate"], "m", -1.0).above_begin()
    signals["position_apart"] = _position_apart(records, kalman)
    # planes do not log their take-off
    received = get("GPS", ["Alt"], ["receiver"], "m").above_begin()
    lifted = off_ground(armed, signals["height"], received)
    air = state_spans(landing, end_s, state=False) if landing else lifted
    flight = overlap(air, armed)
    signals["climb"] = get(f"{kalman}1", ["VD"], ["climb"], "m/s", -1.0)
    signals["climb_wanted"] = get("PSCD", ["TVD"], ["wanted"], "m/s", -1.0)
    signals["acceleration"] = get("IMU", ["AccX", "AccY", "AccZ"], "xyz", "m/s2")
    signals["battery"] = _battery(records, lacks)
    used = get("GPS", ["U"])
    if used and not used.only[inside(used.time_s, flight)].any():
        lacks["gps"] = "the log says that its receiver was not used"
    else:
        signals["gps"] = get("GPS", ["Status", "NSats"], ["fix", "satellites"])
    signals["climb_received"] = get("GPS", ["VZ", "Status"]).climb()
    signals["position"] = get("GPS", ["Lat", "Lng", "Status"]).way()
    signals["ratios"] = get(f"{kalman}4", ["SV", "SP", "SH"], RATIOS)
    vibration = get("VIBE", ["VibeX", "VibeY", "VibeZ"], unit="m/s2")
    signals["vibration"] = vibration.each_sample("vibration", np.max)
    signals["clipping"] = get("VIBE", ["Clip"], ["clipped"], "samples")
    return LogFacts(
        "ArduPilot", vehicle, records.first_ns, records.duration_s, tuple(armed), tuple(flight), signals,
        (*_statements(records, texts, kind), *state_statements(arming, landing)), tuple(_commands(records)),
        records.parameters, lacks,
    )  # fmt: skip


def _changes(records: LogRecords) -> tuple[Changes, Changes]:
    """Return the changes between disarmed and armed, and between in the air and landed."""
    events = records.signal("EV", ["Id"])
    event = list(zip(events.time_s.tolist(), events.only.astype(int).tolist(), strict=True))
    arming = records.signal("ARM", ["ArmState"]).changes() or [
        (at, float(kind == _ARMED)) for at, kind in event if kind in (_ARMED, _DISARMED)
    ]
    if not arming or not arming[0][1]:
        # the log begins at arming
        arming = [(0.0, 1.0), *arming]
    landing = [(at, float(kind == _LANDED)) for at, kind in event if kind in (_LANDED, _IN_THE_AIR)]
    if landing and landing[0][1]:
        # the log begins in the air
        landing = [(0.0, 0.0), *landing]
    return arming, landing


def _battery(records: LogRecords, lacks: dict[str, str]) -> LogSignal:
    read = partial(records.signal, columns=["Volt", "Curr"], shown=["voltage", "current"], unit="V, A")
    battery = first_known(read("BAT"), read("CURR"))
    most = np.nanmax(battery.only, initial=0.0)
    if battery and most <= 1.0:
        lacks["battery"] = "its voltage is below 1 V from begin to end: no sensor is connected"
        return NO_SIGNAL
    return replace(battery, values=battery.values / 100.0) if most > _MOST_VOLTS else battery


def output_commands(
    records: LogRecords, armed: Spans, name: str, fields: Iterable[str], first: int, system: int = 0
) -> LogSignal:
    """Return the commands of the outputs that are motors by the parameters; else of the first outputs if all move.

    Their pulses are in records of this name, in the first of ``fields`` that they have; {} is an output's number.
    """
    said = {k: records.parameters.get(f"SERVO{k}_FUNCTION") for k in range(1, _OUTPUTS + 1)}
    motors = {k: MOTOR_FUNCTIONS[int(function)] for k, function in said.items() if function in MOTOR_FUNCTIONS}
    numbers = motors or {k: k - 1 for k in range(1, first + 1)}
    low, high = _pulse_range(records.parameters)
    shown = [f"motor{index + 1}" for index in numbers.values()]
    columns = ([field.format(k) for k in numbers] for field in fields)
    pulses = first_known(*(records.signal(name, column, shown, "us", system=system) for column in columns))
    during = pulses.values[inside(pulses.time_s, armed)]
    if not motors and not (len(during) and np.ptp(during, axis=0).all()):
        return NO_SIGNAL
    return replace(pulses, values=np.maximum(pulses.values - low, 0.0) / (high - low), unit="of full")


def _pulse_range(parameters: Mapping[str, float]) -> tuple[float, float]:
    """Return the pulses (us) of no and of full command.

    Without MOT_PWM_MIN and MOT_PWM_MAX (before 3.4, or if they are 0) the range is that of the throttle channel, of
    which versions before 3.3 use MOT_TCRV_MAXPCT percent.
    """
    channel = f"RC{parameters.get('RCMAP_THROTTLE', _THROTTLE_CHANNEL):.0f}"
    low, high = (
        parameters.get(f"MOT_PWM_{end}") or parameters.get(f"{channel}_{end}") or default
        for end, default in (("MIN", _PWM_FROM), ("MAX", _PWM_TO))
    )
    curve = parameters.get("MOT_TCRV_MAXPCT", 100.0) if parameters.get("MOT_TCRV_ENABLE") else 100.0
    return low, low + (high - low) * curve / 100.0


def _wanted(records: LogRecords) -> Iterator[list[str]]:
    """Yield the possible names of the wanted attitude's fields."""
    yield ["DesRoll", "DesPitch", "DesYaw"]
    # before 3.2; in acro mode they held the sticks
    modes = (records.signal("MODE", [column]).only for column in ("ModeNum", "Mode"))
    if not any((numbers == _ACRO).any() for numbers in modes):
        yield ["RollIn", "PitchIn", "NavYaw"]


_ACRO = 1
"""Acro mode of a copter: https://github.com/ArduPilot/ardupilot/blob/master/ArduCopter/mode.h."""


def _throttle(records: LogRecords) -> LogSignal:
    """Return the throttle of a copter that applies to all its motors, 0 to 1."""
    names = ("ThO", "ThrOut")
    throttle = first_known(*(records.signal("CTUN", [name], ["throttle"], "of full") for name in names))
    # before 3.4 it is in thousandths
    thousandths = np.nanmax(throttle.only, initial=0.0) > _MOST_SHARE
    return replace(throttle, values=throttle.values / (1000.0 if thousandths else 1.0))


_MOST_SHARE = 2.0
"""A share of full command is always smaller, and a flight's throttle in thousandths always larger."""


def _position_apart(records: LogRecords, kalman: str) -> LogSignal:
    """Return the distance of the controller's position from the nearest position that a lane estimates.

    Before 4.0, and in Rover 4.7, the controller's position is in centimetres: its unit is the one that fits the
    estimate better over the log.
    """
    north, east = (
        first_known(*(records.signal(name, [field], ["apart"], "m") for name, field in known))
        for known in ((("PSCN", "PN"), ("PSC", "PX")), (("PSCE", "PE"), ("PSC", "PY")))
    )
    lanes = [records.signal(f"{kalman}1{k}", ["PN", "PE"], ["north", "east"], "m") for k in ("", "/1", "/2")]
    times = north.time_s
    if not (east and any(lanes)):
        return NO_SIGNAL
    flown = np.stack([north.only, np.interp(times, east.time_s, east.only)])
    estimated = [[np.interp(times, lane.time_s, axis) for axis in lane.values.T] for lane in lanes if lane]
    by_unit = (np.min([np.hypot(*(unit * flown - lane)) for lane in estimated], axis=0) for unit in (1.0, 0.01))
    apart = min(by_unit, key=np.median)
    return replace(north, values=apart[:, None], origin=f"{north.origin} against {kalman}1")


def _rpm(records: LogRecords) -> LogSignal:
    """Return the speeds of the ESCs at the times of the first ESC."""
    speeds = [records.signal(name, ["RPM"], ["rpm"], "rpm") for name in ("ESC", *(f"ESC/{k}" for k in range(1, 12)))]
    known = [(k, speed) for k, speed in enumerate(speeds) if (speed.only > 0).any()]
    if not known:
        return NO_SIGNAL
    times = known[0][1].time_s
    values = np.concatenate([speed.at(times) for _, speed in known], axis=1)
    return LogSignal(times, values, tuple(f"motor{k + 1}" for k, _ in known), "rpm", "ESC")


def _statements(records: LogRecords, texts: Sequence[tuple[float, str]], kind: int) -> Iterator[Statement]:
    for at, text in texts:
        yield Statement(at, "text", text, UNKNOWN_LEVEL)
    for at, value in records.signal("MODE", ["ModeNum"]).changes():
        yield Statement(at, "mode", f"mode {mode_name(ARDUPILOT, kind, 0, int(value)) or int(value)}")
    errors = records.signal("ERR", ["Subsys", "ECode"])
    for at, (subsystem, code) in zip(errors.time_s.tolist(), errors.values.astype(int).tolist(), strict=True):
        if code and subsystem not in _NO_FAILSAFE:
            yield Statement(at, "failsafe", f"{_SUBSYSTEMS.get(subsystem, f'subsystem {subsystem}')} (code {code})", 1)


def _commands(records: LogRecords) -> Iterator[CommandSent]:
    for at, row in records.listed("MAVC"):
        values = tuple(float(row.get(f"P{k}", 0.0)) for k in range(1, 5))
        yield CommandSent(at, int(row.get("SS", 0)), int(row.get("SC", 0)), str(int(row.get("Cmd", 0))), values)
