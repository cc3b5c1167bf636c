"""Detect faults that begin suddenly: the likelihood ratio of a loss of an actuator against health, sample by sample.

The observer's estimates answer within tenths of a second and its evidence has to last; a sudden loss is certain after a
few samples. The one-step innovation nu of the fitted model is coloured, and its variance grows with the motion that the
model describes worst; both are fitted to healthy flights:

    e(k) = nu(k) - sum_i Phi_i nu(k - i)                                   whitened by a vector autoregression
    sigma_i^2 = (c_0 + c_1 r_i^2 + c_2 d_i^2 + c_3 w^2) lambda_i           r, d: largest output and change of the
    z_i = e_i / sigma_i,   w = sum_i r_i^2                                 commanded effect over ``HOLD_S``

A linear model lacks the products of body rates, of which the torque of a turning body consists, omega x J omega; that
about one axis is large while the others turn, however still it is itself. w bounds all of them.

lambda, at least 1, follows the mean of e^2 over its healthy variance: it grows in gusts that no fitted flight had.

A row longer than ``clip`` is shortened, with the signatures of all hypotheses: it counts as a row of larger noise. For
hypothesis j, begun at t_0, the signature s_j(k) is the response of z, through lag, model and the same filters, to one
of these faults since t_0: a whole loss of actuator j, before its lag or behind it (a broken propeller); a loss that
grows by the whole each second; a sensor that reads 1 too much, or 1 more each second. Then

    g_j = max over t_0 of (sum s_j' z)^2 / (2 sum s_j' s_j),    theta_j = sum s_j' z / sum s_j' s_j

g_j is the logarithm, in nats, of the likelihood of the data under the hypothesis over that in health. theta_j is the
share lost; its standard deviation is 1 / sqrt(sum s_j' s_j), times the factor by which the rest of z exceeds noise
(Birge's ratio). A loss begins between two samples: with onsets on samples alone, a loss of 10 % read 5.6 % for three
samples and one of 20 % read 30 %, so t_0 is fitted, too. The actuator with the largest g_j is named if it is far enough
ahead of all others, sensors among them, and explains most of the window (:mod:`monitor.core.changes`). A loss grows if
that explains it better than any sudden one. The observer tells the size of the fault afterwards.

An output that is no state is predicted from as many samples as its block of the model has states: with the block's
characteristic polynomial, z^n + a_1 z^(n-1) + ... + a_n, sum_l a_l y(k - l) depends on inputs alone (Cayley, Hamilton).

Sources: Willsky and Jones, IEEE Trans. Automatic Control 21(1), 1976; Lai, IEEE Trans. Information Theory 44(7), 1998.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapters.sample import Samples
from adapters.toml_tables import Table
from gains.plants.plant import FloatArray, Plant, padded_curves
from monitor.core.changes import ChangeTest
from monitor.estimation.excitation import HOLD_S, judged_outputs

WINDOW_S = 2.0
"""Span of the onsets that are tried, seconds. Slower faults belong to the slow path, whose mean is as long (slow_s of
AlarmRule)."""
LEVEL_S = 3.0
"""Time constant of the noise's own level. Chosen: longer than the window, so that a fault cannot raise it before it is
detected, and shorter than weather changes."""
CLIP = 15.0
"""Length of z above which a row counts as one of larger noise: no two rows can then raise an alarm (theory 5.1 (3))."""


_LARGEST_COMMAND = 10.0
"""Largest command that is accepted. Commands are shares of full command, near 1; a larger one comes from a broken
sender. Chosen: far above full command."""


@dataclass(frozen=True, slots=True, eq=False)
class ChangeRule:
    """The noise of an observer's innovations in healthy flights."""

    outputs: tuple[str, ...]  # the p outputs that are judged
    whitening: NDArray[np.float64]  # Phi_1 ... Phi_P (P, p, p)
    variance: NDArray[np.float64]  # c_0 to c_3 of each (p, 4)
    # faults that are named although they scale no input, and how long their measurements take for a jump, seconds
    lasts_s: Mapping[str, float] = field(default_factory=dict)
    # actuators that may be off by a share of their full deflection, and the lag with which they follow, seconds
    lags_s: Mapping[str, float] = field(default_factory=dict)


class ChangeRun(NamedTuple):
    """The results of the test for n samples."""

    named: NDArray[np.intp]  # index of the fault that is named (n,), -1 if none is
    nats: NDArray[np.float64]  # its log-likelihood ratio (n,)
    # its size, its growth each second, and the standard deviation of the size (n,): of an actuator's fault the share of
    # its effect, negative for a loss
    size: NDArray[np.float64]
    growth: NDArray[np.float64]
    sd: NDArray[np.float64]
    onset_ns: NDArray[np.int64]  # vehicle time of its onset (n,)
    noise: NDArray[np.float64]  # variance of each judged output's noise relative to that of healthy flights (n, p)
    # fault that would explain it as well if actuators were as likely to deliver more (n,), -1 for none
    instead: NDArray[np.intp]


