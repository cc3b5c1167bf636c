"""JSON payloads of the contract: estimates, alarm events and status as text that any client can parse."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import zenoh
    from numpy.typing import NDArray

    from monitor.estimate import Estimates, Layout

MAX_PAYLOAD_BYTES = 1 << 24
"""Most bytes of a payload. Chosen: the history of 4096 events, the largest answer, has some megabytes."""


_ENCODER = json.JSONEncoder(ensure_ascii=False, allow_nan=False, separators=(",", ":"))


def to_json(payload: Mapping[str, Any] | Sequence[Any]) -> bytes:
    """Return compact JSON in UTF-8; a number that JSON cannot write (NaN, infinity) becomes null."""
    try:
        text = _ENCODER.encode(payload)
    except ValueError:
        text = _ENCODER.encode(_finite(payload))
    return text.encode(errors="backslashreplace")


def estimate_json(layout: Layout, estimates: Estimates, row: int) -> dict[str, Any]:
    """Return one estimate of an observer as the JSON object of the contract, values by channel name."""
    u = dict(zip(layout.inputs, estimates.samples.u[row].tolist(), strict=True))
    usual = zip(layout.faults, layout.usual_commands, strict=False)  # absent if unknown
    commands = {name: u[name] for name, command in usual if command and name in u}
    return {
        "time_ns": int(estimates.samples.time_ns[row]),
        "vehicle_time_ms": int(estimates.samples.vehicle_time_ns[row]) // 1_000_000,
        "armed": bool(estimates.armed[row]),
        "x": _named(layout.states, estimates.x[row]),
        "fault": _named(layout.faults, estimates.fault[row]),
        "sd": _named(layout.faults, estimates.sd[row]),
        "coasted_s": float(estimates.coasted_s[row]),
        "isolated": _named(layout.faults, estimates.isolated[row]),
        "residual": _named(layout.outputs, estimates.residual[row]),
        **({"commands": commands} if commands else {}),
    }


def _named(names: Sequence[str], values: NDArray[Any]) -> dict[str, float]:
    """Return the entries of a vector by name."""
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
    """Return the JSON of a received payload, or None if it is no JSON or too long."""
    if len(payload) > MAX_PAYLOAD_BYTES:
        return None
    try:
        return json.loads(payload.to_bytes())
    except (ValueError, RecursionError):
        return None
