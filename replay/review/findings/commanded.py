"""What was asked of the vehicle, and what its autopilot decided and commanded: the rules of these stages."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from monitor.alarms.command_watch import FLOOD, CommandWatch, ends_flight
from replay.review.facts.log_facts import LogFacts, LogSignal, overlap, state_spans
from replay.review.findings.loss_of_control import STOPPED, spans_in_control, stops
from replay.review.findings.rule import Judgement, Rule


def _commands_from_outside(facts: LogFacts) -> Iterator[Judgement]:
    watch, flood_s = CommandWatch(), None
    flown = facts.in_flight(np.array([command.time_s for command in facts.commands]))
    for command, flies in zip(facts.commands, flown.tolist(), strict=True):
        for said in watch.follow(command, flies):
            if said.kind == "flood":
                flood_s = command.time_s if flood_s is None else flood_s
                continue
            known, ends = sorted(watch.known), ends_flight(command.name, command.values)
            yield Judgement(
                start_s=command.time_s,
                end_s=command.time_s,
                text=said.text,
                evidence=(
                    f"{'MAV_CMD ' * command.name.isdigit()}{command.name} at {command.time_s:.2f} s with "
                    f"{', '.join(map(str, command.values)) or 'nothing'}",
                ),
                counter=(f"commands before take-off came from {known or 'nobody'}",),
                confidence="likely" if known else "possible",
                # what falls from nowhere is disarmed at each drive's end, by whoever has it at hand
                weight=said.weight if facts.flies or not ends else "information",
            )
    if flood_s is not None:
        yield Judgement(
            start_s=flood_s,
            end_s=flood_s + 1.0,
            text=f"up to {watch.most} commands a second reached the vehicle in flight",
            evidence=(f"more than {FLOOD} commands within a second, from {flood_s:.2f} s on",),
            confidence="certain",
        )


COMMANDS_FROM_OUTSIDE = Rule(
    name="commands_from_outside",
    title="Commands from a new sender in flight",
    stage="link",
    physics="MAVLink without signing obeys everybody. An attacker disarms, reboots, changes the mode, rewrites the "
    "mission or takes safety parameters away; the vehicle does as it is told, and nothing fails.",
    evidence="such a command in flight from ids that had not commanded before take-off; more than "
    f"{FLOOD} commands a second",
    counter=(
        "a second ground station that was switched on in flight looks the same",
        "on the ground a disarming ends every drive: of vehicles that do not fly it is information alone",
        "missions and parameters of a ground station come with an answer to each, and slower than a flood",
        "a sender that uses the ids of the ground station is not seen: signing alone tells it apart",
    ),
    needs=(),
    plots=("height", "motors", "attitude"),
    judge=_commands_from_outside,
)


_APART_M = 2.5
"""Metres by which half of a receiver's fixes are off (data sheet of u-blox's M8): less takes nobody off course.
Measured in 88 logs without such an attack: 0.0 m, and on ten real flights, whose estimator changed its lane, up to
63 m for less than a second."""
_ALTERED_S = 1.0
"""A reset or a change of lane reaches the controller with the next record, a tenth of that later."""


def _position_altered(facts: LogFacts, apart: LogSignal) -> Iterator[Judgement]:
    for start, end in spans_in_control(facts, apart, apart.only > _APART_M, _ALTERED_S)[:1]:
        during = apart.during(start, end).only
        yield Judgement(
            start_s=start,
            end_s=end,
            text=f"the autopilot flew by a position up to {during.max():.0f} m from the one that it estimated, "
            f"for {end - start:.1f} s: something inside it altered the position",
            evidence=(
                f"{apart.origin}: {during[0]:.1f} m apart at {start:.1f} s, {np.median(during):.1f} m in the middle",
            ),
            confidence="certain",
            weight="critical",
        )


POSITION_ALTERED = Rule(
    name="position_altered",
    title="Position altered inside the autopilot",
    stage="decision",
    physics="A controller takes its position from the estimator, as it is. Where the two are metres apart, something "
    "between them changes it: an attack on the autopilot's program, or a fault of it. The sensors agree with each "
    "other all the while, and the estimator with them; the vehicle goes astray.",
    evidence=f"{_APART_M} m between what the controller flies by and each lane of the estimator, for a second",
    counter=(
        "a reset of the estimator and a change of its lane reach the controller within a tenth of a second",
        "a GPS that is led away takes the estimate along: then both agree, and this does not show",
    ),
    needs=("position_apart",),
    plots=("position_apart", "position", "ratios"),
    judge=_position_altered,
)


_BEFORE_S = 2.0
"""How long ahead of the stop a detector may have said so: PX4 stops motors at once and disarms after 2 s
(COM_DISARM_LAND), ArduPilot after 0.5 to 10 s (DISARM_DELAY)."""


def _landing_detected_in_air(facts: LogFacts, motors: LogSignal, height: LogSignal) -> Iterator[Judgement]:
    landings = [statement for statement in facts.statements if statement.kind == "landing" and statement.level]
    for start, end, fell in stops(facts):
        said = [landing for landing in landings if -_BEFORE_S <= landing.time_s - start <= 0.5]
        if not said:
            continue
        at = said[-1].time_s
        yield Judgement(
            start_s=at,
            end_s=end,
            text="the landing detector said 'landed' in the air; the motors were stopped and the vehicle fell "
            f"{fell:.0f} m",
            evidence=(
                f"landing detector: landed at {at:.2f} s",
                f"{motors.origin}: all motors at zero from {start:.2f} to {end:.2f} s",
                f"{height.origin}: {fell:.1f} m lower within 3 s of it",
            ),
            confidence="certain",
            weight="critical",
        )


LANDING_DETECTED_IN_AIR = Rule(
    name="landing_detected_in_air",
    title="Landing detected in the air",
    stage="decision",
    physics="A landing detector that sees low thrust and no vertical motion calls it the ground; autopilots then stop "
    "the motors. A vehicle that cannot descend at its least thrust looks just so.",
    evidence="'landed' ahead of all motors at zero, and the barometer falling by 2 m or more within 3 s",
    counter=(
        "a landing on a roof or a hill looks the same up to the stop, but nothing falls after it",
        "the barometer reads higher when rotors stop near the ground, not lower",
    ),
    needs=("motors", "height"),
    plots=("motors", "height", "climb"),
    judge=_landing_detected_in_air,
    multirotor=True,
)


_NEAR_S = 1.5
"""Chosen: statements of state are logged once or twice a second by default."""


def _motors_stopped_in_air(facts: LogFacts, motors: LogSignal, height: LogSignal) -> Iterator[Judgement]:
    for start, end, fell in stops(facts):
        near = [statement for statement in facts.statements if abs(statement.time_s - start) <= _NEAR_S]
        if any(statement.kind == "landing" and statement.level for statement in near):
            continue
        causes = [
            statement
            for statement in near
            if statement.kind in ("kill", "failsafe") or (statement.kind == "arming" and not statement.level)
        ]
        why = f": {causes[0].text}" if causes else ", and the log does not say why"
        yield Judgement(
            start_s=min([start, *(cause.time_s for cause in causes)]),
            end_s=end,
            text=f"all motors were commanded to stop in the air{why}; the vehicle fell {fell:.0f} m",
            evidence=(
                f"{motors.origin}: all motors at zero from {start:.2f} to {end:.2f} s",
                f"{height.origin}: {fell:.1f} m lower within 3 s of it",
                *(f"{cause.kind} at {cause.time_s:.2f} s: {cause.text}" for cause in causes),
            ),
            confidence="certain",
            weight="critical",
        )


MOTORS_STOPPED_IN_AIR = Rule(
    name="motors_stopped_in_air",
    title="Motors stopped in the air",
    stage="command",
    physics="A kill switch, a disarming, a termination or a crash detector takes all commands to zero, and the "
    "vehicle falls.",
    evidence="all motors at zero for 0.4 s or longer after they turned, the barometer falling by 2 m within 3 s",
    counter=(
        "no landing was detected before it, and the barometer falls",
        "the commands themselves are zero: no motor failed",
    ),
    needs=("motors", "height"),
    plots=("motors", "height", "climb"),
    judge=_motors_stopped_in_air,
    multirotor=True,
)


_STOPPED_S = 1.5
"""Measured: at full sticks a saturated mixer keeps single motors at zero for up to 0.5 s; three times that."""
_FLYING = 0.2
"""Share of full command above which the others' median carries a vehicle: the strongest vehicles hover from 0.15 on,
at which a saturated mixer takes single motors to zero."""


def _motor_command_stopped(facts: LogFacts, motors: LogSignal) -> Iterator[Judgement]:
    times = motors.time_s
    for k, name in enumerate(motors.names):
        others = np.median(np.delete(motors.values, k, axis=1), axis=1)
        marks = [(said.time_s, said.level) for said in facts.statements if (said.kind, said.text) == ("stopped", name)]
        marked = overlap(state_spans(marks, facts.duration_s), facts.flight)
        stopped = spans_in_control(facts, motors, (motors.values[:, k] < STOPPED) & (others > _FLYING), _STOPPED_S)
        for start, end in sorted(stopped + marked)[:1]:
            mean = float(np.median(others[(times >= start) & (times <= end)]))
            said = ("the log marks the output as stopped, not as zero",) if marked else ()
            yield Judgement(
                start_s=start,
                end_s=end,
                text=f"{name} was commanded to stop for {end - start:.1f} s while the others were at "
                f"{100 * mean:.0f} %: the autopilot took it out",
                evidence=(f"{motors.origin}: {name} below {STOPPED:g}, the others at {mean:.2f}", *said),
                confidence="certain" if marked else "likely",
                weight="critical",
            )


MOTOR_COMMAND_STOPPED = Rule(
    name="motor_command_stopped",
    title="One motor commanded to stop",
    stage="command",
    physics="Autopilots stop a motor whose ESC reports a failure, or for a test of failures (PX4's failure injection).",
    evidence="one command at zero for 1.5 s, or marked as stopped, while the others carry the vehicle",
    counter=(
        "its command is zero: a motor that fails by itself gets more, not less",
        "outputs that drive nothing never move; a saturated mixer lets go within half a second",
    ),
    needs=("motors",),
    plots=("motors", "attitude", "rpm"),
    judge=_motor_command_stopped,
    multirotor=True,
)

RULES = COMMANDS_FROM_OUTSIDE, POSITION_ALTERED, LANDING_DETECTED_IN_AIR, MOTORS_STOPPED_IN_AIR, MOTOR_COMMAND_STOPPED