def read_changes(table: Table, outputs: Sequence[str]) -> ChangeRule:
    """Return the rule of an observer's table ``changes``; mistakes are recorded in its file."""
    judged = judged_outputs(table, outputs)
    p, order = len(judged), table.integer("order", at_least=1)
    apart = table.has("lasts_s") or table.has("lags_s")
    stacked = table.matrix("whitening", order if apart else order * p, p)
    turning = table.matrix("turning", p, 1) if table.has("turning") else np.zeros((p, 1))
    variance = np.hstack([table.matrix("variance", p, 3), turning])
    if table.good("variance", "turning") and not ((variance >= 0.0).all() and (variance[:, 0] > 0.0).all()):
        table.mistake("variance", "or 'turning' has a negative entry, or none that is constant")
    times = [table.table(key) for key in ("lasts_s", "lags_s")]
    lasts_s, lags_s = ({name: given.number(name, at_least=0.0) for name in given} for given in times)
    table.done()
    whitening = stacked[:, :, None] * np.eye(p) if apart else stacked.reshape(-1, p, p)
    return ChangeRule(judged, whitening, variance, lasts_s, lags_s)


def changes_table(rule: ChangeRule) -> dict[str, Any]:
    """Return the table that :func:`read_changes` reads back as the same rule."""
    apart = {key: dict(times) for key in ("lasts_s", "lags_s") if (times := getattr(rule, key))}
    whitening = np.diagonal(rule.whitening, axis1=1, axis2=2) if apart else np.concatenate(rule.whitening)
    return {
        "outputs": list(rule.outputs),
        "order": len(rule.whitening),
        "whitening": whitening.tolist(),
        "variance": rule.variance[:, :3].tolist(),
        **({"turning": rule.variance[:, 3:].tolist()} if rule.variance[:, 3].any() else {}),
        **apart,
    }


class ChangeStage:
    """The test as one stage of an observer's chain.

    ``inputs`` has the index of the input that each fault of the observer scales, None for a fault that scales none. The
    test names the former, or, if the rule lists them, faults that add to the outputs, which are then predicted if they
    are no states: sensors that jump, actuators that are off by a part of their deflection. ``adds`` tells which.
    """

    def __init__(self, plant: Plant, rate_hz: float, inputs: Mapping[str, int | None], rule: ChangeRule) -> None:
        added = [*rule.lasts_s, *rule.lags_s]
        named = added or [name for name, source in inputs.items() if source is not None]
        sources = [] if added else [inputs[name] for name in named]
        judged = [plant.outputs.index(name) for name in rule.outputs]
        n = len(plant.outputs)
        common: dict[str, Any] = {
            "whitening": rule.whitening,
            "variance": rule.variance,
            "hold": round(HOLD_S * rate_hz),
            "window": round(WINDOW_S * rate_hz),
            "clip": CLIP,
            "level_rows": LEVEL_S * rate_hz,
            "rate_hz": rate_hz,
            "faults": [list(inputs).index(name) for name in named],
            "judged": judged,
            "actuators": [source for source in sources if source is not None],
        }
        if added:
            self._depth, additions = _additions(plant, rate_hz, rule, tuple(named), tuple(judged))
            self._test = ChangeTest(
                **additions._asdict(),
                curves=np.ones((self._depth * len(plant.inputs), 1)),
                bends=np.zeros((0, self._depth * len(plant.inputs), 1)),
                taps=np.ones(1),
                driven=True,
                largest=np.inf,
                **common,
            )
        else:
            self._depth, self._test = 1, _actuators_test(plant, rule, len(named), judged, common)
        self._rate_hz, self.adds, self._partly = rate_hz, bool(added), bool(rule.lasts_s)
        self._u, self._y = np.zeros((1, len(plant.inputs))), np.zeros((1, n))
        self._judged, self._usable = judged, np.zeros((1, len(judged)), np.bool_)
        self._all = np.ones(len(judged), np.bool_)
        # the judged output whose noise is that of a sensor's fault, by the index of the fault
        self.noisy = {
            list(inputs).index(fault.name): judged.index(output)
            for fault in plant.faults
            if fault.kind == "sensor" and fault.name in rule.lasts_s
            for output in np.flatnonzero(fault.column).tolist()
            if output in judged
        }

    def innovations(self, samples: Samples) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
        """Return what the noise is fitted to: innovations (n, p), r and d (n, 2 p), and where they are known (n,)."""
        return self._test.innovations(*self._given(samples))

    def run(
        self,
        samples: Samples,
        armed: NDArray[np.bool_],
        believed: NDArray[np.float64],
        asked: NDArray[np.float64] | None = None,
        ahead: FloatArray | None = None,
    ) -> ChangeRun:
        """Process n samples; ``armed`` tells which are evidence (n,), ``believed`` each fault's size (n, a).

        With ``asked`` (n,) samples name nothing that has fewer nats: that costs a small part of the time for all names.
        With ``ahead``, y of the sample after each (n, p), that later sample is judged, a sample sooner.
        """
        times_ns = samples.vehicle_time_ns
        if ahead is not None:
            samples, times_ns = replace(samples, y=ahead), times_ns + round(1e9 / self._rate_hz)
        given = self._given(samples)
        return ChangeRun(*self._test.run(*given, times_ns, armed, believed, asked, ahead is not None))

    def _given(self, samples: Samples) -> tuple[FloatArray, FloatArray, NDArray[np.bool_], NDArray[np.bool_]]:
        """Return u and y with those of the samples before beside them, as far as the prediction needs them."""
        inputs = samples.u.shape[1]
        usable = (samples.measured & samples.complete)[:, None] & self._all
        if self.adds:
            lost = samples.lost[:, inputs:]
            if self._partly:
                # A sample that is incomplete only for its lost values is complete for the rest.
                usable |= samples.measured[:, None] & lost.any(axis=1, keepdims=True)
                usable &= ~lost[:, self._judged]
            # Surfaces move all outputs.
            usable &= ~samples.lost[:, : inputs if self._partly else None].any(axis=1, keepdims=True)
        if self._depth == 1:
            return samples.u, samples.y, usable, samples.restart
        u, y = np.vstack([self._u, samples.u]), np.vstack([self._y, samples.y])
        before = np.vstack([self._usable, usable])
        self._u, self._y, self._usable = u[-1:], y[-1:], before[-1:]
        usable = usable & before[:-1] & ~samples.restart[:, None]
        return np.hstack([u[1:], u[:-1]]), np.hstack([y[1:], y[:-1]]), usable, samples.restart


