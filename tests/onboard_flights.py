"""Turns recorded telemetry into the onboard log that PX4 or ArduPilot would have written of the same flight."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from math import cos, degrees, radians, sin
from pathlib import Path
from typing import Any
from unittest import mock

from dataflash_writer import DataflashWriter
from ulog_writer import UlogWriter

from adapters.batch import Batch
from adapters.batch import messages as messages_of_batch
from adapters.logs import onboard_log
from adapters.mavlink.heartbeat import is_autopilot_heartbeat
from adapters.message import Message

# ArduPilot streams magnetic fields in micro-, not in whole gauss.
# Boot was then, microseconds since 1970; GPS week and time of week of it, 18 leap seconds ahead.
BOOT_US = 1_700_000_000_000_000
_GPS_EPOCH_US = 315_964_800_000_000
_LEAP_US = 18_000_000

_TOPICS = {
    "vehicle_attitude": "uint64_t timestamp;uint64_t timestamp_sample;float[4] q",
    "vehicle_angular_velocity": "uint64_t timestamp;uint64_t timestamp_sample;float[3] xyz",
    "sensor_combined": "uint64_t timestamp;float[3] gyro_rad;uint32_t gyro_integral_dt;"
    "int32_t accelerometer_timestamp_relative;float[3] accelerometer_m_s2;uint8_t accelerometer_clipping;"
    "uint8_t[3] _padding0",
    "vehicle_magnetometer": "uint64_t timestamp;float[3] magnetometer_ga;uint8_t[4] _padding0",
    "vehicle_air_data": "uint64_t timestamp;float baro_alt_meter;float baro_temp_celcius;float baro_pressure_pa",
    "actuator_outputs": "uint64_t timestamp;uint32_t noutputs;float[16] output;uint8_t[4] _padding0",
    "actuator_motors": "uint64_t timestamp;float[12] control;uint16_t reversible_flags",
    "vehicle_gps_position": "uint64_t timestamp;uint64_t time_utc_usec;double latitude_deg;double longitude_deg;"
    "double altitude_msl_m;float vel_m_s;float cog_rad;float hdop;float vdop;int32_t timestamp_time_relative;"
    "uint8_t fix_type;uint8_t satellites_used",
    "vehicle_status": "uint64_t timestamp;uint8_t arming_state;uint8_t nav_state;uint8_t system_type",
    "vehicle_land_detected": "uint64_t timestamp;bool landed",
}


def messages_of(batches: Iterable[Batch]) -> list[Message]:
    """Return the messages of batches in their order."""
    return [message for batch in batches for message in messages_of_batch(batch)]


def since_boot(batches: Iterable[Batch]) -> list[Message]:
    """Return the messages of an onboard log with times since boot, as of one without a position fix."""
    with mock.patch.object(onboard_log, "first_relation", return_value=0):
        return messages_of(batches)


def ulog_of(messages: Iterable[Message], path: Path, *, motors: bool = False) -> Path:
    """Write a flight as .ulg; commands of motors at full rate with ``motors``, 10 times a second as outputs."""
    writer = UlogWriter()
    writer.information("sys_name", "PX4")
    writer.parameter("SDLOG_PROFILE", 3)
    for name, fields in _TOPICS.items():
        writer.define(name, fields)
    ids = {name: writer.subscribe(name) for name in _TOPICS}

    def add(name: str, time_us: int, **values: Any) -> None:
        writer.add(ids[name], name, {"timestamp": time_us, **values})

    slow: dict[str, Any] = {}
    outputs = 0
    for time_us, message in _of_the_vehicle(messages):
        fields = message.fields
        if message.name == "ATTITUDE":
            add("vehicle_attitude", time_us, q=_quaternion(fields["roll"], fields["pitch"], fields["yaw"]))
            rates = [fields[name] for name in ("rollspeed", "pitchspeed", "yawspeed")]
            add("vehicle_angular_velocity", time_us, xyz=rates)
        elif message.name == "HIGHRES_IMU":
            field = [fields[name] / 1e6 for name in ("xmag", "ymag", "zmag")]
            air = fields["pressure_alt"], fields["abs_pressure"]
            if slow.get("mag") != field:
                add("vehicle_magnetometer", time_us, magnetometer_ga=field)
            if slow.get("air") != air:
                add("vehicle_air_data", time_us, baro_alt_meter=air[0], baro_pressure_pa=100.0 * air[1])
            slow = {"mag": field, "air": air}
            gyro = [fields[name] for name in ("xgyro", "ygyro", "zgyro")]
            force = [fields[name] for name in ("xacc", "yacc", "zacc")]
            add("sensor_combined", time_us, gyro_rad=gyro, accelerometer_m_s2=force)
        elif message.name == "SERVO_OUTPUT_RAW":
            pulses = [float(fields[f"servo{number}_raw"]) for number in range(1, 17)]
            outputs += 1
            if not motors or outputs % 10 == 0:
                add("actuator_outputs", time_us, noutputs=4, output=pulses)
            if motors:
                commands = [(pulse - 1000.0) / 1000.0 for pulse in pulses[:4]] + [float("nan")] * 8
                add("actuator_motors", time_us, control=commands)
        elif message.name == "GPS_RAW_INT":
            course = radians(fields["cog"] / 100.0)
            known = {"latitude_deg": fields["lat"] / 1e7, "longitude_deg": fields["lon"] / 1e7}
            known |= {"altitude_msl_m": fields["alt"] / 1000.0, "vel_m_s": fields["vel"] / 100.0}
            known |= {"cog_rad": course if course <= 3.14159 else course - radians(360.0)}
            known |= {"fix_type": fields["fix_type"], "time_utc_usec": BOOT_US + time_us}
            add("vehicle_gps_position", time_us, **known)
        elif message.name == "HEARTBEAT":
            add("vehicle_status", time_us, arming_state=2 if fields["base_mode"] & 128 else 1, system_type=2)
        elif message.name == "EXTENDED_SYS_STATE":
            add("vehicle_land_detected", time_us, landed=fields["landed_state"] == 1)
    return writer.write(path)


def dataflash_of(messages: Iterable[Message], path: Path) -> Path:
    """Write a flight as .bin, with formats of ArduPilot 4.5."""
    writer = DataflashWriter()
    writer.define("ATT", "QffffffB", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw,AEKF")
    writer.define("RATE", "Qfffffffff", "TimeUS,RDes,R,ROut,PDes,P,POut,YDes,Y,YOut")
    columns = "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz"
    writer.define("IMU", "QBffffffIIfBBHH", columns, "s#-------------")
    writer.define("MAG", "QBhhh", "TimeUS,I,MagX,MagY,MagZ", "s#---")
    writer.define("BARO", "QBffc", "TimeUS,I,Alt,Press,Temp", "s#---")
    writer.define("RCOU", "Q" + "H" * 14, "TimeUS," + ",".join(f"C{number}" for number in range(1, 15)))
    columns = "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U"
    writer.define("GPS", "QBBIHBcLLeffffB", columns, "s#-------------")
    writer.define("ARM", "QBIBB", "TimeUS,ArmState,ArmChecks,Forced,Method")
    writer.define("EV", "QB", "TimeUS,Id")
    slow: dict[str, Any] = {}
    for time_us, message in _of_the_vehicle(messages):
        fields = message.fields
        if message.name == "ATTITUDE":
            roll, pitch, yaw = (degrees(fields[name]) for name in ("roll", "pitch", "yaw"))
            writer.add("ATT", time_us, 0.0, roll, 0.0, pitch, 0.0, yaw % 360.0, 3)
            rates = [degrees(fields[name]) for name in ("rollspeed", "pitchspeed", "yawspeed")]
            writer.add("RATE", time_us, *(value for rate in rates for value in (0.0, rate, 0.0)))
        elif message.name == "HIGHRES_IMU":
            field = [round(fields[name] / 1e3) for name in ("xmag", "ymag", "zmag")]
            air = fields["pressure_alt"], fields["abs_pressure"]
            if slow.get("mag") != field:
                writer.add("MAG", time_us, 0, *field)
            if slow.get("air") != air:
                writer.add("BARO", time_us, 0, air[0], 100.0 * air[1], 20.0)
            slow = {"mag": field, "air": air}
            values = [fields[name] for name in ("xgyro", "ygyro", "zgyro", "xacc", "yacc", "zacc")]
            for instance in (0, 1):
                writer.add("IMU", time_us, instance, *values, 0, 0, 20.0, 1, 1, 1000, 1000)
        elif message.name == "SERVO_OUTPUT_RAW":
            writer.add("RCOU", time_us, *(fields[f"servo{number}_raw"] for number in range(1, 15)))
        elif message.name == "GPS_RAW_INT":
            gps_us = BOOT_US + time_us - _GPS_EPOCH_US + _LEAP_US
            week, ms = divmod(gps_us // 1000, 604_800_000)
            place = fields["lat"] / 1e7, fields["lon"] / 1e7, fields["alt"] / 1000.0
            motion = fields["vel"] / 100.0, fields["cog"] / 100.0, 0.0, 0.0
            writer.add("GPS", time_us, 0, fields["fix_type"], ms, week, 10, 0.7, *place, *motion, 1)
        elif message.name == "HEARTBEAT" and slow.get("armed") != fields["base_mode"] & 128:
            slow["armed"] = fields["base_mode"] & 128
            writer.add("ARM", time_us, slow["armed"] // 128, 0, 0, 0)
        elif message.name == "EXTENDED_SYS_STATE" and slow.get("landed") != fields["landed_state"]:
            slow["landed"] = fields["landed_state"]
            writer.add("EV", time_us, 18 if fields["landed_state"] == 1 else 28)
    return writer.write(path)


def _of_the_vehicle(messages: Iterable[Message]) -> Iterator[tuple[int, Message]]:
    """Return the autopilot's messages with the newest time since boot, microseconds."""
    now_us = 0
    for message in messages:
        if message.system != 1 or (message.name == "HEARTBEAT" and not is_autopilot_heartbeat(message)):
            continue
        stamp_us = message.fields.get("time_usec", 1000 * message.fields.get("time_boot_ms", 0))
        if message.name in ("ATTITUDE", "HIGHRES_IMU", "SERVO_OUTPUT_RAW", "GPS_RAW_INT"):
            now_us = stamp_us if message.name != "GPS_RAW_INT" or stamp_us < 1e12 else now_us
            yield stamp_us if stamp_us < 1e12 else now_us, message
        elif now_us:
            yield now_us, message


def _quaternion(roll: float, pitch: float, yaw: float) -> list[float]:
    (cr, sr), (cp, sp), (cy, sy) = ((cos(0.5 * angle), sin(0.5 * angle)) for angle in (roll, pitch, yaw))
    return [
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    ]
