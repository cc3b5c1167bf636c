"""The facts that a log of PX4 states."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from monitor.alarms.command_watch import CommandSent
from replay.review.facts.log_facts import (
    NO_SIGNAL,
    RATIOS,
    Floats,
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

_INSTANCES = ("", "/1", "/2", "/3")
TOPICS = frozenset(
    {
        "vehicle_status", "actuator_armed", "vehicle_land_detected", "actuator_motors", "esc_status",
        "vehicle_attitude", "vehicle_attitude_setpoint", "vehicle_air_data", "vehicle_local_position",
        "vehicle_local_position_setpoint",
        "sensor_combined", "battery_status", "vehicle_gps_position", "estimator_status", "estimator_status_flags",
        "failure_detector_status",
        "vehicle_command", "log/text", "log/parameter",
        *(f"{name}{instance}" for name in ("actuator_outputs", "vehicle_imu_status") for instance in _INSTANCES),
    }
)  # fmt: skip

# https://github.com/PX4/PX4-Autopilot/blob/main/msg/versioned/VehicleStatus.msg
_MODES = {
    0: "Manual", 1: "Altitude", 2: "Position", 3: "Mission", 4: "Hold", 5: "Return", 10: "Acro", 12: "Descend",
    13: "Termination", 14: "Offboard", 15: "Stabilized", 17: "Takeoff", 18: "Land", 19: "Follow", 20: "Precision land",
    21: "Orbit",
}  # fmt: skip
_DETECTOR = "failure_detector_status"
_FAILURES = {
    "roll": "roll", "pitch": "pitch", "alt": "altitude", "ext": "external", "arm_escs": "ESCs at arming",
    "battery": "battery", "imbalanced_prop": "propeller imbalance", "motor": "motor", "high_wind": "high wind",
}  # fmt: skip
"""Flags of failure_detector_status (msg/FailureDetectorStatus.msg), in words."""
_BITS = {name: bit for bit, name in enumerate(_FAILURES) if name != "high_wind"}
"""Bits of vehicle_status' field of the same name, for logs without the topic: between 1.12 and 1.13 the upper bits had
another meaning for a while, so the topic's flags take precedence."""
_CHANGED = "primary EKF changed"
"""Part of PX4's text about the change to another of its estimators, like ArduPilot's error 24."""
_KILLS = {"manual_lockdown": "kill switch", "kill": "kill switch", "force_failsafe": "termination"}
"""Fields of actuator_armed that stop all outputs, in words."""
_ABOUT_THE_LOG = frozenset({2510, 2511})
"""MAV_CMD_LOGGING_START and _STOP: their sender listens, and commands no vehicle."""
_ARMED = 2
_KINDS = {1: "multirotor", 2: "plane", 3: "rover"}
"""Values of arming_state and vehicle_type, from the same file."""
_UAVCAN_FULL, _DSHOT_FULL, _PWM_LEAST, _PWM_SPAN = 8191.0, 1999.0, 800.0, 1000.0
"""Full command of UAVCAN's ESCs (14 bits), of DShot (11 bits, 48 of them are commands), and PWM's 1000 to 2000 us, of
which PX4 sends 900 when disarmed."""
_GPS_BIT = 2
"""Bit of estimator_status.control_mode_flags for the use of GPS, in versions without separate flags."""
_MOST_ROTORS = 12
"""Number of rotors that actuator_motors holds."""


