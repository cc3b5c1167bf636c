"""How long readings of sensors last in healthy flight, and how long the same one may be repeated."""

from collections.abc import Sequence
from math import ceil, cos, log, pi, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapters.channels import Channel
from monitor.core.sampling import LINE_PERIODS
from monitor.fitting.flights import Flight
from monitor.fitting.survey import Survey
from monitor.vehicles.inertial.strapdown import GPS, IMU, MAGNETOMETER, SENSORS

BENT_SINGLE, BENT_DOUBLE = 1e-6, 1e-12
"""Smallest bend that counts, relative to the signal's size, of numbers of single and of double precision: above the
rounding of a straight line. Heights in logs of PX4, of single precision, bend by 1e-7 between measurements."""
HELD_PERIODS = 3.0
"""Number of its usual periods after which a measurement that stays the same has stopped. Chosen: two measurements may
be lost."""
_LEAST_STUCK_S = 1.0
"""Time after which a receiver that repeats a fix is stuck, seconds: in 27 flights of two simulators, with 5 and 8 fixes
a second, no two consecutive fixes were the same."""
_FROZEN_S = 0.5
"""Time without a change of any value of IMU and attitude after which they are frozen, seconds. Chosen: two samples over
the slowest radio (4 Hz); nine noisy values do not repeat once."""
_REPEATED = 5.0
"""Least ratio of that time to the longest repetition in healthy flight. Chosen: simulators without noise repeat
values."""
_LEAST_TURNS = 1.0 / 3.0
"""Least share of changes against the one before of a sensor that is noisy: 2/3 by white noise alone, 1/3 if motion has
two thirds of their variance. Measured on 19 flights: 0.47 to 0.68 where readings hardly ever repeat, 0.01 to 0.31
for simulated barometers without noise, which repeat for up to 6.8 s in a calm."""
_MOST_REPEATS = 0.25
"""Largest chance of a repeat: the noise is then one step of the readings (q / (2 sqrt(pi) sigma) = 0.28), and the
chance is the same wherever between two steps the value lies."""
_RULE_OF_THREE = 3.0
"""Repeats that were not seen but are possible, at 95 %."""
_CALMER = 3.0
"""Ratio of the noise in the fitted flights to that of a calm one, by which repeats come more often there. Chosen: the
wash of propellers and gusts have a part in it."""
_LEAST_FROZEN_S = 1.0
"""Least time: twice the 500 ms (`BARO_TIMEOUT_MS`) for which ArduPilot takes a silent barometer for healthy."""
_LEAST_READINGS = 100.0
"""Fewest readings from which a chance is known: it is then below 0.03 if none repeats."""


class _Repeats(NamedTuple):
    """What the readings of a sensor in healthy flights show of its repeats."""

    line: int  # samples that a reading lasts
    readings: int
    repeated: float  # readings that equal the one before
    longest: float  # most that do so one after the other
    turns: float  # share of changes against the one before, of the noisiest signal; 0 of too few readings


def line_s(raw: Sequence[Flight], index: int, signal_hz: float, bent_from: float) -> float:
    """Return the median length of the straight lines from one measurement of a signal to the next, seconds.

    A bend counts from a share of the signal's size on.
    """
    lines = [np.zeros(0)]
    bent, count = 0, 0
    for flight in raw:
        values = flight.samples.u[flight.evidence, index]
        bends = np.abs(np.diff(values, 2)) > bent_from * max(1.0, float(np.abs(values).max(initial=0.0)))
        # a measurement between two samples bends both of them
        first = np.flatnonzero(bends & ~np.concatenate([[False], bends[:-1]]))
        lines.append(np.diff(first))
        bent, count = bent + int(bends.sum()), count + len(bends)
    steps = np.concatenate(lines)
    # A line of three samples and more bends at two samples in three at most.
    ticks = float(np.median(steps)) if len(steps) and 3 * bent <= 2 * count else 1.0
    return round(ticks / signal_hz, 3)


def holds(
    surveys: Sequence[Survey], channels: Sequence[Channel], raw: Sequence[Flight], signal_hz: float
) -> dict[str, float]:
    """Return how long a fix, a magnetic field, and the whole IMU may stay the same until the next measurement."""
    times = {}
    repeated = [_longest_same(flight.samples.u[flight.evidence, : len(IMU)]) / signal_hz for flight in raw]
    if repeated and _REPEATED * max(repeated) <= _FROZEN_S:
        times["imu_hold_s"] = _FROZEN_S
    for index, channel in enumerate(channels):
        if channel.name == GPS[0]:
            slowest_hz = min(survey.rate_hz[channel.message] for survey in surveys)
            times["gps_hold_s"] = max(_LEAST_STUCK_S, HELD_PERIODS / slowest_hz)
        if channel.name == MAGNETOMETER[0]:
            fields = [flight.samples.u[flight.evidence, index : index + len(MAGNETOMETER)] for flight in raw]
            firsts = [_news(field) for field in fields]
            steps = np.concatenate([np.zeros(0, np.intp), *(np.diff(one) for one in firsts if one is not None)])
            if len(steps):
                times["compass_hold_s"] = round(HELD_PERIODS * float(np.median(steps)) / signal_hz, 3)
    return times


