"""A straight line through the levels of flights, each with its own uncertainty, with intervals for few flights.

    y_i = a + b x_i + between_i + within_i,     within_i ~ N(0, s_i^2) known,     between_i ~ N(0, tau^2)

tau^2 is chosen so that the weighted sum of squares has its expected value, n - 2 (Paule and Mandel, J. Res. NBS 87,
1982); it is zero if the flights scatter less. Intervals use Student's t with n - 2 degrees of freedom and the weighted
variance of the remainder (Knapp and Hartung, Statistics in Medicine 22, 2003): with few flights the intervals of the
normal distribution are far too short.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

COVERED = 0.95
"""Share of intervals that contain the truth."""
LEAST_FLIGHTS = 4
"""Fewest flights for a line: two more than its coefficients. With one more the interval is thirteen standard errors to
each side."""
_LEAST_SCATTER = 1e-6
"""Smallest scatter, relative to the weights: values exactly on a line keep errors above zero."""


@dataclass(frozen=True, slots=True)
class Line:
    """A line y = a + b x over x counted from ``origin``."""

    origin: float
    coefficients: Floats  # a, b
    covariance: Floats  # covariance of the coefficients (2, 2)
    between: float  # tau
    freedom: int

    @property
    def slope(self) -> float:
        """Growth of y per unit of x."""
        return float(self.coefficients[1])

    @property
    def slope_error(self) -> float:
        """Standard error of the slope."""
        return math.sqrt(float(self.covariance[1, 1]))

    def at(self, x: Floats) -> tuple[Floats, Floats]:
        """Return the line's values at x, and their standard errors (n,)."""
        X = _regressors(x - self.origin)
        return X @ self.coefficients, np.sqrt(np.einsum("ni,ij,nj->n", X, self.covariance, X))

    def quantile(self, share: float = COVERED) -> float:
        """Return the number of standard errors to each side that contains this share."""
        from scipy.stats import t

        return float(t.ppf(0.5 + 0.5 * share, self.freedom))

    def crossing(self, level: float) -> tuple[float, float, float] | None:
        """Return the earliest, best and latest x at which the line reaches a level (Fieller's interval).

        Return None if the slope is not certain, because the interval then has no end.
        """
        c2 = self.quantile() ** 2
        a, b = float(self.coefficients[0]) - level, self.slope
        (vaa, vab), (_, vbb) = self.covariance.tolist()
        square = b * b - c2 * vbb
        if square <= 0.0:
            return None
        middle = (c2 * vab - a * b) / square
        half = math.sqrt(max(0.0, middle * middle - (a * a - c2 * vaa) / square))
        return self.origin + middle - half, self.origin - a / b, self.origin + middle + half


def fit_line(x: Floats, y: Floats, sd: Floats) -> Line:
    """Return the line through n values over n different x (n,), each with its standard deviation above zero (n,)."""
    from scipy.optimize import brentq

    n, origin = len(x), float(x.mean())
    X = _regressors(x - origin)
    freedom = n - 2

    def excess(tau2: float) -> float:
        """Return the difference of the weighted sum of squares from its expected value."""
        return float(np.sum(_rest(X, y, sd**2 + tau2) ** 2 / (sd**2 + tau2))) - freedom

    tau2 = 0.0
    if excess(0.0) > 0.0:
        # the unweighted sum of squares is an upper bound: with a larger tau^2 the weighted sum is below its expected
        # value
        most = float(np.sum(_rest(X, y, np.ones(n)) ** 2))
        tau2 = float(brentq(excess, 0.0, most))
    weight = 1.0 / (sd**2 + tau2)
    covariance: Floats = np.asarray(np.linalg.inv(X.T @ (X * weight[:, None])), np.float64)
    coefficients = covariance @ (X.T @ (weight * y))
    scatter = max((excess(tau2) + freedom) / freedom, _LEAST_SCATTER)
    return Line(origin, coefficients, covariance * scatter, math.sqrt(tau2), freedom)


def _regressors(x: Floats) -> Floats:
    return np.column_stack([np.ones(len(x)), x])


def _rest(X: Floats, y: Floats, variance: Floats) -> Floats:
    root = np.sqrt(variance)
    return y - X @ np.linalg.lstsq(X / root[:, None], y / root, rcond=None)[0]
