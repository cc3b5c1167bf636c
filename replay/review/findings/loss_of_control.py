"""The time of a loss of control: everything later is a consequence, and no finding of its own."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from replay.review.facts.log_facts import Floats, LogFacts, LogSignal, inside, spans_where

STOPPED = 0.02
"""Share of full command below which a motor does not turn: less than every autopilot's idle (PX4 idles from 0.05 on,
ArduPilot's SPIN_ARM is 0.1)."""
FULL = 0.945
"""Share of full command that counts as full: ArduPilot leaves 5 % unused (MOT_SPIN_MAX 0.95) and logs whole
microseconds, and a range of pulses has at least 200 of them."""
FAST_M_S = 15.0
"""Speed of a fast multirotor, m/s: a fifth more than PX4 (MPC_XY_VEL_MAX 12) and ArduPilot (LOIT_SPEED 12.5) allow by
default. Beyond it the air turns a multirotor about as much as its motors do, and the lift of rotors changes in the
oblique flow."""
_PACE_S = 1.0
"""Time over which a receiver's path gives a speed, seconds: its noise, some 0.1 m from fix to fix, is negligible
then."""
IDLE = 0.4
"""Share of its usual command below which the strongest motor idles. Measured in 24 public logs: idle ones have 0.08 to
0.26 of it, flying ones 0.61 and more."""
_STOPPED_S = 0.4
"""Shortest stop, seconds. Chosen: four samples of a log with default rates; a saturated mixer takes all motors to zero
for less."""
FELL_M = 2.0
"""Smallest fall, metres: a vehicle without motors needs 0.64 s for it, and no gust makes it sink that far within two
seconds. Measured: a barometer's reading changes by 1 m when motors stop on the ground, and by up to 5 m under strong
motors."""
_FALL_S = 3.0
"""Time in which the fall is measured, seconds: a vehicle falls 44 m in it, twice the barometer's slowest averaging."""
_UPSIDE_DOWN = 100.0
"""Degrees from level beyond which a multirotor is only in a deliberate flip."""
_GRAVITY = 9.81
_ABOUT_S = 1.0
"""Time before an attitude in which an impact belongs to it, seconds: a vehicle that was hit tumbles within a second."""
_BLOW, _AFTER_S, _RARELY = 8.0 * _GRAVITY, 3.0, 0.01
"""Acceleration of a blow, m/s2: half of the range that IMUs usually have. Time after it in which an estimator's error
is its consequence, seconds. Chosen: a tumble on the ground ends sooner. Largest share of a flight with such
accelerations. Chosen: ten crashes that ring for a tenth of a second are a hundredth of 100 s; more is vibration."""
_ON_ITS_BACK_S = 0.3
"""Shortest time upside down, seconds. Chosen: a flip takes that long, a tumbling vehicle too; six samples at 20 Hz."""


def stops(facts: LogFacts) -> list[tuple[float, float, float]]:
    """Return the stops of all motors after which the vehicle fell: begin, end, and metres of the fall."""
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
    """Return the decrease of a height within some seconds after a time."""
    before, after = height.during(start_s - 1.0, start_s).only, height.during(start_s, start_s + _FALL_S).only
    if not len(before) or not len(after):
        return None
    # turning rotors change the pressure at the barometer: a reading that jumps up and stays there is no fall
    return float(np.median(before) - np.median(after[-max(1, len(after) // 3) :]))


def tumbles(facts: LogFacts) -> list[tuple[float, float]]:
    """Return the spans in which a multirotor was tilted further than it is ever flown."""
    attitude = facts.signal("attitude")
    if not attitude or facts.vehicle != "multirotor":
        return []
    # the span lasts from the air to the ground, where the vehicle stays: a slow link has one sample of the fall
    spans = spans_where(attitude.time_s, tilts_deg(attitude) > _UPSIDE_DOWN, _ON_ITS_BACK_S)
    begun = facts.in_flight(np.array([start for start, _ in spans]))
    return [span for span, flies in zip(spans, begun, strict=True) if flies and not undisturbed(facts, span[0])]


def tilts_deg(attitude: LogSignal) -> Floats:
    """Return a vehicle's tilt (n,), degrees; roll alone jumps when the nose points up or down."""
    roll, pitch = np.cos(np.radians(attitude.values[:, :2].T))
    return np.asarray(np.degrees(np.arccos(roll * pitch)))


def undisturbed(facts: LogFacts, start_s: float) -> bool:
    """Return whether accelerometers and barometer show that a vehicle stood still, whatever its attitude is.

    A vehicle that has turned over falls, and hits the ground: an attitude without either is the estimator's error.
    """
    force, fell = facts.signal("acceleration"), _fall(facts.signal("height"), start_s)
    if not force or fell is None:
        return False
    values = force.during(start_s - _ABOUT_S, start_s + _FALL_S).values
    blow = float(np.linalg.norm(values, axis=1).max(initial=0.0))
    on_its_back = not len(values) or float(np.median(values[:, 2])) > 0.0
    return not on_its_back and blow < 2 * _GRAVITY and abs(fell) < FELL_M


def struck(facts: LogFacts, before_s: float) -> bool:
    """Return whether a blow came in the seconds before a time: it takes an estimator off, not the other way round."""
    force = facts.signal("acceleration")
    hard, flown = np.linalg.norm(force.values, axis=1) > _BLOW, facts.in_flight(force.time_s)
    just = slice(*np.searchsorted(force.time_s, (before_s - _AFTER_S, before_s)))
    return bool(hard[just].any() and np.count_nonzero(hard & flown) <= _RARELY * np.count_nonzero(flown))


def lost_s(facts: LogFacts) -> float:
    """Return the time of the loss of control, by a kill switch or to be seen; the log's end if there was none."""
    kills = [said.time_s for said in facts.statements if said.kind == "kill"]
    ends = [start for start, _, _ in stops(facts)] + [start for start, _ in tumbles(facts)]
    ends += [at for at, flies in zip(kills, facts.in_flight(np.array(kills)), strict=True) if flies]
    return min(ends, default=facts.duration_s)


def in_control(facts: LogFacts, time_s: Floats) -> NDArray[np.bool_]:
    """Return which of n times are in flight and before control was lost (n,)."""
    return facts.in_flight(time_s) & (time_s < lost_s(facts))


def spans_in_control(
    facts: LogFacts, signal: LogSignal, holds: NDArray[np.bool_], least_s: float
) -> list[tuple[float, float]]:
    """Return the spans in which a condition on n samples of a signal held in flight, before control was lost."""
    return spans_where(signal.time_s, holds & in_control(facts, signal.time_s), least_s)


def speed(facts: LogFacts) -> LogSignal:
    """Return a vehicle's speed over ground (m/s), from its receiver's path over a second."""
    way = facts.signal("position")
    times = way.time_s
    before = np.maximum(np.searchsorted(times, times - _PACE_S, side="right") - 1, 0)
    past = times - times[before]
    gone = np.hypot(*(way.values - way.values[before]).T) if way else np.empty(0)
    pace = np.where(past > 0, gone / np.where(past > 0, past, 1.0), 0.0)
    return replace(way, values=pace[:, None], names=("speed",), unit="m/s")
