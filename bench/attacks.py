"""What attackers do to a flying vehicle: what is told of it, how soon, and whether a motor's loss is still alarmed.

    python bench/attacks.py [--only WORDS] [--live] [--flight LOG --profile FOLDER --channel NAME --onset-ms MS]

Attacks begin 3 s after the first packet, 5.6 s before the motor fails. Without ``--live`` the packets are replayed as a
log. With it they are sent over UDP to a running daemon, eight vehicles at a time, and a client in another process
listens; health is asked twice a second, and recording and journal have to hold the very events. Rows in which nothing
is told while the fault is missed or late come first; then those in which nothing is told.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from heapq import merge
from pathlib import Path
from typing import Any

from soak import last_statuses, lines_of, name_of, running, set_up, wait_for

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "tools"))

from chaos import ATTACK_S, ATTACKS, FORGER, Distortion, alter, babble, hold, insert, lose, time_forged
from fleet_sender import Due, fleet_packets, read_flight, send_fleet
from packet_edit import checksummed, packet_fields, set_back, signed, stamp_ns_of, with_fields
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from adapters.batch import pack
from adapters.logs.recordings import read_batches, read_recording
from adapters.mavlink.mavlink_message import message_number
from adapters.mavlink.signing import unix_stamp
from adapters.message import silence
from monitor.event import AlarmEvent
from monitor.pipeline import Pipeline
from monitor.profile import read_profile
from monitor.recording.journal import Journal
from replay.player import play

ROOT = Path(__file__).parent.parent
LENGTH_S, LEAD_S = 22.0, 8.6
"""Of each run, and of it before the fault."""
PRELUDE_S = 1.0
"""Before the flight, in which the vehicle stands on the ground and its ground station arms it."""
AT_ONCE = 8
"""Vehicles of one daemon. Chosen: two cores hold back none of them."""
TOLD_S = 6.0
"""Until when an attack has to be told of: 5 s without evidence, and the messages that show it."""
START_NS = 1_795_251_917_000_000_000
GROUND, STRANGER = (255, 190), (66, 1)
SECOND_NS = 1_000_000_000
LAND = 9  # ArduCopter's mode
_ATTITUDE, _IMU, _GPS, _OUTPUTS = 30, 105, 24, 36
TELLING = ("impostor", "blind", "command", "signing", "telemetry", "link")


@dataclass(frozen=True)
class Flight:
    """A flight in which a motor fails, and what raises its alarm."""

    log: Path
    profile: Path
    channel: str
    onset_ms: int

    def packets(self, system: int) -> list[Due]:
        """Return the packets of some seconds around the fault, from :data:`PRELUDE_S` on."""
        begins = next(stamp for _, packet in read_flight(self.log, system).packets if (stamp := stamp_ns_of(packet)))
        start_s = max(0.0, self.onset_ms / 1e3 - begins / 1e9 - LEAD_S)
        flight = read_flight(self.log, system, start_s, start_s + LENGTH_S)
        return [(due, packet) for due, (_, packet) in fleet_packets([flight])]

    def onset_due(self, packets: Sequence[Due]) -> int:
        """Return when the fault begins."""
        return next(due for due, one in packets if (stamp_ns_of(one) or 0) >= self.onset_ms * 1_000_000)


def begun(packets: Sequence[Due], commanded: bool) -> list[Due]:
    """Return the packets a second later; ``commanded``: after those of a vehicle whose ground station arms it."""
    system = packets[0][1][5]
    own, ground = mavlink.MAVLink(None, system, 1), mavlink.MAVLink(None, *GROUND)
    beat = next(packet_fields(one) for _, one in packets if message_number(one) == 0)
    said = [
        (own, mavlink.MAVLink_heartbeat_message(beat["type"], beat["autopilot"], beat["base_mode"] & 127, 0, 3, 3)),
        (own, mavlink.MAVLink_extended_sys_state_message(0, 1)),
        (ground, mavlink.MAVLink_command_long_message(system, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0)),
    ]
    first = next(one for _, one in packets if message_number(one) == _ATTITUDE)
    prelude = [set_back(first, round(PRELUDE_S * 1e9)), *(bytes(message.pack(sender)) for sender, message in said)]
    return [(k * SECOND_NS // 10, one) for k, one in enumerate(prelude) if commanded] + [
        (due + round(PRELUDE_S * 1e9), packet) for due, packet in packets
    ]


def chosen(keeps: Callable[[int, bytes], bool]) -> Distortion:
    """Lose the packets of the attack that ``keeps`` is not true of, by time due and packet."""
    return lambda packets, rng, now_ns: [one for one in packets if one[0] < ATTACK_S * 1e9 or keeps(*one)]


def without(*numbers: int, share: float = 1.0, of_s: float = 1.0) -> Distortion:
    """Lose messages by their numbers, for a share of each ``of_s``."""
    return chosen(lambda due, one: message_number(one) not in numbers or due % (of_s * 1e9) >= share * of_s * 1e9)


def beside(name: str, changes: Callable[[Mapping[str, Any]], Mapping[str, Any]], late_ms: float = 2.0) -> Distortion:
    """Send a forged message shortly after each one of a kind, under the next sequence number."""
    number = next(number for number, kind in mavlink.mavlink_map.items() if kind.msgname == name)

    def forged(packets: Sequence[Due], rng: random.Random, now_ns: int) -> list[Due]:
        added = [
            (due + round(late_ms * 1e6), with_fields(one, changes(packet_fields(one))))
            for due, one in packets
            if due >= ATTACK_S * 1e9 and message_number(one) == number
        ]
        return list(merge(packets, added, key=lambda one: one[0]))

    return forged


def commands(
    *messages: Callable[[int], Any],
    times: int = 1,
    every_s: float = 0.5,
    sender: tuple[int, int] = STRANGER,
    sign: bool = False,
    by_turns: bool = False,
) -> Distortion:
    """Let somebody send commands, all a number of times, or one after the other."""

    def sent(packets: Sequence[Due], rng: random.Random, now_ns: int) -> list[Due]:
        packer, added = mavlink.MAVLink(None, *sender), []
        turns = [[message] for message in messages] if by_turns else [messages] * times
        for k, turn in enumerate(turns):
            due = round((ATTACK_S + k * every_s) * 1e9)
            for message in turn:
                packet = bytes(message(packets[0][1][5]).pack(packer))
                packer.seq = (packer.seq + 1) % 256
                added.append((due, signed(packet, FORGER, unix_stamp(now_ns + due)) if sign else packet))
        return list(merge(packets, added, key=lambda one: one[0]))

    return sent


def long(number: int, *values: float) -> Callable[[int], Any]:
    """Return what makes a COMMAND_LONG to a system."""
    return lambda system: mavlink.MAVLink_command_long_message(system, 1, number, 0, *[*values, *[0] * 7][:7])


def parameter(name: str, value: float) -> Callable[[int], Any]:
    """Return what makes a PARAM_SET to a system."""
    return lambda system: mavlink.MAVLink_param_set_message(system, 1, name.encode(), value, 9)


def ftp(opcode: int) -> Callable[[int], Any]:
    """Return what makes a FILE_TRANSFER_PROTOCOL message to a system."""
    payload = [0, 0, 0, opcode, 9, 0, 0, 0, 0, 0, 0, 0, *b"@SYS/a.sh"]
    return lambda system: mavlink.MAVLink_file_transfer_protocol_message(0, system, 1, payload + [0] * (251 - 21))


def setpoint(system: int) -> Any:
    return mavlink.MAVLink_set_position_target_local_ned_message(0, system, 1, 1, 3576, 50, 0, -5, *[0] * 8)


def override(system: int) -> Any:
    return mavlink.MAVLink_rc_channels_override_message(system, 1, 1500, 1500, 1000, *[1500] * 5)


def _from_everybody(packets: Sequence[Due], rng: random.Random, now_ns: int) -> list[Due]:
    for system in range(100, 200):
        packets = commands(long(400, 0, 21196), times=2, every_s=2.0, sender=(system, 1))(packets, rng, now_ns)
    return list(packets)


COMMANDED: Mapping[str, Distortion] = {
    "PARAM_SET FENCE_ENABLE 0": commands(parameter("FENCE_ENABLE", 0.0)),
    "PARAM_SET of 8 safety parameters": commands(
        *(parameter(n, 0.0) for n in ("FS_THR_ENABLE", "FS_GCS_ENABLE", "FENCE_ENABLE", "BATT_FS_LOW_ACT")),
        *(parameter(n, 0.0) for n in ("ARMING_CHECK", "RTL_ALT", "DISARM_DELAY", "COM_RCL_EXCEPT")),
    ),
    "PARAM_SET of a PID": commands(parameter("ATC_RAT_RLL_P", 5.0)),
    "disarm": commands(long(400, 0, 21196)),
    "reboot": commands(long(246, 1)),
    "termination": commands(long(185, 1)),
    "mode LAND": commands(long(176, 1, LAND)),
    "SET_MODE": commands(lambda system: mavlink.MAVLink_set_mode_message(system, 1, LAND)),
    "motors' emergency stop by an auxiliary function": commands(long(218, 31, 2)),
    "mission cleared and written": commands(
        lambda system: mavlink.MAVLink_mission_clear_all_message(system, 1),
        lambda system: mavlink.MAVLink_mission_count_message(system, 1, 5),
    ),
    "guided item": commands(
        lambda system: mavlink.MAVLink_mission_item_int_message(system, 1, 0, 6, 16, 2, 1, 0, 0, 0, 0, 1, 1, 50)
    ),
    "mode, 4 s later disarm": commands(long(176, 1, LAND), long(400, 0, 21196), every_s=4.0, by_turns=True),
    "RC_CHANNELS_OVERRIDE, 50 a second": commands(override, times=500, every_s=0.02),
    "RC_CHANNELS_OVERRIDE, once": commands(override),
    "MANUAL_CONTROL, 25 a second": commands(
        lambda system: mavlink.MAVLink_manual_control_message(system, 900, 0, 500, 0, 0), times=250, every_s=0.04
    ),
    "setpoints of position, 20 a second": commands(setpoint, times=200, every_s=0.05),
    "setpoints of attitude, 50 a second": commands(
        lambda system: mavlink.MAVLink_set_attitude_target_message(0, system, 1, 7, [1, 0, 0, 0], 0, 0, 0, 0.1),
        times=500,
        every_s=0.02,
    ),
    "GPS_INPUT, 5 a second": commands(
        lambda system: mavlink.MAVLink_gps_input_message(0, 0, 0, 0, 0, 3, 473977420, 85455940, 488, 1, 1, *[0] * 7, 9),
        times=50,
        every_s=0.2,
    ),
    "a file written by FTP": commands(ftp(6), ftp(7), ftp(1)),
    "files read by FTP": commands(ftp(4), ftp(5), times=50, every_s=0.02),
    "SERIAL_CONTROL opens a shell": commands(
        lambda system: mavlink.MAVLink_serial_control_message(10, 6, 0, 0, 6, [*b"reboot", *[0] * 64])
    ),
    "200 harmless commands a second": commands(long(512, 30), times=1000, every_s=0.005),
    "disarm from 100 system ids": _from_everybody,
    "disarm, signed with a wrong key": commands(long(400, 0, 21196), sign=True),
    "disarm in the ground station's name": commands(long(400, 0, 21196), sender=GROUND),
    "disarm in the vehicle's own name": lambda packets, rng, now_ns: commands(
        long(400, 0, 21196), sender=(packets[0][1][5], 1)
    )(packets, rng, now_ns),
    "disarm to all systems": commands(lambda _: long(400, 0, 21196)(0)),
    "disarm by COMMAND_INT": commands(
        lambda system: mavlink.MAVLink_command_int_message(system, 1, 0, 400, 0, 0, 0, 21196, 0, 0, 0, 0, 0)
    ),
}
"""What a stranger commands; nothing of it hides the fault."""


def _second(behind_s: float, share: float = 1.0, only: Sequence[int] = ()) -> Distortion:
    """Let another vehicle of the same id send, which was switched on later (before, where negative)."""

    def added(packets: Sequence[Due], rng: random.Random, now_ns: int) -> list[Due]:
        others = [
            (due + 3_000_000, set_back(one, round(behind_s * 1e9)))
            for due, one in packets
            if due >= ATTACK_S * 1e9 and rng.random() < share and (not only or message_number(one) in only)
        ]
        return list(merge(packets, others, key=lambda one: one[0]))

    return added


def _repeated(back_s: float, restamped: bool, beside_true: bool, *only: int) -> Distortion:
    """Send what came before once more, over and over, in place of what follows or beside it."""

    def replayed(packets: Sequence[Due], rng: random.Random, now_ns: int) -> list[Due]:
        begin, back = round(ATTACK_S * 1e9), round(back_s * 1e9)
        taken = [(due, one) for due, one in packets if begin - back <= due < begin]
        taken = [(due, one) for due, one in taken if not only or message_number(one) in only]
        turns = range(1, math.ceil((packets[-1][0] - begin) / back) + 1)
        again = [
            (due + k * back, set_back(one, -k * back) if restamped else one)
            for k in turns
            for due, one in taken
            if due + k * back <= packets[-1][0]
        ]
        kept = [
            (due, one)
            for due, one in packets
            if due < begin or beside_true or (only and message_number(one) not in only)
        ]
        return list(merge(kept, again, key=lambda one: one[0]))

    return replayed


def _late(most_s: float) -> Distortion:
    """Let each packet of the attack be late by up to so much."""

    def late(packets: Sequence[Due], rng: random.Random, now_ns: int) -> list[Due]:
        begin = ATTACK_S * 1e9
        return sorted(
            ((due + round(rng.uniform(0, most_s) * 1e9) if due >= begin else due, one) for due, one in packets),
            key=lambda one: one[0],
        )

    return late


def _restamped(back_s: float, back_per_s: float = 0.0, *only: int) -> Distortion:
    """Set the stamps of all packets, or of some kinds, back: by so much, and by more as time passes."""

    def changed(packets: Sequence[Due], rng: random.Random, now_ns: int) -> list[Due]:
        begin = ATTACK_S * 1e9
        return [
            (due, set_back(one, round(back_s * 1e9 + (due - begin) * back_per_s)))
            if due >= begin and (not only or message_number(one) in only)
            else (due, one)
            for due, one in packets
        ]

    return changed


def _flooded(number: int, per_s: float) -> Distortion:
    """Send the newest packet of a kind again and again."""

    def flooded(packets: Sequence[Due], rng: random.Random, now_ns: int) -> list[Due]:
        added, newest, due_ns = [], None, ATTACK_S * 1e9
        for due, one in packets:
            while newest is not None and due >= due_ns:
                added.append((round(due_ns), newest))
                due_ns += 1e9 / per_s
            newest = one if message_number(one) == number else newest
        return list(merge(packets, added, key=lambda one: one[0]))

    return flooded


def _both(*attacks: Distortion) -> Distortion:
    def made(packets: Sequence[Due], rng: random.Random, now_ns: int) -> list[Due]:
        for attack in attacks:
            packets = attack(packets, rng, now_ns)
        return list(packets)

    return made


def _bursts(name: str, changes: Mapping[str, Any], count: int, step_s: float) -> Distortion:
    """Forge a message several times in a row, every 10 s."""
    turns = [insert(name, lambda said: changes, 10.0, False, k * step_s) for k in range(count)]
    return _both(*turns)


def _shifted(name: str, by_ms: float) -> Distortion:
    """Alter the stamps of all messages of a kind by so much."""
    unit = {"time_boot_ms": 1.0, "time_usec": 1e3}
    return alter(
        name, lambda said, first: {k: max(0, said[k] + round(by_ms * u)) for k, u in unit.items() if k in said}
    )


_SERVOS = [f"servo{k}_raw" for k in range(1, 5)]

FORGED: Mapping[str, Distortion] = {
    "HEARTBEAT of a ground station, 1 a second": insert("HEARTBEAT", lambda _: {"type": 6, "autopilot": 8}, 1.0, True),
    "HEARTBEAT of a submarine, every 0.7 s": insert("HEARTBEAT", lambda _: {"type": 12}, 0.7, False),
    "HEARTBEAT disarmed and on standby, every 3.3 s": insert(
        "HEARTBEAT", lambda said: {"base_mode": said["base_mode"] & 127, "system_status": 3}, 3.3, False
    ),
    "HEARTBEAT disarmed, ten a second": insert(
        "HEARTBEAT", lambda said: {"base_mode": said["base_mode"] & 127}, 0.1, True
    ),
    "EXTENDED_SYS_STATE on ground, five in 1 s, every 10 s": _bursts("EXTENDED_SYS_STATE", {"landed_state": 1}, 5, 0.2),
    "HEARTBEAT disarmed, three in 0.15 s, every 10 s": _bursts("HEARTBEAT", {"base_mode": 81}, 3, 0.05),
    "HEARTBEAT disarmed, once": insert("HEARTBEAT", lambda said: {"base_mode": said["base_mode"] & 127}, 99.0, False),
    "HEARTBEAT altered to mode LAND": alter("HEARTBEAT", lambda said, first: {"custom_mode": LAND}),
    "HEARTBEAT altered to an emergency": alter("HEARTBEAT", lambda said, first: {"system_status": 6}),
    "EXTENDED_SYS_STATE altered to landing": alter("EXTENDED_SYS_STATE", lambda said, first: {"landed_state": 4}),
    "EXTENDED_SYS_STATE altered to undefined": alter("EXTENDED_SYS_STATE", lambda said, first: {"landed_state": 0}),
    "EXTENDED_SYS_STATE on ground, ten a second": insert(
        "EXTENDED_SYS_STATE", lambda said: {"landed_state": 1}, 0.1, True
    ),
    "both altered to on ground and disarmed": _both(
        alter("EXTENDED_SYS_STATE", lambda said, first: {"landed_state": 1}),
        alter("HEARTBEAT", lambda said, first: {"base_mode": said["base_mode"] & 127, "system_status": 3}),
    ),
    "HEARTBEAT and EXTENDED_SYS_STATE lost": without(0, 245),
    "ATTITUDE 0.6 s ahead, ten a second": insert(
        "ATTITUDE", lambda said: {"time_boot_ms": said["time_boot_ms"] + 600}, 0.1, False
    ),
    "HIGHRES_IMU 0.5 s ahead, 2 a second": insert(
        "HIGHRES_IMU", lambda said: {"time_usec": said["time_usec"] + 500_000}, 0.5, False
    ),
    "SERVO_OUTPUT_RAW 3 s ahead, 1 a second": insert(
        "SERVO_OUTPUT_RAW", lambda said: {"time_usec": said["time_usec"] + 3_000_000}, 1.0, False
    ),
    "GPS_RAW_INT 5 s ahead, 2 a second": insert(
        "GPS_RAW_INT", lambda said: {"time_usec": said["time_usec"] + 5_000_000}, 0.5, False
    ),
    "ATTITUDE 30 s ahead, every 5 s": insert(
        "ATTITUDE", lambda said: {"time_boot_ms": said["time_boot_ms"] + 30_000}, 5.0, False
    ),
    "ATTITUDE at the stamp 2^32 - 1 ms, 2 a second": insert(
        "ATTITUDE", lambda _: {"time_boot_ms": 2**32 - 1}, 0.5, False
    ),
    "stamps of HIGHRES_IMU altered to stand still": hold("HIGHRES_IMU", "time_usec"),
    "stamps of ATTITUDE altered to run backwards": alter(
        "ATTITUDE", lambda said, first: {"time_boot_ms": max(0, 2 * first["time_boot_ms"] - said["time_boot_ms"])}
    ),
    "stamps of SERVO_OUTPUT_RAW altered by 0.3 s ahead": _shifted("SERVO_OUTPUT_RAW", 300.0),
    "stamps of ATTITUDE altered by 0.1 s behind": _shifted("ATTITUDE", -100.0),
    "all stamps 10 % slow": _restamped(0.0, 0.1),
    "all stamps 5 % fast": _restamped(0.0, -0.05),
    "stamps of ATTITUDE 1 % fast": _restamped(0.0, -0.01, _ATTITUDE),
    "another vehicle in place of the own, 4 s older": _restamped(-4.0),
    "another vehicle in place of the own, 4 s younger": _restamped(4.0),
    "another vehicle in place of the own, an hour older": _restamped(-3600.0),
    "SYSTEM_TIME an hour ahead, 5 a second": time_forged,
    "another vehicle, 0.4 s younger": _second(0.4),
    "another vehicle, 3 s older": _second(-3.0),
    "another vehicle, an hour older, a tenth of its packets": _second(-3600.0, 0.1),
    "GPS of another vehicle, 30 s younger": _second(30.0, only=[_GPS]),
    "IMU of another vehicle, 10 min older": _second(-600.0, only=[_IMU]),
    "ATTITUDE rolled by 6 degrees beside each": beside("ATTITUDE", lambda said: {"roll": said["roll"] + 0.1}),
    "HIGHRES_IMU turning beside each": beside("HIGHRES_IMU", lambda said: {"xgyro": said["xgyro"] + 0.3}),
    "GPS_RAW_INT 20 m north beside each": beside("GPS_RAW_INT", lambda said: {"lat": said["lat"] + 1800}),
    "SERVO_OUTPUT_RAW of one motor 80 us less beside each": beside(
        "SERVO_OUTPUT_RAW", lambda said: {"servo1_raw": said["servo1_raw"] - 80}
    ),
    "GPS_RAW_INT without a fix, every second one": beside("GPS_RAW_INT", lambda _: {"fix_type": 0}),
    "GPS_RAW_INT altered to no fix": alter("GPS_RAW_INT", lambda said, first: {"fix_type": 1}),
    "SERVO_OUTPUT_RAW altered to 0": alter("SERVO_OUTPUT_RAW", lambda said, first: dict.fromkeys(_SERVOS, 0)),
    "SERVO_OUTPUT_RAW altered to another port": alter("SERVO_OUTPUT_RAW", lambda said, first: {"port": 3}),
    "SERVO_OUTPUT_RAW altered to 65535": alter("SERVO_OUTPUT_RAW", lambda said, first: dict.fromkeys(_SERVOS, 65535)),
    "ATTITUDE altered to NaN": alter("ATTITUDE", lambda said, first: {"rollspeed": math.nan}),
    "commands of motors 1 and 2 held": hold("SERVO_OUTPUT_RAW", "servo1_raw", "servo2_raw"),
    "IMU held": hold("HIGHRES_IMU", "xacc", "yacc", "zacc", "xgyro", "ygyro", "zgyro"),
    "GPS held": hold("GPS_RAW_INT", "lat", "lon", "alt", "vel", "cog"),
    "barometer held": hold("HIGHRES_IMU", "abs_pressure", "pressure_alt"),
    "compass held": hold("HIGHRES_IMU", "xmag", "ymag", "zmag"),
    "ATTITUDE lost": without(_ATTITUDE),
    "HIGHRES_IMU lost": without(_IMU),
    "GPS_RAW_INT lost": without(_GPS),
    "SERVO_OUTPUT_RAW lost": without(_OUTPUTS),
    "SERVO_OUTPUT_RAW lost for 2 s of every 3": without(_OUTPUTS, share=2 / 3, of_s=3.0),
    "HIGHRES_IMU lost for 0.4 s of every 0.5": without(_IMU, share=0.8, of_s=0.5),
    "all lost but HEARTBEAT": without(_ATTITUDE, _IMU, _GPS, _OUTPUTS, 245),
    "all lost for 4.8 s of every 5": chosen(lambda due, one: due % 5_000_000_000 >= 4_800_000_000),
    "all lost for 0.9 s of every second": chosen(lambda due, one: due % 1_000_000_000 >= 900_000_000),
    "19 of 20 lost": lambda packets, rng, now_ns: [
        *(one for one in packets if one[0] < ATTACK_S * 1e9),
        *lose([one for one in packets if one[0] >= ATTACK_S * 1e9], rng, 0.95),
    ],
    "all later and later, by 0.1 s a second": lambda packets, rng, now_ns: [
        (due + max(0, round(0.1 * (due - ATTACK_S * 1e9))), one) for due, one in packets
    ],
    "late by up to 0.5 s": _late(0.5),
    "late by up to 2 s": _late(2.0),
    "the last 2 s in place of what follows": _repeated(2.0, False, False),
    "the last 2 s in place of what follows, new stamps": _repeated(2.0, True, False),
    "the last 2 s beside what follows": _repeated(2.0, False, True),
    "the last 2 s beside what follows, new stamps": _repeated(2.0, True, True),
    "IMU of the last 2 s in place, new stamps": _repeated(2.0, True, False, _IMU),
    "commands of the last 1 s in place, new stamps": _repeated(1.0, True, False, _OUTPUTS),
    "all altered to component 2": lambda packets, rng, now_ns: [
        (due, checksummed(one[:6] + b"\x02" + one[7:]) if due >= ATTACK_S * 1e9 else one) for due, one in packets
    ],
    "HEARTBEAT 2000 a second": _flooded(0, 2000.0),
    "GPS_RAW_INT 500 a second": _flooded(_GPS, 500.0),
    "random bytes between packets": lambda packets, rng, now_ns: [
        *(one for one in packets if one[0] < ATTACK_S * 1e9),
        *babble([one for one in packets if one[0] >= ATTACK_S * 1e9], rng, 0.5),
    ],
}  # fmt: skip
"""What is done to telemetry beyond :data:`chaos.ATTACKS`."""

ALL: Mapping[str, Distortion] = {
    "none": lambda packets, rng, now_ns: list(packets),
    **ATTACKS,
    **FORGED,
    **{f"command: {name}": what for name, what in COMMANDED.items()},
}


@dataclass
class Outcome:
    """What came of an attack: seconds from its begin, of the fault's alarm from the fault."""

    name: str
    told_s: float | None = None
    told: str = ""
    severity: str = ""
    fault_s: float | None = None
    others: list[str] = field(default_factory=list)
    trouble_s: float | None = None  # when healthz was not ok, live
    faithful: bool = True  # recording and journal hold the events that were heard, live

    def rank(self, usual_s: float) -> int:
        """Return 0 where the attack hides the fault, 1 where nothing is told, 2 otherwise."""
        told = min([s for s in (self.told_s, self.trouble_s) if s is not None], default=math.inf) <= TOLD_S
        seen = self.fault_s is not None and self.fault_s <= max(2 * usual_s, usual_s + 0.2)
        return 2 if told else 1 if seen else 0


