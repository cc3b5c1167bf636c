"""How long an observer takes to forget that it was started at the wrong state.

A restart takes the states from the outputs, x = C^+ y; what the outputs do not show starts at zero, whatever the
vehicle was doing. Two copies of one observer fed with the same (u, y) differ by d(k) = M_ss^k d(0), so from the
compiled step alone it follows how the estimates of faults are off after a start that is wrong by d(0) = L1 x, C x = 0.
An observer all of whose states are measured has nothing to forget, however slow its poles.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gains.synthesis.gains_file import Gains

_FORGOTTEN = 0.05
"""Share of its largest error down to which a fault estimate has forgotten a wrong start. Chosen: a smaller share
waits longer after each restart, a larger one may let a wrong start show as a fault."""
_NEGLIGIBLE = 1e-9
"""Singular values and errors, relative to the largest and to effects near 1, below which there is only rounding."""
_LONGEST_S = 60.0
"""Longest wait, seconds. Chosen: a longer wait would leave little of a flight to watch."""


def settling_s(gains: Gains) -> float:
    """Return the time after which a wrong start moves no fault estimate by more than a twentieth of its largest error.

    Parameters
    ----------
    gains : Gains
        Gains of an observer. Those of another structure than :mod:`gains.analysis.augment` count as zero: nothing tells
        which of their states the outputs show.

    Returns
    -------
    float
        Seconds, at most a minute.
    """
    n, a = len(gains.states), len(gains.faults)
    if not gains.L1.size or not a:
        return 0.0
    unseen = unseen_states(gains)
    if not len(unseen):
        return 0.0
    ns = len(gains.initial_matrix)
    M_ss, M_fs = gains.step_matrix[:ns, :ns], gains.step_matrix[ns + n : ns + n + a, :ns]
    d = np.zeros((ns, len(unseen)))
    d[: len(gains.L1)] = gains.L1 @ unseen.T
    errors = []
    for _ in range(round(_LONGEST_S * gains.rate_hz)):
        errors.append(np.abs(M_fs @ d).max(axis=1))
        d = M_ss @ d
    series = np.stack(errors)
    largest = series.max(axis=0)
    off = np.any((series > _FORGOTTEN * largest) & (largest > _NEGLIGIBLE), axis=1)
    return float(np.flatnonzero(off)[-1] + 1) / gains.rate_hz if off.any() else 0.0


def unseen_states(gains: Gains) -> NDArray[np.float64]:
    """Return orthonormal directions of the states that the outputs do not show, as rows (k, n).

    They are the null space of C, and so of F C = [I; 0] - L1, which the gains hold.
    """
    _, sizes, Vt = np.linalg.svd(np.eye(*gains.L1.shape) - gains.L1)
    return np.asarray(Vt[int(np.sum(sizes > _NEGLIGIBLE * sizes[0])) :])
