"""The distortions themselves: each does what its name says, and nothing else."""

from __future__ import annotations

import math
import random
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import chaos
import pytest
from fleet_sender import Due, fleet_packets, read_flight
from packet_stream import PacketStream, messages_of, packet_sequence

from adapters.mavlink.signing import SignatureVerdict, SignatureVerifier

NOW_NS = 1_795_251_917_265_689_600
SECOND_NS = 1_000_000_000


@pytest.fixture(scope="module")
def packets(data: Path) -> list[Due]:
    flight = read_flight(data / "copter_gps_step25m.tlog.xz", 7)
    return [(due, packet) for due, (_, packet) in fleet_packets([flight])]


@pytest.fixture
def rng() -> random.Random:
    return random.Random(1)


def in_order(packets: Sequence[Due]) -> bool:
    return all(before[0] <= after[0] for before, after in pairwise(packets))


@pytest.mark.parametrize("name", chaos.DISTORTIONS)
def test_a_distortion_repeats_itself_and_keeps_the_order_of_time(packets: list[Due], name: str) -> None:
    distort = chaos.DISTORTIONS[name]
    once = distort(packets, random.Random(3), NOW_NS)
    assert once == distort(packets, random.Random(3), NOW_NS)
    assert in_order(once)
    assert (once == packets) == (name == "none")


def test_loss_takes_a_share(packets: list[Due], rng: random.Random) -> None:
    left = chaos.lose(packets, rng)
    assert 0.28 < 1 - len(left) / len(packets) < 0.32
    assert set(left) < set(packets)


def test_duplicates_add_a_share(packets: list[Due], rng: random.Random) -> None:
    more = chaos.duplicate(packets, rng)
    assert 0.18 < len(more) / len(packets) - 1 < 0.22
    assert {packet for _, packet in more} == {packet for _, packet in packets}


def test_reordering_moves_by_no_more_than_five(packets: list[Due], rng: random.Random) -> None:
    moved = chaos.reorder(packets, rng)
    place = {packet: at for at, (_, packet) in enumerate(packets)}
    distances = [abs(place[packet] - at) for at, (_, packet) in enumerate(moved)]
    assert 4 <= max(distances) <= 5
    assert sum(distance > 0 for distance in distances) > len(packets) / 2
    assert Counter(packet for _, packet in moved) == Counter(packet for _, packet in packets)


def test_bursts_hold_back_for_half_a_second_at_most(packets: list[Due], rng: random.Random) -> None:
    late = chaos.hold_back(packets, rng)
    delays = [after - before for (before, _), (after, _) in zip(packets, late, strict=True)]
    assert 0 <= min(delays) <= max(delays) <= SECOND_NS // 2
    assert [packet for _, packet in late] == [packet for _, packet in packets]


def test_silence_leaves_a_hole(packets: list[Due]) -> None:
    dues = [due for due, _ in chaos.fall_silent(packets, 4.0, 10.0)]
    assert max(after - before for before, after in pairwise(dues)) == pytest.approx(1e10, rel=0.01)


def test_at_a_reboot_the_clock_goes_back_and_nothing_else_changes(packets: list[Due]) -> None:
    before, after = messages_of(packets), messages_of(chaos.reboot(packets, 5.0))
    assert len(before) == len(after)
    for one, other in zip(before, after, strict=True):
        stamps = {key for key in one.fields if key in ("time_boot_ms", "time_usec") and one.fields[key]}
        assert {k: v for k, v in one.fields.items() if k not in stamps} == {
            k: v for k, v in other.fields.items() if k not in stamps
        }
        for key in stamps:
            back_s = (one.fields[key] - other.fields[key]) * (1e-3 if key == "time_boot_ms" else 1e-6)
            if one.received_ns < 5 * SECOND_NS:
                assert back_s == 0
            else:
                assert back_s >= 100.0 - 0.001


def test_flipped_bits_damage_some_packets(packets: list[Due], rng: random.Random) -> None:
    flipped = chaos.flip_bits(packets, rng)
    different = sum(before != after for before, after in zip(packets, flipped, strict=True))
    assert 0.04 < different / len(packets) < 0.06
    assert len(packets) - len(messages_of(flipped)) == pytest.approx(different, abs=5)


def test_noise_between_packets_costs_hardly_one_of_them(packets: list[Due], rng: random.Random) -> None:
    stream = PacketStream()
    found = [packet for _, data in chaos.babble(packets, rng) for packet in stream.packets(data)]
    assert stream.scanner.skipped_bytes > 10_000
    # Noise that claims to be a packet of an unknown kind cannot be told from one: it takes what stands in it along.
    assert len({packet for _, packet in packets} - set(found)) < 10


def test_poison_is_in_packets_that_are_intact(packets: list[Due], rng: random.Random) -> None:
    found = messages_of(chaos.poison(packets, rng))
    assert len(found) == len(packets)
    bad = [m for m in found if any(isinstance(v, float) and not math.isfinite(v) for v in m.fields.values())]
    assert 0.01 < len(bad) / len(found) < 0.05


def test_a_forger_has_another_key_and_replays_are_old(packets: list[Due], rng: random.Random) -> None:
    verifier = SignatureVerifier(chaos.KEY)
    verdicts = Counter(verifier.check(packet, NOW_NS + due) for due, packet in chaos.forge(packets, rng, NOW_NS))
    assert verdicts[SignatureVerdict.VALID] == len(packets)
    assert verdicts[SignatureVerdict.FORGED] > 20
    assert verdicts[SignatureVerdict.REPLAYED] > 50
    assert verdicts[SignatureVerdict.UNSIGNED] == 0


def test_sequence_numbers_survive(packets: list[Due]) -> None:
    signed = chaos.sign(packets, NOW_NS)
    assert [packet_sequence(packet) for _, packet in signed] == [packet_sequence(packet) for _, packet in packets]
