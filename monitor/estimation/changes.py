"""Faults that begin suddenly: the likelihood ratio of a loss of an actuator against health, sample by sample.

The observer's estimates answer within tenths of a second, its evidence has to stand; a sudden loss is certain after a
few samples. The one-step innovation nu of the fitted model is coloured and its variance grows with what the model knows
least; both are fitted to healthy flights:

    e(k) = nu(k) - sum_i Phi_i nu(k - i)                                   whitened by a vector autoregression
    sigma_i^2 = (c_0 + c_1 r_i^2 + c_2 d_i^2) lambda_i                     r, d: largest output and change of the
    z_i = e_i / sigma_i                                                    commanded effect over ``HOLD_S``

lambda, 1 or more, follows the mean of e^2 over its healthy variance: in gusts that no fitted flight had it grows.

A row longer than ``clip`` is shortened, with the signatures of all hypotheses: it counts as one of larger noise. For
hypothesis j, begun at t_0, the signature s_j(k) is the response of z to a whole loss of actuator j since t_0 (or to a
sensor that reads 1 too much since t_0), through lag, model and the same filters, and

    g_j = max over t_0 of (sum s_j' z)^2 / (2 sum s_j' s_j),    theta_j = sum s_j' z / sum s_j' s_j

is the logarithm, in nats, of how much likelier the data are with it than in health; theta_j is the share lost. The
actuator with the largest g_j is named where it is far enough ahead of all others, sensors among them, and explains most
of what the window holds (:mod:`monitor.core.changes`). The observer says how large the fault is afterwards.

Sources: Willsky and Jones, IEEE Trans. Automatic Control 21(1), 1976; Lai, IEEE Trans. Information Theory 44(7), 1998.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapters.sample import Samples
from adapters.toml_tables import Table
from gains.plants.plant import Plant
from gains.synthesis.compilation import input_curves
from monitor.core.changes import ChangeTest
from monitor.estimation.excitation import HOLD_S

WINDOW_S = 2.0
"""Onsets that are tried. Slower faults are the slow path's, whose mean is as long (slow_s of AlarmRule)."""
LEVEL_S = 3.0
"""Time constant of the noise's own level. Chosen: longer than the window, so that a fault cannot raise it before it is
seen, and shorter than weather changes."""
CLIP = 15.0
"""Length of z from which a row counts as one of larger noise: no two rows can then raise an alarm (theory 5.1 (3))."""


@dataclass(frozen=True, slots=True, eq=False)
class ChangeRule:
    """What healthy flights say about the innovations of an observer.

    Parameters
    ----------
    outputs : tuple[str, ...]
        The p outputs that are judged.
    whitening : NDArray[np.float64]
        Phi_1 ... Phi_P (P, p, p).
    variance : NDArray[np.float64]
        c_0, c_1 and c_2 of each (p, 3).
    """

    outputs: tuple[str, ...]
    whitening: NDArray[np.float64]
    variance: NDArray[np.float64]


class ChangeRun(NamedTuple):
    """What the test says of n samples."""

    named: NDArray[np.intp]  # index of the fault that is named (n,), -1 where none is
    nats: NDArray[np.float64]  # its log-likelihood ratio (n,)
    size: NDArray[np.float64]  # its size, in the unit of the input that it scales (n,)
    onset_ns: NDArray[np.int64]  # vehicle time of its onset (n,)


def read_changes(table: Table, outputs: Sequence[str]) -> ChangeRule:
    """Return the rule of an observer's table ``changes``; mistakes are recorded in its file."""
    judged = table.texts("outputs")
    for name in judged:
        if name not in outputs:
            table.mistake("outputs", f"has '{name}'; the observer has {', '.join(outputs)}")
    p, order = len(judged), table.integer("order", at_least=1)
    stacked = table.matrix("whitening", order * p, p)
    variance = table.matrix("variance", p, 3)
    if table.good("variance") and not ((variance >= 0.0).all() and (variance[:, 0] > 0.0).all()):
        table.mistake("variance", "has a negative entry, or none that is constant")
    table.done()
    return ChangeRule(judged, stacked.reshape(-1, p, p), variance)


def changes_table(rule: ChangeRule) -> dict[str, Any]:
    """Return the table that :func:`read_changes` reads back as the same rule."""
    return {
        "outputs": list(rule.outputs),
        "order": len(rule.whitening),
        "whitening": np.concatenate(rule.whitening).tolist(),
        "variance": rule.variance.tolist(),
    }


def change_test(plant: Plant, rate_hz: float, actuators: Sequence[int], rule: ChangeRule) -> ChangeTest:
    """Return the test of a plant whose outputs are its states, for faults that scale these inputs."""
    judged = [plant.outputs.index(name) for name in rule.outputs]
    return ChangeTest(
        dynamics=np.column_stack([plant.A, plant.B, plant.c])[judged],
        curves=input_curves(plant),
        taps=np.array(plant.taps),
        judged=judged,
        actuators=actuators,
        whitening=rule.whitening,
        variance=rule.variance,
        hold=round(HOLD_S * rate_hz),
        window=round(WINDOW_S * rate_hz),
        clip=CLIP,
        level_rows=LEVEL_S * rate_hz,
    )


class ChangeStage:
    """The test as one stage of an observer's chain.

    ``inputs`` has the index of the input that each fault of the observer scales, None where it scales none.
    """

    def __init__(self, plant: Plant, rate_hz: float, inputs: Sequence[int | None], rule: ChangeRule) -> None:
        self._faults = np.array([fault for fault, source in enumerate(inputs) if source is not None], np.intp)
        self._inputs = np.array([source for source in inputs if source is not None], np.intp)
        self._step_ns = 1e9 / rate_hz
        self._test = change_test(plant, rate_hz, self._inputs.tolist(), rule)

    def run(self, samples: Samples, armed: NDArray[np.bool_], believed: NDArray[np.float64]) -> ChangeRun:
        """Process n samples; ``armed`` says which are evidence (n,), ``believed`` each fault's size (n, a)."""
        usable = samples.measured & samples.complete
        named, nats, share, age = self._test.run(
            samples.u, samples.y, usable, samples.restart, armed, believed[:, self._faults]
        )
        commands = samples.u[np.arange(len(named)), self._inputs[named]]
        onset_ns = samples.vehicle_time_ns - np.round(age * self._step_ns).astype(np.int64)
        fault = np.where(named < 0, -1, self._faults[named])
        return ChangeRun(fault, nats, -share * commands, onset_ns)
