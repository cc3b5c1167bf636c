"""Messages packed into batches with fields of any type on the wire."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from adapters.batch import Batch, Columns
from adapters.message import Message
from adapters.source import MAVLINK


def pack(messages: Sequence[Message], types: dict[str, Any] | None = None) -> Batch:
    """Return messages as a block; those whose fields are not all numbers, or unlike the first's, stay messages.

    ``types`` gives NumPy types of fields by name; otherwise they are int64 and float64.
    """
    groups: dict[tuple[Any, ...], list[tuple[int, Message]]] = {}
    others: dict[int, Message] = {}
    for place, one in enumerate(messages):
        kinds = tuple((name, _kind(value)) for name, value in one.fields.items())
        if one.source != MAVLINK or any(kind is None for _, kind in kinds):
            others[place] = one
            continue
        members = groups.setdefault((one.source, one.name, one.system, one.component), [])
        if members and kinds != tuple((name, _kind(value)) for name, value in members[0][1].fields.items()):
            others[place] = one
        else:
            members.append((place, one))
    columns = []
    for (source, name, system, component), members in groups.items():
        fields = {}
        for field in members[0][1].fields:
            values = [one.fields[field] for _, one in members]
            first = values[0][0] if isinstance(values[0], list) else values[0]
            usual = np.int64 if isinstance(first, int) else np.float64
            fields[field] = np.array(values, (types or {}).get(field, usual))
        columns.append(
            Columns(
                source,
                name,
                system,
                component,
                np.array([place for place, _ in members]),
                np.array([one.received_ns for _, one in members]),
                fields,
            )
        )
    return Batch(len(messages), tuple(columns), others)


def _kind(value: Any) -> tuple[str, int] | None:
    if isinstance(value, list):
        inner = {_kind(one) for one in value}
        return (inner.pop()[0], len(value)) if len(inner) == 1 and None not in inner else None  # type: ignore[index]
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    if isinstance(value, int):
        return ("int", 0) if abs(value) < 1 << 63 else None
    return "float", 0
