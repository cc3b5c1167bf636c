"""Tests of a model's residuals: whether they are white and normal."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gains.plants.plant import FloatArray

LAGS = 25
"""Half a second at 50 Hz: where dynamics that a model lacks show. Ljung and Box suggest 20 to 30."""
_LEAST_P = 0.01
"""One of a hundred white residuals is called coloured."""
_SMALL_CORRELATION = 0.2
"""It inflates the variance of a mean by less than half (1.4 / .6 of a first-order process is 1.5)."""
_HEAVY_TAILS = 3.0
"""Excess kurtosis, 0 for a normal distribution and 3 for a Laplace distribution."""
_SKEWED = 1.0
"""Half the skewness of an exponential distribution."""


@dataclass(frozen=True, slots=True, eq=False)
class ResidualStatistics:
    """One output's residual."""

    name: str  # of the output
    rms: float  # its size, in the output's unit
    autocorrelation: FloatArray  # normalised, at lags 1, 2, ... (L,)
    bound: float  # what white residuals stay within at 99 of 100 lags
    ljung_box_p: float  # chance that white residuals correlate as much (Ljung and Box 1978)
    # both 0 for a normal distribution
    skewness: float
    excess_kurtosis: float

    @property
    def white(self) -> bool:
        """Whether no test contradicts white residuals."""
        return self.ljung_box_p >= _LEAST_P

    @property
    def note(self) -> str:
        """The verdict in a phrase for people."""
        lag = int(np.argmax(np.abs(self.autocorrelation)))
        largest = float(self.autocorrelation[lag])
        if self.white:
            text = "white"
        elif abs(largest) < _SMALL_CORRELATION:
            text = f"nearly white (correlation {largest:.2f} at lag {lag + 1})"
        else:
            text = f"not white (correlation {largest:.2f} at lag {lag + 1}): dynamics or a disturbance the model lacks"
        if self.excess_kurtosis > _HEAVY_TAILS:
            return f"{text}; heavy tails (excess kurtosis {self.excess_kurtosis:.1f})"
        if abs(self.skewness) > _SKEWED:
            return f"{text}; skewed ({self.skewness:.1f})"
        return f"{text}; {'near' if abs(self.excess_kurtosis) < 1.0 else 'not far from'} normal"


def residual_statistics(names: Sequence[str], segments: Sequence[FloatArray]) -> tuple[ResidualStatistics, ...]:
    """Return the statistics of each output's residual.

    Each segment (N_i, p) is without a break, and correlations are taken within it, at fewer lags where it is short.
    """
    # not scipy.stats, which takes longer to load than this takes altogether
    from scipy.special import gammaincc

    joined = np.concatenate(segments)
    joined = joined - joined.mean(axis=0)
    centred = np.split(joined, np.cumsum([len(segment) for segment in segments])[:-1])
    lags = max(1, min(LAGS, min(len(segment) for segment in segments) - 2))
    power = np.maximum((joined**2).sum(axis=0), 1e-300)
    rho, pairs = np.empty((lags, len(names))), np.empty(lags)
    for lag in range(1, lags + 1):
        products = np.concatenate([segment[lag:] * segment[:-lag] for segment in centred])
        pairs[lag - 1] = len(products)
        rho[lag - 1] = products.sum(axis=0) / power * (len(joined) / len(products))
    # the variance of a lag's correlation is one over its number of pairs, which is Ljung's and Box's correction
    p = gammaincc(0.5 * lags, 0.5 * (rho**2 * pairs[:, None]).sum(axis=0))
    deviation = np.sqrt(power / len(joined))
    standard = joined / deviation
    return tuple(
        ResidualStatistics(
            name=name,
            rms=float(deviation[i]),
            autocorrelation=rho[:, i],
            bound=2.576 / float(np.sqrt(pairs[0])),
            ljung_box_p=float(p[i]),
            skewness=float((standard[:, i] ** 3).mean()),
            excess_kurtosis=float((standard[:, i] ** 4).mean() - 3.0),
        )
        for i, name in enumerate(names)
    )
