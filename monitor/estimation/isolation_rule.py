"""How joint estimates become evidence against channels: the isolation part of a profile, read and written."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from math import exp
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adapters.toml_tables import Table


def keep_share(smoothing_s: float, rate_hz: float) -> float:
    """Return the share of m that a row leaves in m <- keep m + (1 - keep) value: e^(-T / time constant)."""
    return exp(-1.0 / (smoothing_s * rate_hz)) if smoothing_s > 0.0 else 0.0


LEVEL_S = 3.0
"""As :data:`monitor.estimation.changes.LEVEL_S`: half as long again as the mean of the slow path at 100 Hz."""
METHODS = ("independent", "bank")


@dataclass(frozen=True, slots=True)
class IndependentRule:
    """Every channel answers for its own estimate, for plants whose faults the observer distinguishes well."""

    smoothing_s: float  # time constant of the smoothing, seconds


@dataclass(frozen=True, slots=True, eq=False)
class BankRule:
    """One observer for each hypothesis; the one that explains the data names the faults: see ``bank``."""

    smoothing_s: float  # time constant of the smoothing of estimates and residuals, seconds
    tolerance: float  # share of the worst hypothesis' score that model error may leave on the right one
    score_floor: float  # score sqrt(r' S^-1 r) that healthy flight does not reach
    # factor on the evidence for an actuator that would deliver more than commanded: motors fail towards less
    gain_penalty: float
    hypotheses: tuple[tuple[str, ...], ...]  # the faults of each hypothesis
    # healthy covariance of the smoothed residual of each hypothesis (p, p)
    covariances: tuple[NDArray[np.float64], ...]
    # which hypotheses take no part in the comparison, and show edges of the faults that no other hypothesis has
    edges: tuple[bool, ...]
    # time constant, seconds, with which the estimate of a fault is washed out before it is restored
    washouts: Mapping[str, float] = field(default_factory=dict)
    # healthy covariance of the mean of each of these residuals over level_s (p, p); empty: that of the residual, which
    # no mean of a stationary one exceeds
    lasting: tuple[NDArray[np.float64], ...] = ()
    # largest size of each output, lately, with which each of these hypotheses is believed (p,), 0 for any; empty: any
    calm: tuple[NDArray[np.float64], ...] = ()
    jump_s: float = 0.03  # time within which an estimate makes an edge, seconds
    """Chosen: three samples at 100 Hz, as long as the mean of an edge's levels needs to follow."""
    # root of the mean J of the hypothesis believed in healthy flight, 0 if the level of J is not followed, and the time
    # constant, seconds, with which it is
    usual_score: float = 0.0
    level_s: float = LEVEL_S


IsolationRule = IndependentRule | BankRule


def edge_faults(rule: IsolationRule) -> frozenset[str]:
    """Return the faults of a bank whose evidence is an edge of their estimate: no compared hypothesis has them."""
    if not isinstance(rule, BankRule):
        return frozenset()
    each = list(zip(rule.hypotheses, rule.edges, strict=True))
    compared = {fault for faults, edge in each if not edge for fault in faults}
    return frozenset(fault for faults, edge in each if edge for fault in faults) - compared


def read_hypotheses(table: Table) -> tuple[tuple[str, ...], ...] | None:
    """Return the faults of a bank's hypotheses, None if the isolation runs a single observer.

    Mistakes are recorded in the table's file: an unknown method, or a bank that has no hypotheses or one twice.
    """
    if table.choice("method", METHODS) != "bank":
        return None
    hypotheses = tuple(entry.texts("faults") for entry in table.tables("hypotheses"))
    if not hypotheses or not all(hypotheses):
        table.mistake("hypotheses", "is empty or has an entry without 'faults'")
    elif len({frozenset(faults) for faults in hypotheses}) < len(hypotheses):
        table.mistake("hypotheses", "has the same faults twice")
    return hypotheses


