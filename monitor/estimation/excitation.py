"""The accuracy of an observer's model at each sample: its errors grow with the motion that excites them.

A model that is a few per cent wrong makes errors of a few per cent of the vehicle's motion. In a calm hover that is
nothing, in a flip it is more than any fault. The deviation of an actuator's estimate is therefore taken to be

    s^2 = max(1, max(1, lambda) (c_0 + c_1 r^2 + c_2 d^2) + c_3 lambda + b_1 (r^2 - R^2)+ + b_2 (d^2 - D^2)+)

times its threshold, with lambda the level of the run's own residuals (:mod:`monitor.estimation.bank`), r the largest
output (body rate) and d the largest change of a command from one sample to the next, over the last ``HOLD_S``. The c
are fitted to the estimates of healthy flight, in which r reached R and d reached D: c_3 is what gusts bring, which the
residuals show, so that a calm flight has smaller thresholds than a gusty one of the same fit. Beyond R and D nothing is
known of this vehicle, and b, measured on others, is added: sizes that raise an alarm grow by themselves if a flight is
livelier than those that were fitted.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from math import ceil
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adapters.sample import Samples
from adapters.toml_tables import Table
from monitor.core.excitation import Excitation
from monitor.estimation.envelope import WORTH_SAYING, furthest_text, outside_text

HOLD_S = 0.3
"""Time for which motion counts after it has ended, seconds: model error outlasts its cause, and rates that decay and
rotors that spin down take about as long (theory 5.1)."""


@dataclass(frozen=True, slots=True)
class ExcitationRule:
    """Coefficients of s^2, and the outputs whose size counts."""

    outputs: tuple[str, ...]  # the outputs
    constant: float  # c_0, c_1 (per squared output) and c_2 (per squared change of a command)
    output: float
    command: float
    output_beyond: float  # b_1 and b_2
    command_beyond: float
    output_fitted: float  # r and D, in the units of the outputs and the commands
    command_fitted: float
    residuals: float = 0.0  # c_3, per level of the residuals
    # largest mean command and strength of gusts (root of lambda) of the fitted flights, for people to be told; 0: not
    # known
    throttle_fitted: float = 0.0
    gusts_fitted: float = 0.0


_NUMBERS = tuple(key.name for key in fields(ExcitationRule) if key.name != "outputs")
_LATER = ("residuals", "throttle_fitted", "gusts_fitted")
"""Numbers that earlier profiles do not have."""


def judged_outputs(table: Table, outputs: Sequence[str]) -> tuple[str, ...]:
    """Return the ``outputs`` that a rule's table names; one that the observer does not have is a mistake."""
    judged = table.texts("outputs")
    for name in judged:
        if name not in outputs:
            table.mistake("outputs", f"has '{name}'; the observer has {', '.join(outputs)}")
    return judged


def read_excitation(table: Table, outputs: Sequence[str]) -> ExcitationRule:
    """Return the rule of an observer's table ``excitation``; mistakes are recorded in its file."""
    judged = judged_outputs(table, outputs)
    numbers = {key: table.number(key, 0.0 if key in _LATER else None, at_least=0.0) for key in _NUMBERS}
    table.done()
    return ExcitationRule(judged, **numbers)


def excitation_table(rule: ExcitationRule) -> dict[str, Any]:
    """Return the table that :func:`read_excitation` reads back as the same rule."""
    return {"outputs": list(rule.outputs)} | {key: getattr(rule, key) for key in _NUMBERS}


# What excites the noise: its name, the unit in which people read it, and how many of these a 1 is.
_SIZES = (
    ("rate", "rad/s", 1.0),
    ("change of a command", "%", 100.0),
    ("throttle", "%", 100.0),
    ("gusts", "times the usual", 1.0),
)


class ExcitationStage:
    """Scale of an observer's evidence, sample by sample."""

    def __init__(self, rule: ExcitationRule, outputs: Sequence[str], inputs: int, rate_hz: float) -> None:
        judged = [outputs.index(name) for name in rule.outputs]
        numbers = np.array([getattr(rule, key) for key in _NUMBERS])
        # as many samples as last HOLD_S, and the one at which a change of commands shows
        self._core = Excitation(judged, numbers, ceil(HOLD_S * rate_hz) + 1, inputs, WORTH_SAYING)
        self._fitted = rule.output_fitted, rule.command_fitted, rule.throttle_fitted, rule.gusts_fitted
        self._rate_hz = rate_hz

    def run(self, samples: Samples, level: NDArray[np.float64]) -> NDArray[np.float64]:
        """Process n samples whose residuals have some level (n,).

        Returns
        -------
        NDArray[np.float64]
            r, d, s, and the factor by which r or d exceeds the fitted flights, 1 inside of them (n, 4).
        """
        return self._core.run(samples.u, samples.y, samples.restart, level)

    @property
    def outside(self) -> str | None:
        """The excess of the last ``HOLD_S`` over the fitted flights, for people; None if there is none."""
        *sizes, scale = self._core.newest
        return outside_text(self._sizes(sizes), scale)

    @property
    def furthest(self) -> tuple[float, str] | None:
        """For how long, seconds, and how far a run was outside of the fitted flights; None if it was not."""
        sizes, seconds = self._sizes(self._core.furthest), self._core.rows / self._rate_hz
        return furthest_text(sizes, seconds, "only larger faults are detected there")

    def _sizes(self, sizes: Sequence[float]) -> Iterator[tuple[str, float, float, str]]:
        for (name, unit, scale), now, fitted in zip(_SIZES, sizes, self._fitted, strict=True):
            yield name, scale * now, scale * fitted, unit
