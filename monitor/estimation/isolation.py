"""Which single fault explains the estimates best: generalised least squares with the healthy covariance.

The joint estimate f^ of all fault channels carries disturbance along directions that healthy flight shows (a gust
looks like all motors at once). With Sigma its healthy covariance, the size of a fault of channel i alone is

    theta_i = e_i' Sigma^-1 f^ / (e_i' Sigma^-1 e_i),        J_i = theta_i^2 e_i' Sigma^-1 e_i,

J_i being the drop of the misfit when channel i is held responsible. The channel with the largest J is the
suspect. Others are held responsible beside it one by one, each for the largest drop of what the suspects so far
leave unexplained, and only while that drop is beyond healthy flight and beyond what model error makes of the first
suspect; the sizes of all suspects are then fitted together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from monitor.estimation.smoothing import smooth

_SMALLEST_WEIGHT = 1e-9


@dataclass(frozen=True, slots=True)
class Isolation:
    """Result for one sample.

    Parameters
    ----------
    single : NDArray[np.float64]
        theta: size of each fault if it were alone (a,).
    evidence : NDArray[np.float64]
        What each channel is held responsible for (a,): its fitted size for a suspect, zero for the others.
    """

    single: NDArray[np.float64]
    evidence: NDArray[np.float64]


class SingleFaultIsolator:
    """Smooths the joint estimates and holds one channel responsible at a time.

    Parameters
    ----------
    covariance : NDArray[np.float64]
        Healthy covariance Sigma of the smoothed joint estimate (a, a).
    smoothing_s : float
        Time constant of the first-order smoothing, seconds.
    rate_hz : float
        Samples per second.
    tolerance : float
        Share of the first suspect's score sqrt(J) that model error may leave unexplained.
    score_floor : float
        Score that healthy flight does not reach: below it nobody is held responsible beside the first suspect.
    gain_penalty : float
        How much larger J must be to believe that a channel delivers more than commanded, rather than that
        another one delivers less: motors fail towards less.
    losses : NDArray[np.bool_]
        Channels (a,) to which that belief applies.
    """

    def __init__(
        self,
        covariance: NDArray[np.float64],
        smoothing_s: float,
        rate_hz: float,
        tolerance: float,
        score_floor: float,
        gain_penalty: float,
        losses: NDArray[np.bool_],
    ) -> None:
        self._information = np.linalg.inv(covariance)
        self._weight = np.diag(self._information).copy()
        self._keep = float(np.exp(-1.0 / (smoothing_s * rate_hz))) if smoothing_s > 0 else 0.0
        self._tolerance = tolerance
        self._floor = score_floor
        self._penalty = np.where(losses, gain_penalty, 0.0)
        self._smoothed = np.zeros(len(covariance))

    def restart(self) -> None:
        """Forget the smoothed estimate."""
        self._smoothed[:] = 0.0

    def update(self, fault: NDArray[np.float64]) -> Isolation:
        """Take the joint estimate f^ (a,) of one sample."""
        self._smoothed *= self._keep
        self._smoothed += (1.0 - self._keep) * fault
        projected = np.dot(self._information, self._smoothed)
        single = projected / self._weight
        score = single * projected
        suspect = int(np.argmax(score - self._penalty * (single > 0.0)))
        return Isolation(single=single, evidence=self._evidence(projected, single, score, suspect))

    def run(self, fault: NDArray[np.float64]) -> NDArray[np.float64]:
        """Take the joint estimates of N samples (N, a); return the evidence (N, a) of each, to the same bits.

        A test holds it together with :meth:`update`.
        """
        smoothed = smooth(fault, self._keep, self._smoothed)
        # One call of BLAS for each sample: that of np.dot.
        projected = np.matmul(self._information, smoothed[:, :, None])[:, :, 0]
        single = projected / self._weight
        score = single * projected
        suspect = np.argmax(score - self._penalty * (single > 0.0), axis=1)
        rows = np.arange(len(fault))
        evidence: NDArray[np.float64] = np.zeros_like(single)
        evidence[rows, suspect] = single[rows, suspect]
        share = self._tolerance * np.sqrt(score[rows, suspect])
        limit = np.where(share > self._floor, share, self._floor)
        for row in np.flatnonzero(limit < np.sqrt(score.max(axis=1))).tolist():
            evidence[row] = self._evidence(projected[row], single[row], score[row], int(suspect[row]))
        return evidence

    def _evidence(
        self, projected: NDArray[np.float64], single: NDArray[np.float64], score: NDArray[np.float64], suspect: int
    ) -> NDArray[np.float64]:
        """Return what each channel is held responsible for (a,), beginning with the first suspect."""
        suspects = [suspect]
        evidence: NDArray[np.float64] = np.zeros_like(single)
        evidence[suspects] = single[suspects]
        limit = max(self._floor, self._tolerance * float(np.sqrt(score[suspects[0]])))
        while limit < float(np.sqrt(score.max())) and len(suspects) < len(single):
            rest, weight = self._unexplained(projected, suspects)
            drop = rest * rest / weight
            drop[suspects] = 0.0
            following = int(np.argmax(drop))
            if drop[following] <= limit * limit:
                break
            suspects.append(following)
            block = self._information[np.ix_(suspects, suspects)]
            evidence[suspects] = np.linalg.solve(block, projected[suspects])
        return evidence

    def _unexplained(
        self, projected: NDArray[np.float64], suspects: list[int]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return Sigma^-1 of what the suspects leave unexplained (a,), and its weight in each channel (a,)."""
        columns = self._information[:, suspects]
        share = np.linalg.solve(self._information[np.ix_(suspects, suspects)], columns.T)
        rest = projected - share.T @ projected[suspects]
        weight = self._weight - np.einsum("ij,ji->i", columns, share)
        return rest, np.maximum(weight, _SMALLEST_WEIGHT * self._weight)


class IndependentChannels:
    """Every channel answers for its own estimate: for plants whose faults are well told apart by the observer.

    Parameters
    ----------
    channels : int
        Number of fault channels a.
    smoothing_s, rate_hz : float
        As for :class:`SingleFaultIsolator`.
    """

    def __init__(self, channels: int, smoothing_s: float, rate_hz: float) -> None:
        self._keep = float(np.exp(-1.0 / (smoothing_s * rate_hz))) if smoothing_s > 0 else 0.0
        self._smoothed = np.zeros(channels)

    def restart(self) -> None:
        """Forget the smoothed estimate."""
        self._smoothed[:] = 0.0

    def update(self, fault: NDArray[np.float64]) -> Isolation:
        """Take the joint estimate f^ (a,) of one sample."""
        self._smoothed *= self._keep
        self._smoothed += (1.0 - self._keep) * fault
        value = self._smoothed.copy()
        return Isolation(single=value, evidence=value)

    def run(self, fault: NDArray[np.float64]) -> NDArray[np.float64]:
        """Take the joint estimates of N samples (N, a); return the evidence (N, a) of each, to the same bits."""
        return smooth(fault, self._keep, self._smoothed)
