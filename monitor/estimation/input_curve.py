"""The static input curve v = curve(u), and actuator faults taken back through it into command units.

An actuator fault that scales an input is estimated as a change f of its effect v = curve(u). What a person asks is
how much of the command is missing: the command u_eff that would have had the effect curve(u) + f.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_NEWTON_STEPS = 4
_SMALLEST_COMMAND = 0.02
_SMALLEST_SLOPE = 1e-9


def effect_of_command(curve: NDArray[np.float64], u: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return v = c1 u + c2 u^2 + ... (..., s) for coefficients ``curve`` (s, degree), without a constant term."""
    value = curve[:, -1] * u
    for degree in range(curve.shape[1] - 2, -1, -1):
        value = (value + curve[:, degree]) * u
    return value


def curve_columns(curve: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Return the coefficients of each power, the highest first, for :func:`effect_into`; nothing where v = u."""
    if curve.shape[1] == 1 and np.all(curve == 1.0):
        return ()
    return tuple(np.ascontiguousarray(column) for column in curve.T[::-1])


def effect_into(columns: tuple[NDArray[np.float64], ...], u: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Write what :func:`effect_of_command` returns for u (s,), to the same bits, into ``out`` (s,)."""
    if not columns:
        out[:] = u
        return
    np.multiply(columns[0], u, out)
    for column in columns[1:]:
        np.add(out, column, out)
        np.multiply(out, u, out)


def fault_in_command(
    fault: NDArray[np.float64], u: NDArray[np.float64], curve: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return u_eff - u for each input, u_eff solving curve(u_eff) = curve(u) + fault.

    Parameters
    ----------
    fault : NDArray[np.float64]
        Faults in effect units, one per input, any number of rows at once (..., s).
    u : NDArray[np.float64]
        Commands, of all rows or row by row (..., s).
    curve : NDArray[np.float64]
        Polynomial coefficients c1, c2, ... of each input (s, degree), no constant term.

    Returns
    -------
    NDArray[np.float64]
        Faults in command units (..., s). An actuator that would have to push the other way (u_eff below zero) is
        extrapolated along the slope at zero.
    """
    if curve.shape[1] == 1:
        return np.asarray(fault / curve[:, 0])
    target = effect_of_command(curve, u) + fault
    if curve.shape[1] == 2:
        linear, square = curve.T
        # Below zero the root stays at that of zero, which is the extrapolation along the slope there.
        root = np.sqrt(np.maximum(linear * linear + 4.0 * square * np.maximum(target, 0.0), 0.0))
        return np.asarray(2.0 * target / np.maximum(linear + root, _SMALLEST_SLOPE) - u)
    u_eff = u + fault / np.maximum(_slope(curve, u), _SMALLEST_SLOPE)
    for _ in range(_NEWTON_STEPS):
        u_eff = np.maximum(u_eff, 0.0)
        miss = target - effect_of_command(curve, u_eff)
        u_eff = u_eff + miss / np.maximum(_slope(curve, u_eff), _SMALLEST_SLOPE)
    return np.asarray(u_eff - u)


def relative_loss(fault: float, command: float) -> float | None:
    """Return fault over command (-0.05: five per cent less than commanded), None near zero command."""
    return fault / command if abs(command) >= _SMALLEST_COMMAND else None


def _slope(curve: NDArray[np.float64], u: NDArray[np.float64]) -> NDArray[np.float64]:
    degree = curve.shape[1]
    value: NDArray[np.float64] = degree * curve[:, -1] + 0.0 * u
    for power in range(degree - 1, 0, -1):
        value = value * u + power * curve[:, power - 1]
    return value
