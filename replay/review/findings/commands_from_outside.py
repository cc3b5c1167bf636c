"""A sender that had not commanded the vehicle before take-off did so in flight, or there was a flood of commands."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from monitor.alarms.command_watch import FLOOD, CommandSent, CommandWatch, ends_flight
from replay.review.facts.log_facts import BEGIN_S, LogFacts
from replay.review.findings.rule import WEIGHTS, Judgement, Rule


def _judge(facts: LogFacts) -> Iterator[Judgement]:
    watch, flood_s = CommandWatch(), None
    flown = facts.in_flight(np.array([command.time_s for command in facts.commands]))
    found: dict[tuple[int, int], Judgement] = {}
    for command, flies in zip(facts.commands, flown.tolist(), strict=True):
        for said in watch.follow(command, flies):
            if said.sender is None:
                flood_s = command.time_s if flood_s is None else flood_s
                continue
            ends = ends_flight(command.name, command.values)
            # a vehicle that does not fly is disarmed at the end of each drive, by any of its operators
            weight = said.weight if facts.flies or not ends else "information"
            before = found.get(said.sender)
            if before is None:
                known = ", ".join(f"system {system}, component {number}" for system, number in sorted(watch.known))
                found[said.sender] = Judgement(
                    span=(command.time_s, command.time_s),
                    text=said.text,
                    evidence=(_evidence(command),),
                    counter=(
                        f"commands before take-off came from {known}" if known else "no command came before take-off",
                    ),
                    confidence="likely" if known else "possible",
                    weight=weight,
                )
                continue
            found[said.sender] = replace(
                before,
                span=(before.start_s, command.time_s),
                text=said.text,
                evidence=before.evidence if said.text == before.text else (*before.evidence, _evidence(command)),
                weight=max(before.weight, weight, key=WEIGHTS.index),
            )
    if not watch.known and facts.flight and facts.flight[0][0] < BEGIN_S:
        # it may be the operator, who commanded before the log begins
        unknown = "the log begins in flight: who commanded before take-off is not known"
        found = {sender: replace(one, counter=(unknown,), weight="information") for sender, one in found.items()}
    yield from found.values()
    if flood_s is not None:
        yield Judgement(
            span=(flood_s, flood_s + 1.0),
            text=f"up to {watch.most} commands a second reached the vehicle {facts.when}",
            evidence=(f"more than {FLOOD} commands within a second, from {flood_s:.2f} s on",),
            confidence="certain",
        )


def _evidence(command: CommandSent) -> str:
    # a command without a name is given by its MAV_CMD number
    name = f"MAV_CMD {command.name}" if command.name.isdigit() else command.name
    return f"{name} at {command.time_s:.2f} s with {', '.join(map(str, command.values)) or 'nothing'}"


RULE = Rule(
    title="Commands from a new sender in flight",
    stage="link",
    physics="Without signing a vehicle obeys every sender. An attacker disarms, reboots, changes the mode, steers it, "
    "rewrites the mission, files or parameters; the vehicle obeys, and nothing fails.",
    evidence="such a command in flight from ids that had not commanded before take-off; more than "
    f"{FLOOD} commands a second",
    counter=(
        "a second ground station that was switched on in flight looks the same",
        "every drive ends with disarming on the ground: for vehicles that do not fly this is information only",
        "a ground station sends missions and parameters one by one, with answers, and slower than a flood",
        "a sender that uses the ids of the ground station is not recognised; only signing would show it",
    ),
    needs=(),
    plots=("height", "motors", "attitude"),
    judge=_judge,
)
