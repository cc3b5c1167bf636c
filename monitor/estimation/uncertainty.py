"""The uncertainty of each fault estimate, sample by sample: noise, lag and the model's own errors.

The errors of an observer and of its fault estimates follow its error system
(:class:`monitor.estimation.observer.ErrorSystem`), [delta; phi]+ = A [delta; phi] + B w with w white and as large as
designed for, so their covariance is P+ = A P A^T + B B^T. While all rows are measured P stays at the solution of the
Lyapunov equation P = A P A^T + B B^T and nothing has to be computed; after a loss or a restart it is stepped until it
is back.

The scales are those of healthy flight (:mod:`monitor.fitting.spread`), and flights differ: with weather and manoeuvres,
and in what the vehicle's model or a receiver has for constant. While nothing is faulty each estimate is an error, so
the flight itself tells their variance, rho lambda P: lambda is the level of this run's residuals (1 in the fitted
flights and calmer ones, larger in gusts), rho the mean of f^2 / (lambda P), in which the fitted flights (1) count for
:data:`PRIOR_S`.

A fault brings errors that healthy flight does not have, so the standard deviation of an alarm's size, and of the
estimate of a channel that is held responsible, is

    sqrt(rho lambda P + way^2),    way = T / h max(0, |f(t) - f(t - h)| - 2 sd_h),

with h = max(lag, MOVED T), f the size, and way what is still missing of f, as its movement tells. Behind a ramp an
estimate with a mean delay T is T times the slope; after a step, which it approaches as e^(-t / T), it misses less, by
the factor (h / T) / (e^(h / T) - 1). Which of the two a fault is its size does not say. sd_h is what moves a size in
healthy flight, as measured there (a receiver that wanders moves much less within h than white noise). Where it was not
measured, noise moves it that the observer alone smooths, sd_h = sqrt(2 (1 - e^(-h / T_own)) rho lambda P). A size that
is a share of a command is one here, too: a constant share does not move.

Nothing grows with f itself: where a motor delivers less the model's errors are those of healthy flight at the smaller
command, and faults of sensors add. On recorded losses of motors the truth was within two of these standard deviations
94 to 100 % of the time (docs/sizes.md).

T = T_own + lag / log 2, and as much more as a straight line between two measurements lasts longer than between fixes:
a sample on it is complete only with its end. T_own is the mean delay by the error system, of a fault that moves the
plant's states: a second of slow commands, 2 to 6 s of a gyro's bias that an angle shows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from gains.plants.discretise import discretise
from gains.plants.plant import Plant
from monitor.core.observers import ErrorCovariance, FlightErrors, SizeErrors
from monitor.estimation.bank import owners
from monitor.estimation.isolation_rule import BankRule, IsolationRule
from monitor.estimation.observer import Observer

LAG_S = 0.3
"""Time in which half of a step's error fades that is no lag of the observer, seconds. Chosen: smoothing (0.05 to 0.12
s), motors' lag and the delay of fixes (0.1 to 0.2 s) together. The estimate of a GPS that walks by 0.7 m/s is
0.4 to 0.5 s behind."""
_FIXES_S = 0.2
"""Time between two measurements that :data:`LAG_S` has: that of a receiver with five fixes a second."""
MOVED = 0.25
"""Time over which the movement of a size is taken, as a share of its delay. Chosen: a longer one tells movement from
noise more surely; within a shorter one the fault is raised (a gyro's of 5 times its threshold after a fifth)."""
PRIOR_S, MEMORY_S = 20.0, 60.0
"""For how much of a flight the fitted flights' variance counts, and how much of it is remembered, seconds. Derived: the
variances of flights differ by a factor of about 3 (one deviation; docs/sizes.md), which one or two independent errors
tell as well (2 / nu = log(3)^2), and an error of slow commands or a receiver lasts some ten seconds. Chosen: six of
them are known to a factor of 1.7, and within a minute weather and manoeuvres are alike."""
_MOST = 4.0
"""Largest error that counts in it, in standard deviations: a fault that no alarm shows yet is no error. Chosen: the
errors of radios' motors are twice the fitted ones."""
_BACK = 0.01
"""Share of the steady standard deviations within which others count as steady. Chosen: a hundredth shows in no plot and
no alarm, while the rest of an exponential approach would be stepped in vain."""


class Uncertainty:
    """Standard deviations of the fault estimates of one observer or bank, designed for a plant.

    ``faults`` are all fault channels (a,) in the order of the estimates, ``scale`` has factors on the standard
    deviations of the error system, for some of them. ``moves`` has, for some, how far noise moves an estimate within
    ``rows`` samples, as a multiple of its standard deviation. ``lines_s`` has, for some, the time between two
    measurements. ``lag_s`` is :data:`LAG_S`, or the smoothing alone where the model has all other lags. ``of_flight``
    returns how much larger those of n estimates are in this flight, as :class:`FlightErrors` says, and ``of_sizes``
    those of n sizes of alarms, as :class:`SizeErrors` says.
    """

    def __init__(
        self,
        observer: Observer,
        plant: Plant | None,
        faults: Sequence[str],
        scale: Mapping[str, float] = MappingProxyType({}),
        moves: Mapping[str, float] = MappingProxyType({}),
        lines_s: Mapping[str, float] = MappingProxyType({}),
        lag_s: float = LAG_S,
    ) -> None:
        self._covariance: ErrorCovariance | None = None
        self._channels = len(faults)
        systems = None if plant is None else observer.error_systems(discretise(plant, observer.rate_hz))
        hypotheses = observer.hypotheses
        owned = owners(hypotheses, faults)
        own_s = np.zeros(len(faults))
        if systems is not None:
            own_s += [systems[k].lag_s[hypotheses[k].faults.index(name)] for name, k in zip(faults, owned, strict=True)]
        longer_s = np.maximum(0.0, [lines_s.get(name, 0.0) - _FIXES_S for name in faults])
        delay_s = own_s + lag_s / np.log(2.0) + longer_s
        self.rows = np.maximum(1, np.rint(np.maximum(lag_s, MOVED * delay_s) * observer.rate_hz)).astype(np.intp)
        moved_s = self.rows / observer.rate_hz
        still = np.exp(-moved_s / np.maximum(own_s, 1e-3 * moved_s))
        apart = [moves.get(name, white) for name, white in zip(faults, np.sqrt(2.0 * (1.0 - still)), strict=True)]
        self.of_flight = FlightErrors(len(faults), 1.0 / observer.rate_hz, PRIOR_S, MEMORY_S, _MOST).run
        self.of_sizes = SizeErrors(self.rows, delay_s / moved_s, np.array(apart)).run
        if systems is None:
            return
        # Of each observer only the errors that are coupled with those of its faults: one axis knows nothing of others.
        entries, parts = [], dict[tuple[int, ...], int]()
        coupled = {k: _coupled(systems[k].A) for k in set(owned)}
        for name, k in zip(faults, owned, strict=True):
            at = len(systems[k].steady) - len(hypotheses[k].faults) + hypotheses[k].faults.index(name)
            part = np.flatnonzero(coupled[k][at]).tolist()
            entries.append((parts.setdefault((k, *part), len(parts)), part.index(at)))
        size = max(map(len, parts)) - 1
        A, Q = np.zeros((2, len(parts), 3, size, size))
        steady, start = np.zeros((2, len(parts), size, size))
        for (k, *part), at in parts.items():
            for padded, matrix in zip((A, Q, steady, start), systems[k], strict=False):
                padded[at, ..., : len(part), : len(part)] = matrix[..., part, :][..., part]
        owner, entry = np.array(entries, np.intp).T
        self._covariance = ErrorCovariance(
            A,
            Q,
            steady,
            start,
            owner=owner,
            entry=entry,
            scale=np.array([scale.get(name, 1.0) for name in faults]),
            tolerance=_BACK,
        )

    def run(self, measured: NDArray[np.bool_], restart: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return one fitted standard deviation of each fault estimate after each of n samples (n, a), effect units.

        NaN if there is no plant, or the observer has no error system. ``measured`` tells whether the outputs of each
        sample were measured (n,), ``restart`` whether the observer restarts before it (n,).
        """
        if self._covariance is None:
            return np.full((len(measured), self._channels), np.nan)
        return self._covariance.run(measured, restart)


def _coupled(A: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which errors depend on which, or on the same as these, by any of the matrices (kinds, d, d)."""
    moved = (A != 0.0).any(axis=0)
    return np.linalg.matrix_power(moved | moved.T | np.eye(len(moved), dtype=np.bool_), len(moved))


def unmodelled_lag_s(rule: IsolationRule) -> float:
    """Return the lag of an observer's estimates that its model does not have, seconds."""
    return LAG_S if isinstance(rule, BankRule) else rule.smoothing_s
