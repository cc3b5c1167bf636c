"""The ALFA flights (a fixed wing whose engine or surfaces fail), detectors at the same rate of false alarms.

    python bench/leaderboard/alfa.py FOLDER [--per-hour 2] [--json]

FOLDER is ``failures`` of https://github.com/FabioCarosi/FaultDetection_ALFA-Dataset: one CSV for each flight, 20 Hz,
wanted less measured (roll, pitch, yaw, speeds, height), rates and accelerations. Nothing of it is in this repository.
The set has no commands of actuators, so no profile of fauio can be fitted on it; what runs under its name is its way to
see a sudden loss, written for these signals: what a regression on healthy flight leaves, against a shift of its mean in
any direction, and in those that failures of the other flights took, in noise as coloured as it is seen to be.

Leave one flight out: what is fitted and the threshold come from the healthy parts of all other flights (recordings of
one log, by their date, are one flight). The threshold is the smallest at which those have at most so many false alarms
an hour. A failure counts as found if an alarm begins at it or later; one that was active before counts against it.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

HZ = 20.0
SIGNALS = (
    "delta_roll",
    "delta_pitch",
    "delta_yaw",
    "delta_z",
    "delta_roll_airspeed",
    "field.twist.angular.x",
    "field.twist.angular.y",
    "field.twist.angular.z",
    "field.twist.linear.z",
    "field.linear_acceleration.x",
    "field.linear_acceleration.y",
    "field.linear_acceleration.z",
    "field.orientation.x",
    "field.orientation.y",
)
EXPLAINED = ("delta_z", "field.twist.angular.x", "field.twist.angular.y", *SIGNALS[7:12])
"""What a failure changes: rates, accelerations, climb and its error. The rest, wanted less measured and attitude, says
what the autopilot asks for and how the aircraft lies."""
RARE = 0.999
"""Share of healthy samples below which windows of all lengths are set to the same size."""
MERGE_S = 10.0
"""Chosen: what crosses the threshold twice within it is one alarm, as alarms of a monitor clear late."""
SETTLE_S = 10.0
"""Chosen: what every detector leaves out at the begin of a flight, to settle."""
WINDOWS_S = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0)
"""Lengths over which a mean may have shifted: from two samples to twice the published mean delay."""
KNOWN_FROM_S = 0.5
"""Shortest window in which known directions are looked for: the signature is of the first seconds."""
SEEN_S = (0.5, 4.0)
"""Seconds after a failure that show its direction: its motion has begun, the autopilot has not yet turned away."""
LAGS_S = (0.0, 0.25, 0.5, 1.0)
"""How long ago what explains was so: surfaces, engine and aircraft follow within a second."""
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
    return lambda values: _mean(np.square(scale.scaled(values)).mean(axis=1), int(HZ))


def cusum(training: Sequence[Flight]) -> Callable[[Floats], Floats]:
    """Largest two-sided cumulative sum of the scaled signals, with a drift of half a deviation."""
    scale = Scale.of(training)

    def score(values: Floats) -> Floats:
        scaled = scale.scaled(values)
        up = down = np.zeros(scaled.shape[1])
        sums = np.empty(len(scaled))
        for row, one in enumerate(scaled):
            up, down = np.maximum(up + one - 0.5, 0.0), np.maximum(down - one - 0.5, 0.0)
            sums[row] = max(up.max(), down.max())
        return sums

    return score


def glr(training: Sequence[Flight]) -> Callable[[Floats], Floats]:
    """Likelihood of a shifted mean in the scaled signals, as if they were white."""
    scale = Scale.of(training)
    return lambda values: _shift(scale.scaled(values))


def fauio(training: Sequence[Flight]) -> Callable[[Floats], Floats]:
    """Likelihood of a shifted mean in what a regression on wanted less measured leaves, in noise as it is."""
    scale = Scale.of(training)
    explained = [SIGNALS.index(name) for name in EXPLAINED]
    others = [column for column in range(len(SIGNALS)) if column not in explained]
    scaled = [scale.scaled(flight.healthy) for flight in training]
    causes = np.concatenate([_causes(one, others) for one in scaled])
    effects = np.concatenate([one[:, explained] for one in scaled])
    weights = np.linalg.solve(causes.T @ causes + 1e-3 * len(causes) * np.eye(causes.shape[1]), causes.T @ effects)

    def left(one: Floats) -> Floats:
        return np.asarray(np.clip(one[:, explained] - _causes(one, others) @ weights, -CLIP, CLIP))

    lengths = [max(2, round(seconds * HZ)) for seconds in WINDOWS_S]
    remains = [left(one) for one in scaled]
    means = [np.concatenate([_mean(one, length) for one in remains]) for length in lengths]
    # of coloured noise a mean over a window has the covariance that it is seen to have
    shapes = [np.linalg.inv(np.cov(one.T) + 1e-4 * np.eye(one.shape[1])) for one in means]
    known = _signatures([(flight, left(scale.scaled(flight.values))) for flight in training])
    tests = [
        (length, _test(shape, direction))
        for length, shape in zip(lengths, shapes, strict=True)
        for direction in [None, *known]
        if direction is None or length >= KNOWN_FROM_S * HZ
    ]
    usual = {
        number: np.quantile(test(means[lengths.index(length)]), RARE) for number, (length, test) in enumerate(tests)
    }

    def score(values: Floats) -> Floats:
        after = left(scale.scaled(values))
        shifted = {length: _mean(after, length) for length in lengths}
        sizes = [test(shifted[length]) / usual[number] for number, (length, test) in enumerate(tests)]
        return np.asarray(np.max(sizes, axis=0))

    return score


_KINDS = r"engine|left_aileron|right_aileron|both|elevator|rudder_left|rudder_right|rudder"


def _signatures(training: Sequence[tuple[Flight, Floats]]) -> list[Floats]:
    """Return the directions that failures of the training flights take: engine and surfaces, each to either side."""
    parts: dict[str, list[Floats]] = {}
    begin, end = (round(seconds * HZ) for seconds in SEEN_S)
    for flight, left in training:
        if flight.onset < len(left) - end:
            before = left[max(flight.onset - 5 * int(HZ), 0) : flight.onset].mean(axis=0)
            word = re.search(_KINDS, flight.name)
            shift = left[flight.onset + begin : flight.onset + end].mean(axis=0) - before
            parts.setdefault(word[0] if word else "", []).append(shift)
    return [np.asarray(np.mean(shifts, axis=0), np.float64) for shifts in parts.values()]


def _test(shape: Floats, direction: Floats | None) -> Callable[[Floats], Floats]:
    """Return the likelihood of a shift of any direction, or of a known one."""
    if direction is None:
        return lambda values: np.sqrt(_size(values, shape))
    along = shape @ direction / math.sqrt(direction @ shape @ direction)
    return lambda values: np.asarray(np.maximum(values @ along, 0.0))


def _size(values: Floats, shape: Floats) -> Floats:
    return np.asarray(np.einsum("ni,ij,nj->n", values, shape, values))


def _causes(values: Floats, columns: Sequence[int]) -> Floats:
    parts = [np.ones((len(values), 1))]
    for lag in (round(seconds * HZ) for seconds in LAGS_S):
        late = values[np.maximum(np.arange(len(values)) - lag, 0)][:, columns]
        parts += [late, np.square(late)]
    return np.concatenate(parts, axis=1)


def _mean(values: Floats, count: int) -> Floats:
    """Return running means over the last samples (n, ...)."""
    total = np.concatenate([np.zeros_like(values[:1]), np.cumsum(values, axis=0)])
    index = np.arange(1, len(values) + 1)
    first = np.maximum(index - count, 0)
    size = (index - first).reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray((total[index] - total[first]) / size)


def _shift(values: Floats) -> Floats:
    """Return the largest likelihood of a shifted mean over windows up to each sample, in deviations of noise."""
    count = values.shape[1]
    best = np.zeros(len(values))
    for window in (max(2, round(seconds * HZ)) for seconds in WINDOWS_S):
        size = window * np.square(_mean(values, window)).sum(axis=1)
        best = np.maximum(best, (size - count) / math.sqrt(2.0 * count))
    return best


DETECTORS: dict[str, Detector] = {"fauio": fauio, "residual energy": residual_energy, "CUSUM": cusum, "GLR": glr}


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
    outcomes = []
    for log in sorted({flight.log for flight in flights}):
        training = [flight for flight in flights if flight.log != log]
        score = detector(training)
        threshold = threshold_for([score(flight.healthy) for flight in training], per_hour)
        for flight in (one for one in flights if one.log == log):
            spans = alarms(score(flight.values), threshold)
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
        "false_alarms_bound": _bound(false) / hours,
        "healthy_hours": hours,
    }


def _bound(count: int) -> float:
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
            delay = "-" if mean is None else f"{mean:.2f} s (longest {longest:.1f})"
            sys.stdout.write(
                f"  {kind:<10} found {one['found']}/{one['failures']}, mean delay {delay}, "
                f"accuracy {one['accuracy']:.2f}, "
                f"precision {one['precision'] or 0:.2f}, recall {one['recall']:.2f}, "
                f"false/h {one['false_alarms_per_hour']:.1f} (at most {one['false_alarms_bound']:.1f})\n"
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
