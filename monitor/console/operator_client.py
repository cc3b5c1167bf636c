"""The client of an operator's commands: finds the alarm that is meant, sends the command, returns the reply."""

import re
import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import zenoh

from adapters.errors import UsageError, printable
from monitor.bus.keys import ANY, vehicle_of, vehicle_root
from monitor.bus.payload import decode_payload, to_json
from monitor.event import AlarmEvent, valid_event

ANSWER_S = 5.0
"""Seconds to wait for a reply. Chosen: a monitor answers within milliseconds, a network of radios may take seconds."""
TRIES = 10
"""Number of tries. Chosen: with the pause two seconds, for routes that come up after the monitor was announced."""
PAUSE_S = 0.2
"""Seconds between two tries. Chosen: a person does not notice one."""

_ULID = re.compile(r"[0-9A-HJKMNP-TV-Z]{26}")
_NAMED = 5
"""Largest number of alarms that an error names: those that fit on a line."""


class Target(NamedTuple):
    """An alarm as its monitor knows it: the vehicle, and the part of the request that names the alarm."""

    vehicle: str
    request: dict[str, str]


class _Answer(NamedTuple):
    vehicle: str
    payload: Any
    error: str | None


def find_target(session: zenoh.Session, text: str, prefix: str, vehicle: str, endpoints: Sequence[str]) -> Target:
    """Return the alarm that a text names: an id, ``OBSERVER/CHANNEL`` or ``CHANNEL``.

    An id, or ``OBSERVER/CHANNEL``, of a named vehicle is used as it stands. Everything else is looked up among the
    active alarms of all monitors. Raises UsageError if no monitor answers at the ``endpoints``, or no alarm or several
    match.
    """
    root = vehicle_root(prefix, vehicle)
    whole = "id" if _ULID.fullmatch(text) else "channel" if "/" in text else None
    if whole is not None and vehicle != ANY:
        return Target(vehicle, {whole: text})
    answers = _ask(session, root, "alarms")
    if not answers:
        who = "no monitor answers" if vehicle == ANY else f"no monitor of '{vehicle}' answers"
        raise UsageError(f"{who} at {', '.join(endpoints)}; start one with 'fauio run', or give --connect")
    active = {
        (answer.vehicle, alarm["id"], f"{alarm['observer']}/{alarm['channel']}")
        for answer in answers
        for alarm in _alarms(answer.payload)
    }
    meant = sorted(
        (name, channel) for name, own_id, channel in active if text in (own_id, channel, channel.partition("/")[2])
    )
    if len(meant) > 1:
        raise UsageError(f"'{text}' is more than one alarm: {_listed(meant)}; add --vehicle, or name the observer too")
    if meant:
        name, channel = meant[0]
        return Target(name, {"id": text} if whole == "id" else {"channel": channel})
    if whole is not None and len(answers) == 1:
        return Target(answers[0].vehicle, {whole: text})
    known = (
        f"active are {_listed(sorted((name, channel) for name, _, channel in active))}" if active else "none is active"
    )
    raise UsageError(f"no active alarm '{text}'; {known}")


def send_command(
    session: zenoh.Session, prefix: str, vehicle: str, verb: str, request: Mapping[str, Any]
) -> dict[str, Any]:
    """Ask a vehicle's monitor to acknowledge, shelve, unshelve or reset an alarm; return its reply.

    Raises UsageError if the monitor does not answer, does not accept this command, or refuses it with a reason.
    """
    root = vehicle_root(prefix, vehicle)
    answers = _ask(session, root, f"command/{verb}", to_json(request))
    done = next((answer.payload for answer in answers if answer.error is None), None)
    if isinstance(done, dict):
        return done
    if answers:
        raise UsageError(f"{verb}: {answers[0].error or 'the answer is no JSON object'}")
    if any(reply.ok is not None for reply in session.liveliness().get(f"{root}/live", timeout=ANSWER_S)):
        raise UsageError(
            f"the monitor of '{vehicle}' does not take '{verb}'; its configuration has to allow it: "
            f'[commands] allow = ["{verb}"]'
        )
    raise UsageError(
        f"no monitor of '{vehicle}' answers to '{verb}': it is not running, or its configuration does not allow it "
        f'([commands] allow = ["{verb}"])'
    )


def past_events(session: zenoh.Session, prefix: str, vehicle: str = ANY) -> list[AlarmEvent]:
    """Return the past events that the monitors of a vehicle, or of all, still keep.

    Raises UsageError if the vehicle's name or the prefix cannot be part of a key.
    """
    answers = _ask(session, vehicle_root(prefix, vehicle), "alarms?history=true")
    listed = [answer.payload for answer in answers if isinstance(answer.payload, list)]
    return [event for payload in listed for entry in payload if (event := valid_event(entry)) is not None]


def _ask(session: zenoh.Session, root: str, what: str, payload: bytes | None = None) -> list[_Answer]:
    """Return all replies; ask again if there is none, as a route can come up later than the session that uses it."""
    for left in reversed(range(TRIES)):
        replies = list(
            session.get(
                f"{root}/{what}",
                payload=payload,
                encoding=None if payload is None else zenoh.Encoding.APPLICATION_JSON,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=ANSWER_S,
            )
        )
        if replies:
            return [_answer(root, reply) for reply in replies]
        if left:
            time.sleep(PAUSE_S)
    return []


def _answer(root: str, reply: zenoh.Reply) -> _Answer:
    if reply.ok is not None:
        return _Answer(vehicle_of(root, str(reply.ok.key_expr)), decode_payload(reply.ok.payload), None)
    payload = decode_payload(reply.err.payload) if reply.err is not None else None
    error = payload.get("error") if isinstance(payload, dict) else None
    if not isinstance(error, str):
        error = f"no answer within {ANSWER_S:g} s; look with 'fauio alarms' whether it was done"
    return _Answer("", None, printable(error))


def _alarms(payload: Any) -> list[dict[str, str]]:
    names = ("id", "observer", "channel")
    if not isinstance(payload, list):
        return []
    return [
        alarm
        for alarm in payload
        if isinstance(alarm, dict) and all(isinstance(alarm.get(name), str) for name in names)
    ]


def _listed(alarms: Sequence[tuple[str, str]]) -> str:
    names = [printable(f"{channel} of {vehicle}") for vehicle, channel in alarms[:_NAMED]]
    return ", ".join(names) + (f" and {len(alarms) - _NAMED} more" if len(alarms) > _NAMED else "")
