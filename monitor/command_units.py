"""Fault estimates of actuators in the units of commands, at a command smoothed like the estimates."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from monitor.estimation.input_curve import fault_in_command
from monitor.profile import ObserverProfile
from monitor.sampling.stretch import first_order


class CommandRun(NamedTuple):
    """A stretch in command units: fault, isolated and sd (n, a); the smoothed command that each fault scales (n,)."""

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
        self._curves = gains.input_curves
        pairs = [(i, channel.input) for i, channel in enumerate(profile.faults) if channel.input is not None]
        self._faults = np.array([fault for fault, _ in pairs], dtype=np.intp)
        self._inputs = np.array([source for _, source in pairs], dtype=np.intp)
        self._input_of = dict(pairs)
        smoothing_s = profile.isolation.smoothing_s
        self._keep = float(np.exp(-1.0 / (smoothing_s * gains.rate_hz))) if smoothing_s > 0 else 0.0
        self._u = np.zeros(len(gains.inputs))

    def restart(self, u: NDArray[np.float64]) -> None:
        """Start the smoothed command at ``u`` (s,)."""
        self._u[:] = u

    def follow(self, u: NDArray[np.float64]) -> None:
        """Take the command of one sample (s,)."""
        self._u *= self._keep
        self._u += (1.0 - self._keep) * u

    def convert(self, faults: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return rows of fault estimates (k, a) in command units where a fault scales an input."""
        if len(self._faults):
            faults[:, self._faults] = fault_in_command(
                faults[:, self._faults], self._u[self._inputs], self._curves[self._inputs]
            )
        return faults

    def run(
        self,
        u: NDArray[np.float64],
        restart: NDArray[np.bool_],
        fault: NDArray[np.float64],
        evidence: NDArray[np.float64],
        sd: NDArray[np.float64],
    ) -> CommandRun:
        """Take a stretch: restart, follow and convert for each sample, to the same bits; a test holds them together.

        Parameters
        ----------
        u : NDArray[np.float64]
            Commands (n, s).
        restart : NDArray[np.bool_]
            Which samples start afresh (n,).
        fault, evidence, sd : NDArray[np.float64]
            Fault estimates, what is held responsible, and one standard deviation of the estimates (n, a), effect units.
        """
        rows = np.stack([fault, evidence, fault + sd])
        smoothed = {
            source: self._smoothed(source, u[:, source], restart) for source in sorted(set(self._input_of.values()))
        }
        if len(self._faults) and len(u):
            commands = np.column_stack([smoothed[source] for source in self._inputs.tolist()])
            rows[..., self._faults] = fault_in_command(rows[..., self._faults], commands, self._curves[self._inputs])
        of_fault = {index: smoothed[source] for index, source in self._input_of.items()}
        return CommandRun(rows[0], rows[1], np.abs(rows[2] - rows[0]), of_fault)

    def _smoothed(self, source: int, u: NDArray[np.float64], restart: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return one smoothed command after each sample; those that no fault scales are nobody's business."""
        parts = []
        for start, stop in pairwise([0, *np.flatnonzero(restart).tolist(), len(u)]):
            if start == stop:
                continue
            before = float(u[start] if restart[start] else self._u[source])
            parts.append(first_order(self._keep, (1.0 - self._keep) * u[start:stop], before))
            self._u[source] = parts[-1][-1]
        return np.concatenate(parts) if parts else np.zeros(0)

    def command(self, index: int) -> float | None:
        """Return the smoothed command that a fault scales, None where it scales none."""
        source = self._input_of.get(index)
        return None if source is None else float(self._u[source])
