"""A recording through an observer at once: (u, y) as arrays in, estimates as arrays out, many times faster than live.

Two ways compute the same recursion: plain NumPy (:mod:`monitor.estimation.lifted_run`) and, with the extra ``fast``, a
compiled loop (:mod:`monitor.estimation.compiled_run`). Both add up in another order than a live step does, so estimates
agree with :meth:`monitor.estimation.observer.Observer.run` to rounding and not to the last bit: for a stable observer
within ``AGREEMENT`` times the largest numbers that an estimate is summed from, and what is not a number stands in the
same places. What must be bit for bit as it was live steps the live observer.
"""

from __future__ import annotations

import sys
from importlib.util import find_spec

import numpy as np
from numpy.typing import NDArray

from gains.synthesis.gains_file import Gains
from monitor.estimation.compiled_run import CompiledRun
from monitor.estimation.input_curve import effect_of_command
from monitor.estimation.lifted_run import LiftedRun
from monitor.estimation.recursion import ObserverRun, recursion_of

AGREEMENT = 1e-11
_WORTH_LOADING = 5_000_000
"""Samples from which on the compiled path saves more time than it takes to load."""


class WholeRun:
    """One observer over arrays, stretch after stretch: recordings of any length in bounded memory.

    Parameters
    ----------
    gains : Gains
        Compiled gains.
    compiled : bool | None
        Whether to run compiled code; None does where Numba is installed and the first stretch is worth loading it.

    Raises
    ------
    ExtraMissingError
        Compiled code is asked for and Numba is not installed.
    """

    def __init__(self, gains: Gains, compiled: bool | None = None) -> None:
        self._gains = gains
        self._recursion = recursion_of(gains)
        self._undecided = compiled is None
        self._run: LiftedRun | CompiledRun = (CompiledRun if compiled else LiftedRun)(self._recursion)

    def restart(self, u: NDArray[np.float64], y: NDArray[np.float64]) -> None:
        """Forget the past: start at the state that (u, y), (s,) and (p,), explain without a fault."""
        v = effect_of_command(self._gains.input_curves, u)
        self._run.state = self._gains.initial_matrix @ np.concatenate([v, y, [1.0]])

    def advance(self, u: NDArray[np.float64], y: NDArray[np.float64]) -> ObserverRun:
        """Take the next N samples, u (N, s) and y (N, p), and return their estimates.

        Raises
        ------
        ValueError
            The arrays have other shapes.
        """
        expected = (len(u), len(self._gains.inputs)), (len(u), len(self._gains.outputs))
        if (u.shape, y.shape) != expected:
            raise ValueError(f"u and y have the shapes {u.shape} and {y.shape}, not {expected[0]} and {expected[1]}")
        if self._undecided:
            self._undecided = False
            if find_spec("numba") and ("numba" in sys.modules or len(u) >= _WORTH_LOADING):
                state, self._run = self._run.state, CompiledRun(self._recursion)
                self._run.state = state
        found = np.empty((len(u), len(self._recursion.step) - self._recursion.ns))
        self._run.advance(effect_of_command(self._gains.input_curves, u), y, found)
        return self._recursion.split(found)


def run_whole(
    gains: Gains, u: NDArray[np.float64], y: NDArray[np.float64], compiled: bool | None = None
) -> ObserverRun:
    """Restart at the first sample and run through all: u (N, s), y (N, p).

    Parameters
    ----------
    gains : Gains
        Compiled gains.
    u, y : NDArray[np.float64]
        Inputs (N, s) and outputs (N, p) in the order of the gains file.
    compiled : bool | None
        As of :class:`WholeRun`.

    Raises
    ------
    ExtraMissingError
        As :class:`WholeRun`.
    """
    run = WholeRun(gains, compiled)
    if len(u):
        run.restart(u[0], y[0])
    return run.advance(u, y)
