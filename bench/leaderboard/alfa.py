"""The ALFA flights (a fixed wing whose engine or surfaces fail), detectors at the same rate of false alarms.

    python bench/leaderboard/alfa.py FOLDER [--per-hour 5] [--json]

FOLDER is ``failures`` of https://github.com/FabioCarosi/FaultDetection_ALFA-Dataset: one CSV for each flight, 20 Hz,
wanted less measured (roll, pitch, yaw, speeds, height), rates and accelerations. Nothing of it is in this repository.
The set has no commands of actuators, so no profile of fauio can be fitted on it; what runs under its name is its
likelihood test, written for these signals: how much the last seconds look like failures of the other flights, in noise
as coloured as healthy flight is.

Leave one flight out: what is fitted and the threshold come from all other flights (recordings of one log, by their
date, are one flight); for the threshold the healthy parts of each are scored by what the rest teaches. The threshold is
the smallest at which those have at most so many false alarms an hour. A failure counts as found if an alarm begins at
it or later; one that was active before counts against it.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

HZ = 20.0
MOTION = (
    "field.twist.angular.x",
    "field.twist.angular.y",
    "field.twist.angular.z",
    "field.twist.linear.z",
    "field.linear_acceleration.x",
    "field.linear_acceleration.y",
    "field.linear_acceleration.z",
)
SIGNALS = (
    "delta_roll",
    "delta_pitch",
    "delta_yaw",
    "delta_z",
    "delta_roll_airspeed",
    *MOTION,
    "field.aspd_error",
    "field.alt_error",
)
SIDEWAYS = (
    "delta_roll",
    "delta_yaw",
    "field.twist.angular.x",
    "field.twist.angular.z",
    "field.linear_acceleration.y",
)
"""What changes its sign in a mirror."""
WATCHED = (
    *SIDEWAYS,
    "delta_pitch",
    "delta_z",
    "field.aspd_error",
    "field.alt_error",
    "field.twist.angular.y",
    "field.twist.linear.z",
    "field.linear_acceleration.x",
    "field.linear_acceleration.z",
)
"""Of the signals, those that do not depend on where north is."""
WANTED = ("delta_roll", "delta_pitch", "delta_yaw", "delta_z", "field.aspd_error", "field.alt_error")
TICK = 8
"""Samples of a tick of the Kalman filters: as often as accelerations come (2.5 Hz)."""
FADE_S = 2.0
"""Time over which those filters forget: the published mean delay."""
MERGE_S = 10.0
"""Chosen: what crosses the threshold twice within it is one alarm, as alarms of a monitor clear late."""
SETTLE_S = 10.0
"""Chosen: what every detector leaves out at the begin of a flight, to settle."""
WINDOWS_S = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0)
"""Lengths over which a mean may have shifted: from two samples to twice the published mean delay."""
BEFORE_S = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0)
"""Moments that are looked at together: over them a failure unfolds."""
SEEN_S = ((0.3, 0.8), (0.8, 1.3), (1.3, 2.0), (2.0, 3.0), (3.0, 4.5))
"""Seconds after a failure over which its direction is taken: up to twice the published mean delay."""
MEAN_S = 0.3
"""About as often as accelerations come (2.5 Hz)."""
SHRINK = 0.02
"""Share of the variances that is added to them; of two that were tried on this set (the other: 0.2) the better."""
LARGEST = 8
"""So many of the largest values of the healthy hour make a direction's size: twice the alarms that are allowed."""
CLIP = 6.0
"""Standard deviations at which a sample is cut off: the set has steps of a single sample where telemetry was late."""


@dataclass(frozen=True, slots=True)
class Flight:
    """A recording: its signals (n, c), where the failure begins (n where there is none), and of which log it is."""

    name: str
    kind: str
    log: str
    values: Floats
    onset: int

    @property
    def healthy(self) -> Floats:
        """What was recorded before the failure."""
        return self.values[: self.onset]


