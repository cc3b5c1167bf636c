"""The smallest faults that a profile detects within given delays, found by trials on healthy recordings.

A fault that scales an input is a loss: the actuator executes (1 - loss) of the command recorded. Any other fault is a
step of its size, of either sign; so is one of an input that healthy flight commands so little that losing half of it
stays below the alarm threshold. Noise, gusts and model error are those of the recording.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import inf

import numpy as np

from adapters.batch import of_names
from monitor.estimation.affine import AffineObserver
from monitor.estimation.input_curve import effect_of_command
from monitor.fitting.capability import Capability, Detection
from monitor.fitting.fitted import BatchSource
from monitor.fitting.flights import Flight
from monitor.fitting.progress import track
from monitor.pipeline import Pipeline
from monitor.profile import FaultChannel, ObserverProfile, Profile
from replay.attacks.attack import Attack
from replay.sensitivity.healthy import Healthy, Span, free_spans, onsets, play_healthy
from replay.sensitivity.trial import Task, run_task

WITHIN_S = (2.0, 1.0, 0.25)
"""Delays within which the smallest detected fault is determined, seconds: a pilot, a failsafe and a controller can use
them."""
_TICKS = 10
"""Ticks of a slow observer in the longest delay: the longest time for which its evidence has to last."""
ONSETS = 3
"""Times of onset for each size. Chosen: they reveal a size that is missed now and then, and a fit takes only
seconds."""

_LEAD_S = 2.0
"""Time before an onset in addition to the observer's own wait: one second for the first samples, one with alarms."""
_TAIL_S = 1.0
"""Time watched after the longest delay, for alarms of other channels that come later, seconds."""
_LOSSES = (0.01, 0.015, 0.02, 0.03, 0.04, 0.05, 0.07, 0.10, 0.15, 0.20, 0.30, 0.50)
"""Losses to try, as fractions of the command: round numbers, each about 1.4 times the one before."""
_DIGITS = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)
"""Digits of the steps to try, with about the same ratios."""
_STEPS = 12
"""Steps to try: the largest is more than twenty times the threshold."""
_ACTIVE_S = 0.5
"""Time after an onset during which a command has to be in use, so that its loss has an effect, seconds."""
_ACTIVE_SHARE = 0.5
"""Smallest mean effect of a command in use, as a share of its root mean square over the recording."""


def measure_capability(profile: Profile, logs: Sequence[BatchSource]) -> tuple[Capability, ...]:
    """Measure what an observer detects, for each fault channel whose alarm has a positive threshold.

    The profile has one observer, with its model. The delays are :data:`WITHIN_S`, proportionally longer for an observer
    with few ticks a second. :data:`ONSETS` are spread over the recordings (for a loss, over times with the command in
    use).
    """
    [observer] = profile.observers
    wanted = Pipeline(profile).interests
    played = (play_healthy(profile, (of_names(batch, wanted) for batch in log())) for log in logs)
    flown = (recording for recording in played if observer.name in recording.flights)
    recordings = [recording for recording in flown if len(recording.flights[observer.name].evidence)]
    thresholds = {rule.channel: rule.threshold for rule in observer.alarms}
    longer = max(1.0, _TICKS / observer.rate_hz / WITHIN_S[0])
    limits = [float(f"{delay * longer:.2g}") for delay in WITHIN_S]
    capabilities = []
    for fault in track(observer.faults, f"measuring what {observer.name} will detect", "faults"):
        if (threshold := thresholds.get(fault.name, 0.0)) <= 0.0:
            continue
        typical = _typical_command(fault, [recording.flights[observer.name] for recording in recordings])
        loss = _LOSSES[-1] * typical >= threshold
        sizes = _LOSSES if loss else step_sizes(threshold)
        tasks = _tasks(profile, fault, loss, recordings, limits[0] + _TAIL_S)
        detections = _search(tasks, fault, loss, sizes, limits[-1])
        smallest = [
            (within, next((d.size for d in detections if d.worst_s is not None and d.worst_s <= within), None))
            for within in limits
        ]
        unit = "" if loss else fault.unit
        capabilities.append(Capability(fault.name, unit, loss, tuple(smallest), sizes[-1], tuple(detections)))
    return tuple(capabilities)


