"""How much of its command an actuator still delivers: loss and offset from the fault estimate, with their errors.

A surface that lost a share of its effectiveness shows nothing while it stands at trim: its additive fault estimate
f^ has to be read against the deflection at which it arose. With u the effect commanded (lagged like f^) and m the
effect of a full constant deflection (speed scaling; 1 where there is none),

    f^ = -loss u + offset m + noise.

Both are followed by least squares with exponential forgetting: information Lambda and moments b,

    Lambda <- e^(-T / memory) Lambda + w phi phi',   b <- e^(-T / memory) b + w phi f^,     phi = [-u, m],

where 1 / w is the variance of the noise times the number of samples that count as one (noise is coloured). Loss
alone and offset alone are tested each by itself, estimate over standard error, the latter including how wrong the
healthy model may be in both, and that the time between u and f^ is known within ``timing_s`` only, which looks like a
fault of size timing_s u' while u moves. The one that explains more, b_i^2 / Lambda_ii, is the evidence. An
unexcited actuator has a large standard error: it is neither accused nor acquitted.

A short memory sees a large fault, and its end, at once; a long one a small fault. The shortest memory that says
anything is heard. Where health explains better than its accusation what the shortest one holds, the accusation is
dropped and everything before forgotten: what an actuator did while it was deflected would otherwise outweigh what it
does at rest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import exp, inf, sqrt

import numpy as np
from numpy.typing import NDArray

from monitor.estimation.effectiveness_run import (
    ACQUITTAL,
    CONTRADICTION,
    LOSSES,
    SMALLEST_INFORMATION,
    Moments,
    heard_verdicts,
)
from monitor.sampling.stretch import first_order, since

Array = NDArray[np.float64]

_AHEAD = 256
"""Samples judged at once before it is known whether an accusation is dropped among them: more where none is."""


@dataclass(frozen=True, slots=True)
class EffectivenessRule:
    """How one actuator's fault estimate is read.

    Parameters
    ----------
    noise : float
        Standard deviation of f^ in healthy operation, in effect units.
    inflation : float
        Number of consecutive samples of that noise that count as one.
    lag_s : float
        Mean delay of f^ behind the fault, seconds.
    loss_doubt, offset_doubt : float
        Standard deviation of loss and offset that the healthy model's own errors cause.
    certainty : float
        Number of standard errors that healthy operation does not reach.
    least_loss, least_offset : float
        Smallest loss, as a share of the command, and smallest offset, as a fraction of full deflection, that matter.
    memories_s : tuple[float, ...]
        Time constants of forgetting, shortest first, seconds.
    timing_s : float
        How well the time between command and effect is known, seconds.
    hold_s : float
        How long an accusation stands without the excitation that could confirm it, seconds; the shortest memory has
        to fade first.
    full : str | None
        Input that is the effect of a full constant deflection; None: that effect is 1.
    """

    noise: float
    inflation: float
    lag_s: float
    loss_doubt: float
    offset_doubt: float
    certainty: float
    least_loss: float = 0.08
    least_offset: float = 0.04
    memories_s: tuple[float, ...] = (0.25, 1.0)
    timing_s: float = 0.02
    hold_s: float = 3.0
    full: str | None = None


@dataclass(frozen=True, slots=True)
class Effectiveness:
    """What is known about an actuator after one sample.

    Parameters
    ----------
    loss, loss_error : float
        Share of the commanded effect that is missing if that is all that is wrong, and its standard error.
    offset, offset_error : float
        Constant deflection that is there without command, as a fraction of full deflection, likewise.
    score : float
        The one that explains more over its standard error.
    evidence : float | None
        Deflection that is missing (negative) or there without command in the actuator's present use, as a fraction of
        full deflection, where one of the two is certain and matters; zero where not; None where an accusation can
        neither be confirmed nor dropped for want of excitation.
    relative : float | None
        -loss where that is certain beside an offset, else None.
    is_loss : bool
        Whether the loss explains more than the offset.
    """

    loss: float
    loss_error: float
    offset: float
    offset_error: float
    score: float
    evidence: float | None
    relative: float | None
    is_loss: bool

    @property
    def share(self) -> float | None:
        """``relative``; where that is not known but loss explains more than an offset does, -loss."""
        return -self.loss if self.relative is None and self.is_loss and self.evidence else self.relative


class EffectivenessEstimator:
    """State of one actuator's recursive least squares.

    Parameters
    ----------
    rule : EffectivenessRule
        How to read the estimate.
    rate_hz : float
        Samples per second.
    """

    def __init__(self, rule: EffectivenessRule, rate_hz: float) -> None:
        self.rule = rule
        self._rate_hz = rate_hz
        self._keep = exp(-1.0 / (rule.lag_s * rate_hz)) if rule.lag_s > 0 else 0.0
        self._memories = [_Memory(rule, memory_s, rate_hz) for memory_s in rule.memories_s]
        self._longest_hold = self._unconfirmed = round(rule.hold_s * rate_hz)
        self.restart()

    def restart(self) -> None:
        """Forget everything."""
        self._u: float | None = None
        self._m = 0.0
        self._start_afresh()

    def update(self, fault: float, command: float, full: float = 1.0) -> Effectiveness:
        """Take one sample that is evidence; others are left out altogether.

        Parameters
        ----------
        fault : float
            f^ of the observer, in effect units, not smoothed further.
        command : float
            u, in the same units.
        full : float
            m: effect of a constant full deflection.
        """
        if self._u is None:
            self._u, self._m = command, full
        step = (1.0 - self._keep) * (command - self._u)
        self._u += step
        self._m += (1.0 - self._keep) * (full - self._m)
        for memory in self._memories:
            memory.take(fault, self._u, self._m, step * self._rate_hz)
        said = [memory.judge() for memory in self._memories]
        heard = next((verdict for verdict in said if verdict.evidence is not None), said[-1])
        if heard.evidence and self._memories[0].contradicts(heard):
            self._start_afresh()
            return replace(heard, evidence=0.0, relative=None)
        relative = next((v.relative for v in said if v.relative is not None), None) if heard.evidence else None
        return replace(heard, evidence=self._standing(heard), relative=relative)

    def run(self, fault: Array, command: Array, full: Array, taken: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Take a stretch as :meth:`update` and :meth:`skip` take samples, to the same bits: a test holds them together.

        Parameters
        ----------
        fault, command, full : Array
            As of :meth:`update`, one per sample (n,).
        taken : NDArray[np.bool_]
            Whether the sample is evidence, not skipped (n,).

        Returns
        -------
        tuple[Array, Array]
            ``evidence`` and ``share`` of each verdict (n,), not a number where that is None or there is no verdict.
        """
        u, m, speed = self._lagged(command, full, taken)
        fault = np.where(taken, fault, 0.0)
        evidence, share = np.full(len(fault), np.nan), np.full(len(fault), np.nan)
        start, ahead = 0, _AHEAD
        while start < len(fault):
            rows = slice(start, start + ahead)
            moments = [memory.run(fault[rows], u[rows], m[rows], speed[rows]) for memory in self._memories]
            heard = heard_verdicts(self.rule, moments, taken[rows], [memory.size for memory in self._memories])
            count = heard.contradicted + 1 if heard.contradicted is not None else len(taken[rows])
            found = slice(start, start + count)
            unconfirmed = np.minimum(since(heard.confirmed[:count], self._unconfirmed), self._longest_hold)
            stands = heard.confirmed[:count] | ((unconfirmed < self._longest_hold) & (heard.evidence[:count] != 0.0))
            evidence[found] = np.where(stands, heard.evidence[:count], 0.0)
            if heard.contradicted is None:
                self._unconfirmed = int(unconfirmed[-1])
                for memory, held in zip(self._memories, moments, strict=True):
                    memory.hold(held)
            else:
                evidence[start + count - 1] = 0.0
                self._start_afresh()
            accused = heard.is_loss[:count] & ~np.isnan(evidence[found]) & (evidence[found] != 0.0)
            share[found] = np.where(
                np.isnan(heard.relative[:count]) & accused, -heard.loss[:count], heard.relative[:count]
            )
            start, ahead = start + count, 2 * ahead if heard.contradicted is None else max(ahead // 4, 16)
        evidence[~taken] = np.nan
        return evidence, share

    def _lagged(self, command: Array, full: Array, taken: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
        """Return u, m and the speed of u after each sample, all zero where it is skipped."""
        u, m, gain = self._u, self._m, 1.0 - self._keep
        found = []
        for target, whole, use in zip(command.tolist(), full.tolist(), taken.tolist(), strict=True):
            if not use:
                found.append((0.0, 0.0, 0.0))
                continue
            if u is None:
                u, m = target, whole
            step = gain * (target - u)
            u += step
            m += gain * (whole - m)
            found.append((u, m, step * self._rate_hz))
        self._u, self._m = u, m
        columns = np.array(found, np.float64).reshape(-1, 3).T
        return columns[0], columns[1], columns[2]

    def skip(self) -> None:
        """Let the time of a sample pass that is no evidence."""
        self._unconfirmed = min(self._unconfirmed + 1, self._longest_hold)
        for memory in self._memories:
            memory.take(0.0, 0.0, 0.0, 0.0)

    def _start_afresh(self) -> None:
        for memory in self._memories:
            memory.clear()
        self._unconfirmed = self._longest_hold

    def _standing(self, heard: Effectiveness) -> float | None:
        """Return the evidence; once nothing could have confirmed an accusation for as long as it may stand, zero."""
        reach = max(memory.reach(self._memories[0], heard) for memory in self._memories)
        if heard.evidence and reach >= self.rule.certainty:
            self._unconfirmed = 0
            return heard.evidence
        self._unconfirmed = min(self._unconfirmed + 1, self._longest_hold)
        return heard.evidence if self._unconfirmed < self._longest_hold and heard.evidence != 0.0 else 0.0


class _Memory:
    """Information and moments under one time constant of forgetting."""

    def __init__(self, rule: EffectivenessRule, memory_s: float, rate_hz: float) -> None:
        self._rule = rule
        self._length = memory_s * rate_hz
        self._forget = exp(-1.0 / self._length)
        # Noise that is slower than the memory does not average out in it, nor does it grow.
        self._inflation = min(rule.inflation, self._length)
        self._weight = 1.0 / (rule.noise**2 * self._inflation)
        self.size = self._length, self._inflation
        self.clear()

    def clear(self) -> None:
        self._uu = self._um = self._mm = self._bu = self._bm = 0.0
        # Moments of u', the speed of u, with the regressors.
        self._su = self._sm = 0.0

    def take(self, fault: float, u: float, m: float, speed: float) -> None:
        forget, weight = self._forget, self._weight
        self._uu = forget * self._uu + weight * u * u
        self._um = forget * self._um - weight * u * m
        self._mm = forget * self._mm + weight * m * m
        self._bu = forget * self._bu - weight * u * fault
        self._bm = forget * self._bm + weight * m * fault
        self._su = forget * self._su + weight * u * speed
        self._sm = forget * self._sm + weight * m * speed

    def run(self, fault: Array, u: Array, m: Array, speed: Array) -> Moments:
        """Return the moments after each sample of a stretch; :meth:`hold` takes over the last."""
        now, forget, of_u, of_m = self._moments(), self._forget, self._weight * u, self._weight * m
        gained = Moments(of_u * u, -(of_u * m), of_m * m, -(of_u * fault), of_m * fault, of_u * speed, of_m * speed)
        return Moments(*(first_order(forget, one, was) for one, was in zip(gained, now, strict=True)))

    def hold(self, moments: Moments) -> None:
        self._uu, self._um, self._mm, self._bu, self._bm, self._su, self._sm = (float(one[-1]) for one in moments)

    def _moments(self) -> tuple[float, ...]:
        return self._uu, self._um, self._mm, self._bu, self._bm, self._su, self._sm

    def contradicts(self, heard: Effectiveness) -> bool:
        """Return whether what this memory holds is explained worse by the accusation than by health."""
        if heard.is_loss:
            return heard.loss * (heard.loss * self._uu - 2.0 * self._bu) > CONTRADICTION
        return heard.offset * (heard.offset * self._mm - 2.0 * self._bm) > CONTRADICTION

    def reach(self, shortest: _Memory, heard: Effectiveness) -> float:
        """Return by how many standard errors the accusation would stand out here, if things went on as lately."""
        size, lately = (heard.loss, shortest._uu) if heard.is_loss else (heard.offset, shortest._mm)
        return abs(size) * sqrt(lately * shortest._inflation / shortest._length * self._length / self._inflation)

    def judge(self) -> Effectiveness:
        rule = self._rule
        doubts = rule.loss_doubt, rule.offset_doubt
        loss, loss_error = _single(self._bu, self._uu, self._um * doubts[1], self._su * rule.timing_s, doubts[0])
        offset, offset_error = _single(self._bm, self._mm, self._um * doubts[0], self._sm * rule.timing_s, doubts[1])
        is_loss = _plausible(loss, loss_error) and loss * self._bu >= offset * self._bm
        score = abs(loss) / loss_error if is_loss else abs(offset) / offset_error
        matters = abs(loss) >= rule.least_loss if is_loss else abs(offset) >= rule.least_offset
        evidence: float | None = None
        if score >= rule.certainty and matters:
            evidence = -loss * sqrt(self._uu / max(self._mm, SMALLEST_INFORMATION)) if is_loss else offset
        elif (
            abs(loss) + ACQUITTAL * loss_error < rule.least_loss
            and abs(offset) + ACQUITTAL * offset_error < rule.least_offset
        ):
            evidence = 0.0
        return Effectiveness(
            loss=loss,
            loss_error=loss_error,
            offset=offset,
            offset_error=offset_error,
            score=score,
            evidence=evidence,
            relative=self._loss_beside_offset(),
            is_loss=is_loss,
        )

    def _loss_beside_offset(self) -> float | None:
        """Return -loss of the fit of both, where it is certain and plausible."""
        rule = self._rule
        determinant = self._uu * self._mm - self._um * self._um
        if determinant <= SMALLEST_INFORMATION:
            return None
        beside = (self._mm * self._bu - self._um * self._bm) / determinant
        slip = rule.timing_s * (self._mm * self._su + self._um * self._sm) / determinant
        error = sqrt(self._mm / determinant + slip * slip + rule.loss_doubt**2)
        return -beside if rule.certainty * error <= abs(beside) and _plausible(beside, error) else None


def _single(moment: float, own: float, other: float, timing: float, doubt: float) -> tuple[float, float]:
    """Return one size fitted alone and its standard error; ``other`` and ``timing`` are moments of known doubts."""
    if own <= SMALLEST_INFORMATION:
        return 0.0, inf
    return moment / own, sqrt(1.0 / own + doubt * doubt + (other / own) ** 2 + (timing / own) ** 2)


def _plausible(loss: float, error: float) -> bool:
    return error < inf and LOSSES[0] <= loss <= LOSSES[1] + ACQUITTAL * error
