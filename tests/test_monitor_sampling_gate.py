"""When samples count as evidence: armed, in the air, settled, however the samples are cut into batches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sampled import raw_samples

from adapters.batch import pack
from adapters.channels import Channel
from adapters.message import Message
from adapters.sample import Samples
from adapters.source import MAVLINK
from monitor.core.sampling import VehicleClock
from monitor.sampling.gate import FlightGate, GatedSampler, GateRule
from monitor.sampling.phase import FlightPhase
from monitor.sampling.transform import LiftRule, SampleSource

COUNT = 300


def phase(armed: bool | None = True, landed: int | None = 2) -> FlightPhase:
    found = FlightPhase()
    if armed is not None:
        mode = 209 if armed else 81
        found.feed(Message(MAVLINK, "HEARTBEAT", 0, {"type": 2, "autopilot": 3, "base_mode": mode}, 1, 1))
    if landed is not None:
        found.feed(Message(MAVLINK, "EXTENDED_SYS_STATE", 0, {"landed_state": landed}, 1, 1))
    return found


def commanded(*commands: float) -> Samples:
    """Return samples at 100 Hz whose two inputs have this mean."""
    return raw_samples(np.array([[command - 0.1, command + 0.1] for command in commands]))


def admitted(rule: GateRule, samples: Samples, *phases: tuple[FlightPhase, int]) -> list[bool]:
    """Return what a gate admits; each phase holds up to a row."""
    gate, found, start = FlightGate(rule), list[bool](), 0
    for known, stop in phases:
        found += gate.admitted(known, samples.part(start, stop)).tolist()
        start = stop
    return found


def test_evidence_begins_when_the_rules_have_held_for_the_time_to_settle() -> None:
    rule = GateRule(settle_s=0.5)
    found = admitted(rule, commanded(*[0.5] * COUNT), (phase(armed=False), 100), (phase(), COUNT))
    assert found == [False] * 150 + [True] * 150


@pytest.mark.parametrize(
    ("known", "counts"),
    [
        (phase(None, None), True),
        (phase(False, None), False),
        (phase(False, 2), False),
        (phase(True, 1), False),
        (phase(True, 3), False),
        (phase(True, 4), False),
        (phase(None, 2), True),
    ],
)
def test_only_the_air_counts_and_what_is_unknown_does_not_block(known: FlightPhase, counts: bool) -> None:
    assert admitted(GateRule(settle_s=0.0), commanded(0.5), (known, 1)) == [counts]


def test_each_rule_may_be_left_out() -> None:
    landed, disarmed = phase(True, 1), phase(False, 2)
    assert admitted(GateRule(settle_s=0.0, require_airborne=False), commanded(0.5), (landed, 1)) == [True]
    assert admitted(GateRule(settle_s=0.0, require_armed=False), commanded(0.5), (disarmed, 1)) == [True]


def test_the_mean_command_tells_where_the_landed_state_is_not_reported() -> None:
    rule = GateRule(settle_s=0.02, airborne_command=0.3)
    samples = commanded(0.1, 0.4, 0.4, 0.4, 0.2, 0.4, 0.4, 0.4)
    assert admitted(rule, samples, (phase(landed=None), 8)) == [False] * 3 + [True] + [False] * 3 + [True]
    taken_off = commanded(0.6, 0.1, 0.4, 0.4, 0.2, 0.4, 0.4, 0.4)
    assert admitted(rule, taken_off, (phase(), 8)) == [False] * 2 + [True] * 6


def test_what_reports_that_it_flies_counts_from_commands_of_hovering_on() -> None:
    rule = GateRule(settle_s=0.02, airborne_command=0.3)
    leaning = commanded(0.1, 0.3, 0.5, 0.5, 0.6, 0.3, 0.5, 0.5)
    assert admitted(rule, leaning, (phase(), 8)) == [False] * 6 + [True] * 2
    assert admitted(rule, leaning, (phase(), 3), (phase(), 8)) == [False] * 6 + [True] * 2
    # on the ground again
    assert admitted(rule, leaning, (phase(), 5), (phase(landed=1), 6), (phase(), 8)) == [False] * 8
    unloaded = commanded(*[0.4] * 1100)
    assert admitted(rule, unloaded, (phase(), 1100)).index(True) == 1002


def test_what_stands_on_the_ground_counts_no_more_although_it_is_still_reported_to_fly() -> None:
    rule = GateRule(settle_s=0.02, airborne_command=0.3)
    landing = commanded(*[0.6] * 10, *[0.1] * 60, *[0.5] * 20, *[0.6] * 10)
    assert admitted(rule, landing, (phase(), 100)) == [False] * 2 + [True] * 58 + [False] * 32 + [True] * 8
    dropping = commanded(*[0.6] * 10, *([0.1] * 45 + [0.4] * 5) * 3)
    assert admitted(rule, dropping, (phase(), 160)) == [False] * 2 + [True] * 158
    # never again, however long it goes on to report that
    assert not any(admitted(rule, commanded(0.6, *[0.1] * 1200), (phase(), 1201))[60:])


@pytest.mark.parametrize(
    ("rate", "above_mm", "held"),
    [(0.005, 0, True), (0.005, 5000, False), (0.05, 0, False), (np.nan, 0, False)],
)
def test_a_command_that_falls_while_the_vehicle_stands_low_is_a_touch_down(
    rate: float, above_mm: int, held: bool
) -> None:
    """What turns, or is high, flies, and so does what goes on with a smaller command."""
    known = phase()
    known.feed(Message(MAVLINK, "GLOBAL_POSITION_INT", 0, {"relative_alt": above_mm}, 1, 1))
    samples = commanded(*[0.6] * 100, *np.linspace(0.6, 0.35, 150), *[0.35] * 400)
    turning = np.full((len(samples), 3), rate)
    turning[:100] = 0.05
    samples = replace(samples, y=turning)
    found = admitted(GateRule(settle_s=0.02, airborne_command=0.3), samples, (known, len(samples)))[2:]
    missed = np.flatnonzero(~np.array(found))
    assert len(missed) == 0 if not held else 145 <= missed[0] < 160 and 350 < missed[-1] < 650


def test_what_stands_has_not_lifted_off_although_its_command_is_that_of_hovering() -> None:
    known = phase()
    known.feed(Message(MAVLINK, "GLOBAL_POSITION_INT", 0, {"relative_alt": 0}, 1, 1))
    samples = commanded(*np.linspace(0.1, 0.6, 100), *[0.6] * 100)
    samples = replace(samples, y=np.repeat([[0.001], [0.1]], 100, axis=0))
    assert admitted(GateRule(settle_s=0.02, airborne_command=0.3), samples, (known, 200)).index(True) == 102


def test_raw_signals_of_sensors_are_no_commands() -> None:
    source = SampleSource((Channel("zmag", "A", ("zmag",)),))
    messages = [
        Message(MAVLINK, "A", 1_000 * t, {"time_usec": t, "zmag": -0.5}, 1, 1) for t in range(0, 500_000, 10_000)
    ]
    rule = GateRule(settle_s=0.0, airborne_command=0.3)
    for commands in (True, False):
        sampler = GatedSampler(source, 100.0, VehicleClock(), rule, commands=commands)
        found = sampler.sample(pack(messages), phase(landed=None)).armed
        assert len(found) and found.all() != commands


@pytest.mark.parametrize(
    ("vtol_state", "rotors", "wings"),
    [(None, True, True), (0, True, True), (1, False, False), (2, False, False), (3, True, False), (4, False, True)],
)
def test_what_is_watched_has_to_carry_a_vehicle_of_rotors_and_wings(
    vtol_state: int | None, rotors: bool, wings: bool
) -> None:
    known = phase()
    known.feed(Message(MAVLINK, "EXTENDED_SYS_STATE", 0, {"landed_state": 2, "vtol_state": vtol_state}, 1, 1))
    for rule, counts in ((LiftRule("rotors", 0.5), rotors), (LiftRule("wings"), wings)):
        gate = FlightGate(GateRule(settle_s=0.0), lift=rule)
        assert gate.admitted(known, commanded(0.6)).tolist() == [counts]
        assert gate.carried == counts


def test_rotors_that_turn_slowly_in_the_air_do_not_carry_the_vehicle_and_it_has_not_landed() -> None:
    gate = FlightGate(GateRule(settle_s=0.0), lift=LiftRule("rotors", 0.5))
    assert gate.admitted(phase(landed=None), commanded(0.6, 0.4, 0.0)).tolist() == [True, False, False]
    assert not gate.carried
    assert (gate.idle, gate.airborne) == (-1, None)


def test_a_command_of_zero_asks_for_none() -> None:
    # raw signals, with a field of -0.5 gauss among them, are no commands
    assert admitted(GateRule(settle_s=0.0), commanded(-0.5), (phase(landed=None), 1)) == [True]


@pytest.mark.parametrize("above_mm", [-1500, 0, 1900])
def test_a_vehicle_that_says_nothing_is_not_watched_at_the_height_of_its_home(above_mm: int) -> None:
    plane, copter = GateRule(settle_s=0.0), GateRule(settle_s=0.0, airborne_command=0.3)
    for landed, rule, counts in ((None, plane, False), (None, copter, True), (2, plane, True)):
        known = phase(landed=landed)
        known.feed(Message(MAVLINK, "GLOBAL_POSITION_INT", 0, {"relative_alt": above_mm}, 1, 1))
        assert admitted(rule, commanded(0.5), (known, 1)) == [counts]


@pytest.mark.parametrize("above_mm", [-2500, 2500])
def test_elsewhere_it_is(above_mm: int) -> None:
    known = phase(landed=None)
    for arrival_ns, height_mm in ((0, 0), (1, above_mm)):
        known.feed(Message(MAVLINK, "GLOBAL_POSITION_INT", arrival_ns, {"relative_alt": height_mm}, 1, 1))
    assert admitted(GateRule(settle_s=0.0), commanded(0.5), (known, 1)) == [True]


@pytest.mark.parametrize(("left_s", "watched_s"), [(6, 6), (None, 20)])
def test_a_plane_that_reports_to_fly_while_it_rolls_is_watched_once_it_has_left_the_ground(
    left_s: int | None, watched_s: int
) -> None:
    """Heights that are always those of home hide no more of a flight than the longest roll."""
    known = phase(landed=1)
    found = []
    for second in range(25):
        height_mm = 0 if left_s is None or second < left_s else 2500
        now_ns = second * 10**9
        known.feed(Message(MAVLINK, "GLOBAL_POSITION_INT", now_ns, {"relative_alt": height_mm}, 1, 1))
        known.feed(Message(MAVLINK, "EXTENDED_SYS_STATE", now_ns, {"landed_state": 2}, 1, 1))
        found += admitted(GateRule(settle_s=0.0), commanded(0.5), (known, 1))
    assert found == [second >= watched_s for second in range(25)]


def test_a_plane_in_low_flight_is_watched_from_the_first_message_on() -> None:
    known = FlightPhase()
    for second in range(3):
        known.feed(Message(MAVLINK, "GLOBAL_POSITION_INT", second * 10**9, {"relative_alt": 1000}, 1, 1))
        known.feed(Message(MAVLINK, "EXTENDED_SYS_STATE", second * 10**9, {"landed_state": 2}, 1, 1))
        assert admitted(GateRule(settle_s=0.0), commanded(0.5), (known, 1)) == [True]


def test_a_forged_height_of_its_home_among_true_ones_does_not_end_the_watch() -> None:
    known = phase(landed=None)
    for tick in range(50):
        height = {"relative_alt": 0 if tick % 5 == 4 else 80_000}
        known.feed(Message(MAVLINK, "GLOBAL_POSITION_INT", tick * 200_000_000, height, 1, 1))
        assert admitted(GateRule(settle_s=0.0), commanded(0.5), (known, 1)) == [True]
    for tick in range(50, 56):  # landed: no other height for a second
        known.feed(Message(MAVLINK, "GLOBAL_POSITION_INT", tick * 200_000_000, {"relative_alt": 0}, 1, 1))
    assert admitted(GateRule(settle_s=0.0), commanded(0.5), (known, 1)) == [False]


def test_a_height_that_is_not_sent_any_more_holds_for_three_seconds() -> None:
    known = phase(landed=None)
    known.feed(Message(MAVLINK, "GLOBAL_POSITION_INT", 0, {"relative_alt": 0}, 1, 1))
    for seconds, near in ((2, True), (4, False)):
        known.feed(Message(MAVLINK, "HEARTBEAT", seconds * 10**9, {"base_mode": 128, "type": 1, "autopilot": 3}, 1, 1))
        assert known.near_home is near


def test_inputs_that_are_no_commands_say_nothing_about_the_air() -> None:
    gate = FlightGate(GateRule(settle_s=0.0, airborne_command=0.3), commands=False)
    assert gate.admitted(phase(landed=None), commanded(0.1)).tolist() == [True]


def test_a_restart_settles_anew() -> None:
    samples = commanded(*[0.5] * 20)
    samples.restart[10] = True
    assert admitted(GateRule(settle_s=0.05), samples, (phase(), 20)) == ([False] * 5 + [True] * 5) * 2


@given(
    st.lists(st.sampled_from([0.1, 0.4, 0.6]), min_size=1, max_size=20),
    st.lists(st.integers(0, 399), max_size=3),
    st.lists(st.integers(0, 400), max_size=5),
    st.sampled_from([None, 2]),
)
def test_where_samples_are_cut_makes_no_difference(
    commands: Sequence[float], restarts: Sequence[int], cuts: Sequence[int], landed: int | None
) -> None:
    samples = commanded(*np.repeat(commands, 20).tolist())
    rule = GateRule(settle_s=0.03, airborne_command=0.3)
    samples.restart[[row for row in restarts if row < len(samples)]] = True
    known, gate = phase(landed=landed), FlightGate(rule)
    places = [0, *sorted(min(cut, len(samples)) for cut in cuts), len(samples)]
    found = [good for start, stop in pairwise(places) for good in gate.admitted(known, samples.part(start, stop))]
    assert found == FlightGate(rule).admitted(known, samples).tolist()


def test_samples_restart_where_the_vehicle_comes_to_say_that_it_flies_and_lost_ones_are_no_evidence() -> None:
    source = SampleSource((Channel("u", "A", ("u",)),), (Channel("y", "A", ("y",)),))
    sampler = GatedSampler(source, 100.0, VehicleClock(), GateRule(settle_s=0.0))
    messages = [
        Message(MAVLINK, "A", 1_000 * t, {"time_usec": t, "u": 1.0, "y": 2.0}, 1, 1)
        for t in range(10_000, 2_010_000, 10_000)
        if not 1_500_000 <= t < 1_540_000
    ]
    before, flying = sampler.sample(pack(messages[:100]), phase(False)), sampler.sample(pack(messages[100:]), phase())
    assert np.flatnonzero(before.samples.restart).tolist() == np.flatnonzero(flying.samples.restart).tolist() == [0]
    assert not before.armed.any()
    assert flying.samples.index[~flying.armed].tolist() == [150, 151, 152, 153]
