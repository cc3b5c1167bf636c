"""Fault estimates back through the input curve."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from monitor.estimation.input_curve import effect_of_command, fault_in_command, relative_loss

CURVE = np.array([[0.4, 0.6], [0.4, 0.6]])


@given(u=st.floats(0.1, 1.0), loss=st.floats(-0.9, 0.3))
def test_a_loss_of_command_is_recovered_from_its_effect(u: float, loss: float) -> None:
    command = np.array([u, 0.5])
    felt = effect_of_command(CURVE, command * np.array([1 + loss, 1.0]))
    fault = felt - effect_of_command(CURVE, command)
    found = fault_in_command(fault, command, CURVE)
    assert found == pytest.approx([loss * u, 0.0], abs=1e-6)


def test_rows_are_converted_together_as_one_by_one() -> None:
    faults = np.array([[-0.1, 0.02], [0.05, -0.2]])
    u = np.array([0.6, 0.7])
    both = fault_in_command(faults, u, CURVE)
    assert np.array_equal(both, np.stack([fault_in_command(row, u, CURVE) for row in faults]))


def test_more_loss_than_there_is_effect_stays_finite() -> None:
    assert np.isfinite(fault_in_command(np.array([-5.0, 5.0]), np.array([0.5, 0.5]), CURVE)).all()


def test_a_linear_input_only_changes_units() -> None:
    assert fault_in_command(np.array([1.0]), np.array([0.3]), np.array([[2.0]])) == pytest.approx([0.5])


def test_no_relative_loss_is_stated_near_zero_command() -> None:
    assert relative_loss(-0.1, 0.5) == pytest.approx(-0.2)
    assert relative_loss(-0.1, 0.0) is None