def _actuators_test(
    plant: Plant, rule: ChangeRule, named: int, judged: Sequence[int], common: Mapping[str, Any]
) -> ChangeTest:
    """Return the test of actuators: outputs are states, and jumps of them are no faults of the ``named`` ones."""
    dynamics = np.column_stack([plant.A, plant.B_r, plant.c])[judged]
    units = np.eye(len(plant.outputs))[judged]
    # A jump that a filter passes as slowly as the motors' lag, or two of them, must not be taken for a motor's fault.
    lags = [np.ones(1), taps := np.array(plant.taps), np.convolve(taps, taps)]
    depth = len(rule.whitening) + 1 + len(lags[-1])
    courses = [np.clip(np.cumsum(np.pad(lag, (0, depth - len(lag)))), 0.0, 1.0) for lag in lags]
    moved = np.concatenate([course[:, None, None] * units for course in courses], axis=1)
    jumps = moved.shape[1]
    return ChangeTest(
        dynamics=dynamics,
        curves=padded_curves(plant.curves),
        bends=plant.bends[plant.bent],
        taps=taps,
        additions=_whitened(_unpredicted(moved, dynamics[:, : len(plant.outputs)], judged), rule.whitening),
        grown=np.ones((depth, jumps)),
        owner=named + np.arange(jumps) % len(judged),
        sudden=np.ones(jumps),
        driven=False,
        largest=_LARGEST_COMMAND,
        **common,
    )


class _Additions(NamedTuple):
    """What the test of faults that add to the outputs has from plant and rule alone, as :class:`ChangeTest` says."""

    dynamics: FloatArray
    additions: FloatArray  # (D, S, p)
    grown: FloatArray  # (D, S)
    owner: list[int]
    sudden: list[bool]


