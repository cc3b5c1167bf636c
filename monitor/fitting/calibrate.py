"""How the evidence of a bank is weighed, and when it counts, from its residuals in healthy flight."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from adapters.sample import Given
from gains.identification.segment import Segment
from gains.synthesis.gains_file import Gains
from monitor.chain import ObserverChain
from monitor.core.lagged import exponential_mean
from monitor.core.sampling import VehicleClock
from monitor.estimation.affine import AffineObserver
from monitor.estimation.bank import smallest, whitening
from monitor.estimation.isolation_rule import LEVEL_S, BankRule, keep_share
from monitor.fitting.flights import Flight
from monitor.profile import ObserverProfile, Profile
from monitor.sampling.gate import GateRule

SETTLE_S = 1.0
"""Least wait after arming, take-off or a restart before samples are evidence, seconds. Chosen: observers of vehicles
forget a wrong start within some tenths of a second (:func:`settling_s`); slower ones wait longer."""
MARGIN = 2.0
"""Factor on the largest score that the best hypothesis left unexplained in healthy flight. Chosen: minutes of flight do
not show the largest score of many hours; a fault that no hypothesis explains exceeds it many times."""
LEVEL_SHARE = 1.5
"""Time constant of the level of the residuals relative to that of the slow path's mean, so that a fault
cannot raise the level before it is detected. At 100 Hz it is :data:`monitor.estimation.changes.LEVEL_S`."""

SMOOTHING_S = 0.05
"""Smoothing of estimates and residuals before hypotheses are compared, seconds. Chosen: five samples of a 100 Hz
observer, a third of the time that evidence has to last (``raise_s``)."""
_LONGEST_SETTLE_S = 60.0
"""Longest wait, seconds: a wait of more than a minute would leave short flights unwatched."""
_TOLERANCE = 0.2
"""Share of the worst hypothesis' score that model error may leave on the right one. Chosen: effects of motors are known
within one or two per cent, and gusts and manoeuvres add more; with a larger share two motors are named if one has
failed."""
_GAIN_PENALTY = 25.0
"""Factor by which the mean J of an actuator that delivers more than commanded has to be smaller than that of the
opposite one that delivers less: a score of five times. Motors usually fail towards less, so the opposite needs plain
evidence."""
_STARTS = 8
"""Number of restarts tried in each recording, spread over it. Chosen: some of them fall into each kind of motion that
is flown."""
_WRONG_START = 0.5
"""Share of the healthy deviation of an estimate that a wrong start may still add. Chosen: together they are 12 % more
than the healthy deviation, and thresholds lie further than that above healthy evidence."""
_NOISE_SHARE = 0.1
"""Weight of a residual that a sensor fault absorbs completely, as a share of the noise: small enough to change no other
residual, large enough that rounding does not decide."""


def bank_rule(
    bank: Sequence[Gains],
    segments: Sequence[Segment],
    *,
    edges: Collection[str] = (),
    smoothing_s: float = SMOOTHING_S,
    settle_s: float = SETTLE_S,
    noise: NDArray[np.float64] | None = None,
    washouts: Mapping[str, float] | None = None,
    jump_s: float = 0.03,
    level_s: float = LEVEL_S,
    calm: Mapping[frozenset[str], NDArray[np.float64]] | None = None,
) -> BankRule:
    """Return the isolation stage of a bank, from the residuals of its hypotheses in healthy flight.

    ``edges`` names the faults that are watched for edges instead of compared; of each segment the first ``settle_s``
    is left out; ``noise`` (p,) of the outputs, where given, keeps a residual that a sensor fault takes up altogether
    from counting for more than a tenth of it; ``washouts``, ``jump_s``, ``level_s`` and ``calm``, by faults, are the
    rule's.

    The covariances are taken about zero; the floor of the score is the largest one that the best hypothesis leaves
    unexplained in healthy flight, with a margin. A hypothesis that contains another does not count in it: it
    explains whatever that one does, and is believed only where that one does not.
    """
    rate_hz = bank[0].rate_hz
    observer, settled = AffineObserver(bank), round(settle_s * rate_hz)
    keep, keep_mean = keep_share(smoothing_s, rate_hz), keep_share(level_s, rate_hz)
    smoothed, means = [], []
    for segment in segments:
        raw = observer.run(segment.u, segment.y, restart=np.arange(len(segment.u)) == 0).residual
        mean = exponential_mean(raw.reshape(len(raw), -1), keep).reshape(raw.shape)
        smoothed.append(mean[settled:])
        slow = exponential_mean(mean.reshape(len(raw), -1), keep_mean).reshape(raw.shape)
        means.append(slow[settled + round(level_s * rate_hz) :])
    residuals = list(np.moveaxis(np.concatenate(smoothed), 1, 0))
    watched = tuple(any(name in edges for name in member.faults) for member in bank)
    least = 0.0 if noise is None else np.diag((_NOISE_SHARE * noise) ** 2)
    covariances = tuple(residual.T @ residual / len(residual) + least for residual in residuals)
    lasting = _of_means(np.concatenate(means), covariances, 0.5 / (level_s * rate_hz))
    fewest = smallest([member.faults for member in bank])
    scores = np.array(
        [
            np.where(edge, np.inf, np.linalg.norm(residual @ W.T, axis=1))
            for residual, W, edge in zip(residuals, whitening(covariances, fewest), watched, strict=True)
        ]
    )
    still = tuple((calm or {}).get(frozenset(member.faults), np.zeros(len(covariances[0]))) for member in bank)
    # the level is followed without those that are believed in calm alone
    always = np.array([not sizes.any() for sizes in still])
    return BankRule(
        smoothing_s=smoothing_s,
        tolerance=_TOLERANCE,
        score_floor=MARGIN * float(scores[fewest].min(axis=0).max()),
        usual_score=float(f"{np.sqrt(np.mean(scores[always].min(axis=0) ** 2)):.4g}"),
        level_s=level_s,
        gain_penalty=_GAIN_PENALTY,
        hypotheses=tuple(member.faults for member in bank),
        covariances=covariances,
        lasting=lasting,
        calm=still,
        edges=watched,
        washouts=washouts or {},
        jump_s=jump_s,
    )


def _of_means(
    means: NDArray[np.float64], covariances: Sequence[NDArray[np.float64]], share: float
) -> tuple[NDArray[np.float64], ...]:
    """Return the covariances of means of residuals (N, K, p), of which a row tells as much as a share of its own mean.

    Minutes of flight hold few such means. The prior (inverse Wishart, of p + 1 of them) is that of the residuals, which
    no mean exceeds.
    """
    told, prior = share * len(means), means.shape[2] + 1.0
    return tuple(
        (share * mean.T @ mean + prior * covariance) / (told + prior)
        for mean, covariance in zip(np.moveaxis(means, 1, 0), covariances, strict=True)
    )


def healthy_maxima(profile: Profile, flights: Sequence[Flight], raise_s: float) -> NDArray[np.float64]:
    """Return for each fault of a profile's first observer the largest healthy size that lasted ``raise_s`` (a,)."""
    observer = profile.observers[0]
    width = max(1, round(raise_s * observer.rate_hz))
    worst = np.zeros(len(observer.faults))
    for flight in flights:
        chain = ObserverChain(observer, profile.name, profile.gate, VehicleClock())
        run = chain.estimate(Given(flight.samples), flight.armed)
        sizes = np.abs(run.estimates.isolated) * flight.armed[:, None]
        if len(sizes) >= width:
            lasted = np.lib.stride_tricks.sliding_window_view(sizes, width, axis=0).min(axis=-1)
            worst = np.maximum(worst, lasted.max(axis=0))
    return worst