def made(flight: Flight, name: str, system: int, now_ns: int) -> tuple[list[Due], int]:
    """Return the packets of an attack and when the fault begins."""
    packets = flight.packets(system)
    attacked = ALL[name](packets, random.Random(system), now_ns)  # noqa: S311
    return begun(attacked, name.startswith("command")), flight.onset_due(packets) + round(PRELUDE_S * 1e9)


def outcome(name: str, channel: str, heard: Sequence[tuple[int, Mapping[str, Any]]], onset: int) -> Outcome:
    """Judge events, each with nanoseconds since the first packet."""
    found, begin = Outcome(name), round((PRELUDE_S + ATTACK_S) * 1e9)
    for at, event in heard:
        if event["state"] != "raised" or at < begin:
            continue
        if event["channel"] in TELLING and event["observer"] in ("link", "monitor"):
            if found.told_s is None:
                found.told_s, found.told = (at - begin) / 1e9, f"{event['channel']}: {event['message']}"
                found.severity = event["severity"]
        elif event["channel"] == channel and at >= onset and found.fault_s is None:
            found.fault_s = (at - onset) / 1e9
        else:
            found.others.append(f"{event['channel']} {(at - begin) / 1e9:.1f}")
    return found


def replayed(flight: Flight, names: Sequence[str], folder: Path) -> Iterator[Outcome]:
    """Replay each attack as a log."""
    profile = read_profile(flight.profile)
    for name in names:
        packets, onset = made(flight, name, 1, START_NS)
        log = folder / "attack.tlog"
        log.write_bytes(b"".join(((START_NS + due) // 1000).to_bytes(8) + packet for due, packet in packets))
        pipeline = Pipeline(profile, system=1)
        # at the end time passes without telemetry, as it does in a daemon
        batches = [*read_batches(log), pack([silence(START_NS + packets[-1][0])])]
        events = [one for batch in batches for one in pipeline.run(batch) if isinstance(one, AlarmEvent)]
        heard = [(one.time_ns - START_NS, one.to_json()) for one in events]
        yield outcome(name, flight.channel, heard, onset)


def live(flight: Flight, names: Sequence[str], folder: Path) -> Iterator[Outcome]:
    """Send the attacks to a daemon, each to a vehicle of its own."""
    folder.mkdir()
    setup = set_up(folder, flight.profile, [flight.log] * len(names))
    config, health = setup.config(), dict[int, float]()
    with (
        running(["-m", "fauio", "run", "--config", str(config)], folder / "daemon.log") as daemon,
        running(["bench/soak_listener.py", setup.zenoh, str(setup.heard)], folder / "listener.log"),
    ):
        wait_for(lambda: len(last_statuses(lines_of(setup.heard))) == len(names), daemon, 90.0, "a status of each")
        plan = json.dumps([list(names), str(flight.log), str(flight.profile), flight.channel, flight.onset_ms])
        send = [__file__, "--send", f"udp:{setup.udp}", "--plan", plan]
        with running(send, folder / "sender.log", stdout=subprocess.PIPE) as sender:
            assert sender.stdout is not None
            said = json.loads(sender.stdout.readline())
            while sender.poll() is None:
                at = (time.time_ns() - said["start_ns"]) / 1e9 - PRELUDE_S - ATTACK_S
                for system in range(1, len(names) + 1):
                    if at >= 0.0 and any(name_of(system) in line for line in _problems(setup.metrics)):
                        health.setdefault(system, at)
                time.sleep(0.5)
        time.sleep(3.0)
        shown = subprocess.run(  # noqa: S603 - our own command
            [sys.executable, "-m", "fauio", "alarms", "--json", "--for", "2", "--connect", setup.zenoh],
            cwd=ROOT, capture_output=True, text=True, check=False,
        )  # fmt: skip
        (folder / "alarms.jsonl").write_text(shown.stdout)
        daemon.terminate()
        daemon.wait(30)
        time.sleep(0.5)
    heard = [line for line in lines_of(setup.heard) if "/alarm/" in line["key"]]
    journal = Journal(folder / "journal.db")
    kept = [one.to_json() for one in journal.events(limit=100_000)]
    journal.close()
    for system, name in enumerate(names, 1):
        own = [line for line in heard if line["payload"]["vehicle"] == name_of(system)]
        events = [line["payload"] for line in own]
        found = outcome(
            name,
            flight.channel,
            [(line["at_ns"] - said["start_ns"], line["payload"]) for line in own],
            said["onset"][system - 1],
        )
        found.trouble_s = health.get(system)
        again = play(
            read_profile(flight.profile),
            read_recording(folder / "recordings" / name_of(system)),
            vehicle=name_of(system),
        )
        in_journal = [one for one in kept if one["vehicle"] == name_of(system)]
        found.faithful = [one.to_json() for one in again.events][: len(events)] == events == in_journal[: len(events)]
        yield found


def _problems(metrics: str) -> list[str]:
    with suppress(OSError):
        try:
            with urllib.request.urlopen(f"http://{metrics}/healthz", timeout=2.0) as answer:
                return list(json.loads(answer.read())["problems"])
        except urllib.error.HTTPError as trouble:
            return list(json.loads(trouble.read())["problems"])
    return []


def send(to: str, plan: str) -> None:
    """Send what :func:`live` asks for; print when it begins."""
    names, log, profile, channel, onset_ms = json.loads(plan)
    flight, now_ns = Flight(Path(log), Path(profile), channel, onset_ms), time.time_ns()
    all_made = [made(flight, name, system, now_ns) for system, name in enumerate(names, 1)]
    streams = [[(due, (k, one)) for due, one in packets] for k, (packets, _) in enumerate(all_made, 1)]
    begin_ns = time.time_ns() - min(stream[0][0] for stream in streams)
    print(json.dumps({"start_ns": begin_ns, "onset": [onset for _, onset in all_made]}), flush=True)
    send_fleet(merge(*streams, key=lambda one: one[0]), to)


def table(outcomes: Sequence[Outcome]) -> str:
    """Return the rows, misses first."""
    usual_s = next((one.fault_s for one in outcomes if one.name == "none" and one.fault_s), 0.2)
    lines = [
        f"usual delay of the fault's alarm {usual_s:.2f} s; attacks {len(outcomes) - 1}",
        "",
        "| attack | told after, s | by | fault after, s | also raised | health |",
        "|---|---|---|---|---|---|",
    ]
    for one in sorted(outcomes, key=partial(Outcome.rank, usual_s=usual_s)):
        told = "**never**" if one.told_s is None else f"{one.told_s:.2f}"
        late = one.fault_s is None or one.fault_s > max(2 * usual_s, usual_s + 0.2)
        fault = "never" if one.fault_s is None else f"{one.fault_s:.2f}"
        fault = f"**{fault}**" if late else fault
        health = "" if one.trouble_s is None else f"{one.trouble_s:.1f}"
        health += "" if one.faithful else " NOT FAITHFUL"
        mark = ("MISS ", "untold ", "")[one.rank(usual_s)]
        said = f"{one.severity} {one.told}".strip()
        lines.append(f"| {mark}{one.name} | {told} | {said} | {fault} | {', '.join(one.others)} | {health} |")
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[], help="words of attacks' names (default: all)")
    parser.add_argument("--live", action="store_true", help="over UDP to a running daemon")
    parser.add_argument("--flight", type=Path, default=ROOT / "replay" / "data" / "copter_motor1.tlog.xz")
    parser.add_argument("--profile", type=Path, default=ROOT / "replay" / "data" / "quad")
    parser.add_argument("--channel", default="motor1", help="that the fault's alarm has (default motor1)")
    parser.add_argument("--onset-ms", type=int, default=112_594, help="of the fault, on the vehicle's clock")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="leave everything there")
    parser.add_argument("--send", help=argparse.SUPPRESS)
    parser.add_argument("--plan", help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    if args.send is not None:
        send(args.send, args.plan)
        return 0
    flight = Flight(args.flight.resolve(), args.profile.resolve(), args.channel, args.onset_ms)
    names = [name for name in ALL if name == "none" or not args.only or any(word in name for word in args.only)]
    with tempfile.TemporaryDirectory() as temporary:
        folder = (args.keep or Path(temporary)).resolve()
        folder.mkdir(parents=True, exist_ok=True)
        if args.live:
            groups = [names[k : k + AT_ONCE] for k in range(0, len(names), AT_ONCE)]
            outcomes = [one for k, group in enumerate(groups) for one in live(flight, group, folder / str(k))]
        else:
            outcomes = list(replayed(flight, names, folder))
    print(table(outcomes))
    return 0


if __name__ == "__main__":
    sys.exit(main())
