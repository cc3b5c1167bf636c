"""What networks and attackers do to telemetry, as functions on packets and the times they are due.

All of them are pure: they take the packets of one vehicle in order of time, a generator of random numbers where they
need one, and return others. :func:`send` lets a process of its own send what several vehicles suffer at once.

All that was done to a monitor, and where it is tested: a file, and the word that ``pytest -k`` finds its tests by. The
first ten are those that made it blind, fall silent or grow without bound while it said that it was well.

| what is done | tested in | -k |
|---|---|---|
| forged reports, stamps and values; a second vehicle of the same id | test_chaos_attacks | told_of_within |
| commands and rates that stand still on their way | test_chaos_attacks | stands_still |
| a job that is slow for want of processor time | test_monitor_background | processor_time |
| bursts of loss | test_chaos_attacks | beside_the_attack |
| the active of two peers hangs, wholly or by its main thread, and comes back | test_standby | hangs |
| a disk that hangs | test_monitor_background | disk_that_hangs |
| tokens and events of somebody without the key | test_standby | without_the_key |
| packets of a signed link in another; a key without `require` | test_adapters_mavlink_link | a_replay_on, lets_in |
| the clock set an hour back or forth; a leap second | test_monitor_vehicle_service | an_hour |
| a flood of another vehicle, 64 ids at once, a busy host, SIGSTOP for 5 s | test_chaos_surroundings | breaks_around |
| JSON objects of megabytes; subscribers that stall | test_chaos_zenoh | huge_payloads |
| a full disk and kill -9, again and again | test_chaos_crash | killed, full_disk |
| the same forgeries at other rates and times, into two autopilots | test_monitor_impostor | hides, hide |
| a clock that goes back, a stretch sent over and over | test_monitor_impostor | goes_back, over_and_over |
| forged values among true ones, from the first message on | test_monitor_interleaved | two_senders |
| damaged bytes, poisoned values, forged signatures, reboots | test_chaos_hostile | failing_motor |
| loss, duplicates, reordering, silence | test_chaos_network | failing_motor |
| each of these to each kind of fault | test_chaos | every_fault |
| gaps in which the vehicle speeds up | test_monitor_vehicles_strapdown | a_gap_while |
| telemetry that stops reaching an observer | test_monitor_blind | gps |
| a process whose main loop stands still | test_monitor_watchdog | stands_still |
| telemetry that is late for good | test_chaos_surroundings | ten_seconds_late |
| what waits for longer than a second, or is too large | test_monitor_inbox | waited, bounded |
| alarms that a flood would hold back | test_monitor_desk | flood |
| requests for the past without end | test_monitor_publisher | takes_long |
| a program that holds the journal's log | test_monitor_journal | holds |
| recordings that a crash leaves | test_adapters_mcap_recovery | cut_off |
| a Zenoh router that goes and comes | test_chaos_zenoh | router |
"""

from __future__ import annotations

import json
import math
import random
import subprocess
import sys
from array import array
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from heapq import merge
from pathlib import Path
from typing import Any

# Also where it runs as a process of its own.
sys.path.insert(0, str(Path(__file__).parent / "tools"))

from fleet_sender import Due, fleet_packets, read_flight, send_fleet
from packet_edit import checksummed, packet_fields, set_back, signed, stamp_ns_of, with_fields
from pymavlink.dialects.v20 import ardupilotmega

from adapters.mavlink.mavlink_message import message_number
from adapters.mavlink.signing import SigningKey, unix_stamp

ROOT = Path(__file__).parent.parent
KEY = SigningKey(bytes(range(32)))
FORGER = SigningKey(bytes(32))

_SECOND_NS = 1_000_000_000
_LARGEST_STAMP = (1 << 48) - 1
_ATTITUDE = 30


def lose(packets: Sequence[Due], rng: random.Random, share: float = 0.3) -> list[Due]:
    """Lose packets at random."""
    return [one for one in packets if rng.random() >= share]


def duplicate(packets: Sequence[Due], rng: random.Random, share: float = 0.2, within_s: float = 0.03) -> list[Due]:
    """Let packets arrive a second time."""
    again = [(due + round(rng.uniform(0.0, within_s) * 1e9), packet) for due, packet in packets if rng.random() < share]
    return list(merge(packets, sorted(again), key=lambda one: one[0]))


def reorder(packets: Sequence[Due], rng: random.Random, reach: int = 5) -> list[Due]:
    """Let packets overtake others, none by more than ``reach`` places."""
    places = sorted(range(len(packets)), key=lambda place: place + rng.uniform(0.0, reach + 1))
    return [(due, packets[place][1]) for (due, _), place in zip(packets, places, strict=True)]


