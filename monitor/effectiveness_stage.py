"""The effectiveness estimators of one observer: fed with samples that are evidence, silent on all others.

They begin anew with the observer, and where evidence was missing for longer than their longest memory.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from adapters.sample import Sample, Samples
from monitor.estimation.effectiveness import Effectiveness, EffectivenessEstimator, EffectivenessRule
from monitor.profile import FaultChannel

_ABSURD = 1e6
"""Effects are near 1; what a network sends need not be."""


Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class EffectivenessRun:
    """What is known about one of the faults after each sample of a stretch.

    Parameters
    ----------
    evidence : Array
        Evidence of the verdict (n,), not a number where it is None or there is no verdict.
    share : Array
        Its share (n,), not a number where there is none.
    size : Array
        Evidence last known (n,), as ``EffectivenessStage.sizes``.
    """

    evidence: Array
    share: Array
    size: Array


class EffectivenessStage:
    """State of the estimators.

    Parameters
    ----------
    rules : Mapping[str, EffectivenessRule]
        Rule of each fault that is read this way.
    faults : Sequence[FaultChannel]
        The observer's fault channels, in the order of its estimates.
    inputs : Sequence[str]
        Names of its inputs.
    rate_hz : float
        Samples per second.

    Attributes
    ----------
    sizes : dict[int, float]
        Evidence last known of each of these faults, by index: while one can neither be confirmed nor dropped it
        stays, without evidence it is zero.
    """

    def __init__(
        self,
        rules: Mapping[str, EffectivenessRule],
        faults: Sequence[FaultChannel],
        inputs: Sequence[str],
        rate_hz: float,
    ) -> None:
        self._channels = [
            (
                index,
                channel.input,
                None if (full := rules[channel.name].full) is None else inputs.index(full),
                EffectivenessEstimator(rules[channel.name], rate_hz),
            )
            for index, channel in enumerate(faults)
            if channel.name in rules and channel.input is not None
        ]
        self._heard_ns: dict[int, int] = {}
        self.sizes = {index: 0.0 for index, *_ in self._channels}

    def judge(self, sample: Sample, fault: NDArray[np.float64], armed: bool) -> dict[int, Effectiveness]:
        """Take one sample; return what is known about each of the faults, by index, none where it is no evidence.

        Parameters
        ----------
        sample : Sample
            Gives commands and the effects of full deflections.
        fault : NDArray[np.float64]
            Fault estimates in effect units, not smoothed (a,).
        armed : bool
            Whether the sample is evidence.
        """
        found = {}
        for index, command, full, estimator in self._channels:
            effects = (
                float(fault[index]),
                float(sample.u[command]),
                1.0 if full is None else float(sample.u[full]),
            )
            now, last = sample.vehicle_time_ns, self._heard_ns.get(index)
            anew = sample.restart or last is None or now - last > estimator.rule.memories_s[-1] * 1e9
            if not armed or not all(abs(effect) < _ABSURD for effect in effects):
                if anew:
                    self._heard_ns.pop(index, None)
                    self.sizes[index] = 0.0
                else:
                    estimator.skip()
                continue
            if anew:
                estimator.restart()
            self._heard_ns[index] = now
            found[index] = estimator.update(*effects)
            self.sizes[index] = _known(found[index].evidence, self.sizes[index])
        return found

    def run(self, samples: Samples, fault: Array, armed: Flags) -> dict[int, EffectivenessRun]:
        """Take a stretch as :meth:`judge` takes samples one by one, to the same bits: a test holds them together.

        Parameters
        ----------
        samples : Samples
            The samples.
        fault : Array
            Fault estimates in effect units (n, a).
        armed : Flags
            Whether each sample is evidence (n,).
        """
        if not len(samples):
            return {index: EffectivenessRun(*np.zeros((3, 0))) for index in self.sizes}
        with np.errstate(all="ignore"):
            return {
                index: self._run(
                    index,
                    estimator,
                    samples,
                    (
                        fault[:, index],
                        samples.u[:, command],
                        np.ones(len(samples)) if full is None else samples.u[:, full],
                    ),
                    armed,
                )
                for index, command, full, estimator in self._channels
            }

    def _run(
        self,
        index: int,
        estimator: EffectivenessEstimator,
        samples: Samples,
        effects: tuple[Array, Array, Array],
        armed: Flags,
    ) -> EffectivenessRun:
        """Take a stretch of one fault."""
        heard = armed & np.all([np.abs(effect) < _ABSURD for effect in effects], axis=0)
        anew = self._anew(index, samples, heard, estimator.rule.memories_s[-1] * 1e9)
        evidence, share = np.full(len(samples), np.nan), np.full(len(samples), np.nan)
        followed = np.flatnonzero(heard | ~anew)
        begins = np.flatnonzero((heard & anew)[followed]).tolist()
        for start, stop in pairwise([0, *begins, len(followed)]):
            rows = followed[start:stop]
            if not len(rows):
                continue
            if anew[rows[0]]:
                estimator.restart()
            fault, command, full = (effect[rows] for effect in effects)
            evidence[rows], share[rows] = estimator.run(fault, command, full, heard[rows])
        said = np.where(heard, evidence, np.where(anew, 0.0, np.nan))
        last = np.maximum.accumulate(np.where(np.isnan(said), -1, np.arange(len(said))))
        size = np.where(last < 0, self.sizes[index], said[last])
        self.sizes[index] = float(size[-1])
        return EffectivenessRun(evidence, share, size)

    def _anew(self, index: int, samples: Samples, heard: Flags, limit_ns: float) -> Flags:
        """Return where all begins anew, or would if the sample were heard; note when the fault was heard last."""
        rows, times_ns = np.arange(len(heard)), samples.vehicle_time_ns
        last = np.maximum.accumulate(np.where(heard, rows, -1))
        before = np.concatenate([[-1], last[:-1]])
        last_ns = np.where(before < 0, self._heard_ns.get(index, 0), times_ns[before])
        anew = samples.restart | (times_ns - last_ns > limit_ns)
        if index not in self._heard_ns:
            anew |= before < 0
        forgotten = np.maximum.accumulate(np.where(anew, rows, -1))
        anew[1:] |= forgotten[:-1] > before[1:]
        if anew[-1] and not heard[-1]:
            self._heard_ns.pop(index, None)
        elif last[-1] >= 0:
            self._heard_ns[index] = int(times_ns[last[-1]])
        return anew


def _known(evidence: float | None, last: float) -> float:
    return last if evidence is None else evidence