def read_isolation(table: Table, outputs: int) -> IsolationRule:
    """Return the rule of an isolation table, for a number of outputs.

    Mistakes are recorded in the table's file; those that :func:`read_hypotheses` records have to be raised before.
    """
    hypotheses = read_hypotheses(table)
    smoothing_s = table.number("smoothing_s", 0.05, at_least=0.0)
    rule: IsolationRule = IndependentRule(smoothing_s)
    if hypotheses is not None:
        entries = table.tables("hypotheses")
        rule = BankRule(
            smoothing_s=smoothing_s,
            tolerance=table.number("tolerance", 0.2, at_least=0.0),
            score_floor=table.number("score_floor", at_least=0.0),
            gain_penalty=table.number("gain_penalty", 25.0, at_least=0.0),
            hypotheses=hypotheses,
            covariances=tuple(_covariance(entry, outputs, "covariance") for entry in entries),
            lasting=tuple(_covariance(entry, outputs, "lasting") for entry in entries if entry.has("lasting")),
            calm=tuple(
                entry.matrix("calm", 1, outputs)[0] if entry.has("calm") else np.zeros(outputs) for entry in entries
            ),
            edges=tuple(entry.boolean("edge", False) for entry in entries),
            jump_s=table.number("jump_s", 0.03, above=0.0),
            washouts=_washouts(table.table("washout_s"), {name for faults in hypotheses for name in faults}),
            usual_score=table.number("usual_score", 0.0, at_least=0.0),
            level_s=table.number("level_s", LEVEL_S, above=0.0),
        )
        compared = {name for faults, edge in zip(hypotheses, rule.edges, strict=True) if not edge for name in faults}
        for entry, hypothesis, edge in zip(entries, hypotheses, rule.edges, strict=True):
            if edge and compared.issuperset(hypothesis):
                entry.mistake("edge", "needs a hypothesis with a fault that no compared one has")
        if rule.lasting and len(rule.lasting) < len(hypotheses):
            table.mistake("hypotheses", "have 'lasting' in some entries only")
        if all(rule.edges):
            table.mistake("hypotheses", "has none but edges; a bank needs one to compare")
        for entry in entries:
            entry.texts("faults")
            entry.done()
    table.done()
    return rule


def isolation_table(rule: IsolationRule) -> dict[str, Any]:
    """Return the table that :func:`read_isolation` reads back as the same rule."""
    if isinstance(rule, IndependentRule):
        return {"method": "independent", "smoothing_s": rule.smoothing_s}
    lasting = [{"lasting": matrix.tolist()} for matrix in rule.lasting] or [{}] * len(rule.hypotheses)
    calm = [{"calm": [sizes.tolist()]} if sizes.any() else {} for sizes in rule.calm] or [{}] * len(rule.hypotheses)
    hypotheses = [
        {"faults": list(faults), **({"edge": True} if edge else {}), "covariance": covariance.tolist(), **mean, **still}
        for faults, covariance, edge, mean, still in zip(
            rule.hypotheses, rule.covariances, rule.edges, lasting, calm, strict=True
        )
    ]
    return {
        "method": "bank",
        "smoothing_s": rule.smoothing_s,
        "tolerance": rule.tolerance,
        "score_floor": rule.score_floor,
        "gain_penalty": rule.gain_penalty,
        **({"jump_s": rule.jump_s} if any(rule.edges) else {}),
        **({"washout_s": dict(rule.washouts)} if rule.washouts else {}),
        **({"usual_score": rule.usual_score, "level_s": rule.level_s} if rule.usual_score else {}),
        "hypotheses": hypotheses,
    }


def gains_file_names(observer: str, hypotheses: Sequence[Sequence[str]] = ()) -> tuple[str, ...]:
    """Return the names of the files with an observer's gains: one, or one for each hypothesis of a bank.

    They are named after the faults that a hypothesis does not share with all others.
    """
    if not hypotheses:
        return (f"{observer}.gains.json",)
    shared = set.intersection(*map(set, hypotheses)) if len(hypotheses) > 1 else set[str]()
    own = ["+".join(name for name in faults if name not in shared) or "rest" for faults in hypotheses]
    return tuple(f"{observer}.{name}.gains.json" for name in own)


def _washouts(table: Table, faults: Collection[str]) -> dict[str, float]:
    for name in table:
        if name not in faults:
            table.mistake(name, ": no hypothesis has this fault")
    return {name: table.number(name, at_least=0.1) for name in table}


def _covariance(table: Table, size: int, key: str) -> NDArray[np.float64]:
    covariance = table.matrix(key, size, size)
    if not table.good(key):
        return covariance
    scale = np.sqrt(np.abs(np.diag(covariance)))
    correlation = covariance / np.outer(scale, scale).clip(1e-300)
    if not np.allclose(correlation, correlation.T) or not covariance.any():
        table.mistake(key, "is not symmetric, or zero")
    elif np.linalg.eigvalsh(correlation).min() < -1e-9:
        table.mistake(key, "is not positive semidefinite")
    return covariance
