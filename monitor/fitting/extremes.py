"""Extreme values: the level that a statistic of healthy flight exceeds at a stated rate, with its confidence.

Peaks over threshold. A peak is a sample that is the largest within ``SEPARATION_S`` on both sides: alarms closer than
that are one alarm. Of the N peaks of T hours the k largest, above a limit u, are taken as generalised Pareto,

    P(X > u + e) = (1 + xi e / sigma)^(-1/xi)            e >= 0, exponential for xi = 0,

so that r alarms per hour are reached at  z(r) = u + sigma ((k / (T r))^xi - 1) / xi.

Minutes of flight say little about xi and everything hangs on it: a thousandfold extrapolation adds 3.3 sigma at
xi = -0.25, 6.9 at 0 and 23 at 0.3. Therefore xi is limited to that range and gets a prior, normal about zero, and the
posterior of (xi, log sigma) is summed on a grid. The level is its median, the limits are its quantiles. All this is
deterministic, grows with the time between alarms, and scales with the data.

A Gumbel law of block maxima was the alternative. It scatters less but cannot learn the tail. From 8 minutes of known
truth, extrapolated to one alarm in 20 hours, the median Gumbel level is 23 % too low for noise of varying strength,
52 % too low for Student-t noise of 5 degrees and 18 % too high for Gaussian noise; that of the peaks is 16 % and 41 %
too low and 6 % too high.

Sources: Coles, An Introduction to Statistical Modeling of Extreme Values, 2001, ch. 4; penalised shape: Coles and
Dixon, Extremes 2(1), 1999; Martins and Stedinger, Water Resources Research 36(3), 2000.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from monitor.core.alarms import standing_rungs

SEPARATION_S = 2.0
"""Least time between peaks, seconds. Peaks within two seconds are one gust or manoeuvre, and one alarm to an
operator."""
SHAPE_LIMITS = (-0.25, 0.3)
"""Smallest and largest xi: a tail that is bounded at 4 sigma above the limit, and one without a fourth moment."""

_SHAPE_STD = 0.15
"""Standard deviation of the prior of xi. Chosen: half of the limits, so that data can reach them."""
_SHARE = 0.5
"""Share of the peaks taken as the tail. Chosen: with a smaller share, minutes of flight would leave too few to fit."""
_FEWEST_PEAKS = 10
"""Least number of peaks in the tail. The standard error of the scale is a third of it for ten peaks; fewer are
useless."""
_SCALE_LIMITS = (1.0 / 3.0, 3.0)
"""Factor by which sigma may differ from the mean excess: three standard errors of ten peaks above it, and as far
below."""
_GRID = (44, 60)
"""Points of xi and of sigma. Measured on twelve random series: twice as many of both move the level by 0.2 % at
most."""
_FINEST = 0.01
"""Share of the largest value below which a statistic decides no threshold."""
_RUNGS = 480
"""Sizes per two decades: 1 % apart, the rounding that :func:`standing` states."""


@dataclass(frozen=True, slots=True, eq=False)
class Tail:
    """How often a statistic of healthy flight is expected to exceed any size."""

    peaks: NDArray[np.float64]  # all of them, in any order
    limit: float  # u
    hours: float
    # the posterior of (xi, sigma) on its grid
    xi: NDArray[np.float64]
    sigma: NDArray[np.float64]
    weights: NDArray[np.float64]

    def per_hour(self, size: float) -> float:
        """Return how often an hour peaks exceed a size: as counted up to the limit u, the posterior's mean above it."""
        if size < self.limit:
            return float((self.peaks >= size).sum()) / self.hours
        inside = np.maximum(1.0 + self.xi * (size - self.limit) / self.sigma, 0.0)
        with np.errstate(divide="ignore"):
            share = np.where(inside > 0.0, inside ** (-1.0 / self.xi), 0.0)
        return float((self.peaks > self.limit).sum()) / self.hours * float(share @ self.weights)


@dataclass(frozen=True, slots=True)
class ReturnLevel:
    """The level that is exceeded at a stated rate."""

    level: float  # best estimate, in units of the statistic; never below the largest value of the series
    # limits that hold the level with the stated confidence, by the fit alone
    low: float
    high: float
    hours: float  # length of the series
    peaks: int  # number of peaks the tail was fitted to
    tail: Tail | None = field(default=None, repr=False, compare=False)  # None if there was no peak

    def per_hour(self, size: float) -> float:
        """Return how often an hour the statistic is expected to exceed a size."""
        return 0.0 if self.tail is None else self.tail.per_hour(size)


