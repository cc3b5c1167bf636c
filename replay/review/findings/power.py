"""Whether motors had power and turned as commanded: the rules of these stages."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from replay.review.facts.log_facts import Floats, LogFacts, LogSignal, spans_where
from replay.review.findings.loss_of_control import IDLE, in_control, spans_in_control
from replay.review.findings.rule import Judgement, Rule

_CELL_V = 3.3
"""Volts of a cell of lithium polymer under load below which its voltage collapses (PX4's docs: empty at 3.5 under load,
damage below 3.3)."""
_FULL_CELL_V = 4.2
"""Volts of a full cell, by which the number of cells is guessed where nothing says it: then it stays information."""
_EMPTY_S = 3.0
"""Chosen: longer than a full command of the motors, which lets voltage sag and come back."""
_CELLS, _EMPTY = ("BAT1_N_CELLS", "BAT_N_CELLS"), ("BAT1_V_EMPTY", "BAT_V_EMPTY")


def _battery_low(facts: LogFacts, battery: LogSignal) -> Iterator[Judgement]:
    volts = battery.only
    if not (in_control(facts, battery.time_s) & np.isfinite(volts)).any():
        return
    said = next((facts.parameters[name] for name in _CELLS if facts.parameters.get(name, 0) > 0), 0.0)
    cells = int(said) or max(1, round(float(np.nanmax(volts)) / _FULL_CELL_V))
    source = "as its parameters say" if said else "from the highest voltage"
    # cells of lithium ion may be taken further down, which their owner then says
    limit = min([_CELL_V, *(facts.parameters[name] for name in _EMPTY if facts.parameters.get(name, 0.0) > 1.0)])
    for start, end in spans_in_control(facts, battery, volts < limit * cells, _EMPTY_S)[:1]:
        least = float(battery.during(start, end).only.min())
        yield Judgement(
            start_s=start,
            end_s=end,
            text=f"the battery was down to {least:.1f} V, {least / cells:.2f} V for each of {cells} cells",
            evidence=(
                f"{battery.origin}: below {limit * cells:.1f} V from {start:.1f} to {end:.1f} s",
                f"{cells} cells, {source}",
            ),
            confidence="likely" if said else "possible",
            weight="warning" if said else "information",
        )


BATTERY_LOW = Rule(
    name="battery_low",
    title="Battery empty",
    stage="supply",
    physics="Below 3.3 V a cell's voltage collapses under load: motors get less than their commands ask for, and in "
    "the end the autopilot no power.",
    evidence="less than 3.3 V for each cell, or what the parameters call empty where that is less, over 3 s of flight",
    counter=(
        "the log says that a battery is connected and shows volts, not zero",
        "a dip under full command passes within seconds",
        "where the number of cells is a guess it is information alone",
    ),
    needs=("battery",),
    plots=("battery", "motors"),
    judge=_battery_low,
)


_HIGH_M = 3.0
"""Metres above the begin: higher than a barometer errs beside turning rotors."""
_AT_END_S = 1.5
"""Chosen: the slowest statements of state come once a second."""


def _log_ends_in_flight(facts: LogFacts, height: LogSignal) -> Iterator[Judgement]:
    late = facts.duration_s - _AT_END_S
    last = height.only[height.time_s > late]
    ends = [spans[-1][1] for spans in (facts.flight, facts.armed) if spans]
    if not facts.flies or len(ends) < 2 or min(ends) < late or not len(last) or last[-1] < _HIGH_M:
        return
    battery = facts.signals.get("battery")
    volts = "" if battery is None else f"; the last voltage is {battery.values[-1, 0]:.1f} V"
    yield Judgement(
        start_s=facts.duration_s,
        end_s=facts.duration_s,
        text=f"the log ends in the air, {last[-1]:.0f} m above where it begins: power was lost, or recording stopped",
        evidence=(f"{height.origin}: {last[-1]:.1f} m at the end, armed and not landed{volts}",),
        confidence="possible",
        weight="information",
    )


LOG_ENDS_IN_FLIGHT = Rule(
    name="log_ends_in_flight",
    title="Log ends in flight",
    stage="supply",
    physics="An autopilot without power writes nothing more.",
    evidence="armed, not landed and 3 m high in the last second and a half",
    counter=("a file that was cut or a recording that was stopped looks the same",),
    needs=("height",),
    plots=("height", "battery"),
    judge=_log_ends_in_flight,
)


_SLOW = 0.4
"""Share of the speed usual at that command: a third of the thrust goes with a speed of 0.8, and what the fastest motor
still runs down from a commanded step within a sample is above 0.5."""
_SLOW_S = 0.6
"""Chosen: two samples of the slowest reports of ESCs, 3 a second."""
_COMMANDED = 0.08
"""Share of full command from which a motor turns (see loss_of_control.STOPPED)."""


def _esc_stopped(facts: LogFacts, rpm: LogSignal, motors: LogSignal) -> Iterator[Judgement]:
    if len(rpm.names) != len(motors.names):
        return
    times = rpm.time_s
    command = motors.at(times)
    judged = in_control(facts, times) & (command > _COMMANDED).all(axis=1) & np.isfinite(rpm.values).all(axis=1)
    if not judged.any():
        return
    # ArduPilot's motors idle at MOT_SPIN_MIN, and thrust goes with what is above it
    thrust = np.maximum(command - facts.parameters.get("MOT_SPIN_MIN", 0.0), _COMMANDED)
    # at one command all motors of a vehicle turn about as fast: the others say what is usual
    speed = rpm.values / np.sqrt(thrust)
    usual = float(np.median(speed[judged]))
    least = IDLE * np.median(thrust[judged])
    for k, name in enumerate(motors.names):
        others_turn = np.median(np.delete(speed, k, axis=1), axis=1) > _SLOW * usual
        slow = judged & (thrust[:, k] > least) & others_turn & (speed[:, k] < _SLOW * usual)
        if not _own(thrust, rpm.values, judged & ~slow, k):
            continue
        for start, end in spans_where(times, slow, _SLOW_S)[:1]:
            within = slow & (times >= start) & (times <= end)
            turned, asked = float(np.median(rpm.values[within, k])), float(np.median(command[within, k]))
            normal = usual * float(np.median(thrust[within, k])) ** 0.5
            yield Judgement(
                start_s=start,
                end_s=end,
                text=f"{name} turned at {turned:.0f} rpm while commanded to {100 * asked:.0f} %: motor or ESC failed",
                evidence=(
                    f"{rpm.origin}: {turned:.0f} rpm, usual at that command {normal:.0f} rpm",
                    f"{motors.origin}: command {asked:.2f} meanwhile",
                ),
                confidence="certain",
                weight="critical",
            )


def _own(thrust: Floats, speed: Floats, during: NDArray[np.bool_], k: int) -> bool:
    """Return whether an ESC turns with its own motor's command beside the others: ESCs have numbers of their own."""
    asked, turned = (part[during] - part[during].mean(axis=1, keepdims=True) for part in (thrust, speed))
    together = asked.T @ turned[:, k]
    return bool(together[k] >= together.max())


ESC_STOPPED = Rule(
    name="esc_stopped",
    title="Motor slower than commanded",
    stage="rpm",
    physics="Thrust goes with the square of speed and about with command, so speed over the root of the command is the "
    "same for all motors of a vehicle. A stopped motor or ESC leaves it.",
    evidence="less than 40 % of the usual speed at that command for 0.6 s, in flight",
    counter=(
        "its command had not been taken to zero, nor to idle: large propellers take seconds to run down to that",
        "the other motors turned as usual, and were reported: at take-off all run up together",
        "this ESC turns with this motor's command otherwise, not with another's",
    ),
    needs=("rpm", "motors"),
    plots=("rpm", "motors", "attitude"),
    judge=_esc_stopped,
    multirotor=True,
)

RULES = BATTERY_LOW, LOG_ENDS_IN_FLIGHT, ESC_STOPPED
