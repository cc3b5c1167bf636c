"""First-order smoothing of estimates and residuals."""

from __future__ import annotations

from math import exp


def keep_share(smoothing_s: float, rate_hz: float) -> float:
    """Return the share of m that a row leaves in m <- keep m + (1 - keep) value: e^(-T / time constant)."""
    return exp(-1.0 / (smoothing_s * rate_hz)) if smoothing_s > 0.0 else 0.0