def return_level(
    series: Sequence[NDArray[np.float64]],
    rate_hz: float,
    alarms_per_hour: float,
    confidence: float = 0.9,
) -> ReturnLevel:
    """Return the level that a statistic exceeds ``alarms_per_hour`` times an hour.

    Parameters
    ----------
    series : Sequence[NDArray[np.float64]]
        Sizes (not negative) in healthy flight, one array for each stretch without a gap (N_i,).
    rate_hz : float
        Samples per second.
    alarms_per_hour : float
        Rate at which peaks may exceed the level.
    confidence : float
        Probability that the level lies between ``low`` and ``high``.

    Raises
    ------
    ValueError
        There is no sample, a sample is not finite, or a rate or the confidence is out of range.
    """
    if not (rate_hz > 0.0 and alarms_per_hour > 0.0 and 0.0 < confidence < 1.0):
        raise ValueError(
            f"rates of {rate_hz:g} Hz and {alarms_per_hour:g} alarms per hour must be positive "
            f"and a confidence of {confidence:g} between 0 and 1"
        )
    stretches = [np.asarray(stretch, dtype=np.float64) for stretch in series if len(stretch)]
    if not stretches or not all(np.all(np.isfinite(stretch)) for stretch in stretches):
        raise ValueError("the healthy statistic has no samples or one that is not finite")
    hours = sum(map(len, stretches)) / rate_hz / 3600.0
    largest = max(float(stretch.max()) for stretch in stretches)
    peaks = np.sort(np.concatenate([local_peaks(stretch, rate_hz) for stretch in stretches]))[::-1]
    peaks = peaks[peaks > 0.0]
    if not len(peaks):
        return ReturnLevel(max(largest, 0.0), 0.0, max(largest, 0.0), hours, 0)
    count = max(_FEWEST_PEAKS, round(_SHARE * len(peaks)))
    limit = float(peaks[count]) if count < len(peaks) and peaks[count] < peaks[0] else 0.0
    excess = peaks[peaks > limit] - limit
    growth = max(1.0, len(excess) / (hours * alarms_per_hour))
    xi, sigma, weights = _posterior(excess)
    levels = sigma * (np.expm1(xi * np.log(growth)) / xi)
    tail = (1.0 - confidence) / 2.0
    low, level, high = limit + _quantiles(levels, weights, (tail, 0.5, 1.0 - tail))
    level = max(float(level), largest)
    seen = Tail(peaks, limit, hours, xi, sigma, weights)
    return ReturnLevel(level, min(float(low), level), max(float(high), level), hours, len(excess), seen)


def local_peaks(values: NDArray[np.float64], rate_hz: float) -> NDArray[np.float64]:
    """Return the samples of a stretch (N,) that are the largest within :data:`SEPARATION_S` before and after them."""
    from scipy.ndimage import maximum_filter1d

    reach = max(1, round(SEPARATION_S * rate_hz))
    around = maximum_filter1d(values, 2 * reach + 1, mode="nearest")
    at = np.flatnonzero(values == around)
    apart = np.diff(at, prepend=-reach - 1) > reach  # Of equal neighbouring samples the first one counts.
    return values[at[apart]]


def standing(values: NDArray[np.float64], samples: int) -> NDArray[np.float64]:
    """Return, at each sample, the largest threshold that an alarm's debounce would have let pass by then.

    The debounce counts samples at or above the threshold up and others down, never below zero, and raises at
    ``samples``. An alarm of threshold h is raised within a stretch (N,) of sizes, not negative, exactly where this
    series reaches h: it is the statistic to extrapolate. A windowed minimum is smaller, since it starts anew at every
    sample that dips. Values (N,) are rounded up by at most one per cent of themselves, and zero below a hundredth of
    the largest.
    """
    samples = max(1, samples)
    largest = float(values.max(initial=0.0))
    if largest <= 0.0:
        return np.zeros(len(values))
    rungs = largest * np.exp(np.linspace(np.log(_FINEST), 0.0, _RUNGS))
    passed = standing_rungs(np.searchsorted(rungs, values, side="right"), len(rungs), samples)
    return np.array([0.0, *rungs[1:], largest])[passed + 1]


def _posterior(
    excess: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return xi, sigma and the probability of each point of a grid."""
    low, high = SHAPE_LIMITS
    # No grid point at zero, where the expressions have a removable singularity.
    xi = low + (high - low) * (np.arange(_GRID[0]) + 0.5) / _GRID[0]
    sigma = float(excess.mean()) * np.geomspace(*_SCALE_LIMITS, _GRID[1])
    inside = 1.0 + xi[:, None, None] * excess / sigma[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        log_density = np.where(inside > 0.0, -(1.0 + 1.0 / xi[:, None, None]) * np.log(inside), -np.inf)
    log_posterior = log_density.sum(axis=-1) - len(excess) * np.log(sigma) - 0.5 * (xi[:, None] / _SHAPE_STD) ** 2
    weights = np.exp(log_posterior - log_posterior.max())
    xi, sigma = (array.ravel() for array in np.broadcast_arrays(xi[:, None], sigma))
    return xi, sigma, weights.ravel() / weights.sum()


def _quantiles(
    values: NDArray[np.float64], weights: NDArray[np.float64], probabilities: Sequence[float]
) -> NDArray[np.float64]:
    order = np.argsort(values, kind="stable")
    return np.interp(probabilities, np.cumsum(weights[order]), values[order])