# Shared as the settling time of gains: vehicles, and the trials of a fit, have the plants and rules of one profile.
@lru_cache(maxsize=64)
def _additions(
    plant: Plant, rate_hz: float, rule: ChangeRule, named: tuple[str, ...], judged: tuple[int, ...]
) -> tuple[int, _Additions]:
    """Return the number of samples from which outputs are predicted, and the model of their test."""
    blocks = [predictor(plant, output) for output in judged]
    n, depth = len(plant.outputs), max(len(block.y) for block in blocks)
    dynamics = np.zeros((len(judged), depth * (n + len(plant.inputs)) + 1))
    for row, (output, block) in enumerate(zip(judged, blocks, strict=True)):
        for lag, (y, u) in enumerate(zip(block.y, block.u, strict=True)):
            dynamics[row, lag * n + output] = y
            start = depth * n + lag * len(plant.inputs)
            dynamics[row, start : start + len(plant.inputs)] = u
        dynamics[row, -1] = block.constant
    # Faults that are not named keep others from being named in their place.
    names = [fault.name for fault in plant.faults]
    order = [*map(names.index, named), *(at for at, name in enumerate(names) if name not in named)]
    rows = np.arange(1.0, round(WINDOW_S * rate_hz) + 1.0)
    shown, grown, owner, sudden = [], [], [], []
    for at, fault in enumerate(order):
        for course, grows in _courses(rule, names[fault], rows, rate_hz):
            if (outputs := _shown(plant, fault, course)).any():
                shown.append(outputs)
                grown.append(course if grows else np.ones(len(rows)))
                owner.append(at)
                sudden.append(not grows)
    # One wrong value is nobody's fault, and a gyro that jumps is no fault of an actuator.
    for there in (rows < 2.0, rows > 0.0) if rule.lags_s else (rows < 2.0,):
        for output in judged:
            shown.append(np.outer(there, np.eye(n)[output]))
            grown.append(np.ones(len(rows)))
            owner.append(len(order))
            sudden.append(bool(there.all()))
    added = _unpredicted(np.stack(shown, axis=1), dynamics[:, : depth * n], judged)
    return depth, _Additions(dynamics, _whitened(added, rule.whitening), np.stack(grown, axis=1), owner, sudden)


def _courses(rule: ChangeRule, fault: str, rows: FloatArray, rate_hz: float) -> list[tuple[FloatArray, bool]]:
    """Return the courses that a fault may take from its onset on (D,), and which of them grow."""
    if rule.lags_s:
        # at once (a broken surface), or as fast as the servo follows
        lag = rate_hz * rule.lags_s[fault]
        return [(-np.expm1(-rows / late) if late else np.ones(len(rows)), False) for late in sorted({0.0, lag})]
    # a jump on the straight line between two measurements, or from one sample to the next, and a walk
    lines = sorted({1.0, max(1.0, rate_hz * rule.lasts_s.get(fault, 0.0))})
    return [*((np.minimum(rows / line, 1.0), False) for line in lines), (rows / rate_hz, True)]


class Predictor(NamedTuple):
    """y(k) = sum_l y_l y(k - l) + u_l' u(k - l) + constant of one output, l from 1 to the number of its states."""

    y: FloatArray  # (n,)
    u: FloatArray  # (n, s)
    constant: float


def predictor(plant: Plant, output: int) -> Predictor:
    """Return how an output follows from earlier samples, for a plant in discrete time that is linear in that output."""
    moves = np.linalg.matrix_power((plant.A != 0.0) | np.eye(len(plant.A), dtype=np.bool_), len(plant.A))
    block = np.flatnonzero((plant.C[output] != 0.0) @ moves)
    A, C = plant.A[np.ix_(block, block)], plant.C[output, block]
    a = np.asarray(np.poly(A), np.float64)
    driven = np.column_stack([plant.B[block], plant.c[block]])
    markov = [C @ np.linalg.matrix_power(A, lag) @ driven for lag in range(len(block))]
    given = np.array([sum(a[i] * markov[lag - i] for i in range(lag + 1)) for lag in range(len(block))])
    return Predictor(-a[1:], given[:, :-1], float(given[:, -1].sum()))


def _shown(plant: Plant, fault: int, course: FloatArray) -> FloatArray:
    """Return what a fault that takes its course (D,) adds to the outputs (D, p)."""
    column = plant.faults[fault].column
    if plant.faults[fault].kind == "sensor":
        return course[:, None] * column
    state, outputs = np.zeros(len(plant.states)), []
    for size in course:
        outputs.append(plant.C @ state)
        state = plant.A @ state + column * size
    return np.array(outputs)


def _unpredicted(added: FloatArray, dynamics: FloatArray, judged: Sequence[int]) -> FloatArray:
    """Return the innovations (D, S, p) that additions (D, S, n) to the outputs cause."""
    nu = added[:, :, judged].copy()
    n = added.shape[2]
    for lag in range(1, dynamics.shape[1] // n + 1):
        nu[lag:] -= added[: len(added) - lag] @ dynamics[:, (lag - 1) * n : lag * n].T
    return nu


def _whitened(nu: FloatArray, whitening: FloatArray) -> FloatArray:
    e = nu.copy()
    for lag, phi in enumerate(whitening[: len(nu) - 1], start=1):
        e[lag:] -= nu[: len(nu) - lag] @ phi.T
    return e
