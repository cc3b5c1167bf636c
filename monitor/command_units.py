"""Fault estimates of actuators in the units of commands, at a command smoothed like the estimates."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from monitor.core.observers import CommandScale
from monitor.estimation.isolation_rule import keep_share
from monitor.profile import ObserverProfile


class CommandRun(NamedTuple):
    """n samples in command units: fault, isolated and sd (n, a); the smoothed command that each fault scales (n,)."""

    fault: NDArray[np.float64]
    isolated: NDArray[np.float64]
    sd: NDArray[np.float64]
    commands: Mapping[int, NDArray[np.float64]]


class CommandUnits:
    """Takes fault estimates from effect units to command units at the smoothed command.

    Parameters
    ----------
    profile : ObserverProfile
        Gives the input curves, which fault scales which input, and the smoothing of the estimates, which the
        command has to share for their ratio to mean anything.
    """

    def __init__(self, profile: ObserverProfile) -> None:
        gains = profile.gains[0]
        inputs = sorted({channel.input for channel in profile.faults if channel.input is not None})
        channel = [-1 if fault.input is None else inputs.index(fault.input) for fault in profile.faults]
        self._scale = CommandScale(
            gains.input_curves,
            np.array(inputs, np.intp),
            np.array(channel, np.intp),
            keep_share(profile.isolation.smoothing_s, gains.rate_hz),
        )
        self._channels = [(fault, entry) for fault, entry in enumerate(channel) if entry >= 0]

    def run(
        self,
        u: NDArray[np.float64],
        restart: NDArray[np.bool_],
        fault: NDArray[np.float64],
        evidence: NDArray[np.float64],
        sd: NDArray[np.float64],
    ) -> CommandRun:
        """Return n samples in command units where a fault scales an input; the smoothed command restarts at its own.

        Parameters
        ----------
        u : NDArray[np.float64]
            Commands (n, s).
        restart : NDArray[np.bool_]
            Which samples restart (n,).
        fault, evidence, sd : NDArray[np.float64]
            Fault estimates, evidence, and one standard deviation of the estimates (n, a), effect units.
        """
        scaled, isolated, deviation, commands = self._scale.run(u, restart.view(np.uint8), fault, evidence, sd)
        return CommandRun(scaled, isolated, deviation, {index: commands[entry] for index, entry in self._channels})
