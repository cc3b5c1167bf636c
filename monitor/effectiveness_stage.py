"""The effectiveness estimators of one observer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from adapters.sample import Samples
from monitor.estimation.effectiveness import EffectivenessEstimator, EffectivenessRule, EffectivenessRun
from monitor.profile import FaultChannel


class EffectivenessStage:
    """Estimators of the faults that are read against their actuators' deflection.

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

    def run(
        self, samples: Samples, fault: NDArray[np.float64], armed: NDArray[np.bool_]
    ) -> dict[int, EffectivenessRun]:
        """Process n samples; return the effectiveness of each of these faults' actuators, by index of the fault.

        Parameters
        ----------
        samples : Samples
            Give commands and the effects of full deflections.
        fault : NDArray[np.float64]
            Fault estimates in effect units, not smoothed (n, a).
        armed : NDArray[np.bool_]
            Whether each sample is evidence (n,).
        """
        return {
            index: estimator.run(
                samples.vehicle_time_ns,
                samples.restart,
                armed,
                fault[:, index],
                samples.u[:, command],
                np.ones(len(samples)) if full is None else samples.u[:, full],
            )
            for index, command, full, estimator in self._channels
        }