def px4_facts(records: LogRecords) -> LogFacts:
    """Return the facts that a log of PX4 states."""
    get = records.signal
    end_s = records.duration_s + 1e-3
    arming = get("vehicle_status", ["arming_state"]).changes(lambda state: state == _ARMED)
    armed = state_spans(arming, end_s)
    landing = get("vehicle_land_detected", ["landed"]).changes()
    signals: dict[str, LogSignal] = {}
    lacks: dict[str, str] = {}
    signals["motors"] = _motors(records, armed, lacks)
    # its thrust points upwards, against the third axis
    thrust = get("vehicle_attitude_setpoint", ["thrust_body[2]"], ["throttle"], "of full", -1.0)
    signals["throttle"] = first_known(signals["motors"].each_sample("throttle", np.max), thrust)
    signals["rpm"] = _rpm(records, armed)
    signals["attitude"] = get("vehicle_attitude", [f"q[{k}]" for k in range(4)]).angles_deg()
    signals["attitude_wanted"] = get("vehicle_attitude_setpoint", [f"q_d[{k}]" for k in range(4)]).angles_deg()
    barometers = (get(name, ["baro_alt_meter"], ["barometer"], "m") for name in ("vehicle_air_data", "sensor_combined"))
    signals["height"] = first_known(*barometers).above_begin()
    signals["height_estimate"] = get("vehicle_local_position", ["z"], ["estimate"], "m", -1.0).above_begin()
    height = first_known(signals["height"], signals["height_estimate"])
    flight = overlap(state_spans(landing, end_s, state=False) if landing else off_ground(armed, height), armed)
    signals["climb"] = get("vehicle_local_position", ["vz"], ["climb"], "m/s", -1.0)
    signals["climb_wanted"] = get("vehicle_local_position_setpoint", ["vz"], ["wanted"], "m/s", -1.0)
    signals["acceleration"] = get("sensor_combined", [f"accelerometer_m_s2[{k}]" for k in range(3)], "xyz", "m/s2")
    _battery(records, signals, lacks)
    _gps(records, signals, lacks, flight)
    signals["ratios"] = get("estimator_status", [f"{name}_test_ratio" for name in ("vel", "pos", "hgt")], RATIOS)
    counters = [f"{name}_reset_counter" for name in ("xy", "z", "vxy", "vz")]
    moved = ["position", "height", "velocity", "climb"]
    signals["resets"] = get("vehicle_local_position", counters, moved).above_begin()
    steps = ["delta_xy[0]", "delta_xy[1]", "delta_z", "delta_vxy[0]", "delta_vxy[1]", "delta_vz"]
    signals["reset_steps"] = get("vehicle_local_position", steps, unit="m, m/s")
    # each accelerometer has an estimator of its own: take the accelerometer that clips most
    shaken = [_shaken(records, f"vehicle_imu_status{instance}") for instance in _INSTANCES]
    signals |= max(shaken, key=lambda one: float(np.nanmax(one["clipping"].above_begin().only, initial=0.0)))
    return LogFacts(
        "PX4", _vehicle(records), records.first_ns, records.duration_s, tuple(armed), tuple(flight), signals,
        (*_statements(records), *state_statements(arming, landing)), tuple(_commands(records)),
        records.parameters, lacks,
    )  # fmt: skip


def _vehicle(records: LogRecords) -> str:
    flags = ("is_vtol", "is_rotary_wing", "vehicle_type")
    vtol, rotary, kinds = (records.signal("vehicle_status", [name]).only for name in flags)
    if (vtol == 1).any():
        # a VTOL is neither of the two for long: its rotors stand while it flies on its wings
        return "VTOL"
    if len(rotary) and np.median(rotary) == 1:
        return "multirotor"
    return _KINDS.get(int(np.median(kinds)), "") if len(kinds) else ""


def _motors(records: LogRecords, armed: Spans, lacks: dict[str, str]) -> LogSignal:
    """Return the commands of the outputs that move: a mixer's outputs are logged even if nothing is connected."""
    controls = [f"control[{k}]" for k in range(_MOST_ROTORS)]
    numbers = [f"motor{k + 1}" for k in range(_MOST_ROTORS)]
    commands = records.signal("actuator_motors", controls, numbers, "of full")
    there: NDArray[np.bool_] = np.asarray(np.isfinite(commands.values).any(axis=0))
    if there.any():
        # the command of a motor that the autopilot stopped is NaN while the others are not, and a kill switch stops the
        # outputs, not the commands
        off = [records.signal("actuator_armed", [name]).at(commands.time_s) == 1 for name in _KILLS]
        stopped = np.isnan(commands.values[:, there]) | np.any(off, axis=0)
        values = np.where(stopped, 0.0, commands.values[:, there])
        names = tuple(name for name, known in zip(numbers, there, strict=True) if known)
        return LogSignal(commands.time_s, values, names, "of full", "actuator_motors")
    moving: list[LogSignal] = []
    for topic in (f"actuator_outputs{instance}" for instance in _INSTANCES):
        outputs = records.signal(topic, [f"output[{k}]" for k in range(8)], numbers[:8], "of full")
        during = outputs.values[inside(outputs.time_s, armed)]
        # the output of a switch or a constant has few values
        varied = np.array([len(np.unique(column)) > _FEW_VALUES for column in during.T])
        if varied.any():
            moving.append(_scaled(outputs, varied))
        elif outputs:
            lacks["motors"] = "outputs are logged, but none moves while armed: nothing that flies is connected to them"
    return max(moving, key=lambda outputs: len(outputs.names), default=NO_SIGNAL)


_FEW_VALUES = 10
"""Most values of an output without a motor. Chosen: a gripper, a light or a camera has two or three commands, a
controlled motor another one with each sample."""


def _scaled(outputs: LogSignal, moves: NDArray[np.bool_]) -> LogSignal:
    values = outputs.values[:, moves]
    most = np.nanmax(values, initial=0.0)
    positive = values[values > 0]
    if most > 2 * _DSHOT_FULL:
        share = values / _UAVCAN_FULL
    elif len(positive) and positive.min() >= _PWM_LEAST:
        share = np.maximum(values - _PWM_SPAN, 0.0) / _PWM_SPAN
    else:
        share = values / _DSHOT_FULL
    names = tuple(name for name, moved in zip(outputs.names, moves, strict=True) if moved)
    return LogSignal(outputs.time_s, share, names, "of full", outputs.origin)


