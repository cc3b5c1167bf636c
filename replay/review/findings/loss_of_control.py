"""When a vehicle was no longer flown: what comes later is a consequence, and no finding of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from replay.review.facts.log_facts import Floats, LogFacts, LogSignal, inside, spans_where

STOPPED = 0.02
"""Share of full command below which a motor does not turn: under every autopilot's idle (PX4 idles from 0.05 on,
ArduPilot's SPIN_ARM is 0.1)."""
FULL = 0.945
"""Share of full command: ArduPilot leaves 5 % (MOT_SPIN_MAX 0.95) and logs whole microseconds, of which a range of
pulses has 200 and more."""
FAST_M_S = 15.0
"""A fifth more than PX4 (MPC_XY_VEL_MAX 12) and ArduPilot (LOIT_SPEED 12.5) allow a copter by default: beyond it the
air turns a multirotor about as much as its motors do, and rotors that meet it at a slant lift otherwise."""
_PACE_S = 1.0
"""Over which a receiver's way is a speed: its noise, some 0.1 m from fix to fix, is none then."""
IDLE = 0.4
"""Share of its usual command below which the strongest motor idles. Measured in 24 public logs: idle ones have 0.08 to
0.26 of it, those that fly 0.61 and more."""
_STOPPED_S = 0.4
"""Chosen: four samples of a log of default rates; a mixer that is saturated takes all motors to zero for less."""
FELL_M = 2.0
"""Metres that a vehicle falls without motors in 0.64 s, and no gust lets it sink within two seconds; measured: a
barometer's reading moves by 1 m when motors stop on the ground, and by up to 5 m under strong ones."""
_FALL_S = 3.0
"""Time in which to see it: it falls 44 m in it, twice the barometer's slowest averaging."""
_UPSIDE_DOWN = 100.0
"""Degrees from level beyond which no multirotor is held unless it flips on purpose."""
_GRAVITY = 9.81
_ABOUT_S = 1.0
"""Seconds ahead of an attitude in which a blow belongs to it."""
_ON_ITS_BACK_S = 0.3
"""Chosen: a flip takes as long as it is upside down, a tumbling vehicle too; six samples at 20 Hz."""


def stops(facts: LogFacts) -> list[tuple[float, float, float]]:
    """Return when all motors were commanded to stop while the vehicle then fell: from, to, and metres it fell."""
    motors, height = facts.signal("motors"), facts.signal("height")
    armed_or_just = [(start, end + 1.0) for start, end in facts.armed]
    still = (motors.values < STOPPED).all(axis=1) & inside(motors.time_s, armed_or_just)
    flown = np.flatnonzero((motors.values > STOPPED).any(axis=1))
    found = []
    for start, end in spans_where(motors.time_s, still, _STOPPED_S):
        if not len(flown) or start < motors.time_s[flown[0]]:
            continue
        fell = _fall(height, start)
        if fell is not None and fell >= FELL_M:
            found.append((start, end, fell))
    return found


def _fall(height: LogSignal, start_s: float) -> float | None:
    """Return by how much a height goes down within some seconds of a time."""
    before, after = height.during(start_s - 1.0, start_s).only, height.during(start_s, start_s + _FALL_S).only
    if not len(before) or not len(after):
        return None
    # rotors at work change the pressure at the barometer: a reading that jumps up and stays is no fall
    return float(np.median(before) - np.median(after[-max(1, len(after) // 3) :]))


def tumbles(facts: LogFacts) -> list[tuple[float, float]]:
    """Return from when to when a multirotor was beyond what it is flown at."""
    attitude = facts.signal("attitude")
    if not attitude or facts.vehicle != "multirotor":
        return []
    # from the air to the ground, on which it stays: a slow link has one sample of the fall
    spans = spans_where(attitude.time_s, tilts_deg(attitude) > _UPSIDE_DOWN, _ON_ITS_BACK_S)
    begun = facts.in_flight(np.array([start for start, _ in spans]))
    return [span for span, flies in zip(spans, begun, strict=True) if flies and not undisturbed(facts, span[0])]


def tilts_deg(attitude: LogSignal) -> Floats:
    """Return by how much a vehicle leans (n,), degrees: nose up or down roll alone jumps, and says nothing of it."""
    roll, pitch = np.cos(np.radians(attitude.values[:, :2].T))
    return np.asarray(np.degrees(np.arccos(roll * pitch)))


def undisturbed(facts: LogFacts, start_s: float) -> bool:
    """Return whether accelerometers and barometer say that a vehicle stood still, whatever its attitude says.

    A vehicle that has turned over falls, and meets the ground: an attitude without either is the estimator's error.
    """
    force, fell = facts.signal("acceleration"), _fall(facts.signal("height"), start_s)
    if not force or fell is None:
        return False
    values = force.during(start_s - _ABOUT_S, start_s + _FALL_S).values
    blow = float(np.linalg.norm(values, axis=1).max(initial=0.0))
    on_its_back = not len(values) or float(np.median(values[:, 2])) > 0.0
    return not on_its_back and blow < 2 * _GRAVITY and abs(fell) < FELL_M


def lost_s(facts: LogFacts) -> float:
    """Return when control was lost, as far as can be seen; the log's end where it was not."""
    ends = [start for start, _, _ in stops(facts)] + [start for start, _ in tumbles(facts)]
    return min(ends, default=facts.duration_s)


def in_control(facts: LogFacts, time_s: Floats) -> NDArray[np.bool_]:
    """Return which of n times are in flight and before control was lost (n,)."""
    return facts.in_flight(time_s) & (time_s < lost_s(facts))


def spans_in_control(
    facts: LogFacts, signal: LogSignal, holds: NDArray[np.bool_], least_s: float
) -> list[tuple[float, float]]:
    """Return from when to when a condition on n samples of a signal held in flight, before control was lost."""
    return spans_where(signal.time_s, holds & in_control(facts, signal.time_s), least_s)


def speed(facts: LogFacts) -> LogSignal:
    """Return how fast a vehicle went over the ground (m/s), by its receiver's way over a second."""
    way = facts.signal("position")
    times = way.time_s
    before = np.maximum(np.searchsorted(times, times - _PACE_S, side="right") - 1, 0)
    past = times - times[before]
    gone = np.hypot(*(way.values - way.values[before]).T) if way else np.empty(0)
    pace = np.where(past > 0, gone / np.where(past > 0, past, 1.0), 0.0)
    return replace(way, values=pace[:, None], names=("speed",), unit="m/s")
