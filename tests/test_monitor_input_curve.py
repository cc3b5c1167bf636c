"""The input curve, and shares of a command."""

import pytest

from monitor.estimation.input_curve import relative_loss


def test_no_relative_loss_is_stated_near_zero_command() -> None:
    assert relative_loss(-0.1, 0.5) == pytest.approx(-0.2)
    assert relative_loss(-0.1, 0.0) is None


def test_nothing_lacks_more_than_the_whole_of_its_command() -> None:
    assert relative_loss(-0.52, 0.5) == -1.0
    assert relative_loss(-0.22, 0.06) is None