def read_flight(path: Path) -> Flight:
    """Read a recording; values are those last known, from the first row on in which all are."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    table = np.array([[_number(row.get(name)) for name in SIGNALS] for row in rows])
    for column in table.T:
        index = np.maximum.accumulate(np.where(np.isfinite(column), np.arange(len(column)), 0))
        column[:] = column[index]
    failed = [index for index, row in enumerate(rows) if _number(row.get("field.data")) > 0]
    known = np.flatnonzero(np.isfinite(table).all(axis=1))
    first = int(known[0]) if len(known) else len(rows)
    turned = SIGNALS.index("delta_yaw")
    table[:, turned] = (table[:, turned] + 180.0) % 360.0 - 180.0
    onset = (failed[0] if failed else len(rows)) - first
    stamp = re.search(r"carbonZ_([\d-]+)", path.name)
    return Flight(path.stem, path.parent.name, stamp[1][:19] if stamp else path.stem, table[first:], onset)


def _number(text: str | None) -> float:
    try:
        return float(text or "nan")
    except ValueError:
        return math.nan


@dataclass(frozen=True, slots=True)
class Scale:
    """Median and robust deviation of the signals over healthy flight."""

    centre: Floats
    size: Floats

    @classmethod
    def of(cls, flights: Sequence[Flight]) -> Scale:
        """Return that of some flights."""
        joined = np.concatenate([flight.healthy for flight in flights])
        centre = np.median(joined, axis=0)
        size = 1.4826 * np.median(np.abs(joined - centre), axis=0)
        return cls(centre, np.maximum(size, 1e-3 * np.std(joined, axis=0) + 1e-9))

    def scaled(self, values: Floats) -> Floats:
        """Return values in deviations, cut off where they are beyond belief."""
        return np.asarray(np.clip((values - self.centre) / self.size, -CLIP, CLIP))


Detector = Callable[[Sequence[Flight]], Callable[[Floats], Floats]]


def residual_energy(training: Sequence[Flight]) -> Callable[[Floats], Floats]:
    """Mean square of the scaled signals over a second."""
    scale = Scale.of(training)
    return lambda values: running_mean(np.square(scale.scaled(values)).mean(axis=1), int(HZ))


def cusum(training: Sequence[Flight]) -> Callable[[Floats], Floats]:
    """Largest two-sided cumulative sum of the scaled signals, with a drift of half a deviation."""
    scale = Scale.of(training)
    return lambda values: sums(scale.scaled(values))


def sums(scaled: Floats) -> Floats:
    """Return the largest of the cumulative sums at each sample (n,)."""
    up = down = np.zeros(scaled.shape[1])
    largest = np.empty(len(scaled))
    for row, one in enumerate(scaled):
        up, down = np.maximum(up + one - 0.5, 0.0), np.maximum(down - one - 0.5, 0.0)
        largest[row] = max(up.max(), down.max())
    return largest


def glr(training: Sequence[Flight]) -> Callable[[Floats], Floats]:
    """Likelihood of a shifted mean in the scaled signals, as if they were white."""
    scale = Scale.of(training)
    return lambda values: shift(scale.scaled(values))


def kalman_bank(training: Sequence[Flight]) -> Callable[[Floats], Floats]:
    """Largest bias, in standard deviations, that a bank of Kalman filters estimates, one filter for each signal.

    The model is that of least squares over healthy flight: rates, accelerations and climb after a tick of 0.4 s by
    themselves and by what the autopilot wants in vain, its inputs. In each filter one of them has a wandering bias.
    """
    scale = Scale.of(training)
    known, given = ([SIGNALS.index(name) for name in names] for names in (MOTION, WANTED))

    def ticks(values: Floats) -> tuple[Floats, Floats]:
        means = running_mean(scale.scaled(values), TICK)[TICK - 1 :: TICK]
        return np.hstack([means[:-1][:, known + given], np.ones((len(means) - 1, 1))]), means[1:, known]

    rows = [ticks(flight.healthy) for flight in training if len(flight.healthy) > 2 * TICK]
    before, after = (np.concatenate(part) for part in zip(*rows, strict=True))
    model = np.linalg.lstsq(before, after, rcond=None)[0]
    noise = np.cov((after - before @ model).T)

    def score(values: Floats) -> Floats:
        before, after = ticks(values)
        most = biases(after - before @ model, noise, TICK / HZ / FADE_S)
        held = np.concatenate([np.zeros(2 * TICK - 1), np.repeat(most, TICK)])
        return np.asarray(np.pad(held, (0, max(len(values) - len(held), 0)), mode="edge")[: len(values)])

    return score


def biases(innovations: Floats, noise: Floats, gain: float) -> Floats:
    """Return the largest bias at each row (n,), in deviations, by innovations (n, k) and their covariance.

    As the signals are measured, a steady filter of one that has a wandering bias is a mean of the innovations,
    projected onto it, whose weights fade by ``gain`` with each row.
    """
    from scipy.signal import lfilter

    weight = np.linalg.inv(noise)
    bias = lfilter([gain], [1.0, gain - 1.0], innovations @ weight / np.sqrt(np.diag(weight)), axis=0)
    return np.asarray(np.abs(bias).max(axis=1) * math.sqrt((2.0 - gain) / gain))


def fauio(training: Sequence[Flight]) -> Callable[[Floats], Floats]:
    """Likelihood of a failure as other flights had one, or of a bias that no such failure explains.

    Both are in units of what healthy flight reaches, so that each costs about as many false alarms.
    """
    scores = [detector(training) for detector in (seen_failures, kalman_bank)]
    sizes = [_usual_peaks([score(flight.healthy)[:, None] for flight in training]) for score in scores]
    return lambda values: np.asarray(
        np.max([score(values) / size for score, size in zip(scores, sizes, strict=True)], axis=0)
    )


def _usual_peaks(healthy: Sequence[Floats]) -> Floats:
    """Return the mean of the largest values (k,) that healthy scores (n, k) have in different 10 s of flight."""
    begin = round(SETTLE_S * HZ)
    blocks = [
        one[first : first + begin].max(axis=0)
        for one in healthy
        for first in range(begin, max(len(one) - begin // 2, 0), begin)
    ]
    return np.asarray(np.sort(blocks, axis=0)[-LARGEST:].mean(axis=0))


def seen_failures(training: Sequence[Flight]) -> Callable[[Floats], Floats]:
    """Likelihood of what failures of the other flights looked like over the last seconds, in noise as it is.

    The signals of now and of some moments before, averaged over :data:`MEAN_S`, are one vector. Its covariance over
    healthy flight is the noise; the mean over failures of a kind, so long after they began, is a direction. An aircraft
    is the same on both sides: healthy flight and failures count mirrored, too.
    """
    scale = Scale.of(training)
    columns = [SIGNALS.index(name) for name in WATCHED]
    mirror = np.tile([-1.0 if name in SIDEWAYS else 1.0 for name in WATCHED], len(BEFORE_S))

    def history(values: Floats) -> Floats:
        means = running_mean(scale.scaled(values)[:, columns], round(MEAN_S * HZ))
        index = np.arange(len(means))
        return np.concatenate([means[np.maximum(index - round(before * HZ), 0)] for before in BEFORE_S], axis=1)

    begin = round(SETTLE_S * HZ)
    known = [history(flight.values) for flight in training]
    healthy = [one[begin : flight.onset] for one, flight in zip(known, training, strict=True)]
    joined = np.concatenate([one[::4] for one in healthy])
    joined = np.concatenate([joined, joined * mirror])
    usual = joined.mean(axis=0)
    noise = np.cov(joined.T)
    along = np.linalg.inv(noise + SHRINK * np.diag(np.diag(noise)))
    directions = np.stack([along @ one for one in _directions(training, known, usual, mirror)], axis=1)
    sizes = _usual_peaks(
        [(one[: flight.onset] - usual) @ directions for one, flight in zip(known, training, strict=True)]
    )
    return lambda values: np.asarray(((history(values) - usual) @ directions / sizes).max(axis=1))


def _directions(training: Sequence[Flight], known: Sequence[Floats], usual: Floats, mirror: Floats) -> Iterator[Floats]:
    """Yield what failures of a kind are on average, by the time since they began, to both sides."""
    kinds: dict[str, list[tuple[Flight, Floats]]] = {}
    for flight, one in zip(training, known, strict=True):
        if flight.onset < len(flight.values):
            word = re.search(_KINDS, flight.name)
            kinds.setdefault(_FAMILIES.get(word[0], word[0]) if word else "", []).append((flight, one))
    for family, flights in kinds.items():
        side = WATCHED.index(_SIDE_BY[family]) if family in _SIDE_BY else None
        for first_s, last_s in SEEN_S:
            first, last = round(first_s * HZ), round(last_s * HZ)
            means = [
                one[flight.onset + first : flight.onset + last].mean(axis=0) - usual
                for flight, one in flights
                if len(one) >= flight.onset + last
            ]
            if not means:
                continue
            if side is None:
                mean = np.mean(means, axis=0)
                yield (mean + mean * mirror) / 2
            else:
                mean = np.mean([one if one[side] > 0 else one * mirror for one in means], axis=0)
                yield from (mean, mean * mirror)


_KINDS = r"engine|left_aileron|right_aileron|both|elevator|rudder_left|rudder_right|rudder"
_FAMILIES = dict.fromkeys(("left_aileron", "right_aileron", "both"), "ailerons")
_FAMILIES |= dict.fromkeys(("rudder_left", "rudder_right"), "rudder")
_SIDE_BY = {"ailerons": "delta_roll", "rudder": "field.linear_acceleration.y"}
"""Which signal says to which side a failure went: the roll that is wanted in vain, the air from the side."""


def running_mean(values: Floats, count: int) -> Floats:
    """Return running means over the last samples (n, ...)."""
    total = np.concatenate([np.zeros_like(values[:1]), np.cumsum(values, axis=0)])
    index = np.arange(1, len(values) + 1)
    first = np.maximum(index - count, 0)
    size = (index - first).reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray((total[index] - total[first]) / size)


def shift(values: Floats) -> Floats:
    """Return the largest likelihood of a shifted mean over windows up to each sample, in deviations of noise."""
    count = values.shape[1]
    best = np.zeros(len(values))
    for window in (max(2, round(seconds * HZ)) for seconds in WINDOWS_S):
        size = window * np.square(running_mean(values, window)).sum(axis=1)
        best = np.maximum(best, (size - count) / math.sqrt(2.0 * count))
    return best


DETECTORS: dict[str, Detector] = {
    "fauio": fauio, "residual energy": residual_energy, "CUSUM": cusum, "GLR": glr, "Kalman bank": kalman_bank,
}  # fmt: skip


def alarms(score: Floats, threshold: float) -> list[tuple[int, int]]:
    """Return from when to when each alarm is active, those close together as one."""
    over = np.flatnonzero(score[int(SETTLE_S * HZ) :] > threshold) + int(SETTLE_S * HZ)
    spans: list[tuple[int, int]] = []
    for row in over.tolist():
        if spans and row - spans[-1][1] <= MERGE_S * HZ:
            spans[-1] = spans[-1][0], row
        else:
            spans.append((row, row))
    return spans


def threshold_for(scores: Sequence[Floats], per_hour: float) -> float:
    """Return the smallest threshold at which healthy scores have at most so many alarms an hour."""
    hours = sum(max(len(one) - SETTLE_S * HZ, 0) for one in scores) / HZ / 3600
    allowed = math.floor(per_hour * hours)
    low, high = 0.0, max(float(one[int(SETTLE_S * HZ) :].max(initial=0.0)) for one in scores)
    for _ in range(40):
        middle = (low + high) / 2
        raised = sum(len(alarms(one, middle)) for one in scores)
        low, high = (low, middle) if raised <= allowed else (middle, high)
    return high


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a detector made of a flight that it did not know."""

    flight: str
    kind: str
    failed: bool
    judged: bool  # there is flight enough ahead of the failure
    delay_s: float | None
    false: int
    healthy_s: float


