"""Healthy samples of recordings, and what they say about isolation and thresholds."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from adapters.batch import Batch, pack
from adapters.message import Message
from adapters.sample import Sample, stacked
from gains.identification.segment import Segment
from gains.synthesis.gains_file import Gains
from monitor.chain import ObserverChain
from monitor.core.sampling import VehicleClock
from monitor.estimate import Estimate
from monitor.estimation.affine import AffineObserver
from monitor.estimation.bank import whitening
from monitor.estimation.isolation_rule import BankRule
from monitor.profile import Profile
from monitor.sampling.gate import GatedSample, GatedSampler, GateRule
from monitor.sampling.phase import FlightPhase
from monitor.sampling.transform import Source, Transform

SETTLE_S = 1.0
MARGIN = 2.0

_SMOOTHING_S = 0.05
_LONGEST_SETTLE_S = 60.0
_TOLERANCE = 0.2
_GAIN_PENALTY = 25.0
_NOISE_SHARE = 0.1
_BATCH = 4096


def flight_samples(
    messages: Iterable[Message],
    source: Source,
    rate_hz: float,
    gate: GateRule,
) -> list[GatedSample]:
    """Return a recording's samples, each with whether it is evidence, as the monitor would take them."""
    sampler, phase = GatedSampler(source, rate_hz, VehicleClock(), gate), FlightPhase()
    gated: list[GatedSample] = []
    for batch in _of_one_phase(messages, phase):
        samples, armed = sampler.sample(batch, phase)
        gated += [GatedSample(samples.one(row), good) for row, good in enumerate(armed.tolist())]
    return gated


def _of_one_phase(messages: Iterable[Message], phase: FlightPhase) -> Iterator[Batch]:
    """Yield messages as batches in which the flight phase does not change; ``phase`` follows from batch to batch."""
    following, batch = FlightPhase(), list[Message]()
    for message in messages:
        following.feed(message)
        changed = (following.armed, following.landed) != (phase.armed, phase.landed)
        if batch and (changed or len(batch) >= _BATCH):
            yield pack(batch)
            batch = []
        phase.armed, phase.landed = following.armed, following.landed
        batch.append(message)
    yield pack(batch)


def transformed(flight: Sequence[GatedSample], transform: Transform) -> list[GatedSample]:
    """Return the samples that a transform makes of raw ones."""
    raw = stacked([sample for sample, _ in flight], len(transform.signals), 0)
    samples, rows = transform.run(raw)
    return [
        GatedSample(samples.one(k), flight[row].armed and bool(samples.complete[k]))
        for k, row in enumerate(rows.tolist())
    ]


def contiguous(samples: Iterable[GatedSample]) -> list[Segment]:
    """Return the stretches of evidence without a break."""
    runs: list[list[Sample]] = [[]]
    for sample, armed in samples:
        if runs[-1] and (not armed or sample.restart):
            runs.append([])
        if armed:
            runs[-1].append(sample)
    return [Segment(np.stack([s.u for s in run]), np.stack([s.y for s in run])) for run in runs if run]


def bank_rule(
    bank: Sequence[Gains],
    segments: Sequence[Segment],
    *,
    edges: Collection[str] = (),
    smoothing_s: float = _SMOOTHING_S,
    settle_s: float = SETTLE_S,
    noise: NDArray[np.float64] | None = None,
    washouts: Mapping[str, float] | None = None,
) -> BankRule:
    """Return the isolation stage of a bank, from the residuals of its hypotheses in healthy flight.

    ``edges`` names the faults that are watched for edges instead of compared; of each segment the first ``settle_s``
    is left out; ``noise`` (p,) of the outputs, where given, keeps a residual that a sensor fault takes up altogether
    from counting for more than a tenth of it; ``washouts`` are the rule's.

    The covariances are taken about zero; the floor of the score is the largest one that the best hypothesis leaves
    unexplained in healthy flight, with a margin.
    """
    observer, settled = AffineObserver(bank), round(settle_s * bank[0].rate_hz)
    keep = float(np.exp(-1.0 / (smoothing_s * bank[0].rate_hz)))
    smoothed = []
    for segment in segments:
        raw = observer.run(segment.u, segment.y, restart=np.arange(len(segment.u)) == 0).residual
        smoothed.append(lfilter([1.0 - keep], [1.0, -keep], raw, axis=0)[settled:])
    residuals = list(np.moveaxis(np.concatenate(smoothed), 1, 0))
    watched = tuple(any(name in edges for name in one.faults) for one in bank)
    least = 0.0 if noise is None else np.diag((_NOISE_SHARE * noise) ** 2)
    covariances = tuple(found.T @ found / len(found) + least for found in residuals)
    scores = [
        np.linalg.norm(found @ W.T, axis=1)
        for found, W, edge in zip(residuals, whitening(covariances), watched, strict=True)
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
    )


def healthy_maxima(
    profile: Profile, flights: Sequence[Sequence[GatedSample]], raise_s: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Step the profile's first observer over healthy samples as the monitor does.

    Returns
    -------
    worst : NDArray[np.float64]
        For each fault the largest size that stood for ``raise_s`` (a,).
    typical : NDArray[np.float64]
        Median command of each input (s,).
    """
    observer = profile.observers[0]
    width = max(1, round(raise_s * observer.rate_hz))
    worst = np.zeros(len(observer.faults))
    for flight in flights:
        chain = ObserverChain(observer, profile.name, profile.gate, VehicleClock())
        sizes = [
            np.abs(output.isolated) if output.armed else np.zeros(len(worst))
            for sample, armed in flight
            for output in chain.step(sample, armed)
            if isinstance(output, Estimate)
        ]
        if len(sizes) >= width:
            stood = np.lib.stride_tricks.sliding_window_view(np.stack(sizes), width, axis=0).min(axis=-1)
            worst = np.maximum(worst, stood.max(axis=0))
    commands = [sample.u for flight in flights for sample, armed in flight if armed]
    return worst, np.asarray(np.median(np.stack(commands), axis=0))


def settling_s(bank: Sequence[Gains]) -> float:
    """Return how long the slowest observer takes to forget all but a hundredth of its initial error."""
    slowest = max(float(gains.report["poles_max_abs"]) for gains in bank)
    if not 0.0 < slowest < 1.0:
        return SETTLE_S
    return round(min(_LONGEST_SETTLE_S, math.log(100.0) / -math.log(slowest) / bank[0].rate_hz), 2)
