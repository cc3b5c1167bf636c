"""Observers of one plant under several hypotheses as one affine map with scalar nonlinearities.

Every design compiles offline to the same recursion (symbols of the theory; v = curve(u) is the known static input
nonlinearity, past v are part of the state s and carry motor lag and transport delay):

    nu = argument_matrix [s; v; y; 1]                     arguments of the nonlinearities, from x^
    [s+; zeta^; fa^; yt] = step_matrix [s; v; y; 1; g(nu)],      s = [eta; q; v(k-1); ...]

A row without measurements is the same product with another matrix (:mod:`monitor.estimation.coasting`), and so is the
first one after it. Stacked (:mod:`monitor.estimation.stack_layout`) the observers of a bank are one such map, whose
zeros cost nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, log

import numpy as np
from numpy.typing import NDArray

from gains.plants.expression import compile_expression
from gains.plants.plant import Plant
from gains.synthesis.gains_file import Gains
from monitor.core.observers import AffineMap
from monitor.estimation.error_system import error_system
from monitor.estimation.observer import ErrorSystem, FaultSet, ObserverRun
from monitor.estimation.settling import settling_s
from monitor.estimation.stack_layout import stack_layout


class AffineObserver:
    """Compiled gains as an :class:`monitor.estimation.observer.Observer`: of one observer, or of all of a bank.

    Parameters
    ----------
    gains : Sequence[Gains]
        Gains of each hypothesis, with the same inputs, outputs and states.
    """

    def __init__(self, gains: Sequence[Gains]) -> None:
        first, layout = gains[0], stack_layout(gains)
        self.gains = tuple(gains)
        self.rate_hz = first.rate_hz
        self.hypotheses = tuple(
            FaultSet(single.faults, tuple(source is not None for source in single.fault_inputs)) for single in gains
        )
        K, n, p, F = len(gains), len(first.states), len(first.outputs), sum(layout.faults)
        self._shape = K, n, p
        nonlinearities = [g for single in gains for g in single.nonlinearities]
        s = len(first.inputs)
        entry = {(0, j): j for j in range(s)} | {held: s + i for i, held in enumerate(layout.held)}
        self._map = AffineMap(
            maps=(layout.step, layout.coast, layout.resume),
            initial=layout.initial,
            curves=first.input_curves,
            newer=np.array([entry[delay - 1, j] for delay, j in layout.held], np.intp),
            source=np.array([j for _, j in layout.held], np.intp),
            functions=[compile_expression(g.expression, g.arguments) for g in nonlinearities],
            spans=np.cumsum([0, *(len(g.arguments) for g in nonlinearities)]),
            outputs=p,
            faults=F,
            estimates=K * (n + p) + F,
            first_fault=K * n,
        )

    def run(
        self,
        u: NDArray[np.float64],
        y: NDArray[np.float64],
        measured: NDArray[np.bool_] | None = None,
        restart: NDArray[np.bool_] | None = None,
    ) -> ObserverRun:
        """Process N rows; see :meth:`monitor.estimation.observer.Observer.run`."""
        K, n, p = self._shape
        count = len(u)
        of_measured = np.ones(count, np.uint8) if measured is None else measured.view(np.uint8)
        of_restart = np.zeros(count, np.uint8) if restart is None else restart.view(np.uint8)
        estimates = self._map.run(u, y, of_measured, of_restart)
        end = estimates.shape[1] - K * p
        return ObserverRun(
            estimates[:, : K * n].reshape(count, K, n),
            estimates[:, K * n : end],
            estimates[:, end:].reshape(count, K, p),
        )

    def error_systems(self, plant: Plant) -> tuple[ErrorSystem, ...] | None:
        """Return the error system of each hypothesis, None where the gains are not those of a discrete design."""
        if not all(single.L1.size and single.domain == "discrete" for single in self.gains):
            return None
        return tuple(error_system(single, plant) for single in self.gains)

    def settling_s(self) -> float:
        """Return the time after which a wrong start has no effect on fault estimates any more, seconds."""
        return max(settling_s(single) for single in self.gains)

    def slowest_s(self) -> float:
        """Return the time constant of the slowest mode of the error, seconds; infinite where one does not decay."""
        radius = max(float(np.abs(np.linalg.eigvals(M_ss)).max(initial=0.0)) for M_ss in map(_state_matrix, self.gains))
        if radius >= 1.0:
            return inf
        return -1.0 / (self.rate_hz * log(radius)) if radius > 0.0 else 0.0


def _state_matrix(gains: Gains) -> NDArray[np.float64]:
    """Return M_ss of s+ = M_ss s + ..."""
    ns = len(gains.initial_matrix)
    return gains.step_matrix[:ns, :ns]
