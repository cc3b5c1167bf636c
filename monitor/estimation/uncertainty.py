"""The uncertainty of each fault estimate, sample by sample: noise, lag and the model's own errors.

The errors of an observer and of its fault estimates follow its error system
(:class:`monitor.estimation.observer.ErrorSystem`), [delta; phi]+ = A [delta; phi] + B w with w white and as large as
designed for, so their covariance is P+ = A P A^T + B B^T. While all rows are measured P stays at the solution of the
Lyapunov equation P = A P A^T + B B^T and nothing has to be computed; after a loss or a restart it is stepped until it
is back.

The scales are those of healthy flight (:mod:`monitor.fitting.spread`). A fault brings errors that healthy flight does
not have, so the standard deviation of an alarm's size is

    sqrt(lambda P + way^2 + (SHARE f)^2),     way = max(0, |f(t) - f(t - LAG_S)| - 2 sqrt(lambda P)),

with f the shown size, lambda the level of this run's residuals (1 in healthy flight, larger in gusts), and way the
movement of f beyond noise: a moving estimate lags behind its fault by about as much as it moved during its lag.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from gains.plants.discretise import discretise
from gains.plants.plant import Plant
from monitor.core.observers import ErrorCovariance, SizeErrors
from monitor.estimation.bank import owners
from monitor.estimation.observer import Observer

LAG_S = 0.3
"""Lag of estimates behind their fault, seconds. Chosen: smoothing (0.05 to 0.12 s), motors' lag and the delay of fixes
(0.1 to 0.2 s) together. On a GPS that walks by 0.7 m/s the estimate lags by 0.2 to 0.3 s."""
SHARE = 0.015
"""Part of the standard deviation in proportion to the size: errors of a model grow with what it explains, as curves,
effects and washouts are known to some per cent. Measured on 42 recorded faults: from a second after the alarm on, the
truth is within two standard deviations for 94, 97 and 98 % of the time with 0.01, 0.015 and 0.02, where noise alone
gave 83 % (motors) and 42 % (GPS)."""

_BACK = 0.01
"""Share of the steady standard deviations within which others count as steady. Chosen: a hundredth shows in no plot and
no alarm, while the rest of an exponential approach would be stepped in vain."""


class Uncertainty:
    """Standard deviations of the fault estimates of one observer or bank, designed for a plant.

    ``faults`` are all fault channels (a,) in the order of the estimates, ``scale`` has factors on the standard
    deviations of the error system, for some of them.
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
        self._of_sizes = SizeErrors(max(1, round(LAG_S * observer.rate_hz)), len(faults), SHARE)
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

        NaN if there is no plant, or the observer has no error system. ``measured`` tells whether the outputs of each
        sample were measured (n,), ``restart`` whether the observer restarts before it (n,).
        """
        if self._covariance is None:
            return np.full((len(measured), self._channels), np.nan)
        return self._covariance.run(measured, restart)

    def of_sizes(
        self,
        sd: NDArray[np.float64],
        sizes: NDArray[np.float64],
        level: NDArray[np.float64],
        shown: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Return the standard deviation of n sizes of alarms (n, a); ``sd`` is that of healthy flight.

        ``level`` is the residuals' mean square relative to that of healthy flight (n,). The result is in the unit of
        ``shown``, which is ``sd`` in the unit of alarms (n, a).
        """
        return self._of_sizes.run(sd, sizes, level, shown)


def _padded(matrix: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    more = size - matrix.shape[-1]
    return np.pad(matrix, [(0, 0)] * (matrix.ndim - 2) + [(more, 0), (more, 0)])
