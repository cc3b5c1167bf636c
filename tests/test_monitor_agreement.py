"""Flights that disagree: found where they do, not found where they do not, left out where most agree."""

from __future__ import annotations

import functools
import re

import numpy as np
import pytest

from gains.identification.segment import Segment
from monitor.fitting.agreement import Agreement, ComparedEffect, FlightEffects, agreement, flight_effects
from monitor.vehicles.multirotor.flight_motors import motor_agreement
from monitor.vehicles.multirotor.identify import MultirotorFit, identify_multirotor

EFFECTS = (
    ComparedEffect("motor1", "motor1 pushes {} less", "motor1 pushes {} more", 0.01),
    ComparedEffect("motor2", "motor2 pushes {} less", "motor2 pushes {} more", 0.01),
)
RATE_HZ = 50.0


def flight(name: str, values: list[float], error: float = 0.01) -> FlightEffects:
    return FlightEffects(name, 100.0, np.array(values), np.eye(len(values)) * error**2)


def disagreeing(found: Agreement) -> list[str]:
    return [one.name for one in found.verdicts if one.disagrees]


def test_flights_that_scatter_as_they_say_agree() -> None:
    random = np.random.default_rng(1)
    false = 0
    for _ in range(200):
        flights = [flight(str(k), (1.0 + 0.014 * random.normal(size=2)).tolist()) for k in range(8)]
        false += bool(disagreeing(agreement(EFFECTS, flights)))
    # the scatter between flights is an estimate, too
    assert false <= 8


def test_a_flight_whose_motor_is_weak_disagrees_and_is_left_out_of_many() -> None:
    flights = [flight(str(k), [1.0 + 0.005 * (-1) ** k, 1.0]) for k in range(5)] + [flight("cut", [1.0, 0.85])]
    found = agreement(EFFECTS, flights)
    assert disagreeing(found) == ["cut"]
    assert found.left_out == {"cut"}
    assert found.lines() == ["cut disagrees with the other flights and is left out: motor2 pushes 15 % less (12 sigma)"]
    assert sum(one.weight for one in found.verdicts) == pytest.approx(1.0)
    assert [one.weight for one in found.verdicts if one.left_out] == [0.0]


def test_a_second_odd_flight_does_not_hide_the_first() -> None:
    flights = [flight(str(k), [1.0, 1.0]) for k in range(7)]
    flights += [flight("cut", [1.0, 0.85]), flight("worn", [0.88, 1.0])]
    assert agreement(EFFECTS, flights).left_out == {"cut", "worn"}


def test_of_two_flights_nobody_knows_which_is_right() -> None:
    found = agreement(EFFECTS, [flight("a", [1.0, 1.0]), flight("b", [1.0, 0.8])])
    assert disagreeing(found) == ["a", "b"]
    assert found.left_out == frozenset()


def test_a_small_difference_is_said_and_left_in() -> None:
    flights = [flight(str(k), [1.0, 1.0], 0.001) for k in range(6)] + [flight("odd", [1.0, 0.952], 0.001)]
    found = agreement(EFFECTS, flights)
    assert disagreeing(found) == ["odd"]
    assert found.left_out == frozenset()


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_flights_to_compare_are_no_disagreement(count: int) -> None:
    found = agreement(EFFECTS, ["short", *(flight("a", [1.0, 1.0]) for _ in range(count))])
    assert (found.verdicts, found.silent, found.lines(), found.details()) == ((), ("short",), [], [])


def test_standard_errors_cover_the_truth() -> None:
    """Of coloured errors, too: 95 % intervals hold the truth in 90 to 99 %."""
    random = np.random.default_rng(3)
    inside = total = 0
    for _ in range(100):
        x = np.convolve(random.normal(size=(3000 + 24)), np.ones(25) / 5.0, "valid")
        e = np.convolve(random.normal(size=(3000 + 24)), np.ones(25) / 5.0, "valid")
        regressors = np.stack([np.column_stack([x, np.ones(3000)])], axis=1)
        found = flight_effects("a", regressors, (0.9 * x + e)[:, None], np.ones(1), RATE_HZ)
        assert isinstance(found, FlightEffects)
        error = np.sqrt(found.covariance[0, 0])
        inside += abs(found.values[0] - 0.9) < 2.0 * error
        total += 1
    assert 0.9 <= inside / total <= 0.99


def test_a_flight_that_is_too_short_says_nothing() -> None:
    regressors = np.ones((300, 1, 2))
    assert flight_effects("a", regressors, np.ones((300, 1)), np.ones(1), RATE_HZ) == "a"