def _shaken(records: LogRecords, topic: str) -> dict[str, LogSignal]:
    """Return the vibration and clipping of an accelerometer."""
    clipping = records.signal(topic, [f"accel_clipping[{k}]" for k in range(3)], "xyz", "samples")
    return {
        "vibration": records.signal(topic, ["accel_vibration_metric"], ["vibration"], "m/s2"),
        "clipping": clipping.each_sample("clipped", np.sum),
    }


def _rpm(records: LogRecords, armed: Spans) -> LogSignal:
    rows = [(at, row) for at, row in records.listed("esc_status") if isinstance(row.get("esc"), list)]
    count = max((int(row.get("esc_count", 0)) for _, row in rows), default=0)
    if not count:
        return NO_SIGNAL
    times = np.array([at for at, _ in rows])
    values = np.array([[float(controller.get("esc_rpm", 0)) for controller in row["esc"][:count]] for _, row in rows])
    if not (values[inside(times, armed)] > 0).any():
        return NO_SIGNAL
    return LogSignal(times, values, tuple(f"motor{k + 1}" for k in range(count)), "rpm", "esc_status")


def _battery(records: LogRecords, signals: dict[str, LogSignal], lacks: dict[str, str]) -> None:
    battery = records.signal("battery_status", ["voltage_v", "current_a"], ["voltage", "current"], "V, A")
    connected = records.signal("battery_status", ["connected"])
    if battery and connected and not connected.only.any():
        volts = float(np.nanmax(battery.values[:, 0]))
        lacks["battery"] = f"the log says that none is connected to its sensor (connected = 0, {volts:.2f} V at most)"
        return
    signals["battery"] = battery


def _gps(records: LogRecords, signals: dict[str, LogSignal], lacks: dict[str, str], flight: Spans) -> None:
    gps = partial(records.signal, "vehicle_gps_position")
    uses = (records.signal("estimator_status_flags", [name]) for name in ("cs_gps", "cs_gnss_pos"))
    fused = first_known(*uses)
    if not fused:
        flags = records.signal("estimator_status", ["control_mode_flags"])
        fused = replace(flags, values=_bit(_GPS_BIT, flags.values).astype(np.float64))
    if fused and not fused.only[inside(fused.time_s, flight)].any():
        lacks["gps"] = "the estimator did not use GPS in flight, so its receiver had no effect"
        return
    signals["gps"] = gps(["fix_type", "satellites_used"], ["fix", "satellites"])
    places = (["latitude_deg", "longitude_deg", "fix_type"], ["lat", "lon", "fix_type"])
    signals["position"] = first_known(*map(gps, places)).way()
    signals["climb_received"] = gps(["vel_d_m_s", "fix_type"]).climb()


def _statements(records: LogRecords) -> Iterator[Statement]:
    for at, row in records.listed("log/text"):
        text = str(row.get("text", "")).strip()
        changed = _CHANGED in text
        yield Statement(at, "failsafe" if changed else "text", text, 1 if changed else int(row.get("level", 6)))
    for at, value in records.signal("vehicle_status", ["nav_state"]).changes():
        yield Statement(at, "mode", f"mode {_MODES.get(int(value), int(value))}")
    for at, value in records.signal("vehicle_status", ["failsafe"]).changes():
        if value:
            yield Statement(at, "failsafe", "failsafe active", 1)
    named = {name: records.signal(_DETECTOR, [f"fd_{name}"]).changes() for name in _FAILURES}
    bits = records.signal("vehicle_status", ["failure_detector_status"])
    if not any(named.values()):
        named = {name: bits.changes(partial(_bit, bit)) for name, bit in _BITS.items()}
    for name, entries in named.items():
        for at, value in entries:
            if value:
                yield Statement(at, "failsafe", f"failure detector: {_FAILURES[name]}", 1)
    for k in range(_MOST_ROTORS):
        control = records.signal("actuator_motors", [f"control[{k}]"])
        if np.isfinite(control.only).any():
            for at, value in control.changes(np.isnan)[1:]:
                yield Statement(at, "stopped", f"motor{k + 1}", int(value))
    for name, text in _KILLS.items():
        for at, value in records.signal("actuator_armed", [name]).changes():
            if value:
                yield Statement(at, "kill", text, 1)


def _bit(bit: int, values: Floats) -> NDArray[np.int64]:
    return values.astype(np.int64) >> bit & 1


def _commands(records: LogRecords) -> Iterator[CommandSent]:
    for at, row in records.listed("vehicle_command"):
        values = tuple(float(row.get(f"param{k}", 0.0)) for k in range(1, 8))
        number = int(row.get("command", 0))
        if row.get("from_external", True) and number not in _ABOUT_THE_LOG:
            system, component = int(row.get("source_system", 0)), int(row.get("source_component", 0))
            yield CommandSent(at, system, component, str(number), values)