def measured_settling_s(observer: ObserverProfile, gate: GateRule, flights: Sequence[Flight]) -> float:
    """Return how long after a restart in healthy motion a wrong start still shows in the estimates.

    The observer restarts at some moments of each flight and is compared with the same observer that did not restart:
    until the smoothed estimates of all faults differ by less than half of their healthy deviation.
    """
    rate_hz = observer.rate_hz
    longest = round(_LONGEST_SETTLE_S * rate_hz)
    slowest = 0
    for flight in flights:
        rows = flight.evidence
        if not len(rows):
            continue
        whole = _smoothed(observer, gate, flight)
        least = _WRONG_START * whole[rows].std(axis=0)
        for start in rows[:: max(1, len(rows) // _STARTS)]:
            again = _smoothed(observer, gate, flight.part(int(start), int(start) + longest))
            off = (np.abs(again - whole[start : start + len(again)]) > least).any(axis=1)
            # An estimate that is off until the flight ends has not been seen to settle, so it tells no time.
            slowest = max(slowest, int(np.flatnonzero(off)[-1]) + 1 if off.any() and not off[-1] else 0)
    return slowest / rate_hz


def _smoothed(observer: ObserverProfile, gate: GateRule, flight: Flight) -> NDArray[np.float64]:
    chain = ObserverChain(observer, "healthy", gate, VehicleClock())
    return chain.estimate(Given(flight.samples), flight.armed).found.smoothed
