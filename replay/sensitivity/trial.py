"""One injected fault in one window of a recording, run through the pipeline: was it seen, when, and as what."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf, sqrt
from pathlib import Path

from adapters.message import Message
from monitor.estimate import Estimate
from monitor.pipeline import Pipeline
from monitor.profile import FaultChannel, Profile
from replay.attacks.attack import Attack
from replay.attacks.injector import Injector, inject, plan, profile_clocks

_SMALLEST_COMMAND = 0.02


@dataclass(frozen=True, slots=True)
class Task:
    """Attacks on one channel that begin at the same time, and the window of messages they are tried on.

    Parameters
    ----------
    profile, folder : Profile, Path
        The profile and where it stands.
    observer : str
        The observer whose alarm is meant.
    system : int
        The vehicle's MAVLink system.
    messages : Sequence[Message]
        The window.
    attacks : tuple[Attack, ...]
        The attacks, each tried by itself.
    """

    profile: Profile
    folder: Path
    observer: str
    system: int
    messages: Sequence[Message]
    attacks: tuple[Attack, ...]


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one trial gave.

    Parameters
    ----------
    delay_s : float | None
        From onset to alarm, infinite where none was raised; None where the window raised one before the onset.
    others : frozenset[str]
        Other channels that were raised.
    error : float | None
        Root mean square error of the estimate over the second half of the attack; None where the kind has no size
        that an estimate could be compared with.
    """

    delay_s: float | None
    others: frozenset[str]
    error: float | None


def run_task(task: Task) -> list[Outcome]:
    """Return the outcome of each attack."""
    return [_run(task, attack) for attack in task.attacks]


def _run(task: Task, attack: Attack) -> Outcome:
    profile = task.profile
    observer = next(observer for observer in profile.observers if observer.name == task.observer)
    index = [fault.name for fault in observer.faults].index(attack.channel)
    names = {message.name for message in task.messages}
    made = plan(attack, names, profile, task.folder)
    injector = Injector(attack, made, task.system, profile_clocks(profile))
    # A plant's answer moves its own outputs and nothing else: to other observers a gyro that attitude does not follow.
    alone = replace(profile, observers=(observer,), excuses=())
    pipeline = Pipeline(profile if made.response is None else alone)
    late_ns = (attack.start_ns + attack.end_ns) // 2
    delay_s, others, void = inf, set[str](), False
    squares: list[float] = []
    for message in inject(task.messages, injector):
        for output in pipeline.feed(message):
            if isinstance(output, Estimate):
                sample = output.sample
                if output.observer == task.observer and output.armed and sample.vehicle_time_ns >= late_ns:
                    error = _error(attack, observer.faults[index], output, index)
                    squares += [] if error is None else [error * error]
                continue
            if output.state != "raised" or output.kind == "stale":
                continue
            if output.vehicle_time_ms < attack.start_ns // 1_000_000:
                void = True
            elif output.observer == task.observer and output.channel == attack.channel:
                delay_s = min(delay_s, max(0.0, output.vehicle_time_ms / 1e3 - attack.start_ns / 1e9))
            else:
                others.add(output.channel)
    error = sqrt(sum(squares) / len(squares)) if squares else None
    return Outcome(None if void else delay_s, frozenset(others), error)


def _error(attack: Attack, fault: FaultChannel, output: Estimate, index: int) -> float | None:
    """Return estimate minus truth, of a loss as a share of the command; None where there is no truth or command."""
    estimate = float(output.isolated[index])
    stamp_ns = output.sample.vehicle_time_ns
    if attack.kind == "loss" and fault.input is not None:
        command = float(output.sample.u[fault.input])
        return estimate / command + attack.growth(stamp_ns) if command > _SMALLEST_COMMAND else None
    if attack.kind in ("bias", "ramp"):
        return estimate - attack.growth(stamp_ns)
    if attack.kind == "spoof":
        return estimate - attack.spoof()[0](stamp_ns)
    return None
