"""Judgements from the alarms of a profile that was learned from the flight's own begin."""

from collections.abc import Iterator, Mapping, Sequence
from math import isnan, nan

import numpy as np

from replay.review.facts.log_facts import LearnedAlarm, LogFacts
from replay.review.findings.loss_of_control import FAST_M_S, lost_s, speed
from replay.review.findings.rule import Judgement, UnjudgedError

_LEAST_S = 5.0
"""Shortest alarm that is judged, seconds. Measured on fifteen healthy simulated flights learned from their first 40 s:
alarms of motors end within 3.6 s (hard turns that the begin did not have)."""
_PASSING_S = 12.0
"""An alarm that ends by itself in a shorter time is information only, seconds: a broken part stays broken. Measured on
40 real flights (public logs of ArduPilot): without other signs of a fault, seven alarms of motors and GPS velocities
end after 6 to 11 s, those of GPS velocities because the observer holds a jump for 10 s. Alarms of faults last as
long as the fault."""
_TURNS = 3
"""Alarms of one surface or of the steering that are no coincidence. Chosen: a gust or a kerb is not met three times."""
_TWO = 2
"""Most motors, or axes of inertial sensors, that one fault alarms: it shares itself out among two that look alike."""
_SEVERAL = {"motors": ("motor",), "axes of gyros and accelerometers": ("gyro_", "accel_")}
_POSITIONS = ("gps_north", "gps_east", "gps_down")
_ACCURACY_M = 2.5
"""Metres that half of a receiver's errors exceed (data sheet of u-blox's M8): a smaller error is no fault. Measured: a
healthy flight in 8 m/s of gusty wind after a calm begin reached 0.75 m."""
_DELAY_S = 0.11
"""Difference of two receivers' delays, seconds (ArduPilot's EK3_GPS_DELAY: 0.11 s for a u-blox M8, 0.22 s for an
unknown receiver): a delay is learned while the vehicle moves, and hardly in a hover. Multiplied by the speed it is
an error in metres."""
_FASTER = 1.25
"""Factor on the learned speed: drag is proportional to the square of the speed, so it is half as much again."""
_LANDING_S = 3.0
"""Time before touch-down that is left out, seconds: the ground reflects the rotors' air."""
_CARRIED_S = 5.0
"""Length of the compared parts of the flight, seconds. Chosen: as long as an alarm has to last; climbs and turns
average out in it."""
_GROUND_S = 10.0
"""Shortest time on the ground in which a load, a battery or the calibration may be changed, seconds. Chosen: nobody
reaches a vehicle and leaves it in less. Measured: two gyros of one autopilot drifted apart by 1.1 degrees/s in a flight
and differed by 1.5 the other way after the next arming."""
_SATELLITES = 6
"""Fewest satellites: PX4 (EKF2_REQ_NSATS) and ArduPilot (EK3_GPS_CHECK) require at least as many before their
estimators use GPS."""