def step_sizes(threshold: float) -> tuple[float, ...]:
    """Return round sizes (1, 1.5, 2, 3, 5, 7, 10, ...) from about half a positive alarm threshold upwards."""
    decade = 10.0 ** np.floor(np.log10(threshold / 2.0))
    # Rounded, so that sizes are printed as written: 0.3, not 0.30000000000000004.
    rungs = [float(f"{digit * decade * 10.0**power:.2g}") for power in range(4) for digit in _DIGITS]
    start = max(i for i, size in enumerate(rungs) if size <= threshold / 2.0 * (1.0 + 1e-9))
    return tuple(rungs[start : start + _STEPS])


def _typical_command(fault: FaultChannel, flights: Sequence[Flight]) -> float:
    """Return the root mean square of the command that a fault scales, zero if there is none or no sample."""
    if fault.input is None or not flights:
        return 0.0
    command = np.concatenate([flight.samples.u[flight.armed, fault.input] for flight in flights])
    return float(np.sqrt(np.mean(command**2)))


def _tasks(
    profile: Profile, fault: FaultChannel, loss: bool, recordings: Sequence[Healthy], after_s: float
) -> list[tuple[int, Task]]:
    """Return onsets spread over the recordings (of a loss: with the command in use), and windows around them."""
    [observer] = profile.observers
    wait_s = max(profile.gate.settle_s, observer.settle_s or AffineObserver(observer.gains).settling_s())
    before_ns, after_ns = round((wait_s + _LEAD_S) * 1e9), round(after_s * 1e9)
    if observer.model is not None and not loss:
        # A step adds to the effect of the input; nothing is scaled.
        faults = tuple(replace(f, input=None) if f.name == fault.name else f for f in observer.model.faults)
        observer = replace(observer, model=replace(observer.model, faults=faults))
    trial = replace(profile, observers=(observer,))
    free = [
        free_spans(
            recording.spans_ns(observer.name),
            recording.alarms_ns,
            before_ns,
            after_ns,
            _active_spans(observer, fault, recording.flights[observer.name]) if loss else None,
        )
        for recording in recordings
    ]
    tasks = []
    for index, onset_ns in onsets(free, ONSETS):
        recording = recordings[index]
        window = recording.window(onset_ns - before_ns, onset_ns, onset_ns + after_ns)
        states = recording.states_of(observer.name)
        tasks.append((onset_ns, Task(trial, observer.name, recording.system, window, (), states)))
    return tasks


def _active_spans(observer: ObserverProfile, fault: FaultChannel, flight: Flight) -> list[Span]:
    """Return the spans in which the command that a fault scales is in use, vehicle nanoseconds."""
    effect = np.abs(effect_of_command(observer.gains[0].input_curves, flight.samples.u)[:, fault.input])
    ahead = max(1, round(_ACTIVE_S * observer.rate_hz))
    mean = np.convolve(effect, np.full(ahead, 1.0 / ahead))[ahead - 1 :]
    active = mean >= _ACTIVE_SHARE * float(np.sqrt(np.mean(effect[flight.armed] ** 2)))
    edges = np.flatnonzero(np.diff(active, prepend=False, append=False)).reshape(-1, 2)
    times_ns = flight.samples.vehicle_time_ns
    return [(int(times_ns[first]), int(times_ns[behind - 1])) for first, behind in edges]


def _search(
    tasks: Sequence[tuple[int, Task]], fault: FaultChannel, loss: bool, sizes: Sequence[float], fastest_s: float
) -> list[Detection]:
    """Try sizes, ascending, up to the first that is detected within the shortest delay.

    A size that is missed at one onset costs one trial, so the search may begin far below the result.
    """
    detections: list[Detection] = []
    for size in sizes if tasks else ():
        detections.append(_detect(tasks, fault, loss, size))
        worst_s = detections[-1].worst_s
        if worst_s is not None and worst_s <= fastest_s:
            break
    return detections


def _detect(tasks: Sequence[tuple[int, Task]], fault: FaultChannel, loss: bool, size: float) -> Detection:
    """Try one size at every onset, steps of either sign, until an onset misses it or raises another alarm."""
    delays = []
    for number, (onset_ns, task) in enumerate(tasks):
        signed = -size if number % 2 and not loss else size
        attack = Attack(fault.name, "loss" if loss else "bias", onset_ns, 1 << 62, size=signed)
        [outcome] = run_task(replace(task, attacks=(attack,)))
        if outcome.delay_s is None:  # the window raises an alarm without the fault, so it tells nothing about the fault
            continue
        if outcome.others or outcome.delay_s == inf:
            return Detection(size, None, None, only=not outcome.others)
        delays.append(outcome.delay_s)
    if not delays:
        return Detection(size, None, None, only=False)
    return Detection(size, float(np.median(delays)), max(delays), only=True)
