"""A compiled observer as matrices for runs over arrays: what drives its state, what it says, its nonlinearities.

    nu = arguments [s; w]        [s+; x^; fa^; fs^; yt] = step [s; w; g(nu)],        w = [v; y; 1]

the recursion of :mod:`monitor.estimation.observer` with its estimates in the order in which they are given out.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gains.plants.expression import parse_expression
from gains.plants.postfix import Program, postfix
from gains.synthesis.gains_file import Gains


class ObserverRun(NamedTuple):
    """Estimates over N samples: x (N, n), fault (N, a1 + a2) and residual (N, p)."""

    x: NDArray[np.float64]
    fault: NDArray[np.float64]
    residual: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Recursion:
    """Matrices of one observer.

    Parameters
    ----------
    gains : Gains
        The gains that they are of.
    step : NDArray[np.float64]
        (ns + n + a + p, ns + nw + m).
    arguments : NDArray[np.float64]
        (arguments, ns + nw).
    nonlinearities : tuple[Program, ...]
        The m nonlinearities, of their own arguments each.
    spans : tuple[slice, ...]
        Where the arguments of each stand in nu.
    ns, nw : int
        Sizes of s and w.
    """

    gains: Gains
    step: NDArray[np.float64]
    arguments: NDArray[np.float64]
    nonlinearities: tuple[Program, ...]
    spans: tuple[slice, ...]
    ns: int
    nw: int

    def split(self, estimates: NDArray[np.float64]) -> ObserverRun:
        """Return estimates (N, n + a + p) by what they are, as views."""
        x, fault, residual = np.split(
            estimates, np.cumsum([len(self.gains.states), len(self.gains.faults)]).tolist(), axis=1
        )
        return ObserverRun(x, fault, residual)


def recursion_of(gains: Gains) -> Recursion:
    """Return the matrices of an observer for runs over arrays."""
    s, p, n, a = len(gains.inputs), len(gains.outputs), len(gains.states), len(gains.faults)
    a1 = gains.fault_kinds.count("actuator")
    ns = len(gains.step_matrix) - n - a - p
    fs = ns + n + np.arange(a - a1)
    fa = ns + n + a - a1 + np.arange(a1)
    rows = np.concatenate([np.arange(ns + n), fa, fs, ns + n + a + np.arange(p)])
    return Recursion(
        gains=gains,
        step=gains.step_matrix[rows],
        arguments=gains.argument_matrix,
        nonlinearities=tuple(postfix(parse_expression(g.expression, g.arguments)) for g in gains.nonlinearities),
        spans=argument_spans(gains),
        ns=ns,
        nw=s + p + 1,
    )


def argument_spans(gains: Gains) -> tuple[slice, ...]:
    """Return where the arguments of each nonlinearity stand in nu."""
    ends = np.cumsum([0, *(len(g.arguments) for g in gains.nonlinearities)]).tolist()
    return tuple(slice(start, stop) for start, stop in pairwise(ends))