@functools.cache
def quad(weak: float, seed: int, offset: float = 0.0) -> list[Segment]:
    """Return a flight of a quad in plus whose motor 3 has a share of its effect, under a controller that levels it."""
    random = np.random.default_rng(seed)
    mixer = np.array([[1, -1, 0, 1], [1, 1, 0, 1], [1, 0, 1, -1], [1, 0, -1, -1]], float)
    effect = np.array([[-1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0], [0.1, 0.1, -0.1, -0.1]])
    count = round(90 * RATE_HZ)
    u, y = np.empty((count, 4)), np.empty((count, 4))
    rate, angle = np.zeros(3), np.zeros(3)
    share = np.array([1.0, 1.0, weak, 1.0])
    trim = np.zeros(3)
    for k in range(count):
        if k % 40 == 0:
            wanted = 0.3 * random.normal(size=3)
        command = 0.4 * (wanted - angle) - 0.25 * rate + trim
        trim -= 0.002 * (angle - wanted)
        u[k] = 0.5 + mixer @ np.concatenate([[0.01 * random.normal()], np.clip(command, -0.3, 0.3)]) * [1, 1, 1, 1]
        y[k] = [*rate, -9.81]
        rate = 0.97 * rate + effect @ (share * u[k]) + [0.0, offset, 0.0] + 0.002 * random.normal(size=3)
        angle = angle + rate / RATE_HZ
    return [Segment(u, y)]


def identified(flights: list[list[Segment]]) -> MultirotorFit:
    segments = [segment for one in flights for segment in one]
    return identify_multirotor(segments, RATE_HZ, flights=[number for number, one in enumerate(flights) for _ in one])[
        0
    ]


@functools.cache
def healthy() -> tuple[list[list[Segment]], MultirotorFit]:
    flights = [quad(1.0, seed) for seed in range(4)]
    return flights, identified(flights)


def compared(flights: list[list[Segment]], fit: MultirotorFit) -> Agreement:
    names = [str(number) for number in range(len(flights))]
    return motor_agreement(fit, names, flights, ["motor1", "motor2", "motor3", "motor4"])


def test_a_weak_motor_is_named_with_its_share() -> None:
    flights = [*healthy()[0], quad(0.88, 9)]
    verdicts = compared(flights, identified(flights))
    assert disagreeing(verdicts) == ["4"]
    assert verdicts.left_out == {"4"}
    # 12 % are lost, and the standard error is one per cent
    assert re.match(
        "4 disagrees with the other flights and is left out: motor3 pushes 1[123] % less", verdicts.lines()[0]
    )


def test_a_payload_that_hangs_askew_is_no_weak_motor_and_spoils_no_effect() -> None:
    flights = [quad(1.0, seed) for seed in range(3)] + [quad(1.0, 9, offset=0.1)]
    fit = identified(flights)
    assert fit.B[1, 2] == pytest.approx(1.0, abs=0.03)
    verdicts = compared(flights, fit)
    assert disagreeing(verdicts) == ["3"]
    assert (
        "3 disagrees with the other flights and is left out: is out of trim about pitch by 20 %" in verdicts.lines()[0]
    )


def heavier(flight: list[Segment], begin: float, end: float) -> list[Segment]:
    """Return a flight whose mean command is larger by a share, at its begin and at its end."""
    return [Segment(one.u + 0.5 * np.linspace(begin, end, len(one.u))[:, None], one.y) for one in flight]


@pytest.mark.parametrize(
    ("begin", "end", "says"),
    [
        (0.15, 0.15, "commands 15 % more thrust ("),
        pytest.param(0.0, 0.25, "commands 25 % more thrust at its end than at its begin (", marks=pytest.mark.long),
        (0.15, -0.1, "commands 25 % less thrust at its end than at its begin ("),
    ],
)
def test_a_payload_or_a_battery_that_sags_shows_in_the_thrust(begin: float, end: float, says: str) -> None:
    flights, fit = healthy()
    verdicts = compared([*flights, heavier(quad(1.0, 8), begin, end)], fit)
    assert disagreeing(verdicts) == ["4"]
    assert says in verdicts.lines()[0]


def test_how_lively_a_flight_was_is_no_disagreement() -> None:
    flights, fit = healthy()
    hover = [
        Segment(0.5 + (one.u - 0.5) * 0.2 + 0.002 * np.random.default_rng(1).normal(size=one.u.shape), 0.2 * one.y)
        for one in quad(1.0, 8)
    ]
    assert disagreeing(compared([*flights, hover], fit)) == []


def test_a_fault_for_a_part_of_a_flight_does_not_drown_in_its_mean() -> None:
    flights, fit = healthy()
    [well], [weak] = quad(1.0, 8), quad(0.85, 9)
    third = len(weak.u) // 3
    odd = [Segment(one.u[:third], one.y[:third]) for one in (well, weak, well)]
    verdicts = compared([*flights, odd], fit)
    assert disagreeing(verdicts) == ["4"]
    assert verdicts.left_out == {"4"}
    assert "motor3 pushes 1" in verdicts.lines()[0]
