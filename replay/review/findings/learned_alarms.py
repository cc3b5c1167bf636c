"""Alarms of a profile that was learned from the flight's own begin, as judgements."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from math import isnan, nan

import numpy as np

from replay.review.facts.log_facts import LearnedAlarm, LearnedWatch, LogFacts
from replay.review.findings.loss_of_control import FAST_M_S, lost_s, speed
from replay.review.findings.rule import Judgement, UnjudgedError

_LEAST_S = 5.0
"""Of an alarm that is more than a moment. Measured on fifteen healthy simulated flights learned from their first
40 s: alarms of motors end within 3.6 s (hard turns that the begin did not have)."""
_PASSING_S = 12.0
"""Of an alarm that ends by itself, below which it is information alone: what is broken stays so. Measured on 40 real
flights that were learned from (public logs of ArduPilot): where nothing else speaks of a fault, seven alarms of motors
and GPS velocities end after 6 to 11 s, those of the latter because the observer holds a jump for 10 s. Those of faults
last as long as the fault."""
_POSITIONS = ("gps_north", "gps_east", "gps_down")
_ACCURACY_M = 2.5
"""Metres by which half of a receiver's fixes are off (data sheet of u-blox's M8): less is no fault of it. Measured: in
8 m/s of gusty wind after a calm begin a healthy flight's came to 0.75 m."""
_DELAY_S = 0.11
"""By how much two receivers may be late otherwise (ArduPilot's EK3_GPS_DELAY: 0.11 s of a u-blox M8, 0.22 s of one that
it does not know): a delay is learned where the vehicle moves, and hardly in a hover. Times the speed it is metres."""
_FASTER = 1.25
"""Of speed: drag goes with its square, and is half as much again."""
_LANDING_S = 3.0
"""Seconds ahead of touch-down that are left out: the air that rotors throw at the ground comes back."""
_CARRIED_S = 5.0
"""Chosen: as long as an alarm has to last; over it climbs and turns average out."""
_SATELLITES = 6
"""Fewer than PX4 (EKF2_REQ_NSATS) and ArduPilot (EK3_GPS_CHECK) ask for before their estimators take GPS up."""


def alarms_of(facts: LogFacts, channels: Mapping[tuple[str, ...], float]) -> Iterator[Judgement]:
    """Yield the lasting alarms of channels that begin with some words, one for each channel, from its first on.

    ``channels`` says of such words how many times its threshold an alarm has to be to be more than information.
    """
    watch = facts.watch
    if watch is None:
        return
    end_s = lost_s(facts)
    # what the motors' observer says of gyros is command against motion: which of the two is wrong it cannot tell alone
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
        staying = [alarm for alarm in every if _stays(alarm, facts, end_s)]
        own = staying or every
        largest = max(own, key=lambda alarm: alarm.share)
        until_s = _until_s(largest, facts, end_s)
        fastest = np.max(speed(facts).during(largest.start_s, until_s).only, initial=0.0)
        accurate = channel in _POSITIONS and largest.size < _ACCURACY_M + _DELAY_S * fastest
        doubts = (
            *_still_carried(facts, largest, begin_s, until_s),
            *_few_satellites(facts, largest, until_s),
            *_faster(facts, largest),
        )
        enough = bool(staying) and largest.share >= _least_share(channels, largest) and not (accurate or doubts)
        # a heading off and a turn rate off look alike to the sensors that are left
        either = "the compass is wrong, or " if channel == "gyro_z" and _overlaps(own, watch, "compass") else ""
        yield Judgement(
            span=(own[0].start_s, own[-1].end_s),
            text=f"{either}{largest.text}, compared with the first {learned_s:.0f} s of the flight",
            evidence=(
                f"observer {largest.observer}, learned from the flight until {watch.until_s:.0f} s: alarm from "
                f"{own[0].start_s:.1f} to {own[-1].end_s:.1f} s",
                f"up to {largest.share:.1f} times the threshold",
            ),
            counter=doubts,
            confidence="likely" if enough and not either else "possible",
            weight="warning" if enough else "information",
            plots=(f"estimate_{channel}",),
        )


