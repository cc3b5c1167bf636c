"""Flights of a quadrotor as logs of PX4 and ArduPilot, with what is to be found in them known to the sample."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import cos, radians, sin
from pathlib import Path

from dataflash_writer import DataflashWriter
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from ulog_writer import UlogWriter

END_S = 60.0
TAKEOFF_S, LANDING_S, DISARM_S = 3.0, 54.0, 57.0
HOVER = 0.45
BEGIN_US = 5_000_000


def usual_height(time_s: float) -> float:
    """Return the height of a flight that climbs to 15 m and comes down again."""
    climbed = min(max(time_s - TAKEOFF_S, 0.0) * 1.5, 15.0)
    return max(min(climbed, (LANDING_S - time_s) * 1.5), 0.0)


def usual_motors(time_s: float) -> list[float]:
    return [HOVER] * 4 if TAKEOFF_S <= time_s < LANDING_S else [0.0] * 4


@dataclass
class Flight:
    """A flight; what is not said is as usual."""

    height: Callable[[float], float] = usual_height
    motors: Callable[[float], list[float]] = usual_motors
    landed: Callable[[float], bool] = lambda at: not TAKEOFF_S <= at < LANDING_S
    armed: Callable[[float], bool] = lambda at: 1.0 <= at < DISARM_S
    tilt_deg: Callable[[float], float] = lambda _: 0.0  # roll
    tilt_wanted_deg: Callable[[float], float] = lambda _: 0.0
    climb_wanted: Callable[[float], float] = lambda _: 0.0
    rpm: Callable[[float], list[float]] | None = None
    volts: Callable[[float], float] = lambda _: 15.4
    connected: bool = True
    fix: Callable[[float], int] = lambda _: 3
    gps_used: bool = True
    north_m: Callable[[float], float] = lambda _: 0.0
    altered_m: Callable[[float], float] = lambda _: 0.0  # between the estimator and the controller; ArduPilot alone
    ratio: Callable[[float], float] = lambda _: 0.1
    resets: Callable[[float], int] = lambda _: 1
    reset_by_m: float = 0.0  # how far north each reset puts the position
    yaw_deg: Callable[[float], float] = lambda _: 0.0
    vibration: Callable[[float], float] = lambda _: 2.0
    clipped: Callable[[float], int] = lambda _: 0
    failsafe: Callable[[float], bool] = lambda _: False
    killed: Callable[[float], bool] = lambda _: False
    mode: int = 2
    vtol: bool = False
    end_s: float = END_S
    texts: Sequence[tuple[float, str]] = ()
    commands: Sequence[tuple[float, int, int, float]] = ()  # when, component, MAV_CMD, first parameter
    parameters: Mapping[str, float] = field(default_factory=lambda: {"BAT1_N_CELLS": 4})
    changes: Sequence[tuple[float, str, float]] = ()  # when, parameter, value
    # records of PX4 with more or other fields, at a time; None where the log has no such record
    others: Callable[[float], Mapping[str, Mapping[str, object] | None]] = lambda _: {}


_TOPICS = {
    "vehicle_status": "uint64_t timestamp;uint8_t arming_state;uint8_t nav_state;bool failsafe;uint8_t vehicle_type;"
    "bool is_vtol",
    "vehicle_land_detected": "uint64_t timestamp;bool landed",
    "actuator_armed": "uint64_t timestamp;bool manual_lockdown",
    "actuator_motors": "uint64_t timestamp;float[12] control",
    "esc_report": "uint64_t timestamp;int32_t esc_rpm",
    "esc_status": "uint64_t timestamp;uint8_t esc_count;esc_report[8] esc",
    "vehicle_attitude": "uint64_t timestamp;float[4] q",
    "vehicle_attitude_setpoint": "uint64_t timestamp;float[4] q_d;float[3] thrust_body",
    "vehicle_air_data": "uint64_t timestamp;float baro_alt_meter",
    "vehicle_local_position": "uint64_t timestamp;float z;float vz;float[2] delta_xy;float delta_z;"
    "float[2] delta_vxy;float delta_vz;uint8_t xy_reset_counter;uint8_t z_reset_counter;"
    "uint8_t vxy_reset_counter;uint8_t vz_reset_counter",
    "vehicle_local_position_setpoint": "uint64_t timestamp;float vz",
    "battery_status": "uint64_t timestamp;float voltage_v;float current_a;bool connected",
    "vehicle_gps_position": "uint64_t timestamp;int32_t lat;int32_t lon;float vel_d_m_s;uint8_t fix_type;"
    "uint8_t satellites_used",
    "failure_detector_status": "uint64_t timestamp;bool fd_imbalanced_prop;bool fd_motor",
    "estimator_status_flags": "uint64_t timestamp;bool cs_gps",
    "estimator_status": "uint64_t timestamp;float vel_test_ratio;float pos_test_ratio;float hgt_test_ratio",
    "vehicle_command": "uint64_t timestamp;float param1;uint32_t command;uint8_t source_system;"
    "uint16_t source_component;bool from_external",
    "vehicle_imu_status": "uint64_t timestamp;uint32_t[3] accel_clipping;float accel_vibration_metric",
}


def px4_log(path: Path, flight: Flight) -> Path:
    """Write a flight as PX4 logs it, all topics 10 times a second."""
    log = UlogWriter(BEGIN_US)
    for name, value in flight.parameters.items():
        log.parameter(name, value)
    for name, fields in _TOPICS.items():
        log.define(name, fields)
    ids = {name: log.subscribe(name) for name in _TOPICS if name != "esc_report"}
    ids["vehicle_imu_status/1"] = log.subscribe("vehicle_imu_status", 1)
    texts = sorted(flight.texts)
    for tick in range(int(flight.end_s * 10)):
        at, stamp = tick / 10, BEGIN_US + tick * 100_000
        while texts and texts[0][0] <= at:
            log.text(stamp, texts.pop(0)[1], 4)
        for when, name, value in flight.changes:
            if when <= at < when + 0.1:
                log.parameter(name, value)
        for when, component, number, first in flight.commands:
            if when <= at < when + 0.1:
                sent = {"param1": first, "command": number, "source_system": 255, "source_component": component}
                log.add(ids["vehicle_command"], "vehicle_command", {"timestamp": stamp, **sent, "from_external": True})
        topics = _topics(flight, at)
        for name, values in (topics | flight.others(at)).items():
            if values is not None:
                log.add(ids[name], name.split("/")[0], {"timestamp": stamp, **topics.get(name, {}), **values})
    return log.write(path)


def _turned(roll_deg: float, yaw_deg: float = 0.0) -> list[float]:
    roll, yaw = radians(roll_deg) / 2, radians(yaw_deg) / 2
    return [cos(roll) * cos(yaw), sin(roll) * cos(yaw), sin(roll) * sin(yaw), cos(roll) * sin(yaw)]


def _noisy(flight: Flight, at: float) -> float:
    """Return the ratio of an innovation, which differs from one measurement to the next."""
    return flight.ratio(at) + 0.01 * (at % 0.7)


def _topics(flight: Flight, at: float) -> dict[str, dict[str, object]]:
    count = flight.resets(at)
    topics: dict[str, dict[str, object]] = {
        "vehicle_status": {
            "arming_state": 2 if flight.armed(at) else 1,
            "nav_state": flight.mode,
            "failsafe": flight.failsafe(at),
            "vehicle_type": 1,
            "is_vtol": flight.vtol,
        },
        "vehicle_land_detected": {"landed": flight.landed(at)},
        "actuator_armed": {"manual_lockdown": flight.killed(at)},
        "actuator_motors": {"control": flight.motors(at) + [float("nan")] * 8},
        "vehicle_attitude": {"q": _turned(flight.tilt_deg(at), flight.yaw_deg(at))},
        "vehicle_attitude_setpoint": {
            "q_d": _turned(flight.tilt_wanted_deg(at)),
            "thrust_body": [0.0, 0.0, -max(flight.motors(at))],
        },
        "vehicle_air_data": {"baro_alt_meter": 200.0 + flight.height(at)},
        "vehicle_local_position": {
            "z": -flight.height(at),
            "xy_reset_counter": count,
            "delta_xy": [flight.reset_by_m, 0.0],
            "delta_z": 0.0,
            "delta_vxy": [0.0, 0.0],
            "delta_vz": 0.0,
            "z_reset_counter": 1,
            "vxy_reset_counter": 1,
            "vz_reset_counter": 1,
        },
        "vehicle_local_position_setpoint": {"vz": -flight.climb_wanted(at)},
        "battery_status": {"voltage_v": flight.volts(at), "current_a": 12.0, "connected": flight.connected},
        "vehicle_gps_position": {
            "lat": 470_000_000 + round(flight.north_m(at) * 90.0),
            "lon": 80_000_000,
            "vel_d_m_s": (flight.height(at - 0.1) - flight.height(at + 0.1)) / 0.2,
            "fix_type": flight.fix(at),
            "satellites_used": 4 * flight.fix(at),
        },
        "estimator_status_flags": {"cs_gps": flight.gps_used},
        "estimator_status": {"vel_test_ratio": 0.1, "pos_test_ratio": _noisy(flight, at), "hgt_test_ratio": 0.1},
        "vehicle_imu_status": {
            "accel_clipping": [0, 0, flight.clipped(at)],
            "accel_vibration_metric": flight.vibration(at),
        },
    }
    if flight.rpm is not None:
        reports = [{"esc_rpm": int(speed)} for speed in flight.rpm(at)]
        topics["esc_status"] = {"esc_count": 4, "esc": reports + [{"esc_rpm": 0}] * 4}
    return topics


def ardupilot_log(
    path: Path,
    flight: Flight,
    errors: Sequence[tuple[float, int, int]] = (),
    output: str = "C",
    landed_at_begin: bool = True,
) -> Path:
    """Write a flight as ArduPilot logs it; errors are times, subsystems and codes, ``output`` the name of outputs."""
    log = DataflashWriter()
    log.define("PARM", "QNf", "TimeUS,Name,Value")
    log.define("MSG", "QZ", "TimeUS,Message")
    log.define("EV", "QB", "TimeUS,Id")
    log.define("ERR", "QBB", "TimeUS,Subsys,ECode")
    log.define("MODE", "QMBB", "TimeUS,Mode,ModeNum,Rsn")
    log.define("RCOU", "QHHHH", ",".join(["TimeUS", *(f"{output}{k}" for k in range(1, 5))]))
    log.define("ATT", "Qffffff", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw")
    log.define("BARO", "QBf", "TimeUS,I,Alt", "s#m")
    log.define("BAT", "QBff", "TimeUS,Inst,Volt,Curr", "s#--")
    log.define("GPS", "QBBBB", "TimeUS,I,Status,NSats,U", "s#---")
    log.define("XKF4", "QBfff", "TimeUS,C,SV,SP,SH", "s#---")
    log.define("XKF1", "QBff", "TimeUS,C,PN,PE", "s#mm")
    log.define("PSCN", "Qff", "TimeUS,TPN,PN")
    log.define("PSCE", "Qff", "TimeUS,TPE,PE")
    log.define("MAVC", "QBBHf", "TimeUS,SS,SC,Cmd,P1")
    log.define("VIBE", "QBfffI", "TimeUS,IMU,VibeX,VibeY,VibeZ,Clip", "s#----")
    log.add("MSG", BEGIN_US, "ArduCopter V4.5.7")
    for number in range(1, 5):
        log.add("PARM", BEGIN_US, f"SERVO{number}_FUNCTION", 32.0 + number)
    for name, value in flight.parameters.items():
        log.add("PARM", BEGIN_US, name, value)
    log.add("MODE", BEGIN_US, 5, 5, 1)
    was = (False, landed_at_begin)
    faults = sorted(errors)
    for tick in range(int(flight.end_s * 10)):
        at, stamp = tick / 10, BEGIN_US + tick * 100_000
        now = flight.armed(at), flight.landed(at)
        if now[0] != was[0]:
            log.add("EV", stamp, 10 if now[0] else 11)
        if now[1] != was[1]:
            log.add("EV", stamp, 18 if now[1] else 28)
        was = now
        for when, component, number, first in flight.commands:
            if when <= at < when + 0.1:
                log.add("MAVC", stamp, 255, component, number, first)
        for when, name, value in flight.changes:
            if when <= at < when + 0.1:
                log.add("PARM", stamp, name, value)
        while faults and faults[0][0] <= at:
            log.add("ERR", stamp, *faults.pop(0)[1:])
        log.add("RCOU", stamp, *(round(1000 + 1000 * share) for share in flight.motors(at)))
        log.add("ATT", stamp, flight.tilt_wanted_deg(at), flight.tilt_deg(at), 0.0, 0.0, 0.0, 0.0)
        log.add("BARO", stamp, 0, flight.height(at))
        log.add("BAT", stamp, 0, flight.volts(at), 12.0)
        log.add("GPS", stamp, 0, flight.fix(at), 4 * flight.fix(at), flight.gps_used)
        log.add("XKF4", stamp, 0, 0.1, _noisy(flight, at), 0.1)
        for lane in range(2):
            log.add("XKF1", stamp, lane, flight.north_m(at) + 8.0 * lane, 0.0)
        log.add("PSCN", stamp, 0.0, flight.north_m(at) + flight.altered_m(at))
        log.add("PSCE", stamp, 0.0, 0.0)
        log.add("VIBE", stamp, 0, flight.vibration(at), 0.0, 0.0, flight.clipped(at))
    path.write_bytes(log.data)
    return path


def telemetry(
    path: Path,
    flight: Flight,
    period_s: float = 0.25,
    first_output: int = 1,
    drift_m: float = 0.0,
    unheard: tuple[float, float] = (0.0, 0.0),
    estimator: Callable[[float], tuple[int, float]] | None = None,
    navigation_alone: bool = False,
) -> Path:
    """Write a flight of ArduPilot as a ground station records it, its motors on four outputs from ``first_output`` on.

    ``drift_m`` is by how much the barometer drifts until the vehicle arms, ``unheard`` when the link is lost, after
    which the estimator's height is sent, too, and ``estimator`` its flags and the ratio of its innovations.
    """
    packer = mavlink.MAVLink(None, 1, 1)
    packets = []
    for number in range(4):
        name = f"SERVO{first_output + number}_FUNCTION".encode()
        packets.append((0.0, mavlink.MAVLink_param_value_message(name, 33.0 + number, 9, 4, number)))
    for tick in range(int(flight.end_s / period_s)):
        at = tick * period_s
        if unheard[0] <= at < unheard[1]:
            continue
        pulses = [0] * 16
        pulses[first_output - 1 : first_output + 3] = (round(1000 + 1000 * share) for share in flight.motors(at))
        roll = [radians(flight.tilt_deg(at)), 0.0, radians(flight.yaw_deg(at)), *[0.0] * 3]
        metres = flight.height(at) + drift_m * min(at, 1.0)
        armed = 128 * flight.armed(at) + 1
        wanted = 20.0 if navigation_alone else flight.tilt_wanted_deg(at)
        packets += [
            (at, mavlink.MAVLink_heartbeat_message(22 if flight.vtol else 2, 3, armed, flight.mode, 4, 3)),
            (at, mavlink.MAVLink_attitude_message(round(1000 * at), *roll)),
            (at, mavlink.MAVLink_nav_controller_output_message(wanted, 0.0, 0, 0, 0, 0.0, 0.0, 0.0)),
            (at, mavlink.MAVLink_scaled_pressure_message(round(1000 * at), 1013.25 - metres / 8.43, 0.0, 2000)),
            (at, mavlink.MAVLink_servo_output_raw_message(round(1e6 * at), 0, *pulses)),
        ]
        if unheard[1] and at >= unheard[1]:
            down = -flight.height(at)
            packets.append((at, mavlink.MAVLink_local_position_ned_message(round(1000 * at), 0, 0, down, 0, 0, 0)))
        if estimator is not None:
            flags, ratio = estimator(at)
            packets.append((at, mavlink.MAVLink_ekf_status_report_message(flags, 0.1, 0.1, ratio, 0.1, 0.0)))
    for at, text in flight.texts:
        packets.append((at, mavlink.MAVLink_statustext_message(2, text.encode())))
    written = ((round(1e6 * at) + 1_795_251_917_000_000).to_bytes(8) + said.pack(packer) for at, said in packets)
    path.write_bytes(b"".join(written))
    return path
