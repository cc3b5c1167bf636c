"""Find the flights of a vehicle that disagree: each flight's own estimate of the effects against that of the others.

Flights of one vehicle differ by more than their standard errors: batteries, wind, trim. So there is a scatter tau
between flights: the usual one, with the weight of two flights, combined with the one that the others show (DerSimonian
and Laird, Controlled Clinical Trials 7, 1986). A flight f disagrees if

    (x_f - m)' (C_f + diag(tau^2 + v))^-1 (x_f - m)     x_f, C_f: its estimates and their covariance; m, v: mean and
                                                        its variance of the others, weighted 1 / (C + tau^2)

exceeds what chi-square, with one degree of freedom for each estimate, reaches by chance. A cause, a motor for instance,
moves the estimates in one direction d: it is named if it explains the difference. A flight that is far off is left out
if two thirds of the flights agree, so that a propeller that was cut for one flight does not raise the thresholds.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_CHANCE = 1e-2
"""Probability by which a fit of flights that all agree reports one that disagrees: once in a hundred fits. Chosen: such
a report costs nothing but a line."""
_SIGMA = 3.0
"""Least difference of an estimate that is named, in standard deviations."""
_FAR, _FAR_SIGMA = 0.05, 5.0
"""A flight is left out if an estimate differs from the others' by 5 %, from which a profile makes an alarm, and by five
standard deviations, which does not happen by chance."""
_LEFT_OUT = 1.0 / 3.0
"""Largest share of the flights that may be left out: of more, nobody knows which are right."""
_LEAST_VARIANCE = 1e-12
"""Least variance of a share: no share is known better than to a millionth, and weights stay finite."""
_MOST_NAMED = 3
"""Most estimates that are named. Chosen: as many as fit into a line."""
_USUAL_COUNTS = 2.0
"""Weight of the usual scatter, in flights. Measured on 50 simulated flights: with two, four healthy ones in calm and in
wind agree, and one of them beside a battery that sags by 15 % does not."""
_BLOCK_S = (2.0, 5.0)
"""Shortest and longest blocks whose errors are taken as independent, seconds: as long as gusts and manoeuvres last.
There have to be twice as many blocks as coefficients, or their covariance is of no use: a shorter flight yields no
estimate."""


@dataclass(frozen=True, slots=True)
class ComparedEffect:
    """An estimate that each flight makes: its name, and the texts for one that is smaller or larger than in the others.

    ``scatter`` is the usual standard deviation between healthy flights.
    """

    name: str
    less: str
    more: str
    scatter: float


@dataclass(frozen=True, slots=True, eq=False)
class Cause:
    """An actuator whose complete failure moves the estimates by ``direction`` (k,); ``text`` states a share of it.

    The autopilot compensates a loss by more command, so that a lack by x is a loss of x / (1 + x).
    """

    text: str
    direction: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class FlightEffects:
    """The estimates of the effects from one flight.

    ``values`` (k,) and ``covariance`` (k, k) are shares, of the pooled effects for instance; ``seconds`` is the length
    of the healthy flight.
    """

    name: str
    seconds: float
    values: FloatArray
    covariance: FloatArray

    def first(self, count: int) -> FlightEffects:
        """Return only the first estimates."""
        return FlightEffects(self.name, self.seconds, self.values[:count], self.covariance[:count, :count])


@dataclass(frozen=True, slots=True, eq=False)
class FlightVerdict:
    """The comparison of one flight with the others.

    ``weight`` is its share in the mean of all, ``apart`` the difference of each estimate from the others' mean, and
    ``sigma`` the same in standard deviations (k,). ``chi_square`` of ``freedom`` degrees is exceeded by chance with
    probability ``chance``. ``cause`` is the single cause that explains it, with the share lost and its standard
    deviations.
    """

    name: str
    seconds: float
    weight: float
    apart: FloatArray
    sigma: FloatArray
    chi_square: float
    freedom: int
    chance: float
    disagrees: bool
    cause: tuple[str, float, float] | None = None
    of_part: str | None = None  # the difference that only a part of the flight shows
    left_out: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Agreement:
    """The comparison of all flights of a fit; ``silent`` are those too short for an estimate."""

    effects: tuple[ComparedEffect, ...]
    verdicts: tuple[FlightVerdict, ...]
    silent: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """Return a line for each flight that disagrees."""
        return [
            f"{verdict.name} disagrees with the other flights{' and is left out' if verdict.left_out else ''}: "
            f"{self._why(verdict)}"
            for verdict in self.verdicts
            if verdict.disagrees
        ]

    @property
    def left_out(self) -> frozenset[str]:
        """Names of the flights that are left out."""
        return frozenset(verdict.name for verdict in self.verdicts if verdict.left_out)

    def details(self) -> list[str]:
        """Return a line for each flight: its length, its weight, and how it compares with the others."""
        found = [
            f"{verdict.name}: {verdict.seconds:.0f} s, weight {100 * verdict.weight:.0f} %, "
            f"chi-square {verdict.chi_square:.1f} of {verdict.freedom}"
            + (f": disagrees, {self._why(verdict)}" if verdict.disagrees else "")
            + ("; left out" if verdict.left_out else "")
            for verdict in self.verdicts
        ]
        return ["flights, each against the others:", *(f"  {line}" for line in found)] if found else []

    def to_json(self) -> list[dict[str, Any]]:
        """Return the verdicts as JSON objects."""
        names = [effect.name for effect in self.effects]
        return [
            {
                "flight": verdict.name,
                "seconds": verdict.seconds,
                "weight": verdict.weight,
                "chi_square": verdict.chi_square,
                "degrees_of_freedom": verdict.freedom,
                "chance": verdict.chance,
                "disagrees": verdict.disagrees,
                "left_out": verdict.left_out,
                "apart": dict(zip(names, verdict.apart.tolist(), strict=True)),
                "sigma": dict(zip(names, verdict.sigma.tolist(), strict=True)),
            }
            for verdict in self.verdicts
        ]

    def _why(self, verdict: FlightVerdict) -> str:
        if verdict.of_part is not None:
            return verdict.of_part
        if verdict.cause is not None:
            text, share, sigma = verdict.cause
            return f"{text.format(f'{100 * share:.0f} %')} ({sigma:.0f} sigma)"
        order = np.argsort(-np.abs(verdict.sigma))[:_MOST_NAMED]
        named = [k for k in order if abs(verdict.sigma[k]) >= _SIGMA] or order[:1].tolist()
        said = [
            (self.effects[k].more if verdict.apart[k] > 0.0 else self.effects[k].less).format(
                f"{100 * abs(verdict.apart[k]):.0f} %"
            )
            + f" ({abs(verdict.sigma[k]):.0f} sigma)"
            for k in named
        ]
        return ", ".join(said)


def agreement(
    effects: Sequence[ComparedEffect], flights: Sequence[FlightEffects | str], causes: Sequence[Cause] = ()
) -> Agreement:
    """Compare each flight with the others.

    ``effects`` are the estimates of each flight (k), ``causes`` the actuators that may have failed alone; a flight
    without estimates is given by its name.
    """
    speaking = [flight for flight in flights if isinstance(flight, FlightEffects)]
    silent = tuple(flight for flight in flights if isinstance(flight, str))
    usual = np.array([effect.scatter for effect in effects]) ** 2
    left: set[int] = set()
    most = int(_LEFT_OUT * len(speaking))
    verdicts: list[FlightVerdict] = []
    while len(speaking) > 1:
        verdicts = [_verdict(speaking, at, left, usual, causes) for at in range(len(speaking))]
        far = [at for at, verdict in enumerate(verdicts) if at not in left and _is_far(verdict)]
        if not far or len(left) >= most:
            break
        left.add(max(far, key=lambda at: verdicts[at].chi_square))
    shares = _weights(speaking, left, usual)
    return Agreement(
        tuple(effects),
        tuple(
            replace(verdict, left_out=at in left, weight=share)
            for at, (verdict, share) in enumerate(zip(verdicts, shares, strict=False))
        ),
        silent,
    )


def with_parts(
    whole: Agreement, flights: Sequence[FlightEffects | str], parts: Sequence[FlightEffects], causes: Sequence[Cause]
) -> Agreement:
    """Return a comparison that also considers parts of the flights: the mean of a flight hides a short fault.

    Of parts only large differences count, since their covariance comes from few blocks.

    ``flights`` are the estimates of the whole flights, ``parts`` those of parts of them under the flights' names (k,
    the first effects alone), ``causes`` the actuators that may have failed alone, for these effects.
    """
    if not parts:
        return whole
    effects = whole.effects[: len(parts[0].values)]
    usual = np.array([effect.scatter for effect in effects]) ** 2
    speaking = [flight.first(len(effects)) for flight in flights if isinstance(flight, FlightEffects)]
    left, verdicts = set(whole.left_out), []
    for verdict in whole.verdicts:
        others = [flight for flight in speaking if flight.name != verdict.name and flight.name not in left]
        own = [part for part in parts if part.name == verdict.name]
        compared = [_verdict([*others, part], len(others), (), usual, causes, len(parts)) for part in own if others]
        worst = min(compared, key=lambda part: part.chance, default=verdict)
        if verdict.disagrees or not _is_far(worst):
            verdicts.append(verdict)
            continue
        out = len(left) < int(_LEFT_OUT * len(speaking))
        left.update([verdict.name] * out)
        why = f"{Agreement(effects, ())._why(worst)} for {worst.seconds:.0f} s"
        verdicts.append(replace(verdict, disagrees=True, of_part=why, left_out=out))
    return replace(whole, verdicts=tuple(verdicts))


def _verdict(
    flights: Sequence[FlightEffects],
    at: int,
    left: Collection[int],
    usual: FloatArray,
    causes: Sequence[Cause],
    trials: int | None = None,
) -> FlightVerdict:
    """Compare a flight with the others that are not left out; ``trials`` of them may disagree by chance."""
    flight = flights[at]
    others = [flight for number, flight in enumerate(flights) if number != at and number not in left]
    values = np.array([other.values for other in others])
    variances = np.array([np.diag(other.covariance) for other in others])
    tau2 = _scatter(values, variances, usual)
    weight = 1.0 / (variances + tau2)
    apart = flight.values - (weight * values).sum(axis=0) / weight.sum(axis=0)
    spread = flight.covariance + np.diag(tau2 + 1.0 / weight.sum(axis=0))
    chi_square = float(apart @ np.linalg.solve(spread, apart))
    chance = _chance(chi_square, len(apart))
    disagrees = chance < _CHANCE / (trials or len(flights))
    return FlightVerdict(
        name=flight.name,
        seconds=flight.seconds,
        weight=0.0,
        apart=apart,
        sigma=apart / np.sqrt(np.diag(spread)),
        chi_square=chi_square,
        freedom=len(apart),
        chance=chance,
        disagrees=disagrees,
        cause=_cause(apart, spread, chi_square, causes) if disagrees else None,
    )


def _cause(
    apart: FloatArray, spread: FloatArray, chi_square: float, causes: Sequence[Cause]
) -> tuple[str, float, float] | None:
    """Return the cause that explains the difference best, its share and sigma; None if none explains it."""
    best = None
    for cause in causes:
        weight = np.linalg.solve(spread, cause.direction)
        lack, error = float(weight @ apart / (weight @ cause.direction)), float((weight @ cause.direction) ** -0.5)
        if lack > 0.0 and (best is None or lack / error > best[2]):
            best = cause.text, lack / (1.0 + lack), lack / error
    if best is None or _chance(chi_square - best[2] ** 2, len(apart) - 1) < _CHANCE:
        return None
    return best


def _is_far(verdict: FlightVerdict) -> bool:
    shares, sigmas = list(np.abs(verdict.apart)), list(np.abs(verdict.sigma))
    if verdict.cause is not None:
        shares, sigmas = [*shares, verdict.cause[1]], [*sigmas, verdict.cause[2]]
    far = (share >= _FAR and sigma >= _FAR_SIGMA for share, sigma in zip(shares, sigmas, strict=True))
    return verdict.disagrees and any(far)


def _weights(flights: Sequence[FlightEffects], left: Collection[int], usual: FloatArray) -> list[float]:
    """Return the share of each flight in the mean of all that are not left out."""
    kept = [number for number in range(len(flights)) if number not in left]
    values = np.array([flights[number].values for number in kept])
    variances = np.array([np.diag(flights[number].covariance) for number in kept])
    if len(kept) < 1:
        return []
    weights = 1.0 / (variances + _scatter(values, variances, usual))
    shares = dict(zip(kept, (weights / weights.sum(axis=0)).mean(axis=1).tolist(), strict=True))
    return [shares.get(number, 0.0) for number in range(len(flights))]


def _scatter(values: FloatArray, variances: FloatArray, usual: FloatArray) -> FloatArray:
    """Return the variance between flights of each estimate (k,) from the usual one and the moments of these flights."""
    count = len(values)
    if count < 2:
        return usual
    weight = 1.0 / np.maximum(variances, _LEAST_VARIANCE)
    mean = (weight * values).sum(axis=0) / weight.sum(axis=0)
    excess = (weight * (values - mean) ** 2).sum(axis=0) - (count - 1)
    room = weight.sum(axis=0) - (weight**2).sum(axis=0) / weight.sum(axis=0)
    shown = np.maximum(excess / room, 0.0)
    return np.asarray((_USUAL_COUNTS * usual + (count - 1) * shown) / (_USUAL_COUNTS + count - 1))


def _chance(chi_square: float, freedom: int) -> float:
    from scipy.special import gammaincc

    return float(gammaincc(0.5 * freedom, 0.5 * chi_square))


def flight_effects(
    name: str, regressors: FloatArray, target: FloatArray, std: FloatArray, rate_hz: float
) -> FlightEffects | str:
    """Estimate the effects in one flight by least squares; return its name if it is too short.

    Parameters
    ----------
    name : str
        The flight's.
    regressors : FloatArray
        What each coefficient adds to each output (N, n, k).
    target : FloatArray
        The sum of these contributions (N, n).
    std : FloatArray
        Error of each output (n,).
    rate_hz : float
        Samples per second.
    """
    coefficients, seconds = regressors.shape[2], len(target) / rate_hz
    if seconds < 2 * coefficients * _BLOCK_S[0]:
        return name
    blocks = max(2 * coefficients, int(seconds / _BLOCK_S[1]))
    X, t = regressors / std[:, None], target / std
    gram = np.einsum("tok,tol->kl", X, X)
    inverse = np.linalg.pinv(gram, hermitian=True)
    theta = inverse @ np.einsum("tok,to->k", X, t)
    scores = np.einsum("tok,to->tk", X, t - X @ theta)
    sums = np.stack([part.sum(axis=0) for part in np.array_split(scores, blocks)])
    # errors within a block may be correlated: White 1980, Arellano 1987
    covariance = inverse @ (sums.T @ sums) @ inverse * blocks / (blocks - coefficients)
    return FlightEffects(name, len(target) / rate_hz, theta, covariance)
