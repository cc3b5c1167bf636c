"""The static input curve v = curve(u), a polynomial without constant term.

An actuator fault that scales an input is estimated as a change f of its effect v = curve(u). People want to know how
much of the command is missing: the command u_eff that would have had the effect curve(u) + f
(:class:`monitor.core.observers.CommandScale`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LEAST_COMMAND = 0.02
"""Smallest command, as a share of full command, for which a loss is stated as a share. Chosen: the share of an
estimate's error grows without bound as the command goes to zero."""
_LARGEST_SHARE = 1.3
"""Share of the command above which an estimate tells nothing of an actuator. Measured: motors that were stopped in
flight read 0.85 and 0.93, up to 0.15 off; this is twice that error above the whole."""


def effect_of_command(curve: NDArray[np.float64], u: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return v = c1 u + c2 u^2 + ... (..., s) for coefficients ``curve`` (s, degree)."""
    value = np.zeros(u.shape)
    for coefficients in curve.T[::-1]:
        value = (value + coefficients) * u
    return value


def relative_loss(fault: float, command: float) -> float | None:
    """Return fault over command (-0.05: five per cent less than commanded).

    None if no share can be stated: near zero command, and if the share would exceed the whole. No actuator lacks more
    than its whole command: the excess of an estimate is its own error.
    """
    if abs(command) < LEAST_COMMAND or abs(fault / command) > _LARGEST_SHARE:
        return None
    return max(fault / command, -1.0)
