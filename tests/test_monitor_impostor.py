"""Forged messages beside true ones raise ``link/impostor``, and the watch goes on."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import pytest
from pymavlink.dialects.v20 import ardupilotmega
from test_monitor_blind import events_of

from adapters.logs.recordings import read_recording
from adapters.logs.tlog import TlogReader
from adapters.message import Message
from adapters.source import MAVLINK
from monitor.event import AlarmEvent
from monitor.pipeline import Pipeline
from monitor.profile import Profile, read_profile

QUAD = Path(__file__).parent.parent / "replay" / "data" / "quad"
STAMPS = ("time_usec", "time_boot_ms")
Forge = Callable[[list[Message], int], Message]


def disarmed(sent: list[Message], now_ns: int) -> Message:
    del sent
    return Message(MAVLINK, "HEARTBEAT", now_ns, {"type": 2, "autopilot": 3, "base_mode": 81, "system_status": 3}, 1, 1)


def another_vehicle(sent: list[Message], now_ns: int) -> Message:
    return replace(disarmed(sent, now_ns), fields={"type": 1, "autopilot": 3, "base_mode": 209})


def on_ground(sent: list[Message], now_ns: int) -> Message:
    del sent
    return Message(MAVLINK, "EXTENDED_SYS_STATE", now_ns, {"vtol_state": 0, "landed_state": 1}, 1, 1)


def ahead(seconds: float) -> Forge:
    """Return what forges the newest ATTITUDE with a time further ahead."""

    def forge(sent: list[Message], now_ns: int) -> Message:
        newest = next(message for message in reversed(sent) if message.name == "ATTITUDE")
        stamp = newest.fields["time_boot_ms"] + round(seconds * 1e3)
        return replace(newest, received_ns=now_ns, fields={**newest.fields, "time_boot_ms": stamp})

    return forge


def with_second_vehicle(messages: list[Message], ahead_s: float) -> list[Message]:
    """Return messages beside those of another vehicle of the same id, which was switched on earlier."""
    units = {"time_boot_ms": 1e3, "time_usec": 1e6}
    other = []
    for message in messages:
        later = {
            name: message.fields[name] + round(ahead_s * per_s)
            for name, per_s in units.items()
            if message.fields.get(name)
        }
        other.append(replace(message, received_ns=message.received_ns + 3_000_000, fields={**message.fields, **later}))
    return sorted(messages + other, key=lambda message: message.received_ns)


def with_forged(messages: list[Message], forge: Forge, period_s: float, start_s: float = 0.3) -> list[Message]:
    """Return messages with one that is forged every so often."""
    made: list[Message] = []
    due_ns = messages[0].received_ns + round(start_s * 1e9)
    for message in messages:
        while message.received_ns >= due_ns:
            made.append(forge(made, due_ns))
            due_ns += round(period_s * 1e9)
        made.append(message)
    return made


@pytest.fixture(scope="module")
def whole(data: Path) -> list[Message]:
    """Return a healthy flight."""
    return list(read_recording(data / "copter_healthy_square.tlog.xz"))


@pytest.fixture(scope="module")
def square(whole: list[Message]) -> list[Message]:
    """Return the first 34 s of it."""
    return [message for message in whole if message.received_ns - whole[0].received_ns < 34_000_000_000]


class Weak(NamedTuple):
    """A flight in which motor 2 is weak, and when that is raised where nobody forges anything."""

    messages: list[Message]
    raised_ns: int

    def seen_alike(self, events: list[AlarmEvent], within_ns: int = 100_000_000) -> bool:
        """Return whether motor 2, once, was raised at about that time."""
        [motor] = [event for event in events if event.channel == "motor2" and event.state == "raised"]
        return abs(motor.time_ns - self.raised_ns) < within_ns


@pytest.fixture(scope="module")
def weak(quad_profile: Profile, data: Path) -> Weak:
    messages = list(read_recording(data / "copter_motor2_080.tlog.xz"))
    [plain] = [event for event in events_of(quad_profile, messages) if event.state == "raised"]
    return Weak(messages, plain.time_ns)


@pytest.mark.parametrize(
    ("forge", "period_s", "names"),
    [
        (disarmed, 1.0, "HEARTBEAT"),
        (disarmed, 0.5, "HEARTBEAT"),
        (another_vehicle, 1.0, "HEARTBEAT"),
        (on_ground, 0.9, "EXTENDED_SYS_STATE"),
    ],
)
def test_forged_reports_are_an_impostor_and_hide_no_fault(
    quad_profile: Profile, weak: Weak, forge: Forge, period_s: float, names: str
) -> None:
    events = events_of(quad_profile, with_forged(weak.messages, forge, period_s))
    [impostor] = [event for event in events if event.channel == "impostor"]
    assert (impostor.observer, impostor.kind, impostor.severity) == ("link", "security", "critical")
    assert names in impostor.message
    assert impostor.time_ns - weak.messages[0].received_ns < 5_000_000_000
    assert weak.seen_alike(events)


@pytest.mark.parametrize("forge", [ahead(3600.0), ahead(-40.0)], ids=["an_hour_ahead", "replayed"])
def test_stamps_of_another_clock_are_an_impostor_and_hide_no_fault(
    quad_profile: Profile, weak: Weak, forge: Forge
) -> None:
    events = events_of(quad_profile, with_forged(weak.messages, forge, 0.5))
    impostor = next(event for event in events if event.channel == "impostor")
    assert "two clocks" in impostor.message
    assert impostor.time_ns - weak.messages[0].received_ns < 5_000_000_000
    assert weak.seen_alike(events)


@pytest.mark.parametrize(("ahead_s", "period_s"), [(0.9, 1.0), (0.5, 4.9)])
def test_stamps_less_than_a_second_ahead_do_not_move_the_vehicles_time(
    quad_profile: Profile, square: list[Message], ahead_s: float, period_s: float
) -> None:
    pipeline = Pipeline(quad_profile)
    [raised] = events_of(quad_profile, with_forged(square, ahead(ahead_s), period_s, start_s=20.0), pipeline)
    assert raised.channel == "impostor"
    assert (raised.time_ns - square[0].received_ns) / 1e9 - 20.0 < 5.0
    assert pipeline.statistics()["motors"].incomplete == 0
    plain = Pipeline(quad_profile)
    events_of(quad_profile, square, plain)
    offset = "unix_minus_vehicle_ns"
    assert abs(int(pipeline.metadata()[offset]) - int(plain.metadata()[offset])) < 5_000_000


def test_a_second_vehicle_of_the_same_id_is_an_impostor_and_hides_no_fault(quad_profile: Profile, weak: Weak) -> None:
    events = events_of(quad_profile, with_second_vehicle(weak.messages, 3600.0))
    impostor = next(event for event in events if event.channel == "impostor")
    assert impostor.time_ns - weak.messages[0].received_ns < 5_000_000_000
    assert weak.seen_alike(events)


@pytest.mark.long
@pytest.mark.parametrize("start_s", [0.1, 3.0, 5.4])
@pytest.mark.parametrize("period_s", [0.2, 0.45, 1.0, 1.7])
@pytest.mark.parametrize("forge", [disarmed, another_vehicle, on_ground, ahead(3600.0), ahead(-40.0)])
def test_no_forgery_hides_a_fault(
    quad_profile: Profile, data: Path, forge: Forge, period_s: float, start_s: float
) -> None:
    messages = list(read_recording(data / "copter_motor3_090.tlog.xz"))
    [plain] = [event for event in events_of(quad_profile, messages) if event.state == "raised"]
    events = events_of(quad_profile, with_forged(messages, forge, period_s, start_s))
    seen_ns = [e.time_ns for e in events if e.channel in ("impostor", "blind")]
    motor_ns = [e.time_ns for e in events if e.channel == "motor3" and e.state == "raised"]
    in_time = bool(seen_ns) and seen_ns[0] - messages[0].received_ns < round((start_s + 5.0) * 1e9)
    assert in_time or (motor_ns and motor_ns[0] - plain.time_ns < 200_000_000)


def test_packets_with_numbers_of_their_own_are_an_impostor(quad_profile: Profile, data: Path, tmp_path: Path) -> None:
    packets = list(TlogReader(data / "copter_healthy_square.tlog.xz").packets())
    packets = [(time_ns, packet) for time_ns, packet in packets if time_ns - packets[0][0] < 28_000_000_000]
    sender = ardupilotmega.MAVLink(None, srcSystem=1, srcComponent=1)
    start_ns = packets[0][0] + 8_000_000_000
    for k in range(25):
        sender.seq = 100 + k
        forged = ardupilotmega.MAVLink_vfr_hud_message(1.0, 2.0, 3, 4, 5.0, 6.0)
        packets.append((start_ns + k * 200_000_000, bytes(forged.pack(sender))))
    log = tmp_path / "attacked.tlog"
    log.write_bytes(b"".join(struct.pack(">Q", time_ns // 1000) + packet for time_ns, packet in sorted(packets)))
    for count in (1 << 12, 1 << 20):
        batches = TlogReader(log, Pipeline(quad_profile).interests, count)
        pipeline = Pipeline(quad_profile)
        raised, cleared = [event for batch in batches for event in pipeline.run(batch) if isinstance(event, AlarmEvent)]
        assert (raised.channel, raised.state, raised.severity) == ("impostor", "raised", "warning")
        assert "sequence numbers" in raised.message
        assert raised.time_ns - start_ns < 5_000_000_000
        assert (cleared.channel, cleared.state) == ("impostor", "cleared")
        assert cleared.time_ns - (start_ns + 4_800_000_000) < 12_000_000_000


@pytest.mark.parametrize("before", [True, False], ids=["after_others", "as_the_first"])
@pytest.mark.parametrize("forge", [disarmed, on_ground])
def test_one_report_that_it_does_not_fly_is_contradicted_by_motors_that_run(
    quad_profile: Profile, weak: Weak, forge: Forge, before: bool
) -> None:
    forged = forge([], weak.raised_ns - 3_000_000_000)
    attacked = [m for m in weak.messages if m.name != forged.name or (before and m.received_ns < forged.received_ns)]
    at = next(k for k, message in enumerate(attacked) if message.received_ns >= forged.received_ns)
    events = events_of(quad_profile, [*attacked[:at], forged, *attacked[at:]])
    impostor = next(event for event in events if event.channel == "impostor")
    assert "motors run" in impostor.message
    assert 0.9 < (impostor.time_ns - forged.received_ns) / 1e9 < 1.2
    assert weak.seen_alike(events, 200_000_000)


def test_commands_of_another_vehicle_than_the_profiles_contradict_nothing(
    quad_profile: Profile, square: list[Message]
) -> None:
    forged = on_ground([], square[len(square) // 2].received_ns)
    other = [
        replace(m, fields={**m.fields, "type": 22}) if m.name == "HEARTBEAT" and m.system == 1 else m for m in square
    ]
    before = [m for m in other if m.received_ns < forged.received_ns]
    after = [m for m in other[len(before) :] if m.name != "EXTENDED_SYS_STATE"]
    events = events_of(quad_profile, [*before, forged, *after], Pipeline(quad_profile, force=True))
    assert [event for event in events if event.channel == "impostor"] == []


@pytest.mark.parametrize(
    ("name", "false", "told"),
    [("HEARTBEAT", {"type": 1}, True), ("EXTENDED_SYS_STATE", {"landed_state": 3}, False)],
    ids=["another_type", "take_off"],
)
def test_nothing_that_cannot_be_in_flight_ends_the_watch(
    quad_profile: Profile, weak: Weak, name: str, false: dict[str, int], told: bool
) -> None:
    start_ns = weak.raised_ns - 3_000_000_000
    attacked = [
        replace(m, fields={**m.fields, **false}) if (m.name, m.system) == (name, 1) and m.received_ns > start_ns else m
        for m in weak.messages
    ]
    events = events_of(quad_profile, attacked)
    assert weak.seen_alike(events)
    assert told == any(event.channel == "impostor" for event in events)


def test_motors_that_stop_with_the_report_contradict_nothing(quad_profile: Profile, square: list[Message]) -> None:
    landed_ns = square[-1].received_ns - 5_000_000_000
    landing = [on_ground([], landed_ns), disarmed([], landed_ns + 500_000_000)]
    after = [
        replace(m, fields={**m.fields, **{f"servo{k}_raw": 1000 for k in (1, 2, 3, 4)}})
        if m.name == "SERVO_OUTPUT_RAW" and m.received_ns > landed_ns + 300_000_000
        else m
        for m in square
        if m.received_ns <= landed_ns or m.name not in ("HEARTBEAT", "EXTENDED_SYS_STATE")
    ]
    assert events_of(quad_profile, sorted(after + landing, key=lambda m: m.received_ns)) == []


@pytest.mark.parametrize(
    ("name", "fields"),
    [
        ("SERVO_OUTPUT_RAW", ("servo1_raw", "servo2_raw", "servo3_raw", "servo4_raw")),
        ("ATTITUDE", ("rollspeed", "pitchspeed", "yawspeed")),
    ],
)
def test_values_that_stand_still_in_flight_accuse_nobody_and_blind(
    quad_profile: Profile, square: list[Message], name: str, fields: tuple[str, ...]
) -> None:
    start_ns = square[0].received_ns + 20_000_000_000
    before = [m for m in square if m.name == name and m.received_ns < start_ns]
    frozen = {field: before[-1].fields[field] for field in fields}
    attacked = [
        replace(m, fields={**m.fields, **frozen}) if m.name == name and m.received_ns >= start_ns else m for m in square
    ]
    [blind] = [event for event in events_of(quad_profile, attacked) if event.state == "raised"]
    assert (blind.channel, blind.observer) == ("blind", "monitor")
    assert f"{name} frozen" in blind.message
    assert blind.time_ns - start_ns < 5_400_000_000


def set_back(messages: list[Message], by_ms: int, silent_s: float = 0.0) -> list[Message]:
    """Return messages whose second half has earlier stamps, after a silence."""
    half, units = len(messages) // 2, {"time_boot_ms": 1, "time_usec": 1000}
    back = [
        replace(m, fields={**m.fields, **{n: m.fields[n] - by_ms * u for n, u in units.items() if m.fields.get(n)}})
        for m in messages[half:]
        if m.received_ns - messages[half].received_ns >= round(silent_s * 1e9)
    ]
    return messages[:half] + back


def test_a_reboot_in_flight_is_no_impostor_and_the_watch_goes_on(quad_profile: Profile, square: list[Message]) -> None:
    newest_ms = max(m.fields.get("time_boot_ms", 0) for m in square[: len(square) // 2])
    pipeline = Pipeline(quad_profile)
    events = events_of(quad_profile, set_back(square, newest_ms, silent_s=2.0), pipeline)
    assert [event for event in events if event.channel in ("impostor", "blind")] == []
    assert pipeline.statistics()["motors"].clock_restarts == 1


@pytest.mark.parametrize("by_s", [4, 60])
def test_a_clock_that_goes_back_in_flight_without_a_reboot_is_an_impostors(
    quad_profile: Profile, square: list[Message], by_s: int
) -> None:
    start_ns = square[len(square) // 2].received_ns
    events = events_of(quad_profile, set_back(square, 1000 * by_s))
    raised = {event.channel: event.time_ns - start_ns for event in events if event.state == "raised"}
    assert raised["impostor"] < 2_000_000_000
    # a clock that is 4 s behind has caught up before
    assert by_s == 4 or raised["blind"] < 5_500_000_000


def test_a_stretch_that_is_sent_over_and_over_with_its_own_stamps_is_an_impostors(
    quad_profile: Profile, square: list[Message]
) -> None:
    half, loop_ns = len(square) // 2, 3_000_000_000
    start_ns = square[half].received_ns
    stretch = [m for m in square[:half] if m.received_ns >= start_ns - loop_ns]
    again = [replace(m, received_ns=m.received_ns + (k + 1) * loop_ns) for k in range(6) for m in stretch]
    events = events_of(quad_profile, square[:half] + again)
    raised = {event.channel: event.time_ns - start_ns for event in events if event.state == "raised"}
    assert raised["impostor"] < 2_000_000_000
    assert raised["blind"] < 5_500_000_000
    assert not any(event.state == "cleared" for event in events)


def test_the_alarm_clears_when_the_forgeries_end(quad_profile: Profile, square: list[Message]) -> None:
    half = len(square) // 2
    attacked = [*with_forged(square[:half], disarmed, 1.0), *square[half:]]
    assert [(event.channel, event.state) for event in events_of(quad_profile, attacked)] == [
        ("impostor", "raised"),
        ("impostor", "cleared"),
    ]


def replayed(
    messages: list[Message], names: Sequence[str], start_s: float, length_s: float
) -> tuple[list[Message], int]:
    """Return messages of which some have the values of 12 s earlier for a while, and when that ends."""
    start_ns, earlier_ns = messages[0].received_ns + round(start_s * 1e9), 12_000_000_000
    end_ns = start_ns + round(length_s * 1e9)
    recorded: dict[str, list[Message]] = {name: [] for name in names}
    attacked = []
    for message in messages:
        sent = message
        if message.name in recorded:
            recorded[message.name].append(message)
            if start_ns <= message.received_ns < end_ns:
                past = [one for one in recorded[message.name] if one.received_ns <= message.received_ns - earlier_ns]
                stamps = {name: message.fields[name] for name in STAMPS if name in message.fields}
                sent = replace(message, fields={**past[-1].fields, **stamps})
        attacked.append(sent)
    return attacked, end_ns


def test_what_was_learned_of_a_replayed_stretch_accuses_no_sensor_after_it(whole: list[Message]) -> None:
    attacked, _ = replayed(whole, ("HIGHRES_IMU", "ATTITUDE", "GPS_RAW_INT"), 24.0, 8.0)
    events = events_of(read_profile(QUAD), attacked)
    [ended] = [event for event in events if event.channel == "impostor" and event.state == "cleared"]
    assert whole[-1].received_ns - ended.time_ns > 8_000_000_000
    # the motors, which were not watched meanwhile, are again
    assert {event.channel for event in events if event.time_ns > ended.time_ns} <= {"blind"}


@pytest.mark.parametrize("length_s", [8.0, 12.0])
def test_rates_that_are_replayed_follow_the_commands_as_soon_as_the_recording_has_ended(
    whole: list[Message], length_s: float
) -> None:
    attacked, end_ns = replayed(whole, ("ATTITUDE",), 24.0, length_s)
    events = [event for event in events_of(read_profile(QUAD), attacked) if event.channel in ("impostor", "blind")]
    assert any("commands" in event.message for event in events)
    assert not any(event.state == "raised" for event in events if event.time_ns > end_ns)
    assert {event.channel for event in events if event.state == "cleared"} == {event.channel for event in events}
    assert max(event.time_ns for event in events) - end_ns < 1_000_000_000
