"""The reference of what is published: topics, the fields of each payload from its JSON Schema."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from markup import code, prose, table

from monitor.bus.keys import alarm_key, estimate_key, vehicle_root
from monitor.bus.schemas import SCHEMAS

_ROOT = vehicle_root("PREFIX", "VEHICLE")
_TOPICS = (
    (alarm_key(_ROOT, "OBSERVER", "CHANNEL"), "alarm", "subscribe; `get` for the latest event of each channel"),
    (f"{_ROOT}/alarms", "alarms", "`get`; `?history=true;since=NANOSECONDS` for past events"),
    (estimate_key(_ROOT, "OBSERVER"), "estimate", "subscribe"),
    (f"{_ROOT}/status", "status", "subscribe; once a second"),
    (f"{_ROOT}/live", "", "liveliness token: there as long as the daemon is"),
    (
        f"{_ROOT}/command/VERB",
        "command_request",
        "`get` with a payload; VERB: `ack`, `shelve`, `unshelve`, `reset`",
    ),
)
_TOPICS_HEAD = """# Topics and payloads

Keys of Zenoh, and the fields of every payload, written from the schemas that the tests hold the daemon to. Payloads are
JSON in UTF-8; a number that JSON lacks (NaN, infinity) is `null`. Readers have to ignore fields that they do not know.
`PREFIX` is `fauio` unless the configuration says otherwise. How to read them, with code: [Zenoh](../zenoh.md).
`fauio schema NAME` prints a schema.
"""


def topics_page() -> str:
    """Return the page of topics and payloads."""
    rows = ((code(key), f"[{name}](#{name})" if name else "", how) for key, name, how in _TOPICS)
    parts = [_TOPICS_HEAD, table(("key", "payload", "how to read it"), rows)]
    for name, schema in SCHEMAS.items():
        parts += [
            f"\n## {name}\n",
            f"{prose(schema.get('description', ''))}\nSchema: [{name}.json](../schemas/{name}.json).\n",
        ]
        if schema["type"] == "array":
            parts.append(f"An array; each item is an [{_known(schema['items'])}](#{_known(schema['items'])}).")
            continue
        parts.append(table(("field", "type", "required", "what it is"), _fields(schema, "")))
        if "oneOf" in schema:
            choices = " or ".join(code(", ".join(one["required"])) for one in schema["oneOf"])
            parts.append(f"\nExactly one of {choices} is required.")
    return "\n".join(parts) + "\n"


def _fields(schema: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, str, str, str]]:
    required = schema.get("required", ())
    for name, one in schema["properties"].items():
        place = f"{prefix}{name}"
        yield code(place), _type(one), "yes" if name in required else "", prose(one.get("description", ""))
        values = one.get("additionalProperties")
        if isinstance(values, Mapping) and "properties" in values:
            yield from _fields(values, f"{place}.NAME.")


def _type(schema: Mapping[str, Any]) -> str:
    if "enum" in schema:
        return ", ".join(code(choice) for choice in schema["enum"])
    if "const" in schema:
        return code(str(schema["const"]).lower())
    if known := _known(schema):
        return f"[{known}](#{known})"
    kinds = schema["type"] if isinstance(schema["type"], list) else [schema["type"]]
    text = " or ".join(kinds)
    values = schema.get("additionalProperties")
    if isinstance(values, Mapping) and "properties" not in values:
        kind = values["type"] if isinstance(values["type"], str) else values["type"][0]
        return f"{text} of {kind}s by name"
    if "exclusiveMinimum" in schema:
        return f"{text} > {schema['exclusiveMinimum']}"
    return f"{text} ≥ {schema['minimum']}" if "minimum" in schema else text


def _known(schema: Mapping[str, Any]) -> str:
    """Return the name under which a schema is published by itself, nothing where it is not."""
    title = schema.get("title")
    return next((name for name, one in SCHEMAS.items() if title and one["title"] == title), "")