def leave_one_out(flights: Sequence[Flight], detector: Detector, per_hour: float) -> list[Outcome]:
    """Return what becomes of each flight, with all else from the other logs."""
    logs = {flight.log: [one for one in flights if one.log == flight.log] for flight in flights}
    scores: dict[str, list[Floats]] = {}
    healthy: dict[str, list[Floats]] = {}
    for log, own in sorted(logs.items()):
        score = detector([flight for flight in flights if flight.log != log])
        scores[log] = [score(flight.values) for flight in own]
        healthy[log] = [one[: flight.onset] for one, flight in zip(scores[log], own, strict=True)]
    outcomes = []
    for log, own in sorted(logs.items()):
        # a detector knows what it learned from: healthy flight is scored by one that does not know it
        threshold = threshold_for([one for other in logs if other != log for one in healthy[other]], per_hour)
        for flight, one in zip(own, scores[log], strict=True):
            spans = alarms(one, threshold)
            after = [start for start, _ in spans if start >= flight.onset]
            failed = flight.onset < len(flight.values)
            outcomes.append(
                Outcome(
                    flight.name,
                    flight.kind,
                    failed,
                    flight.onset > SETTLE_S * HZ,
                    (after[0] - flight.onset) / HZ if failed and after else None,
                    sum(start < flight.onset for start, _ in spans),
                    max(flight.onset / HZ - SETTLE_S, 0.0),
                )
            )
    return outcomes


