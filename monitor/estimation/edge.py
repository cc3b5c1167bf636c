"""Edges: tell a sensor that jumps and then stays from a fault of the plant, which makes the same estimate ramp.

A sensor fault is estimated without any assumption about how it moves, so it can explain whatever its output does: the
estimate of a gyro bias takes up a failing motor as well. A jump of the sensor makes an edge, which a push on the
plant cannot make: flat, then another level within a few samples, then flat again, while the hypothesis of this sensor
leaves no more unexplained than healthy flight does. The size of the edge is held until an opposite one cancels
it, at most ``hold_s``: how large the bias is afterwards only another sensor can tell. Lines that bridge lost
measurements are flat and have corners: where more than three in five of the samples around an edge are bridged, it does
not count.

The rule itself is :class:`monitor.core.bank.EdgeDetector`.
"""

from __future__ import annotations

from math import nan

from monitor.core.bank import EdgeDetector

_MEAN_S = 0.03
"""Span of the running mean, seconds. Chosen: three samples at 100 Hz, so that noise of one sample is no level."""
_GAP_S = 0.03
"""Time that the estimate may take to jump, seconds. Chosen: as long as the mean needs to follow."""
_FLAT_S = 0.1
"""Time for which a level has to last, seconds. Chosen: with gap and mean an edge is known within 0.2 s of the jump."""
HOLD_S = 10.0
"""How long an edge is held, seconds. Chosen: a longer one shows an old bias whose present size this sensor alone cannot
tell, a shorter one clears alarms that still hold."""


def edge_detector(rate_hz: float, limit: float, smallest: float | None, hold_s: float = HOLD_S) -> EdgeDetector:
    """Return a detector of edges in one sensor fault's estimate; :meth:`EdgeDetector.run` takes n rows.

    Parameters
    ----------
    rate_hz : float
        Samples per second.
    limit : float
        Largest J = r' S^-1 r of the sensor's own hypothesis with which it is believed.
    smallest : float | None
        Smallest edge that is held, in the unit of the estimate; None: edges only show.
    hold_s : float
        How long an edge is held at most, seconds.
    """
    return EdgeDetector(
        mean=max(1, round(_MEAN_S * rate_hz)),
        gap=max(1, round(_GAP_S * rate_hz)),
        flat=max(2, round(_FLAT_S * rate_hz)),
        longest=round(hold_s * rate_hz),
        limit=limit,
        smallest=nan if smallest is None else smallest,
    )
