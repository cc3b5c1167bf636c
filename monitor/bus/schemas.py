"""JSON Schemas of everything that is published and of operators' commands; ``docs/schemas`` has a file of each."""

import json
from collections.abc import Sequence
from typing import Any

from adapters.errors import UsageError
from monitor.event import ALARM_FIELDS, AlarmField

_DIALECT = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
_COUNT = {"type": "integer", "minimum": 0}
_AMOUNT = {"type": "number", "minimum": 0}
_PERHAPS = {"type": ["number", "null"], "minimum": 0}
_TIME = {"type": "integer", "description": "Unix time, nanoseconds"}


def _object(
    title: str, description: str, required: dict[str, Any], optional: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Return the schema of an object that may have further properties: readers have to ignore unknown ones."""
    head = {**_DIALECT, "title": f"fauio.{title}", "description": description}
    return head | _part(required | (optional or {}), list(required))


def _part(properties: dict[str, Any], required: Sequence[str] | None = None, **more: Any) -> dict[str, Any]:
    """Return the schema of an object within another; all of its properties are required unless some are named."""
    needed = list(properties if required is None else required)
    return {"type": "object", "properties": properties, "required": needed, **more}


def _by(values: dict[str, Any], description: str | None = None) -> dict[str, Any]:
    """Return the schema of an object whose keys are names."""
    found = {"type": "object", "additionalProperties": values}
    return found if description is None else found | {"description": description}


def _list_of(items: dict[str, Any], description: str) -> dict[str, Any]:
    return {"type": "array", "items": items, "description": description}


_BY_NAME = _by({"type": ["number", "null"]})


def _alarm_field(field: AlarmField) -> dict[str, Any]:
    name = {str: "string", bool: "boolean", int: "integer", float: "number"}[field.kind]
    kind = [name, "null"] if field.optional or field.kind is float else name
    schema: dict[str, Any] = {"enum": list(field.choices)} if field.choices else {"type": kind}
    return schema | ({"description": field.description} if field.description else {})


ALARM_SCHEMA = _object(
    "Alarm",
    "One change of state of one alarm.",
    {name: _alarm_field(field) for name, field in ALARM_FIELDS.items()},
)
_ALARM = {key: value for key, value in ALARM_SCHEMA.items() if key != "$schema"}

_ESTIMATE = _object(
    "Estimate",
    "An observer's estimates at one sample, on PREFIX/VEHICLE/estimate/OBSERVER.",
    {
        "time_ns": _TIME,
        "vehicle_time_ms": {"type": "integer", "description": "the same on the vehicle's own clock"},
        "armed": {"type": "boolean", "description": "whether samples are evidence: in the air, settled"},
        "x": _BY_NAME | {"description": "states"},
        "fault": _BY_NAME | {"description": "estimates of the faults"},
        "isolated": _BY_NAME | {"description": "estimates that are evidence; zero if not held responsible"},
        "residual": _BY_NAME | {"description": "measurement minus prediction"},
    },
    {
        "sd": _BY_NAME | {"description": "standard deviations of the estimates, by name"},
        "coasted_s": _AMOUNT | {"description": "time since the last measurement, on the model alone"},
        "commands": _BY_NAME | {"description": "of motors, by their faults; a loss is a share of it"},
    },
)

_LINK = _part(
    {
        "connected": {"type": "boolean"},
        "messages": _COUNT | {"description": "messages received since the start, of all vehicles"},
        "losses": _by(_COUNT, "messages lost on the link or refused, by reason, as in fauio_link_losses_total"),
        "delay_s": _PERHAPS | {"description": "mean delay of the last minute's messages against the quickest one"},
        "jitter_s": _PERHAPS | {"description": "mean change of the delay between messages of a kind"},
        "lost_share": _PERHAPS | {"description": "share of the last minute's packets that was lost"},
    },
    ["connected", "messages", "losses"],
)

_EVIDENCE_TIME = {"type": ["integer", "null"], "description": "Unix time of its last evidence, nanoseconds; null: none"}
_WATCHING = _part(
    {
        "share": _AMOUNT | {"maximum": 1, "description": "share of the last minute of vehicle time with evidence"},
        "last_ns": _EVIDENCE_TIME,
        "why_not": {
            "type": ["string", "null"],
            "description": "why it has no evidence: on_ground, gap, settling, clock, not_carried, "
            "contradicted or no_message NAME; null if it has",
        },
        "sensors": _by(_EVIDENCE_TIME),
    }
)

_CHANNEL = _part(
    {
        "threshold": _PERHAPS,
        "unit": {"type": "string"},
        "usual_command": _PERHAPS | {"description": "command of a motor in hover; a loss is a share of it"},
    },
    ["threshold", "unit"],
)
_CHANNELS = _by(_by(_CHANNEL), "thresholds and units of the fault channels by observer")
_PLACE = {"type": "array", "items": {"type": "number"}, "minItems": 3, "maxItems": 3}
"""Latitude, longitude and altitude."""
_CONDITION = _part(
    {
        "name": {"enum": ["payload", "wind", "pressure"]},
        "kind": {"const": "information"},
        "since_ns": _TIME,
        "text": {"type": "string"},
        "values": _by({"type": "number"}),
    }
)
_FACTS = _part(
    {
        "heartbeat": _by(_COUNT, "its last heartbeat: mode, armed"),
        "position": _PLACE | {"description": "as the autopilot estimates it: degrees north, degrees east, metres"},
        "gps": _PLACE | {"description": "as the GPS receiver reports it"},
        "texts": _list_of(
            _part({"time_ns": _TIME, "severity": _COUNT, "text": {"type": "string"}}),
            "the last messages of the autopilot",
        ),
        "conditions": _list_of(_CONDITION, "the newest condition of each kind; conditions are no faults"),
    },
    ["texts"],
    description="the vehicle's last reports about itself, and conditions that are no faults",
)

_STATUS = _object(
    "Status",
    "How a vehicle's monitor is doing, once a second on PREFIX/VEHICLE/status.",
    {
        "state": {
            "enum": ["starting", "monitoring", "blind", "degraded", "stale"],
            "description": "blind: the vehicle flies and is not watched, or not by all observers and sensors",
        },
        "vehicle": {"type": "string"},
        "time_ns": _TIME,
        "messages": _COUNT | {"description": "messages since the start"},
        "messages_per_s": _AMOUNT,
        "samples": _COUNT | {"description": "samples since the start"},
        "samples_per_s": _AMOUNT,
        "lost": _COUNT | {"description": "packets of the vehicle missing by their sequence numbers, over all links"},
        "links": _by(_LINK, "the links that its telemetry may come over, by URL or key expression"),
        "latency_ms": {"type": "number", "description": "longest time from arrival to result in the last second"},
        "active_alarms": _COUNT,
        "watching": _by(_WATCHING, "how each observer watches now"),
        "observers": _by({"type": "object"}, "counts of each observer"),
        "profile": {"type": "string", "description": "digest of the profile"},
        "versions": _by({"type": "string"}),
    },
    {
        "foreign_messages": _COUNT | {"description": "messages of other stations, ignored"},
        "channels": _CHANNELS,
        "facts": _FACTS,
    },
)

_ALARMS = {
    **_DIALECT,
    "title": "fauio.Alarms",
    "description": "Reply to a get on PREFIX/VEHICLE/alarms: the active alarms, or with ?history=true;since=NS past "
    "events in their order.",
    "type": "array",
    "items": _ALARM,
}

_COMMAND_REQUEST = _object(
    "CommandRequest",
    "Payload of a get on PREFIX/VEHICLE/command/{ack,shelve,unshelve,reset}.",
    {},
    {
        "id": {"type": "string", "description": "id of the alarm"},
        "channel": {"type": "string", "pattern": "^[^/]+/.+$", "description": "OBSERVER/CHANNEL instead of the id"},
        "by": {"type": "string", "description": "who"},
        "reason": {"type": "string", "description": "why"},
        "minutes": {"type": "number", "exclusiveMinimum": 0, "description": "shelve: for how long"},
    },
) | {"oneOf": [{"required": ["id"]}, {"required": ["channel"]}]}

_COMMAND_REPLY = _object(
    "CommandReply",
    "Reply to a command that was carried out; others get an error reply, see fauio.CommandError.",
    {"ok": {"const": True}, "event": _ALARM | {"description": "the event it caused"}},
)

_COMMAND_ERROR = _object(
    "CommandError",
    "Error reply to a command or a query.",
    {"error": {"type": "string", "description": "what was wrong, one line"}},
)

SCHEMAS: dict[str, dict[str, Any]] = {
    "alarm": ALARM_SCHEMA,
    "alarms": _ALARMS,
    "estimate": _ESTIMATE,
    "status": _STATUS,
    "command_request": _COMMAND_REQUEST,
    "command_reply": _COMMAND_REPLY,
    "command_error": _COMMAND_ERROR,
}


def schema_text(name: str | None = None) -> str:
    """Return one schema as indented JSON, or all schemas by name without a name.

    Raise UsageError for an unknown one.
    """
    if name is not None and name not in SCHEMAS:
        raise UsageError(f"schema '{name}': there is none; there are {', '.join(SCHEMAS)}")
    return json.dumps(SCHEMAS if name is None else SCHEMAS[name], indent=2, ensure_ascii=False) + "\n"