def hold_back(packets: Sequence[Due], rng: random.Random, hold_s: float = 0.5, share: float = 0.5) -> list[Due]:
    """Hold back what comes within a stretch of time and let it all arrive at its end."""
    hold_ns = round(hold_s * 1e9)
    last = packets[-1][0] // hold_ns
    held = {stretch for stretch in range(last + 1) if rng.random() < share}
    return [((due // hold_ns + 1) * hold_ns if due // hold_ns in held else due, packet) for due, packet in packets]


def fall_silent(packets: Sequence[Due], from_s: float, for_s: float) -> list[Due]:
    """Lose everything for a while."""
    return [one for one in packets if not from_s * 1e9 <= one[0] < (from_s + for_s) * 1e9]


def set_clock_back(packets: Sequence[Due], at_s: float, by_s: float) -> list[Due]:
    """Set the vehicle's clock back while it goes on otherwise."""
    return [(due, set_back(packet, round(by_s * 1e9)) if due >= at_s * 1e9 else packet) for due, packet in packets]


def reboot(packets: Sequence[Due], at_s: float, boot_s: float = 0.5) -> list[Due]:
    """Let the vehicle's clock begin anew, ``boot_s`` after zero: a reboot in the air, heartbeats going on."""
    at_ns = round(at_s * 1e9)
    stamp_ns = next(stamp for due, packet in packets if due >= at_ns and (stamp := stamp_ns_of(packet)) is not None)
    return set_clock_back(packets, at_s, stamp_ns / 1e9 - boot_s)


def flip_bits(packets: Sequence[Due], rng: random.Random, share: float = 0.05) -> list[Due]:
    """Flip one bit of some packets, anywhere in them."""
    flipped = []
    for due, packet in packets:
        data = bytearray(packet)
        if rng.random() < share:
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        flipped.append((due, bytes(data)))
    return flipped


def babble(packets: Sequence[Due], rng: random.Random, share: float = 0.1) -> list[Due]:
    """Put random bytes between packets, some in datagrams of their own and some before and behind a packet."""
    noisy: list[Due] = []
    for due, packet in packets:
        noise = rng.randbytes(rng.randrange(1, 60)) if rng.random() < share else b""
        if rng.random() < 0.5:
            noisy += [(due, noise), (due, packet)] if noise else [(due, packet)]
        else:
            noisy.append((due, noise + packet + noise[::-1]))
    return noisy


def poison(packets: Sequence[Due], rng: random.Random, share: float = 0.05) -> list[Due]:
    """Put NaN and infinities into a field of some packets, whose checksums are right."""
    return [
        (due, with_fields(packet, _poison_for(packet, rng)) if rng.random() < share else packet)
        for due, packet in packets
    ]


def sign(packets: Sequence[Due], start_ns: int, key: SigningKey = KEY) -> list[Due]:
    """Sign all packets with the times they are due, ``start_ns`` being the Unix time of the beginning."""
    stamp, out = 0, []
    for due, packet in packets:
        stamp = max(stamp + 1, unix_stamp(start_ns + due))
        out.append((due, signed(packet, key, stamp)))
    return out


def forge(packets: Sequence[Due], rng: random.Random, start_ns: int, share: float = 0.05) -> list[Due]:
    """Sign all packets; put wild ones of a forger between them, of the largest time stamp there is, and replays."""
    out: list[Due] = []
    own = sign(packets, start_ns)
    for place, (due, packet) in enumerate(own):
        if rng.random() < share and message_number(packet) == _ATTITUDE:
            wild = with_fields(packets[place][1], {"rollspeed": rng.uniform(-9.0, 9.0)})
            out.append((due, signed(wild, FORGER, _LARGEST_STAMP)))
        if rng.random() < share and place >= 2000:
            out.append((due, own[place - 2000][1]))
        out.append((due, packet))
    return out


def _poison_for(packet: bytes, rng: random.Random) -> dict[str, float]:
    floats = [name for name, value in packet_fields(packet).items() if isinstance(value, float)]
    return {rng.choice(floats): rng.choice((math.nan, math.inf, -math.inf))} if floats else {}


def strangers(rng: random.Random, seconds: float) -> list[tuple[int, tuple[int, bytes]]]:
    """Return what others send to the same port: a ground station, and somebody who sends random bytes."""
    packer = ardupilotmega.MAVLink(None, 255, 190)
    heartbeat = bytes(ardupilotmega.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(packer))
    attitude = bytes(ardupilotmega.MAVLink_attitude_message(5, *[9.0] * 6).pack(packer))
    sent: list[tuple[int, tuple[int, bytes]]] = []
    for tenth in range(round(10 * seconds)):
        due = tenth * _SECOND_NS // 10
        sent += [(due, (255, heartbeat)), (due, (255, attitude))]
        sent.append((due, (0, rng.randbytes(rng.randrange(1, 1400)))))
    return sent


Distortion = Callable[[Sequence[Due], random.Random, int], list[Due]]

DISTORTIONS: Mapping[str, Distortion] = {
    "none": lambda packets, rng, now_ns: list(packets),
    "loss": lambda packets, rng, now_ns: lose(packets, rng),
    "duplicates": lambda packets, rng, now_ns: duplicate(packets, rng),
    "reordering": lambda packets, rng, now_ns: reorder(packets, rng),
    "bursts": lambda packets, rng, now_ns: hold_back(packets, rng),
    "silence": lambda packets, rng, now_ns: fall_silent(packets, 4.0, 6.0),
    "reboot": lambda packets, rng, now_ns: reboot(packets, 5.0),
    "bits": lambda packets, rng, now_ns: flip_bits(packets, rng),
    "noise": lambda packets, rng, now_ns: babble(packets, rng),
    "poison": lambda packets, rng, now_ns: poison(packets, rng),
    "forgery": forge,
}

ATTACK_S = 3.0
"""When the attacks of :data:`ATTACKS` begin, seconds after the first packet."""


def insert(
    name: str,
    changes: Callable[[Mapping[str, Any]], Mapping[str, Any]],
    every_s: float,
    own: bool,
    after_s: float = 0.0,
) -> Distortion:
    """Forge a message again and again: the newest of its kind with other values, and numbers of its ``own`` or not."""
    number = _number(name)

    def forged(packets: Sequence[Due], rng: random.Random, now_ns: int) -> list[Due]:
        made: list[Due] = []
        newest, due_ns, sent = None, round((ATTACK_S + after_s) * 1e9), 0
        for due, packet in packets:
            while newest is not None and due >= due_ns:
                false = with_fields(newest, changes(packet_fields(newest)))
                if own:
                    false = checksummed(false[:4] + bytes([sent % 256]) + false[5:])
                made.append((due_ns, false))
                due_ns, sent = due_ns + round(every_s * 1e9), sent + 1
            made.append((due, packet))
            newest = packet if message_number(packet) == number else newest
        return made

    return forged


def alter(name: str, changes: Callable[[Mapping[str, Any], Mapping[str, Any]], Mapping[str, Any]]) -> Distortion:
    """Change all messages of a kind on their way, by what each says and what the first of them said."""
    number = _number(name)

    def altered(packets: Sequence[Due], rng: random.Random, now_ns: int) -> list[Due]:
        made: list[Due] = []
        first: dict[str, Any] = {}
        for due, packet in packets:
            if due < ATTACK_S * 1e9 or message_number(packet) != number:
                made.append((due, packet))
                continue
            said = packet_fields(packet)
            first = first or said
            made.append((due, with_fields(packet, changes(said, first))))
        return made

    return altered


def hold(name: str, *held: str) -> Distortion:
    """Let values of a kind of message stand still on their way while its stamps go on."""
    return alter(name, lambda said, first: {field: first[field] for field in held})


def _number(name: str) -> int:
    return next(number for number, kind in ardupilotmega.mavlink_map.items() if kind.msgname == name)


def second_vehicle(packets: Sequence[Due], rng: random.Random, now_ns: int) -> list[Due]:
    """Let another vehicle send under the same id, which was switched on 30 s later."""
    others = [(due + 3_000_000, set_back(packet, 30 * _SECOND_NS)) for due, packet in packets if due >= ATTACK_S * 1e9]
    return list(merge(packets, others, key=lambda one: one[0]))


def time_forged(packets: Sequence[Due], rng: random.Random, now_ns: int) -> list[Due]:
    """Let somebody say five times a second that it is an hour later."""
    packer = ardupilotmega.MAVLink(None, packets[0][1][5], 1)
    false: list[Due] = []
    for due in range(round(ATTACK_S * 1e9), packets[-1][0], _SECOND_NS // 5):
        said = ardupilotmega.MAVLink_system_time_message((now_ns + due) // 1000 + 3_600_000_000, 3_700_000)
        false.append((due, bytes(said.pack(packer))))
        packer.seq = (packer.seq + 1) % 256
    return list(merge(packets, false, key=lambda one: one[0]))


def number_anew(packets: Sequence[Due], rng: random.Random, now_ns: int) -> list[Due]:
    """Let the sequence numbers begin anew, as a radio that was restarted does."""
    return [
        (
            due,
            checksummed(packet[:4] + bytes([(packet[4] + 77) % 256]) + packet[5:]) if due >= ATTACK_S * 1e9 else packet,
        )
        for due, packet in packets
    ]


def burst(packets: Sequence[Due], rng: random.Random, now_ns: int) -> list[Due]:
    """Lose all for 100 ms, 2.5 times a second."""
    return [(due, packet) for due, packet in packets if due < ATTACK_S * 1e9 or due % 400_000_000 >= 100_000_000]


def _later(said: Mapping[str, Any], by_us: int) -> dict[str, int]:
    return {"time_usec": said["time_usec"] + by_us}


ON_GROUND = insert("EXTENDED_SYS_STATE", lambda said: {"landed_state": 1}, 0.9, False)

ATTACKS: Mapping[str, Distortion] = {
    "disarmed": insert("HEARTBEAT", lambda said: {"base_mode": said["base_mode"] & 127}, 1.0, False),
    "on ground": ON_GROUND,
    "ahead": insert("ATTITUDE", lambda said: {"time_boot_ms": said["time_boot_ms"] + 900}, 1.0, False),
    "hour ahead": insert("ATTITUDE", lambda said: {"time_boot_ms": said["time_boot_ms"] + 3_600_000}, 0.5, False),
    "own numbers": insert("ATTITUDE", lambda said: {}, 0.2, True),
    "rare attitude": insert(
        "ATTITUDE", lambda said: {"time_boot_ms": said["time_boot_ms"] + 4, "roll": said["roll"] + 0.3}, 0.503, False
    ),
    "ahead seldom": insert("ATTITUDE", lambda said: {"time_boot_ms": said["time_boot_ms"] + 700}, 2.5, False),
    "second vehicle": second_vehicle,
    "another type": alter("HEARTBEAT", lambda said, first: {"type": 1}),
    "take-off": alter("EXTENDED_SYS_STATE", lambda said, first: {"landed_state": 3}),
    "commands held": hold("SERVO_OUTPUT_RAW", *(f"servo{k}_raw" for k in range(1, 5))),
    "rates held": hold("ATTITUDE", "rollspeed", "pitchspeed", "yawspeed"),
    "commands": insert(
        "SERVO_OUTPUT_RAW", lambda said: {f"servo{k}_raw": 1000 for k in range(1, 5)} | _later(said, 4_000), 0.01, False
    ),
    "time": time_forged,
    "on ground, an hour later": lambda packets, rng, now_ns: time_forged(ON_GROUND(packets, rng, now_ns), rng, now_ns),
    "numbers anew": number_anew,
    "bursts 100 ms": burst,
}
"""What attackers and bad links do from :data:`ATTACK_S` on."""


@dataclass(frozen=True, slots=True)
class Sufferer:
    """One vehicle and what happens to it.

    Parameters
    ----------
    system : int
        Its system id, which also is the seed.
    log : Path
        Its recorded flight.
    distortion : str
        One of :data:`DISTORTIONS` or :data:`ATTACKS`.
    stop_s : float
        Second of the log to stop at.
    """

    system: int
    log: Path
    distortion: str
    stop_s: float = 60.0

    def packets(self, now_ns: int) -> list[Due]:
        """Return its packets, to be sent from a Unix time on."""
        flight = read_flight(self.log, self.system, 0.0, self.stop_s)
        numbered = [(due, packet) for due, (_, packet) in fleet_packets([flight])]
        return {**DISTORTIONS, **ATTACKS}[self.distortion](numbered, random.Random(self.system), now_ns)


def send(sufferers: Sequence[Sufferer], to: str) -> subprocess.Popen[str]:
    """Start a process that sends what the vehicles suffer, and strangers; it prints how many packets each sent."""
    plan = [[one.system, str(one.log), one.distortion, one.stop_s] for one in sufferers]
    command = [sys.executable, __file__, to, json.dumps(plan)]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)


def main(to: str, plan: str) -> None:
    """Send; see :func:`send`."""
    import time

    sufferers = [Sufferer(system, Path(log), what, stop_s) for system, log, what, stop_s in json.loads(plan)]
    now_ns = time.time_ns()
    streams = [[(due, (one.system, packet)) for due, packet in one.packets(now_ns)] for one in sufferers]
    streams.append(strangers(random.Random(0), max(one.stop_s for one in sufferers)))
    sent: dict[int, array[int]] = send_fleet(merge(*streams, key=lambda one: one[0]), to)
    print(json.dumps({system: len(times) for system, times in sent.items()}))  # noqa: T201 - its only way to say it


if __name__ == "__main__":
    main(*sys.argv[1:])
