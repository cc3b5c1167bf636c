"""An observer, as the rest of the monitor uses it: the protocol that every kind of observer implements.

The compiled gains of :mod:`gains` implement it as one affine map (:mod:`monitor.estimation.affine`). Another kind, for
instance a nonlinear attitude observer, is another class with these members and is used by banks, isolation, uncertainty
and calibration alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from gains.plants.plant import Plant

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class FaultSet:
    """Faults that an observer estimates together."""

    faults: tuple[str, ...]
    scales: tuple[bool, ...]  # whether each scales an input: an actuator that delivers less, rarely more


class ObserverRun(NamedTuple):
    """Estimates of the observers of K hypotheses after each of N rows."""

    x: Array  # state estimates (N, K, n)
    fault: Array  # fault estimates in effect units, those of one hypothesis after the other (N, sum of their faults)
    residual: Array  # yt = y - y^ (N, K, p)


class ErrorSystem(NamedTuple):
    """How the errors of one observer move, [delta; phi]+ = A [delta; phi] + B w, phi = f^ - f its last entries."""

    # a and Q = B B' of a row that is measured, coasted, and resumed: the first one measured after that (3, d, d)
    A: Array
    Q: Array
    # covariance P while all is measured, P = A P A' + Q, and after a restart (d, d)
    steady: Array
    start: Array


class Observer(Protocol):
    """The observer of one hypothesis, or the observers of all hypotheses of a bank, stepped together."""

    @property
    def rate_hz(self) -> float:
        """Rows per second."""

    @property
    def hypotheses(self) -> tuple[FaultSet, ...]:
        """The K hypotheses, in the order of the estimates."""

    def run(
        self,
        u: Array,
        y: Array,
        measured: NDArray[np.bool_] | None = None,
        restart: NDArray[np.bool_] | None = None,
    ) -> ObserverRun:
        """Process N rows; the result does not depend on how rows are cut into calls, to the bit.

        Parameters
        ----------
        u, y : NDArray[np.float64]
            Commands (N, s) and outputs (N, p).
        measured : NDArray[np.bool_] | None
            Where not, y is ignored and the observer coasts: it goes on by its model alone (N,). None: everywhere.
        restart : NDArray[np.bool_] | None
            Where the observer first forgets the past and starts at the state that (u, y) explain without a fault
            (N,). The first row ever restarts anyway. None: nowhere.
        """

    def error_systems(self, plant: Plant) -> tuple[ErrorSystem, ...] | None:
        """Return the error system of each hypothesis on the sampled plant, None where it is not known."""

    def settling_s(self) -> float:
        """Return the time after which a wrong start has no effect on fault estimates any more, seconds."""
