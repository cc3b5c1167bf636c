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
    """The propagation of one observer's errors, [delta; phi]+ = A [delta; phi] + B w, phi = f^ - f its last entries."""

    # a and Q = B B' of a row that is measured, coasted, and resumed (the first one measured after coasting) (3, d, d)
    A: Array
    Q: Array
    # covariance P while all rows are measured, P = A P A' + Q, and after a restart (d, d)
    steady: Array
    start: Array
    lag_s: Array  # mean delay of each fault's estimate behind a step of the fault, seconds


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
            Whether y is measured (N,). If not, y is ignored and the observer coasts by its model alone. None:
            everywhere.
        restart : NDArray[np.bool_] | None
            Whether the observer first forgets the past and starts at the state that explains (u, y) without a fault
            (N,). The first row of all restarts anyway. None: nowhere.
        """

    def error_systems(self, plant: Plant) -> tuple[ErrorSystem, ...] | None:
        """Return the error system of each hypothesis on the sampled plant, None if it is not known."""

    def settling_s(self) -> float:
        """Return the time after which a wrong start has no effect on fault estimates any more, seconds."""
