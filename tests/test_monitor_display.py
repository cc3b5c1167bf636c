"""Sizes as people say them: their units, few digits, and one form for every place."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from loopback import event

from monitor.display import display_unit, doubt_text, fault_text, number_text, size_text


@pytest.mark.parametrize(
    ("size", "unit", "text"),
    [
        (-0.1745, "rad", "-10 degrees"),
        (0.02, "rad/s", "+1.15 degrees/s"),
        (26.32, "m", "+26.3 m"),
        (-0.0212, "fraction of full command", "-2.1 % of full thrust"),
        (0.6, "m/s^2", "+0.6 m/s²"),
        (12345.6, "alarms", "+12346 alarms"),
        (7.0, "", "+7"),
        (-0.0, "m", "+0 m"),
        (math.log(3.0), "natural logarithm of times", "3 times"),
    ],
)
def test_a_size_has_the_unit_that_people_say(size: float, unit: str, text: str) -> None:
    assert size_text(size, unit, signed=True) == text


@pytest.mark.parametrize(
    ("unit", "text"),
    [
        ("fraction of full command", "-4.8 % of thrust"),
        ("fraction of full deflection", "-4.8 % of effect"),
        ("bar", "-4.8 % of the command"),
    ],
)
def test_a_share_of_the_command_comes_before_the_size(unit: str, text: str) -> None:
    assert fault_text("motor1", -0.02, -0.0479, unit) == text


def test_a_compass_is_never_further_off_than_half_a_turn() -> None:
    assert fault_text("compass", 1.5 * math.pi, None, "rad") == "-90 degrees"


def test_an_event_says_the_size_that_it_has_now() -> None:
    first = event(1, estimate=-0.02, relative=None, unit="rad")
    assert first.display == "-1.15 degrees"
    assert event(2, estimate=None).display == ""
    assert event(3, estimate=0.1, relative=None, unit="rad", display="9 m").display == "+5.73 degrees"


@given(st.from_type(object) | st.floats() | st.integers(), st.floats() | st.text(), st.text() | st.integers())
def test_what_came_over_a_network_is_never_in_the_way(estimate: Any, relative: Any, unit: Any) -> None:
    assert isinstance(fault_text("c", estimate, relative, unit), str)


@given(st.floats(min_value=1.0, max_value=1e29))
def test_no_number_of_one_and_more_has_an_exponent(value: float) -> None:
    assert "e" not in number_text(value)


@pytest.mark.parametrize(
    ("unit", "factor", "said"),
    [
        ("rad/s", 57.29577951308232, "degrees/s"),
        ("fraction of full command/s", 100.0, "% of full thrust/s"),
        ("share of the command", 100.0, "% of the command"),
        ("m/s", 1.0, "m/s"),
        ("m/s/s", 1.0, "m/s/s"),
        ("times", 1.0, "times"),
        ("", 1.0, ""),
    ],
)
def test_units_of_rates_are_those_of_what_grows(unit: str, factor: float, said: str) -> None:
    assert display_unit(unit) == (factor, said)


@pytest.mark.parametrize(
    ("unit", "share", "said"),
    [
        ("fraction of full command", 2.0, "4 %"),
        ("fraction of full command", None, "2 % of full thrust"),
        ("rad", None, "1.15 degrees"),
        ("natural logarithm of times", None, "2 %"),
    ],
)
def test_a_doubt_is_in_the_words_of_its_size(unit: str, share: float | None, said: str) -> None:
    assert doubt_text(0.02, unit, share) == said
