"""What a fault adds to measurements: the plant's response to it, superposed on recorded samples.

In the symbols of the theory, for a discrete plant at rest in the deviation at the onset:

    delta x+ = A delta x + G (g(H (x + delta x)) - g(H x)) + E_f f_a,    delta y = C delta x + D_f f_s

exact for linear plants; with nonlinearities as good as the state x that is known along the recording. The autopilot's
reaction is left out: it is in no recording, and an observer that knows u answers to the fault alone.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gains.plants.expression import compile_expression
from gains.plants.plant import Plant
from monitor.estimation.input_curve import effect_of_command


def fault_response(
    plant: Plant, fault: str, signal: NDArray[np.float64], x: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Return what a fault adds to the outputs, delta y (N, p), from rest.

    Parameters
    ----------
    plant : Plant
        Discrete plant.
    fault : str
        Name of one of its faults.
    signal : NDArray[np.float64]
        The fault f(k) in effect units (N,).
    x : NDArray[np.float64] | None
        State along the recording (N, n), for the plant's nonlinearities; without it they are left out.
    """
    channel = next(one for one in plant.faults if one.name == fault)
    if channel.kind == "sensor":
        return np.outer(signal, channel.column)
    delta = np.zeros(len(plant.states))
    added = np.empty((len(signal), len(plant.outputs)))
    g = [(compile_expression(one.expression, one.arguments), one.rows) for one in plant.nonlinearities]
    for k, f in enumerate(signal):
        added[k] = plant.C @ delta
        change = plant.A @ delta + channel.column * f
        if x is not None and g:
            change += plant.G @ np.array([of(*rows @ (x[k] + delta)) - of(*rows @ x[k]) for of, rows in g])
        delta = change
    return added


def effect_change(
    commanded: NDArray[np.float64], executed: NDArray[np.float64], curve: NDArray[np.float64], taps: Sequence[float]
) -> NDArray[np.float64]:
    """Return the fault of an actuator that executes another command than it was given.

    Parameters
    ----------
    commanded, executed : NDArray[np.float64]
        Commands since the onset (N,): w of the loss w = (1 - loss) u is executed.
    curve : NDArray[np.float64]
        Coefficients of the input's static curve (degree,).
    taps : Sequence[float]
        Lag and delay of the inputs, newest first.

    Returns
    -------
    NDArray[np.float64]
        f(k) = sum_d taps[d] (curve(executed(k - d)) - curve(commanded(k - d))), effect units (N,).
    """
    effect = effect_of_command(np.stack([curve, curve]), np.column_stack([executed, commanded]))
    return np.convolve(effect[:, 0] - effect[:, 1], taps)[: len(commanded)]
