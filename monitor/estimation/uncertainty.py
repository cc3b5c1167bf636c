"""How far each fault estimate may be off: the covariance of its error, sample by sample.

The errors of an observer and of its fault estimates move as its error system says
(:class:`monitor.estimation.observer.ErrorSystem`), [delta; phi]+ = A [delta; phi] + B w with w white and as large as
designed for, so their covariance is P+ = A P A^T + B B^T. While all is measured P stays at the solution of the Lyapunov
equation P = A P A^T + B B^T and nothing has to be computed; after a loss or a restart it is stepped until it is back.

The scales are those of the design: where they are larger than what a flight shows, so is this.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from gains.plants.discretise import discretise
from gains.plants.plant import Plant
from monitor.core.observers import ErrorCovariance
from monitor.estimation.bank import owners
from monitor.estimation.observer import Observer

_BACK = 0.01
"""Standard deviations within this share of the steady ones count as those. Chosen: a hundredth shows in no plot and no
alarm, while the rest of an exponential approach would be stepped for nothing."""


class Uncertainty:
    """Standard deviations of the fault estimates of one observer or bank, designed for a plant.

    ``faults`` are all fault channels (a,) in the order of the estimates, ``scale`` says how many times larger those of
    some are than the error system has them.
    """

    def __init__(
        self,
        observer: Observer,
        plant: Plant | None,
        faults: Sequence[str],
        scale: Mapping[str, float] = MappingProxyType({}),
    ) -> None:
        self._covariance: ErrorCovariance | None = None
        self._channels = len(faults)
        systems = None if plant is None else observer.error_systems(discretise(plant, observer.rate_hz))
        if systems is None:
            return
        hypotheses = observer.hypotheses
        owned = owners(hypotheses, faults)
        used = sorted(set(owned))
        size = max(len(systems[k].steady) for k in used)
        A, Q, steady, start = (np.stack([_padded(systems[k][i], size) for k in used]) for i in range(4))
        self._covariance = ErrorCovariance(
            A,
            Q,
            steady,
            start,
            owner=np.array([used.index(k) for k in owned], dtype=np.intp),
            entry=np.array(
                [
                    size - len(hypotheses[k].faults) + hypotheses[k].faults.index(name)
                    for name, k in zip(faults, owned, strict=True)
                ],
                dtype=np.intp,
            ),
            scale=np.array([scale.get(name, 1.0) for name in faults]),
            tolerance=_BACK,
        )

    def run(self, measured: NDArray[np.bool_], restart: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return one standard deviation of each fault estimate after each of n samples (n, a), effect units.

        Not a number where there is no plant, or the observer has no error system. ``measured`` says whether the outputs
        of each sample were measured (n,), ``restart`` whether the observer restarts before it (n,).
        """
        if self._covariance is None:
            return np.full((len(measured), self._channels), np.nan)
        return self._covariance.run(measured, restart)


def _padded(matrix: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    more = size - matrix.shape[-1]
    return np.pad(matrix, [(0, 0)] * (matrix.ndim - 2) + [(more, 0), (more, 0)])