def frozen_times(
    raw: Sequence[Flight], channels: Sequence[Channel], signal_hz: float, alarms_per_hour: float
) -> dict[str, float]:
    """Return how long each noisy sensor may repeat a reading until it is frozen, and how long one reading may last."""
    signals, times = [channel.name for channel in channels], {}
    for sensor, names in SENSORS.items():
        if not set(names) <= set(signals):
            continue
        found = _repeats(raw, signals.index(names[0]), len(names), signal_hz)
        count = _longest_by_chance(found, signal_hz, alarms_per_hour)
        # Runs that are longer than chance allows are no chance.
        if count is not None and found.longest < count:
            # A reading stays for one period, the repeats for as many more, and half of one is jitter. A message that
            # comes three times as seldom as in these flights is still read.
            periods, period_s = count + 1.5, LINE_PERIODS * found.line / signal_hz
            times[f"{sensor}_frozen_s"] = round(max(_LEAST_FROZEN_S, periods * period_s), 3)
            times[f"{sensor}_reading_s"] = round(times[f"{sensor}_frozen_s"] / periods, 3)
    return times


def _repeats(raw: Sequence[Flight], first: int, width: int, signal_hz: float) -> _Repeats:
    """Return the repeats of the sensor whose signals are ``width`` columns from ``first`` on."""
    line = max(1, round(line_s(raw, first, signal_hz, BENT_SINGLE) * signal_hz))
    repeated, readings, turned, longest = 0.0, 0, [np.zeros((0, width), np.bool_)], 0.0
    healthy = (one.samples.u[rows, first : first + width] for one in raw for rows in one.stretches(at_restart=True))
    for values in healthy:
        news = _news(values)
        ticks = np.diff(np.arange(0, len(values), line) if news is None else news)
        if len(ticks) < 2:
            continue
        if news is None:
            read, again = values[::line], np.array([_longest_same(values)]) / line
        else:
            line = max(line, round(float(np.median(ticks))))
            read, again = values[news[1:] - 1], ticks / line - 1.0
        changes = np.diff(read, axis=0)
        turned.append(changes[1:] * changes[:-1] < 0.0)
        repeated += float(np.rint(again).clip(0.0).sum())
        readings, longest = readings + len(read), max(longest, float(again.max()))
    turns = float(np.concatenate(turned).mean(axis=0).max()) if readings >= _LEAST_READINGS else 0.0
    return _Repeats(line, readings, repeated, longest, turns)


def _longest_by_chance(found: _Repeats, signal_hz: float, alarms_per_hour: float) -> int | None:
    """Return the repeats in a row that chance exceeds at a rate of false alarms; None if chance does not tell.

    Of a sensor with white noise each reading equals the one before with the same probability p, so that N readings an
    hour hold N p^n runs of n repeats. While the vehicle moves p is smaller than at rest. Successive changes have a
    correlation of rho = -1/2 by noise and 1 by smooth motion, and opposite signs in a share s = arccos(rho) / pi of
    cases; so noise is (1 - rho) / 1.5 of their variance, and p at rest is larger by the square root of its inverse.
    """
    if found.turns < _LEAST_TURNS:
        return None
    noise = min(1.0, (1.0 - cos(pi * found.turns)) / 1.5)
    chance = _CALMER * (found.repeated + _RULE_OF_THREE) / found.readings / sqrt(noise)
    if chance > _MOST_REPEATS:
        return None
    return ceil(log(3600.0 * signal_hz / found.line / alarms_per_hour) / -log(chance))


def _news(values: NDArray[np.float64]) -> NDArray[np.intp] | None:
    """Return the rows at which new readings appear that are held; None if the rows are on lines between readings."""
    changes = np.flatnonzero(np.diff(values, axis=0).any(axis=1)) + 1
    if 3 * len(changes) > 2 * len(values):
        return None
    # a measurement between two samples changes both of them, and on a line between two all change
    return changes[np.diff(changes, prepend=-1) > 1]


def _longest_same(rows: NDArray[np.float64]) -> int:
    """Return the largest number of rows for which all values stayed the same."""
    changes = np.flatnonzero((np.diff(rows, axis=0) != 0.0).any(axis=1))
    return int(np.diff(np.concatenate([[-1], changes, [len(rows) - 1]])).max()) - 1 if len(rows) else 0