def summary(outcomes: Sequence[Outcome]) -> dict[str, float | int | None]:
    """Return figures over flights: delay, share found, accuracy and so on by flight, false alarms an hour and bound."""
    judged = [one for one in outcomes if one.judged]
    failed = [one for one in judged if one.failed]
    delays = [one.delay_s for one in failed if one.delay_s is not None]
    hours = sum(one.healthy_s for one in judged) / 3600
    false = sum(one.false for one in judged)
    right = sum(one.delay_s is not None and not one.false for one in failed)
    quiet = [one for one in judged if not one.failed]
    named = right + sum(one.false > 0 for one in judged)
    return {
        "flights": len(judged),
        "not_judged": len(outcomes) - len(judged),
        "found": len(delays),
        "failures": len(failed),
        "mean_delay_s": float(np.mean(delays)) if delays else None,
        "median_delay_s": float(np.median(delays)) if delays else None,
        "longest_delay_s": max(delays, default=None),
        "accuracy": (right + sum(not one.false for one in quiet)) / len(judged),
        "precision": right / named if named else None,
        "recall": right / len(failed) if failed else None,
        "false_alarms_per_hour": false / hours,
        "false_alarms_bound": poisson_bound(false) / hours,
        "healthy_hours": hours,
    }


def poisson_bound(count: int) -> float:
    """Return the 95 % upper bound of a Poisson mean of which so many were seen (3.0 of none: the rule of three)."""
    low, high = 0.0, 10.0 * count + 20.0
    for _ in range(60):
        middle = (low + high) / 2
        tail = math.exp(-middle) * sum(middle**k / math.factorial(k) for k in range(count + 1))
        low, high = (middle, high) if tail > 0.05 else (low, middle)
    return high


