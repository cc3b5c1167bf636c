"""One injected fault in one window of a recording, run through the pipeline: whether it raises alarms, when, and which.

Faults are put into messages, not into samples. So the trial measures the whole monitor, with the sampling of messages,
their resolution, the gate and the transforms, and it includes faults that only messages have (lost, late, repeated).
"""

from dataclasses import dataclass, replace
from math import inf, sqrt

import numpy as np

from adapters.batch import pack
from monitor.estimate import Estimates
from monitor.pipeline import Pipeline
from monitor.profile import FaultChannel, Profile
from replay.attacks.attack import Attack
from replay.attacks.injector import WITHOUT_PAST, Injector, inject, plan, profile_clocks
from replay.attacks.plant_response import States
from replay.sensitivity.healthy import TrialWindow

_SMALLEST_COMMAND = 0.02
"""Smallest command, of full command, at which a loss is estimated: below it the share is a quotient of two small
numbers."""


@dataclass(frozen=True, slots=True)
class Task:
    """Attacks on one channel that begin at the same time, and the window of messages in which they are tried."""

    profile: Profile
    observer: str  # the observer whose alarm has to detect them
    system: int  # the vehicle's MAVLink system
    window: TrialWindow  # the messages, split at the begin of the attacks
    attacks: tuple[Attack, ...]  # the attacks, each tried alone
    # the observer's state estimates in healthy flight, on which the response of a nonlinear plant depends
    states: States | None = None


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of one trial."""

    # from onset to alarm, infinite if none was raised; None if the window raised one before the onset
    delay_s: float | None
    others: frozenset[str]  # other channels whose alarms were raised
    # root mean square error of the estimate over the second half of the attack; None if the kind has no size to compare
    # an estimate with
    error: float | None


def run_task(task: Task) -> list[Outcome]:
    """Return the outcome of each attack."""
    return [_run(task, attack) for attack in task.attacks]


def _run(task: Task, attack: Attack) -> Outcome:
    profile = task.profile
    observer = next(observer for observer in profile.observers if observer.name == task.observer)
    index = [fault.name for fault in observer.faults].index(attack.channel)
    made = plan(attack, task.window.names, profile, task.states)
    injector = Injector(attack, made, task.system, profile_clocks(profile))
    # A plant's response changes only its own outputs: other observers would find a gyro that contradicts the attitude.
    watching = replace(profile, observers=(observer,), excuses=()) if made.response is not None else profile
    # Without models no standard deviations are computed; only alarms of sudden changes need them.
    bare = tuple(observer if observer.changes else replace(observer, model=None) for observer in watching.observers)
    pipeline = Pipeline(replace(watching, observers=bare))
    late_ns = (attack.start_ns + attack.end_ns) // 2
    delay_s, others, void = inf, set[str](), False
    errors: list[float] = []
    if attack.kind in WITHOUT_PAST:
        outputs = pipeline.run(task.window.lead)
        # of the earlier messages, the attack needs only the newest
        for message in task.window.newest():
            injector.feed(message)
        attacked = task.window.tail
    else:
        outputs, attacked = [], task.window.messages()
    outputs += pipeline.run(pack(list(inject(attacked, injector))))
    for output in outputs:
        if isinstance(output, Estimates):
            if output.observer == task.observer:
                errors += _errors(attack, observer.faults[index], output, index, late_ns)
        elif output.state != "raised" or output.kind in ("stale", "blind"):
            continue
        elif output.vehicle_time_ms < attack.start_ns // 1_000_000:
            void = True
        elif output.observer == task.observer and output.channel == attack.channel:
            delay_s = min(delay_s, max(0.0, output.vehicle_time_ms / 1e3 - attack.start_ns / 1e9))
        else:
            others.add(output.channel)
    error = sqrt(float(np.mean(np.square(errors)))) if errors else None
    return Outcome(None if void else delay_s, frozenset(others), error)


def _errors(attack: Attack, fault: FaultChannel, estimates: Estimates, index: int, from_ns: int) -> list[float]:
    """Return estimate minus truth at the samples that count, for a loss as a share of the command.

    The result is empty if there is no truth, or the command is too small.
    """
    samples = estimates.samples
    rows = np.flatnonzero(estimates.armed & (samples.vehicle_time_ns >= from_ns))
    estimate, stamps = estimates.isolated[rows, index], samples.vehicle_time_ns[rows].tolist()
    sizes = attack.sizes(stamps)
    if sizes is None:
        return []
    if attack.kind == "loss":
        command = samples.u[rows, fault.input]
        used = command > _SMALLEST_COMMAND
        return list((estimate[used] / command[used] + sizes[used]).tolist())
    return list((estimate - sizes).tolist())
