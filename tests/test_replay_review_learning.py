"""What a review learns from the flight itself, as its page draws it."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic_run import trace

from replay.review.facts.log_facts import LearnedAlarm, LogFacts
from replay.review.learning import _estimate


def test_an_estimate_is_drawn_in_the_unit_of_its_alarm_s_sentence() -> None:
    run = trace()
    facts = LogFacts("ArduPilot", "multirotor", 0, 15.0, (), (), {})
    drawn = _estimate([run], LearnedAlarm(10.0, 15.0, "motors", "motor1", 1.0, ""), facts)
    assert drawn is not None
    assert drawn.unit == "% of full thrust"
    assert np.nanmin(drawn.values) == pytest.approx(100.0 * run.isolated[run.armed, 0].min())