def _least_share(channels: Mapping[tuple[str, ...], float], alarm: LearnedAlarm) -> float:
    """Return how many times its threshold an alarm has to be; NaN of a channel that is not asked for."""
    return next((share for words, share in channels.items() if alarm.channel.startswith(words)), nan)


def _still_carried(facts: LogFacts, alarm: LearnedAlarm, begin_s: float, end_s: float) -> Iterator[str]:
    """Yield what says that the motors together lift as before, so that none lacks what an alarm says it does.

    What turns a vehicle from outside (wind, a load that moved) takes command from one motor and gives it to another; a
    motor that lacks thrust leaves the others' commands, and what all lift for their commands goes down.
    """
    motors, force = facts.signal("motors"), facts.signal("acceleration")
    if facts.watch is None or not motors or not force or not alarm.channel.startswith("motor"):
        return
    # after take-off, at whose begin the ground still carries
    begins = np.arange(begin_s + _CARRIED_S, facts.watch.until_s - _CARRIED_S, _CARRIED_S).tolist()
    spans = [*((at, at + _CARRIED_S) for at in begins), (alarm.start_s, end_s)]
    asked = np.array([np.sum(part := motors.during(*span).values) / len(part) for span in spans])
    lift = np.array([np.sum(part := force.during(*span).values[:, 2]) / len(part) for span in spans]) / asked
    now, lacking = lift[-1] / np.median(lift[:-1]), alarm.size / asked[-1]
    # half as much as it would cost, where that is more than it moved by itself
    if lacking > np.ptp(lift[:-1] / np.median(lift[:-1])) and now > 1.0 - lacking / 2:
        lifted = f"{100 * now:.0f} % of before at these commands, not {100 - 100 * lacking:.0f} %"
        yield f"the motors together lift {lifted}: something from outside turns the vehicle"


def _few_satellites(facts: LogFacts, alarm: LearnedAlarm, end_s: float) -> Iterator[str]:
    """Yield what says that GPS, by whose motion an alarm's gyro or accelerometer is judged, was too poor for it."""
    gps = facts.signal("gps").during(alarm.start_s, end_s)
    if gps and alarm.channel.startswith(("gyro_", "accel_")) and gps.values[:, 1].min() < _SATELLITES:
        yield f"the receiver was down to {gps.values[:, 1].min():.0f} satellites and may be wrong itself"


def _faster(facts: LogFacts, alarm: LearnedAlarm) -> Iterator[str]:
    """Yield what says that a multirotor was as fast when a motor's alarm began as nothing taught how its motors act."""
    if facts.watch is None or facts.vehicle != "multirotor" or not alarm.channel.startswith(("motor", "esc", "prop")):
        return
    pace = speed(facts)
    taught = np.max(pace.during(-np.inf, facts.watch.until_s).only, initial=0.0)
    # how fast it was when the observer began to leave zero is not known: an alarm comes seconds later
    now = np.max(pace.during(alarm.start_s - _LEAST_S, alarm.start_s).only, initial=0.0)
    if now > max(FAST_M_S, _FASTER * taught):
        yield f"it flew at {now:.0f} m/s; the begin of the flight, at most {taught:.0f} m/s, teaches nothing about that"


def _overlaps(alarms: Sequence[LearnedAlarm], watch: LearnedWatch, channel: str) -> bool:
    others = [alarm for alarm in watch.alarms if alarm.channel == channel]
    return any(alarm.start_s < other.end_s and other.start_s < alarm.end_s for alarm in alarms for other in others)


def _own(alarm: LearnedAlarm) -> bool:
    return alarm.observer == "inertial" or not alarm.channel.startswith(("gyro_", "accel_"))


def _until_s(alarm: LearnedAlarm, facts: LogFacts, end_s: float) -> float:
    """Return when an alarm ended, or what can be judged of the flight."""
    flight_end_s = max((end for start, end in facts.flight if start <= alarm.start_s), default=0.0) - _LANDING_S
    return min(alarm.end_s, end_s, flight_end_s)


def _stays(alarm: LearnedAlarm, facts: LogFacts, end_s: float) -> bool:
    """Return whether an alarm did not end by itself, or lasted long before."""
    until_s = _until_s(alarm, facts, end_s)
    return until_s < alarm.end_s or until_s - alarm.start_s >= _PASSING_S
