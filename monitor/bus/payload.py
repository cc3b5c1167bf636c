"""JSON payloads of the contract: estimates, alarm events and status as text that any client can parse."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from monitor.estimate import Estimates, Layout

if TYPE_CHECKING:
    import zenoh

MAX_PAYLOAD_BYTES = 1 << 24
"""Chosen: the history of 4096 events, the largest answer there is, has some megabytes."""

_TEXT: dict[str, Any] = {"type": "string"}
_COUNT: dict[str, Any] = {"type": "integer"}
_NUMBER: dict[str, Any] = {"type": ["number", "null"]}

ALARM_SCHEMA: dict[str, Any] = {
    "$schema": "https://json-schema.org/draft/2020-12/schema",
    "title": "fauio.Alarm",
    "description": "One change of state of one alarm.",
    "type": "object",
    "properties": {
        "id": _TEXT | {"description": "ULID, the same from raised to cleared"},
        "vehicle": _TEXT,
        "observer": _TEXT,
        "channel": _TEXT,
        "kind": {"enum": ["actuator", "sensor", "residual", "stale", "security", "system"]},
        "state": {"enum": ["raised", "updated", "acknowledged", "shelved", "cleared"]},
        "severity": {"enum": ["warning", "critical"]},
        "estimate": _NUMBER | {"description": "size of the fault now, in unit"},
        "relative": _NUMBER | {"description": "estimate over command, where that makes sense"},
        "unit": _TEXT,
        "threshold": _NUMBER | {"description": "what the estimate has to exceed"},
        "time_ns": _COUNT | {"description": "Unix time of the sample that caused the event"},
        "vehicle_time_ms": _COUNT | {"description": "the same on the vehicle's own clock"},
        "since_ns": _COUNT | {"description": "Unix time of the sample that raised the alarm"},
        "peak": _NUMBER | {"description": "largest estimate since it was raised"},
        "message": _TEXT | {"description": "one sentence for a person"},
        "seq": _COUNT | {"description": "counts the vehicle's events from 1"},
        "acknowledged": {"type": "boolean", "description": "somebody has said that they know"},
        "latched": {"type": "boolean", "description": "it stands although its cause is gone, until it is reset"},
        "shelved_until_ns": {"type": ["integer", "null"], "description": "Unix time at which it speaks again"},
        "creeping": {"type": "boolean", "description": "only the mean over seconds shows it; estimate is that mean"},
        "recurring": {"type": "boolean", "description": "it comes and goes, and clears only after a long quiet"},
    },
}
ALARM_SCHEMA["required"] = list(ALARM_SCHEMA["properties"])


def to_json(payload: Mapping[str, Any] | Sequence[Any]) -> bytes:
    """Return compact JSON in UTF-8; a number that JSON cannot write (NaN, infinity) becomes null."""
    try:
        text = json.dumps(payload, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    except ValueError:
        text = json.dumps(_finite(payload), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return text.encode(errors="backslashreplace")


def estimate_json(layout: Layout, estimates: Estimates, row: int) -> dict[str, Any]:
    """Return one of an observer's estimates as the JSON object of the contract, values by channel name."""
    return {
        "time_ns": int(estimates.samples.time_ns[row]),
        "vehicle_time_ms": int(estimates.samples.vehicle_time_ns[row]) // 1_000_000,
        "armed": bool(estimates.armed[row]),
        "x": named(layout.states, estimates.x[row]),
        "fault": named(layout.faults, estimates.fault[row]),
        "sd": named(layout.faults, estimates.sd[row]),
        "coasted_s": float(estimates.coasted_s[row]),
        "isolated": named(layout.faults, estimates.isolated[row]),
        "residual": named(layout.outputs, estimates.residual[row]),
    }


def named(names: Sequence[str], values: NDArray[Any]) -> dict[str, float]:
    """Return a vector's entries by name."""
    return dict(zip(names, values.tolist(), strict=True))


def _finite(payload: Any) -> Any:
    if isinstance(payload, Mapping):
        return {key: _finite(value) for key, value in payload.items()}
    if isinstance(payload, list | tuple):
        return [_finite(value) for value in payload]
    if isinstance(payload, float) and not math.isfinite(payload):
        return None
    return payload


def decode_payload(payload: zenoh.ZBytes) -> Any:
    """Return the JSON of a payload that was received, None where it is none or absurdly long."""
    if len(payload) > MAX_PAYLOAD_BYTES:
        return None
    try:
        return json.loads(payload.to_bytes())
    except (ValueError, RecursionError):
        return None