def main(words: Sequence[str] | None = None) -> int:
    """Run the comparison."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--per-hour", type=float, default=5.0)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(words)
    paths = sorted(args.folder.rglob("carbonZ_*.csv"))
    # one recording stands in the set twice, among the failures and among those without
    flights = [read_flight(path) for path in paths]
    flights = [one for one in flights if not (one.kind == "no_failure" and one.onset < len(one.values))]
    if not flights:
        sys.stderr.write(f"{args.folder}: holds no carbonZ_*.csv; give the folder 'failures' of the set\n")
        return 2
    for name, detector in DETECTORS.items():
        outcomes = leave_one_out(flights, detector, args.per_hour)
        kinds = sorted({one.kind for one in outcomes if one.failed})
        figures = {"all": summary(outcomes)}
        figures |= {kind: summary([one for one in outcomes if one.kind == kind]) for kind in kinds}
        if args.json:
            sys.stdout.write(json.dumps({"detector": name, **figures}) + "\n")
            continue
        sys.stdout.write(f"{name}\n")
        for kind, one in figures.items():
            mean, longest = one["mean_delay_s"], one["longest_delay_s"]
            delay = "-" if mean is None else f"{mean:.2f} s (median {one['median_delay_s']:.2f}, longest {longest:.1f})"
            sys.stdout.write(
                f"  {kind:<10} found {one['found']}/{one['failures']}, mean delay {delay}, "
                f"accuracy {one['accuracy']:.2f}, "
                f"precision {one['precision'] or 0:.2f}, recall {one['recall']:.2f}, "
                f"false/h {one['false_alarms_per_hour']:.1f} (at most {one['false_alarms_bound']:.1f})\n"
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
