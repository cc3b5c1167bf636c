"""Armed and landed state as the autopilot reports it."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

import pytest

from adapters.message import Message
from adapters.source import MAVLINK, ULOG, ZENOH
from monitor.sampling.phase import FlightPhase


def mavlink(name: str, **fields: Any) -> Message:
    return Message(MAVLINK, name, 0, fields, 1, 1)


def test_nothing_is_known_before_the_first_message() -> None:
    phase = FlightPhase()
    assert (phase.armed, phase.landed) == (None, None)


def test_the_autopilot_says_whether_it_is_armed() -> None:
    phase = FlightPhase()
    phase.feed(mavlink("HEARTBEAT", type=2, autopilot=3, base_mode=81))
    assert phase.armed is False
    phase.feed(mavlink("HEARTBEAT", type=2, autopilot=3, base_mode=209))
    assert phase.armed is True


@pytest.mark.parametrize("other", [{"type": 6, "autopilot": 3}, {"type": 26, "autopilot": 8}])
def test_heartbeats_of_ground_stations_and_payloads_are_ignored(other: dict[str, int]) -> None:
    phase = FlightPhase()
    phase.feed(mavlink("HEARTBEAT", type=2, autopilot=3, base_mode=209))
    phase.feed(mavlink("HEARTBEAT", base_mode=0, **other))
    assert phase.armed is True


@pytest.mark.parametrize(
    ("state", "meaning"),
    [(0, None), (1, "ground"), (2, "air"), (3, "takeoff"), (4, "landing"), (9, None), ([], None)],
)
def test_the_landed_state_is_named(state: Any, meaning: str | None) -> None:
    phase = FlightPhase()
    phase.feed(mavlink("EXTENDED_SYS_STATE", landed_state=state))
    assert phase.landed == meaning


def test_other_messages_change_nothing() -> None:
    phase = FlightPhase()
    phase.feed(mavlink("ATTITUDE", base_mode=209, landed_state=2))
    phase.feed(Message(ZENOH, "HEARTBEAT", 0, {"base_mode": 209}))
    phase.feed(mavlink("HEARTBEAT"))
    assert (phase.armed, phase.landed) == (None, None)


@pytest.mark.parametrize("name", FlightPhase.fields)
def test_of_frequent_messages_no_other_fields_are_read_than_the_phase_names(name: str) -> None:
    asked = set()

    class Fields(dict[str, Any]):
        def get(self, key: str, default: Any = None) -> Any:
            asked.add(key)
            return super().get(key, default)

    FlightPhase().feed(Message(MAVLINK, name, 0, Fields(fix_type=3, alt=10_000, vel=300, relative_alt=9_000), 1, 1))
    assert asked == {*FlightPhase.fields[name]}


def beat(at_s: float, mode: int, kind: int = 2) -> Message:
    fields = {"type": kind, "autopilot": 3, "base_mode": mode}
    return Message(MAVLINK, "HEARTBEAT", round(at_s * 1e9), fields, 1, 1)


def landed(at_s: float, state: int) -> Message:
    return Message(MAVLINK, "EXTENDED_SYS_STATE", round(at_s * 1e9), {"landed_state": state}, 1, 1)


def states(messages: list[Message]) -> list[tuple[bool | None, str | None, tuple[str, ...]]]:
    phase, found = FlightPhase(), []
    for message in sorted(messages, key=lambda message: message.received_ns):
        phase.feed(message)
        found.append((phase.armed, phase.landed, phase.contested))
    return found


def test_heartbeats_of_two_senders_are_contested_and_the_vehicle_stays_armed() -> None:
    true = [beat(second, 209) for second in range(45)]
    forged = [beat(10.4 + second, 81) for second in range(10)]
    found = states(true + forged)
    assert found[9] == (True, None, ())
    first = next(place for place, (_, _, contested) in enumerate(found) if contested)
    assert first <= 10 + 5
    assert all(armed and contested == ("HEARTBEAT",) for armed, _, contested in found[first:29])
    assert found[-1] == (True, None, ())


def test_landed_states_of_two_senders_are_contested_at_less_than_the_usual_rate() -> None:
    true = [landed(0.5 * step, 2) for step in range(60)]
    found = states(true + [landed(10.2 + 2.0 * step, 1) for step in range(8)])
    first = next(place for place, (_, _, contested) in enumerate(found) if contested)
    assert first < 20 + 14
    assert all(state == "air" for _, state, contested in found if contested)


@pytest.mark.parametrize("period_s", [2.0, 3.0, 5.0, 9.7])
@pytest.mark.parametrize(("say", "every_s", "true", "false"), [(beat, 1.0, 209, 81), (landed, 0.5, 2, 1)])
def test_one_false_report_among_true_ones_that_keep_their_period_is_contested_before_the_third(
    period_s: float, say: Callable[[float, int], Message], every_s: float, true: int, false: int
) -> None:
    late = random.Random(1)
    true_ones = [say(every_s * at + late.uniform(0.0, 0.2 * every_s), true) for at in range(round(60 / every_s))]
    forged = [say(10.3 + period_s * at, false) for at in range(round(40 / period_s))]
    messages = sorted(true_ones + forged, key=lambda message: message.received_ns)
    found = states(messages)
    first = next(place for place, (_, _, contested) in enumerate(found) if contested)
    assert messages[first].received_ns <= 10.3e9 + 2.2e9 * every_s
    last = messages.index(forged[-1])
    assert all(contested and armed is not False and state != "ground" for armed, state, contested in found[first:last])


@pytest.mark.parametrize(("say", "every_s", "true", "false"), [(beat, 1.0, 209, 81), (landed, 1.0, 2, 1)])
@pytest.mark.parametrize("step_s", [0.02, 0.2])
def test_false_reports_in_bursts_between_two_true_ones_are_contested_after_the_first_burst(
    step_s: float, say: Callable[[float, int], Message], every_s: float, true: int, false: int
) -> None:
    forged = [say(burst + 0.05 + step_s * at, false) for burst in (12.0, 22.0) for at in range(4)]
    found = states([say(every_s * at, true) for at in range(40)] + forged)
    first = next(place for place, (_, _, contested) in enumerate(found) if contested)
    assert first <= 13 + 4 + 2
    assert all(armed is not False and state != "ground" for armed, state, _ in found[first:])


def test_reports_that_a_link_holds_back_and_brings_together_are_no_contest() -> None:
    says = [209] * 20 + [81] + [209] * 20
    found = states([beat(3.0 * (at // 3) + 0.01 * at, mode) for at, mode in enumerate(says)])
    assert all(not contested for _, _, contested in found)


def test_a_landing_that_bounces_is_no_contest() -> None:
    says = [2] * 20 + [4, 4, 1, 2, 1, 2, 1, 1, 1, 1]
    found = states([landed(0.5 * step, state) for step, state in enumerate(says)])
    assert all(not contested for _, _, contested in found)
    assert found[-1][1] == "ground"


def test_in_the_vehicles_own_log_which_holds_each_change_no_report_is_contested() -> None:
    changes = [(132.5, 2), (133.5, 2), (134.5, 2), (135.5, 2), (135.8, 4), (136.0, 2), (136.4, 4), (137.0, 4)]
    says = [landed(at, state) for at, state in [*changes, (137.3, 2), (137.7, 4), (138.0, 4), (138.4, 1)]]
    assert any(contested for _, _, contested in states(says))
    found = states([Message(ULOG, "log/parameter", 0, {"key": "MAV_TYPE", "value": 2}), *says])
    assert all(not contested for _, _, contested in found)


@pytest.mark.parametrize("lag_s", [1.2, 2.3, 3.0, 3.5])
def test_a_landing_reported_over_two_links_up_to_three_and_a_half_seconds_apart_is_no_contest(lag_s: float) -> None:
    says = [209] * 10 + [81] * 10
    found = states([beat(at + delay, mode) for at, mode in enumerate(says) for delay in (0.02, lag_s)])
    assert all(not contested for _, _, contested in found)
    assert found[-1][0] is False


def test_arming_reported_over_a_second_radio_that_has_just_begun_to_arrive_is_no_contest() -> None:
    says = [beat(at + delay, 81 if at < 6 else 209) for at in range(20) for delay in (0.0, 3.52)]
    assert all(not contested for _, _, contested in states(says))


def test_a_take_off_and_the_climb_after_it_are_no_contest_over_two_links() -> None:
    says = [1] * 18 + [3] * 18 + [2] * 20
    found = states([landed(0.5 * step + delay, state) for step, state in enumerate(says) for delay in (0.02, 3.5)])
    assert all(not contested for _, _, contested in found)
    assert found[-1][1] == "air"


def test_a_contest_ends_with_the_true_reports_on_the_ground() -> None:
    true = [beat(at, 209 if at < 20 else 81) for at in range(40)]
    found = states(true + [beat(10.4 + at, 81) for at in range(12)])
    assert found[-1] == (False, None, ())


def test_a_vehicle_that_stays_in_the_air_although_it_is_disarmed_contradicts_itself() -> None:
    beats = [beat(at, 209 if at < 10 else 81) for at in range(30)]
    found = states(sorted([*beats, *(landed(at + 0.5, 2) for at in range(30))], key=lambda m: m.received_ns))
    assert found[2 * 14] == (False, "air", ())
    assert found[2 * 16] == (False, "air", ("landed_state",))
    # the slower of two links reports the landing later
    late = states(
        sorted([*beats, *(landed(at + 0.5, 2 if at < 13 else 1) for at in range(30))], key=lambda m: m.received_ns)
    )
    assert all(not contested for _, _, contested in late)
