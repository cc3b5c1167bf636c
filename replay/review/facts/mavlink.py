"""The facts that a recording of telemetry states."""

import re
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from adapters.mavlink.heartbeat import ARDUPILOT, PX4, mode_name
from monitor.alarms.command_watch import COMMANDS, CommandSent, command_sent
from monitor.fitting.survey import IMUS
from replay.review.facts.ardupilot import output_commands
from replay.review.facts.log_facts import (
    ANGLES,
    BEGIN_S,
    NO_SIGNAL,
    RATIOS,
    SUBMARINE,
    LogFacts,
    LogRecords,
    LogSignal,
    Spans,
    Statement,
    degrees_apart,
    first_known,
    inside,
    off_ground,
    overlap,
    state_spans,
    state_statements,
)

TOPICS = frozenset(
    {
        "HEARTBEAT", "EXTENDED_SYS_STATE", "SERVO_OUTPUT_RAW", "ATTITUDE", "ATTITUDE_TARGET", "SCALED_PRESSURE",
        "LOCAL_POSITION_NED", *IMUS, "SYS_STATUS", "GPS_RAW_INT", "EKF_STATUS_REPORT",
        "ESTIMATOR_STATUS", "VIBRATION", "STATUSTEXT", "PARAM_VALUE", "NAV_CONTROLLER_OUTPUT",
    }
) | COMMANDS  # fmt: skip

# MAV_TYPE, MAV_AUTOPILOT, MAV_MODE_FLAG and MAV_LANDED_STATE of MAVLink's common definitions
_ROTORS = {2: 4, 13: 6, 14: 8, 29: 12}
_NO_AUTOPILOT, _ARMED, _ON_GROUND = 8, 128, 1
_KINDS = {1: "plane", 10: "rover", 11: "rover", 12: SUBMARINE}
_KINDS |= dict.fromkeys(range(19, 26), "VTOL")
"""Kinds by MAV_TYPE, except multirotors: fixed wing, ground rover, boat, submarine, and vehicles that change between
two kinds."""
_AUTOPILOTS = {ARDUPILOT: "ArduPilot", PX4: "PX4"}
_ANNOUNCED = re.compile(
    r"failsafe|^crash|potential thrust loss|^parachute: released|^low battery!|^ekf variance|^gps glitch|"
    r"^vibration compensation on",
    re.IGNORECASE,
)
_CALLED_OFF = re.compile(r"^(pre)?arm|preflight|clear|recover|resolve|deactivat|disabl|not |\boff\b", re.IGNORECASE)
"""Texts of autopilots about a failsafe or a failure, and texts that it is over, or did not happen."""
_ESTIMATORS = {
    "EKF_STATUS_REPORT": ["velocity_variance", "pos_horiz_variance", "pos_vert_variance"],
    "ESTIMATOR_STATUS": ["vel_ratio", "pos_horiz_ratio", "pos_vert_ratio"],
}
"""Reports of estimators, with their innovations as shares of the gates."""
_PRESSURES = {"SCALED_PRESSURE": "press_abs", "HIGHRES_IMU": "abs_pressure"}
"""Messages of the static pressure in hectopascal, with its field; 0 where the vehicle has no barometer."""
_BLOW_HZ = 20.0
"""Least rate of accelerations in which a blow or a fall shows, hertz. Chosen: a blow rings for a tenth of a second;
ArduPilot logs 25."""
_MILLI = 1e-3
_HECTOPASCAL_M = 8.43
"""Metres of height per hectopascal at sea level: R T / (g M p) at 15 degrees and 1013.25 hPa."""


