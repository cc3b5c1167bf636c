"""The effectiveness estimators of one observer: fed with samples that are evidence, silent on all others.

They begin anew with the observer, and where evidence was missing for longer than their longest memory.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from adapters.sample import Sample
from monitor.effectiveness import Effectiveness, EffectivenessEstimator, EffectivenessRule
from monitor.profile import FaultChannel

_ABSURD = 1e6
"""Effects are near 1; what a network sends need not be."""


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


def _known(evidence: float | None, last: float) -> float:
    return last if evidence is None else evidence
