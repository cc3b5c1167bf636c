"""How the evidence of a bank is weighed, and when it counts, from its residuals in healthy flight."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from gains.identification.segment import Segment
from gains.synthesis.gains_file import Gains
from monitor.chain import ObserverChain
from monitor.core.lagged import exponential_mean
from monitor.core.sampling import VehicleClock
from monitor.estimation.affine import AffineObserver
from monitor.estimation.bank import whitening
from monitor.estimation.isolation_rule import BankRule
from monitor.fitting.flights import Flight
from monitor.profile import Profile

SETTLE_S = 1.0
"""Least wait after arming, take-off or a restart before samples are evidence, seconds. Chosen: observers of vehicles
forget a wrong start within some tenths of a second (:func:`settling_s`); slower ones wait longer."""
MARGIN = 2.0
"""Factor on the largest score that the best hypothesis left unexplained in healthy flight. Chosen: minutes of flight do
not show the largest score of the hours to come; a fault that no hypothesis explains exceeds it many times."""

_SMOOTHING_S = 0.05
"""Smoothing of estimates and residuals before hypotheses are compared, seconds. Chosen: five samples of a 100 Hz
observer, a third of the time that evidence has to last (``raise_s``)."""
_LONGEST_SETTLE_S = 60.0
"""A wait of more than a minute would leave short flights unwatched."""
_TOLERANCE = 0.2
"""Share of the worst hypothesis' score that model error may leave on the right one. Chosen: effects of motors are known
within one or two per cent, gusts and manoeuvres add more; a larger share names two motors where one failed."""
_GAIN_PENALTY = 25.0
"""How much larger J may be before an actuator is believed to deliver more than commanded: a score of five times.
Motors fail towards less, so only plain evidence says otherwise."""
_NOISE_SHARE = 0.1
"""A residual that a sensor fault takes up altogether counts with a tenth of the noise: small enough to change no other
residual, large enough that rounding does not decide."""


def bank_rule(
    bank: Sequence[Gains],
    segments: Sequence[Segment],
    *,
    edges: Collection[str] = (),
    smoothing_s: float = _SMOOTHING_S,
    settle_s: float = SETTLE_S,
    noise: NDArray[np.float64] | None = None,
    washouts: Mapping[str, float] | None = None,
    jump_s: float = 0.03,
) -> BankRule:
    """Return the isolation stage of a bank, from the residuals of its hypotheses in healthy flight.

    ``edges`` names the faults that are watched for edges instead of compared; of each segment the first ``settle_s``
    is left out; ``noise`` (p,) of the outputs, where given, keeps a residual that a sensor fault takes up altogether
    from counting for more than a tenth of it; ``washouts`` and ``jump_s`` are the rule's.

    The covariances are taken about zero; the floor of the score is the largest one that the best hypothesis leaves
    unexplained in healthy flight, with a margin.
    """
    observer, settled = AffineObserver(bank), round(settle_s * bank[0].rate_hz)
    keep = float(np.exp(-1.0 / (smoothing_s * bank[0].rate_hz)))
    smoothed = []
    for segment in segments:
        raw = observer.run(segment.u, segment.y, restart=np.arange(len(segment.u)) == 0).residual
        mean = exponential_mean(raw.reshape(len(raw), -1), keep).reshape(raw.shape)
        smoothed.append(mean[settled:])
    residuals = list(np.moveaxis(np.concatenate(smoothed), 1, 0))
    watched = tuple(any(name in edges for name in one.faults) for one in bank)
    least = 0.0 if noise is None else np.diag((_NOISE_SHARE * noise) ** 2)
    covariances = tuple(residual.T @ residual / len(residual) + least for residual in residuals)
    scores = [
        np.linalg.norm(residual @ W.T, axis=1)
        for residual, W, edge in zip(residuals, whitening(covariances), watched, strict=True)
        if not edge
    ]
    return BankRule(
        smoothing_s=smoothing_s,
        tolerance=_TOLERANCE,
        score_floor=MARGIN * float(np.min(scores, axis=0).max()),
        gain_penalty=_GAIN_PENALTY,
        hypotheses=tuple(one.faults for one in bank),
        covariances=covariances,
        edges=watched,
        washouts=washouts or {},
        jump_s=jump_s,
    )


def healthy_maxima(profile: Profile, flights: Sequence[Flight], raise_s: float) -> NDArray[np.float64]:
    """Return for each fault of a profile's first observer the largest healthy size that lasted ``raise_s`` (a,)."""
    observer = profile.observers[0]
    width = max(1, round(raise_s * observer.rate_hz))
    worst = np.zeros(len(observer.faults))
    for flight in flights:
        chain = ObserverChain(observer, profile.name, profile.gate, VehicleClock())
        run = chain.estimate(flight.samples, flight.armed)
        sizes = np.abs(run.estimates.isolated) * flight.armed[:, None]
        if len(sizes) >= width:
            lasted = np.lib.stride_tricks.sliding_window_view(sizes, width, axis=0).min(axis=-1)
            worst = np.maximum(worst, lasted.max(axis=0))
    return worst


def profile_settling_s(bank: Sequence[Gains]) -> float:
    """Return how long the slowest observer takes to forget all but a hundredth of its initial error."""
    slowest = max(float(gains.report["poles_max_abs"]) for gains in bank)
    if not 0.0 < slowest < 1.0:
        return SETTLE_S
    return round(min(_LONGEST_SETTLE_S, math.log(100.0) / -math.log(slowest) / bank[0].rate_hz), 2)