def alarms_of(facts: LogFacts, channels: Mapping[tuple[str, ...], float]) -> Iterator[Judgement]:
    """Yield judgements of the lasting alarms of some channels, one for each channel, from its first alarm on.

    ``channels`` gives, by the begins of channels' names, the ratio to the threshold from which an alarm is more than
    information.
    """
    watch = facts.watch
    if watch is None:
        return
    end_s = lost_s(facts)
    # the motors' observer compares commands with gyros: alone it cannot tell which of the two is wrong
    lasting = [
        alarm
        for alarm in watch.alarms
        if not isnan(_least_share(channels, alarm))
        and _own(alarm)
        and _until_s(alarm, facts, end_s) - alarm.start_s >= _LEAST_S
    ]
    begin_s = max((start for start, _ in facts.flight if start < watch.until_s), default=0.0)
    learned_s = watch.until_s - begin_s
    wrong = {alarm.observer: alarm for alarm in reversed(lasting) if not alarm.possible}
    sound = [alarm for alarm in lasting if alarm.observer not in wrong]
    if wrong and not sound:
        first = min(wrong.values(), key=lambda alarm: alarm.start_s)
        raise UnjudgedError(
            f"the model learned from the first {learned_s:.0f} s does not fit the rest: from {first.start_s:.0f} s on "
            f"{first.channel} would have an impossible fault"
        )
    for channel in dict.fromkeys(alarm.channel for alarm in sound):
        every = [alarm for alarm in sound if alarm.channel == channel]
        # what a vehicle turns with is seen only while it turns: broken, it is seen in every turn
        turns = facts.vehicle != "multirotor" and len(every) >= _TURNS
        staying = [alarm for alarm in every if turns or _stays(alarm, facts, end_s)]
        own = staying or every
        largest = max(own, key=lambda alarm: alarm.share)
        until_s = _until_s(largest, facts, end_s)
        fastest = np.max(speed(facts).during(largest.start_s, until_s).only, initial=0.0)
        accurate = channel in _POSITIONS and largest.size < _ACCURACY_M + _DELAY_S * fastest
        doubts = (
            *_still_carried(facts, largest, begin_s, until_s),
            *_together(largest, sound),
            *_few_satellites(facts, largest, until_s),
            *_faster(facts, largest),
            *_landed_before(facts, largest),
        )
        enough = bool(staying) and largest.share >= _least_share(channels, largest) and not (accurate or doubts)
        sooner = [alarm for alarm in own[:1] if alarm.onset_s < alarm.start_s]
        # a wrong heading and a wrong turn rate look the same to the other sensors
        compass = any(
            other.channel == "compass" and alarm.start_s < other.end_s and other.start_s < alarm.end_s
            for alarm in own
            for other in watch.alarms
        )
        either = "the compass is wrong, or " if channel == "gyro_z" and compass else ""
        yield Judgement(
            span=(min(own[0].start_s, own[0].onset_s), own[-1].end_s),
            text=f"{either}{largest.text}, compared with the first {learned_s:.0f} s of the flight",
            evidence=(
                f"observer {largest.observer}, learned from the flight until {watch.until_s:.0f} s: alarm from "
                f"{own[0].start_s:.1f} to {own[-1].end_s:.1f} s",
                *(f"its estimate has been out of its usual range since {one.onset_s:.1f} s" for one in sooner),
                f"up to {largest.share:.1f} times the threshold",
            ),
            counter=doubts,
            confidence="likely" if enough and not either else "possible",
            weight="warning" if enough else "information",
            plots=(f"estimate_{channel}",),
        )


def _least_share(channels: Mapping[tuple[str, ...], float], alarm: LearnedAlarm) -> float:
    """Return the ratio to the threshold that an alarm has to reach; NaN for a channel that is not judged."""
    return next((share for words, share in channels.items() if alarm.channel.startswith(words)), nan)


def _still_carried(facts: LogFacts, alarm: LearnedAlarm, begin_s: float, end_s: float) -> Iterator[str]:
    """Yield the evidence that the motors together lift as much as before, so that no motor lacks the alarm's size.

    A turning moment from outside (wind, a load that moved) moves command from one motor to another. A motor that lacks
    thrust leaves the others' commands unchanged, and the total lift relative to the commands decreases.
    """
    motors, force = facts.signal("motors"), facts.signal("acceleration")
    if facts.watch is None or not motors or not force or not alarm.channel.startswith("motor"):
        return
    # after take-off, at whose begin the ground still carries the vehicle
    begins = np.arange(begin_s + _CARRIED_S, facts.watch.until_s - _CARRIED_S, _CARRIED_S).tolist()
    spans = [*((at, at + _CARRIED_S) for at in begins), (alarm.start_s, end_s)]
    asked = np.array([np.sum(part := motors.during(*span).values) / len(part) for span in spans])
    lift = np.array([np.sum(part := force.during(*span).values[:, 2]) / len(part) for span in spans]) / asked
    now, lacking = lift[-1] / np.median(lift[:-1]), alarm.size / asked[-1]
    # the lift lost less than half of the alarm's loss, and that loss exceeds the usual variation of the lift
    if lacking > np.ptp(lift[:-1] / np.median(lift[:-1])) and now > 1.0 - lacking / 2:
        lifted = f"{100 * now:.0f} % of before at these commands, not {100 - 100 * lacking:.0f} %"
        yield f"the motors together lift {lifted}: something from outside turns the vehicle"