def mavlink_facts(records: LogRecords) -> LogFacts:
    """Return the facts that a recording of telemetry states about its first autopilot."""
    system, kind, autopilot = _vehicle(records)
    get = partial(records.signal, system=system)
    end_s = records.duration_s + 1e-3
    modes = get("HEARTBEAT", ["base_mode", "custom_mode", "autopilot"])
    modes = _where(modes.values[:, 2] != _NO_AUTOPILOT, modes)
    arming = modes.changes(lambda base: base.astype(int) & _ARMED > 0)
    armed = state_spans(arming, end_s)
    signals: dict[str, LogSignal] = {}
    lacks: dict[str, str] = {}
    pressures = (get(name, [column], ["barometer"], "m", -_HECTOPASCAL_M) for name, column in _PRESSURES.items())
    signals["height"] = first_known(*(_where(of.only < 0.0, of) for of in pressures)).above_begin()
    forces = [get(name, ["xacc", "yacc", "zacc"], "xyz", "m/s2", scale) for name, scale in IMUS.items()]
    signals["acceleration"] = first_known(*filter(_shows_blows, forces), NO_SIGNAL)
    if any(forces) and not signals["acceleration"]:
        lacks["acceleration"] = f"accelerations come less than {_BLOW_HZ:g} times a second"
    signals["height_estimate"] = get("LOCAL_POSITION_NED", ["z"], ["estimate"], "m", -1.0).above_begin()
    signals["climb"] = get("LOCAL_POSITION_NED", ["vz"], ["climb"], "m/s", -1.0)
    landed = get("EXTENDED_SYS_STATE", ["landed_state"])
    landing = landed.changes(lambda state: state == _ON_GROUND) if (landed.only > 0).any() else []
    # a gap of the recording may hide arming and take-off: the vehicle stood at the last heartbeat before arming
    stood = [(float(np.max(modes.time_s[modes.time_s < start], initial=0.0)), end) for start, end in armed]
    lifted = _off_ground(stood, signals["height_estimate"], signals["height"])
    flight = overlap(state_spans(landing, end_s, state=False) if landing else lifted, armed)
    rotors = _ROTORS.get(kind, 0)
    if rotors:
        signals["motors"] = output_commands(records, armed, "SERVO_OUTPUT_RAW", ["servo{}_raw"], rotors, system)
        signals["throttle"] = signals["motors"].each_sample("throttle", np.max)
    signals["attitude"] = get("ATTITUDE", ANGLES, ANGLES, "deg", float(np.degrees(1.0)))
    turned = get("ATTITUDE_TARGET", [f"q[{k}]" for k in range(4)])
    wanted = get("NAV_CONTROLLER_OUTPUT", ["nav_roll", "nav_pitch"], ANGLES[:2], "deg")
    if not rotors or autopilot != ARDUPILOT or not _followed(wanted, signals["attitude"], flight):
        wanted = NO_SIGNAL
    signals["attitude_wanted"] = first_known(turned.angles_deg(), wanted)
    battery = get("SYS_STATUS", ["voltage_battery", "current_battery"], ["voltage", "current"], "V, A")
    signals["battery"] = _known_volts(battery, lacks)
    signals["gps"] = get("GPS_RAW_INT", ["fix_type", "satellites_visible"], ["fix", "satellites"])
    signals["position"] = get("GPS_RAW_INT", ["lat", "lon", "fix_type"]).way()
    signals["ratios"] = first_known(*(get(name, columns, RATIOS) for name, columns in _ESTIMATORS.items()))
    if autopilot == ARDUPILOT:
        vibration = get("VIBRATION", [f"vibration_{axis}" for axis in "xyz"], unit="m/s2")
        signals["vibration"] = vibration.each_sample("vibration", np.max)
    signals["clipping"] = get("VIBRATION", ["clipping_0"], ["clipped"], "samples")
    vehicle = "multirotor" if rotors else _KINDS.get(kind, "")
    return LogFacts(
        _AUTOPILOTS.get(autopilot, ""), vehicle, records.first_ns, records.duration_s, tuple(armed), tuple(flight),
        signals, (*_statements(records, system, kind, autopilot, modes), *state_statements(arming, landing)),
        tuple(_commands(records, system)), records.parameters, lacks,
    )  # fmt: skip


def _known_volts(battery: LogSignal, lacks: dict[str, str]) -> LogSignal:
    volts = battery.values * [_MILLI, 10 * _MILLI]
    known = (volts[:, 0] > 1.0) & (battery.values[:, 0] < np.iinfo(np.uint16).max)
    if battery and not known.any():
        lacks["battery"] = "the vehicle sends no voltage"
    return _where(known, replace(battery, values=volts))


def _off_ground(stood: Spans, *heights: LogSignal) -> Spans:
    # a height counts from its first samples: a signal that begins in the air tells nothing
    grounded = [height for height in heights if any(height.during(0.0, at + BEGIN_S) for at, _ in stood[:1])]
    return off_ground(stood, first_known(*grounded, *heights))


def _where(rows: NDArray[np.bool_], signal: LogSignal) -> LogSignal:
    return replace(signal, time_s=signal.time_s[rows], values=signal.values[rows])


def _shows_blows(force: LogSignal) -> bool:
    return bool(force) and len(force.time_s) > _BLOW_HZ * float(np.ptp(force.time_s))


def _followed(wanted: LogSignal, attitude: LogSignal, flight: Spans) -> bool:
    """Return whether wanted angles are those of the whole controller: a flight's roll and pitch are mostly near them.

    Old versions and other vehicles send there what navigation alone wants.
    """
    flown = inside(attitude.time_s, flight)
    apart = degrees_apart(wanted.at(attitude.time_s), attitude.values[:, :2])[flown].max(axis=1, initial=0.0)
    return bool(wanted) and bool(flown.any()) and bool(np.nanmedian(apart) < _NEAR_DEG)


_NEAR_DEG = 5.0
"""Largest median distance of a followed attitude, degrees. Measured: 0 to 2.6 in 45 recordings of ArduCopter 3.3 to
4.5; 3.3 to 31.8 in drives, bench runs and tumbles."""


def _vehicle(records: LogRecords) -> tuple[int, int, int]:
    """Return system, kind and autopilot of the first system with an autopilot."""
    for name, system in sorted(records.names(), key=lambda entry: entry[1]):
        if name != "HEARTBEAT":
            continue
        beats = records.signal(name, ["type", "autopilot"], system=system)
        own = beats.values[beats.values[:, 1] != _NO_AUTOPILOT]
        if len(own):
            return system, int(own[0, 0]), int(own[0, 1])
    return 0, 0, 0


def _statements(
    records: LogRecords, system: int, vehicle: int, autopilot: int, modes: LogSignal
) -> Iterator[Statement]:
    if records.strays:
        yield Statement(0.0, "stamps", f"{records.strays} records are stamped a day and more from these: left out")
    for at, row in records.listed("STATUSTEXT", system):
        text = str(row.get("text", "")).strip()
        kind = "failsafe" if _ANNOUNCED.search(text) and not _CALLED_OFF.search(text) else "text"
        yield Statement(at, kind, text, 1 if kind == "failsafe" else int(row.get("severity", 6)))
    for at, value in replace(modes, values=modes.values[:, 1:2]).changes():
        yield Statement(at, "mode", f"mode {mode_name(autopilot, vehicle, _ARMED, int(value)) or int(value)}")


def _commands(records: LogRecords, vehicle: int) -> Iterator[CommandSent]:
    for name, system in records.names():
        for at, component, row in records.rows.get((name, system), ()) if name in COMMANDS else ():
            sent = command_sent(name, row, records.time_s(at), system, component, vehicle)
            if sent is not None:
                yield sent
