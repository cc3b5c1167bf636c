"""The size of the mean of healthy evidence over a whole flight: it has little noise, but flights differ.

Peaks of seconds, extrapolated from a minute of flight, hide a propeller that is cut for a whole hover. The mean over
:data:`LASTING_S` and more does not. In healthy flight it shows hardly any noise, but the differences between flights:
battery, payload, propellers. With F flights the mean of the next one is taken as normal about zero,

    m ~ N(0, tau^2 (1 + 1/F)),        p(tau | flights) ~ p(tau) tau^-d exp(-d s^2 / (2 tau^2))

where s is the deviation of the means of the F flights and d = (F - 1) times :data:`_AXES`. The prior p(tau) is
log-normal: :data:`USUAL`, known to a factor of :data:`FACTOR`. With a flat prior m / s would be Student's t of d
degrees of freedom; this prior excludes from its tail scatters that no vehicle has, and alone decides for a single
flight.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from monitor.alarms.alarm import LASTING_S

FLIGHT_S = 300.0
"""Length of a flight, seconds: the mean grows over this time and forgets what is older, and the flights' scatter is
drawn once in it. Chosen: as long as a small battery lasts. Hops on one battery are alike: the normal flights of
CrazyPAD's E8 lie in two groups, 5 % of thrust apart and 0.6 % wide."""
USUAL, FACTOR = 0.015, 2.0
"""Deviation of a motor's mean from flight to flight, as a share of its hover command, and the factor of one deviation
by which vehicles differ. Measured on the two real vehicles with several available healthy flights (CrazyPAD): 2.8
and 1.1 %."""
_AXES = 2
"""Number of independent means in a flight. Motors are told apart by three axes, but flights may differ most about one
of them (CrazyPAD's E8: 3.0 % of roll, 0.9 of yaw, 0.1 of pitch). Simulated, with 2 to 5 flights in the fit and one
axis three times the others, two make 0.9 to 1.2 times the promised false alarms, three 1.4 to 3.1 and one 0.2 to
0.5; if all axes are equal two make 0.4, if only one axis differs 3 to 6."""
_GRID = np.linspace(-4.0, 4.0, 161)
"""Deviations of the prior at which the posterior is summed; one vehicle in 16 000 lies outside."""


@dataclass(frozen=True, slots=True, eq=False)
class Scatter:
    """The posterior of the scatter of a vehicle's flights: tau on a grid with its weights (n,), and the flights F."""

    tau: NDArray[np.float64]
    weights: NDArray[np.float64]
    flights: int

    def per_hour(self, size: float) -> float:
        """Return how often an hour of flight the mean of a flight is expected to exceed a size."""
        from scipy.special import erfc

        deviation = self.tau * math.sqrt(1.0 + 1.0 / self.flights)
        return float(self.weights @ erfc(size / (math.sqrt(2.0) * deviation))) * 3600.0 / FLIGHT_S

    def level(self, alarms_per_hour: float) -> float:
        """Return the size that means exceed ``alarms_per_hour`` times an hour."""
        from scipy.optimize import brentq

        # upper end of the search: eight deviations of the largest tau, beyond any rate that is granted
        most = 12.0 * float(self.tau[-1])
        return float(brentq(lambda size: self.per_hour(size) - alarms_per_hour, 0.0, most))


def scatter(flights: Sequence[NDArray[np.float64]], rate_hz: float) -> Scatter:
    """Return the scatter that healthy flights show.

    Parameters
    ----------
    flights : Sequence[NDArray[np.float64]]
        Healthy estimates of each flight, as shares of the hover command (N_i, m); flights shorter than
        :data:`LASTING_S` are ignored.
    rate_hz : float
        Samples per second.

    Notes
    -----
    s^2 is the mean square over stretches of :data:`LASTING_S` and more, so that noise of that length counts in it. The
    model was learned on the same flights and is off by their mean, hence F / (F - 1).
    """
    least = round(LASTING_S * rate_hz)
    squares = [
        float(np.mean([np.mean(part.mean(axis=0) ** 2) for part in np.array_split(flight, len(flight) // least)]))
        for flight in flights
        if len(flight) >= least
    ]
    count = max(1, len(squares))
    d = _AXES * (count - 1)
    s2 = float(np.mean(squares)) * count / (count - 1) if d else 0.0
    tau = USUAL * FACTOR**_GRID
    log_posterior = -0.5 * _GRID**2 - d * np.log(tau) - 0.5 * d * s2 / tau**2
    weights = np.exp(log_posterior - log_posterior.max())
    return Scatter(tau, weights / weights.sum(), count)
