"""Outputs that stand still beside moving ones, and stamps of another pace, are another sender's; slow links are not."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from sampled import feed
from test_monitor_impostor import events_of

from adapters.channels import Channel
from adapters.message import Message
from adapters.source import MAVLINK
from monitor.core.sampling import VehicleClock
from monitor.event import AlarmEvent
from monitor.pipeline import Pipeline
from monitor.profile import Profile
from monitor.sampling.sampler import Sampler

START_S = 12.0
UNITS = {"time_boot_ms": 1e3, "time_usec": 1e6}


def since_s(calm_flight: list[Message], message: Message | AlarmEvent) -> float:
    """Return the time since the attack began."""
    at_ns = message.time_ns if isinstance(message, AlarmEvent) else message.received_ns
    return (at_ns - calm_flight[0].received_ns) / 1e9 - START_S


def altered(calm_flight: list[Message], change: Callable[[Message, float], Message]) -> list[Message]:
    """Return messages of which those of the attack were changed, by themselves and their time in it."""
    return [m if (s := since_s(calm_flight, m)) < 0.0 else change(m, s) for m in calm_flight]


def stamped(message: Message, later_s: float) -> Message:
    """Return a message with a later stamp."""
    stamps = {n: message.fields[n] + round(later_s * u) for n, u in UNITS.items() if message.fields.get(n)}
    return replace(message, fields={**message.fields, **stamps})


def received(message: Message, later_s: float) -> Message:
    return replace(message, received_ns=message.received_ns + round(later_s * 1e9))


def raised(bundled_quad: Profile, messages: list[Message]) -> list[AlarmEvent]:
    return [event for event in events_of(bundled_quad, messages) if event.state == "raised"]


@pytest.mark.parametrize("pace", [0.9, 1.05])
def test_stamps_that_go_on_at_another_pace_are_an_impostors(
    bundled_quad: Profile, calm_flight: list[Message], pace: float
) -> None:
    events = raised(bundled_quad, altered(calm_flight, lambda m, s: stamped(m, (pace - 1.0) * s)))
    impostor = next(event for event in events if event.channel == "impostor")
    assert impostor.severity == "critical"
    assert f"{pace:.2f} times as fast" in impostor.message
    assert since_s(calm_flight, impostor) < 4.5


@pytest.mark.parametrize(
    "change",
    [
        lambda m, s: received(m, 0.1 * s),
        received,
        lambda m, s: received(m, max(0.0, 2.0 - 0.1 * s)),
        lambda m, s: received(stamped(m, 0.1 * s), 0.1 * s),
        lambda m, s: stamped(m, 4.0),
    ],
    ids=["link_falls_behind", "simulation_at_half_speed", "link_catches_up", "lower_rate", "clock_set_ahead"],
)
def test_links_and_simulations_of_another_pace_are_no_impostors(
    bundled_quad: Profile, calm_flight: list[Message], change: Callable[[Message, float], Message]
) -> None:
    messages = sorted(altered(calm_flight, change), key=lambda m: m.received_ns)
    assert [event for event in events_of(bundled_quad, messages) if event.channel == "impostor"] == []


def from_the_start(messages: list[Message], change: Callable[[Message, float], Message]) -> list[Message]:
    first_ns = messages[0].received_ns
    return [change(m, (m.received_ns - first_ns) / 1e9) for m in messages if m.received_ns < first_ns + 6e9]


@pytest.mark.parametrize("pace", [0.8, 0.9, 1.04])
def test_a_clock_that_never_went_right_is_an_impostors_and_no_sensors(
    bundled_quad: Profile, calm_flight: list[Message], pace: float
) -> None:
    slow = from_the_start(calm_flight, lambda m, s: stamped(m, (pace - 1.0) * s))
    [impostor] = raised(bundled_quad, slow)
    assert f"{pace:.2f}" in impostor.message
    assert "as fast as time" in impostor.message
    assert (impostor.time_ns - calm_flight[0].received_ns) / 1e9 < 5.5


@pytest.mark.parametrize(
    "change",
    [
        lambda m, s: received(m, 0.1 * s),
        lambda m, s: received(m, -0.5 * s),
        lambda m, s: received(stamped(m, 1.0 * s), 1.0 * s),
    ],
    ids=["simulation_at_0.9_or_a_link_that_falls_behind", "simulation_at_twice_the_speed", "half_the_rate"],
)
def test_simulations_at_another_speed_from_the_start_are_no_impostors(
    bundled_quad: Profile, calm_flight: list[Message], change: Callable[[Message, float], Message]
) -> None:
    events = raised(bundled_quad, from_the_start(calm_flight, change))
    assert "impostor" not in [event.channel for event in events]


def outputs(calm_flight: list[Message], values: Callable[[float], dict[str, int]]) -> list[Message]:
    """Return messages in which commands are others, by their time in the attack."""
    return [
        replace(m, fields={**m.fields, **values(since_s(calm_flight, m))}) if m.name == "SERVO_OUTPUT_RAW" else m
        for m in calm_flight
    ]


def test_outputs_that_stand_still_beside_others_are_an_impostors(
    bundled_quad: Profile, calm_flight: list[Message]
) -> None:
    held = {"servo1_raw": 1590, "servo2_raw": 1580}
    events = raised(bundled_quad, outputs(calm_flight, lambda s: held if s >= 0.0 else {}))
    impostor = next(event for event in events if event.channel == "impostor")
    assert "stand still" in impostor.message
    assert since_s(calm_flight, impostor) < 3.5


@pytest.mark.parametrize("name", ["SERVO_OUTPUT_RAW", "ATTITUDE"])
def test_commands_and_rates_that_do_not_belong_together_are_an_impostors(
    bundled_quad: Profile, calm_flight: list[Message], name: str
) -> None:
    rng = random.Random(name)

    def change(message: Message, s: float) -> Message:
        drawn = {f"servo{k}_raw": 1590 + round(rng.gauss(0, 12)) for k in range(1, 5)}
        if name == "ATTITUDE":
            drawn = {f"{axis}speed": rng.gauss(0, 0.03) for axis in ("roll", "pitch", "yaw")}
        return replace(message, fields={**message.fields, **drawn}) if message.name == name else message

    events = raised(bundled_quad, altered(calm_flight, change))
    impostor = next(event for event in events if event.channel == "impostor")
    assert "commands that the rates do not follow" in impostor.message
    assert since_s(calm_flight, impostor) < 5.0
    # The motors are not watched meanwhile, and what they are accused of is said to be doubtful.
    blind = next(event for event in events if event.channel == "blind")
    assert "motors: altered commands or rates" in blind.message
    assert since_s(calm_flight, blind) < 10.5
    accused = [event for event in events if event.channel.startswith("motor") and event.time_ns > impostor.time_ns]
    assert all("or a second sender makes it look so" in event.message for event in accused)


@pytest.mark.parametrize(
    ("count", "gusts", "replaced"),
    [
        (700, 0.0, True),
        (700, 0.0, False),
        (8000, 0.06, False),  # a hover in gusts, which the commands explain half in some windows
    ],
)
def test_commands_of_10_hz_that_the_rates_do_not_follow_are_an_impostors(
    count: int, gusts: float, replaced: bool
) -> None:
    rng, clock = np.random.default_rng(1), VehicleClock()
    clock.flies = True
    commands = [Channel(f"motor{k}", "B", (f"motor{k}",)) for k in range(4)]
    rates = [Channel(f"rate{k}", "A", (f"rate{k}",)) for k in range(3)]
    to = Sampler(commands, rates, 5.0, clock, restless=True)
    mixer = np.array([[-1.0, 1.0, 1.0, -1.0], [1.0, -1.0, 1.0, -1.0], [0.1, 0.1, -0.1, -0.1]])
    rate = np.zeros(3)
    for k in range(count):
        motors = rng.normal(0.5, 0.05, 4)
        said = rng.normal(0.5, 0.05, 4) if replaced and k >= 400 else motors
        fields = [
            {f"motor{i}": float(x) for i, x in enumerate(said)},
            {f"rate{i}": float(x) for i, x in enumerate(rate)},
        ]
        for name, values in zip("BA", fields, strict=True):
            feed(to, [Message(MAVLINK, name, k * 10**8, {"time_usec": k * 10**5, **values}, 1, 1)])
        rate = 0.9 * rate + mixer @ motors + gusts * rng.normal(size=3)
        assert k >= 500 or not clock.found
        assert replaced or not clock.found
    assert (("B", "response") in clock.found) == replaced


@pytest.mark.parametrize(
    "values",
    [
        lambda s: {"servo1_raw": 1950} if s >= 0.0 else {},
        lambda s: {"servo1_raw": 1150} if s >= 0.0 or -4.0 < s < -2.0 else {"servo2_raw": 1140} if s < -7.0 else {},
        lambda s: {"servo1_raw": 1150} if s >= 0.0 else {"servo2_raw": 1140} if s < -7.0 else {},
        lambda s: {"servo1_raw": 1590} if 0.0 <= s % 4.0 < 2.5 else {},
    ],
    ids=["largest", "limit_of_before", "least_after_idle", "briefly"],
)
def test_outputs_at_a_limit_are_no_impostors(
    bundled_quad: Profile, calm_flight: list[Message], values: Callable[[float], dict[str, int]]
) -> None:
    assert "impostor" not in [event.channel for event in events_of(bundled_quad, outputs(calm_flight, values))]


def test_commands_too_small_for_flight_blind_a_vehicle_that_reports_to_fly(
    bundled_quad: Profile, calm_flight: list[Message]
) -> None:
    stopped = dict.fromkeys(("servo1_raw", "servo2_raw", "servo3_raw", "servo4_raw"), 1000)
    [blind] = raised(bundled_quad, outputs(calm_flight, lambda s: stopped if s >= 0.0 else {}))
    assert blind.message == "the vehicle flies and is not watched: motors: commands too small for flight for 5 s"
    assert 5.5 < since_s(calm_flight, blind) < 6.1


def test_a_vehicle_that_stopped_its_motors_at_the_height_of_its_home_has_landed(
    bundled_quad: Profile, calm_flight: list[Message]
) -> None:
    stopped = dict.fromkeys(("servo1_raw", "servo2_raw", "servo3_raw", "servo4_raw"), 1000)
    heights = [
        replace(
            m, name="GLOBAL_POSITION_INT", fields={"relative_alt": 30_000 if since_s(calm_flight, m) < -2.0 else 300}
        )
        for m in calm_flight
        if m.name == "ATTITUDE"
    ][::20]
    messages = outputs(calm_flight, lambda s: stopped if s >= 0.0 else {})
    assert raised(bundled_quad, sorted((*messages, *heights), key=lambda m: m.received_ns)) == []


def braked(s: float) -> float:
    return max(0.0, 1500 - 500 * max(0.0, s))


@pytest.mark.parametrize(
    ("name", "speed_cm_s", "mode", "told"),
    [
        ("HEARTBEAT", lambda s: 1500, 209, True),
        ("EXTENDED_SYS_STATE", lambda s: 1500, 209, True),
        ("HEARTBEAT", braked, 209, False),
        ("EXTENDED_SYS_STATE", braked, 209, False),
        ("HEARTBEAT", lambda s: 1500, 81, False),
    ],
    ids=["disarmed", "on_the_ground", "disarmed_and_brakes", "on_the_ground_and_brakes", "carried"],
)
def test_a_vehicle_without_motor_commands_that_moves_on_has_not_landed(
    bundled_quad: Profile,
    calm_flight: list[Message],
    name: str,
    speed_cm_s: Callable[[float], float],
    mode: int,
    told: bool,
) -> None:
    false = {"HEARTBEAT": {"base_mode": 81}, "EXTENDED_SYS_STATE": {"landed_state": 1}}

    def change(message: Message) -> Message:
        fields, s = dict(message.fields), since_s(calm_flight, message)
        if message.name == "HEARTBEAT":
            fields["base_mode"] = mode
        if message.name == name and s >= 0.0:
            fields |= false[name]
        if message.name == "GPS_RAW_INT":
            fields["vel"] = round(speed_cm_s(s))
        return replace(message, fields=fields)

    lone = [m for m in calm_flight if m.name == name or m.name != "EXTENDED_SYS_STATE"]
    pipeline = Pipeline(replace(bundled_quad, gate=replace(bundled_quad.gate, airborne_command=0.0)))
    events = events_of(bundled_quad, [*map(change, lone)], pipeline)
    found = [since_s(calm_flight, e) for e in events if e.channel == "impostor" and "it moves on" in e.message]
    assert bool(found) == told
    assert all(4.0 <= s < 5.5 for s in found[:1])


def landing(
    calm_flight: list[Message], sinks_mm_s: float | None, command: int | None, height_mm: int | None
) -> list[Message]:
    """Return messages of a vehicle that reports that it lands: its altitude sinks (None: no fix), commands, height."""

    def change(message: Message, s: float) -> Message:
        fields = dict(message.fields)
        if message.name == "EXTENDED_SYS_STATE":
            fields["landed_state"] = 4
        if message.name == "GPS_RAW_INT":
            fields |= {"fix_type": 1} if sinks_mm_s is None else {"alt": fields["alt"] - round(sinks_mm_s * s)}
        if message.name == "SERVO_OUTPUT_RAW" and command is not None:
            fields |= {f"servo{k}_raw": command + k for k in range(1, 5)}
        return replace(message, fields=fields)

    heights = [] if height_mm is None else [m for m in calm_flight if m.name == "EXTENDED_SYS_STATE"]
    said = [replace(m, name="GLOBAL_POSITION_INT", fields={"relative_alt": height_mm}) for m in heights]
    return sorted([*altered(calm_flight, change), *said], key=lambda message: message.received_ns)


@pytest.mark.parametrize(
    ("sinks_mm_s", "command", "height_mm", "watched"),
    [
        pytest.param(0.0, None, None, True, id="hovers"),
        pytest.param(0.0, None, 500, True, id="hovers_and_reports_to_be_low"),
        pytest.param(None, None, None, True, id="no_gps"),
        pytest.param(400.0, None, None, False, id="sinks"),
        pytest.param(400.0, None, 500, False, id="sinks_and_reports_to_be_low"),
        pytest.param(0.0, 1200, None, False, id="on_the_ground"),
    ],
)
def test_a_landing_vehicle_that_is_not_known_to_be_high_is_watched_while_it_hovers(
    bundled_quad: Profile,
    calm_flight: list[Message],
    sinks_mm_s: float | None,
    command: int | None,
    height_mm: int | None,
    watched: bool,
) -> None:
    pipeline = Pipeline(bundled_quad)
    events_of(bundled_quad, landing(calm_flight, sinks_mm_s, command, height_mm), pipeline)
    why = {name: one.why_not for name, one in pipeline.watching(calm_flight[-1].received_ns).items()}
    assert why["motors"] == (None if watched else "on_ground")