def _together(alarm: LearnedAlarm, sound: Sequence[LearnedAlarm]) -> Iterator[str]:
    """Yield the reason if more motors, or axes of inertial sensors, have an alarm at once than one fault explains."""
    for what, words in _SEVERAL.items():
        at_once = {
            other.channel
            for other in sound
            if other.channel.startswith(words) and alarm.start_s < other.end_s and other.start_s < alarm.end_s
        }
        if alarm.channel.startswith(words) and len(at_once) > _TWO:
            yield f"{len(at_once)} {what} have such an alarm at the same time: the cause is not one of them"


def _few_satellites(facts: LogFacts, alarm: LearnedAlarm, end_s: float) -> Iterator[str]:
    """Yield the reason if GPS, whose motion an alarm of a gyro or accelerometer relies on, was too poor."""
    gps = facts.signal("gps").during(alarm.start_s, end_s)
    if gps and alarm.channel.startswith(("gyro_", "accel_")) and gps.values[:, 1].min() < _SATELLITES:
        yield f"the receiver was down to {gps.values[:, 1].min():.0f} satellites and may be wrong itself"


def _faster(facts: LogFacts, alarm: LearnedAlarm) -> Iterator[str]:
    """Yield the reason if a multirotor was faster at the begin of a motor's alarm than in the part that was learned."""
    if facts.watch is None or facts.vehicle != "multirotor" or not alarm.channel.startswith(("motor", "esc", "prop")):
        return
    pace = speed(facts)
    taught = np.max(pace.during(-np.inf, facts.watch.until_s).only, initial=0.0)
    # an alarm is raised seconds after the estimate leaves zero, at an unknown time: take the highest speed before it
    now = np.max(pace.during(alarm.start_s - _LEAST_S, alarm.start_s).only, initial=0.0)
    if now > max(FAST_M_S, _FASTER * taught):
        yield f"it flew at {now:.0f} m/s; the begin of the flight, at most {taught:.0f} m/s, teaches nothing about that"


def _landed_before(facts: LogFacts, alarm: LearnedAlarm) -> Iterator[str]:
    """Yield the reason if the vehicle landed for long after it was learned: load and calibration may have changed."""
    if facts.watch is None:
        return
    taught_s = max((end for start, end in facts.flight if start < facts.watch.until_s), default=np.inf)
    begun_s = max((start for start, _ in facts.flight if start <= alarm.start_s), default=0.0)
    if begun_s - taught_s > _GROUND_S:
        yield "it has landed since: load, battery and calibration may be others"


def _own(alarm: LearnedAlarm) -> bool:
    return alarm.observer == "inertial" or not alarm.channel.startswith(("gyro_", "accel_"))


def _until_s(alarm: LearnedAlarm, facts: LogFacts, end_s: float) -> float:
    """Return the end of an alarm, or of the part of the flight that can be judged."""
    flight_end_s = max((end for start, end in facts.flight if start <= alarm.start_s), default=0.0) - _LANDING_S
    return min(alarm.end_s, end_s, flight_end_s)


def _stays(alarm: LearnedAlarm, facts: LogFacts, end_s: float) -> bool:
    """Return whether an alarm did not end by itself, or had lasted long before."""
    until_s = _until_s(alarm, facts, end_s)
    return until_s < alarm.end_s or until_s - alarm.start_s >= _PASSING_S
