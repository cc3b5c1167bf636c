"""Channels of a stretch of telemetry as arrays: which messages are meant, their stamps and values.

The rules are those of :class:`adapters.channels.Channel`, for columns of numbers; a test holds both together. What is
no such column is answered with None: its messages have to be taken one by one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from adapters.channels import CLOCK_UNITS_NS, MAX_VALUE, Channel, field_steps

Fields = Mapping[str, NDArray[np.generic]]
# What a message without a usable stamp has in place of it.
UNTIMED = -1


def selected(channel: Channel, fields: Fields, count: int) -> NDArray[np.bool_]:
    """Return which of the first ``count`` messages are those that a channel is taken from (count,)."""
    chosen = np.ones(count, np.bool_)
    for name, value in channel.where:
        column = fields.get(name)
        if column is None:
            chosen[:] = False
        elif isinstance(value, int) and column.ndim == 1 and column.dtype.kind in "iu":
            chosen &= column[:count] == value
        else:
            chosen &= np.fromiter((found == value for found in column[:count].tolist()), np.bool_, count)
    return chosen


def is_clockless(channel: Channel, fields: Fields) -> bool:
    """Return whether the messages have no clock field that the channel would take."""
    return channel.clock is None and "header" not in fields and not any(name in fields for name in CLOCK_UNITS_NS)


def stamps_ns(channel: Channel, fields: Fields, count: int, largest_ns: int) -> NDArray[np.int64] | None:
    """Return the stamps of the first ``count`` messages (count,), ``UNTIMED`` where below 0 or above ``largest_ns``.

    None where the clock is no column of whole numbers.
    """
    name = channel.clock
    if name is None:
        name = next((usual for usual in CLOCK_UNITS_NS if usual in fields), None)
    elif name not in fields and field_steps(name)[0] not in fields:
        return np.full(count, UNTIMED, np.int64)
    column = None if name is None else fields.get(name)
    if name is None or column is None or column.ndim != 1 or column.dtype.kind not in "iu":
        return None
    unit_ns = channel.clock_unit_ns or CLOCK_UNITS_NS.get(name, 1)
    counts: NDArray[np.int64] = column[:count]  # type: ignore[assignment]
    usable = (counts >= 0) & (counts <= largest_ns // unit_ns)
    stamps = np.where(usable, counts, 0).astype(np.int64) * unit_ns
    stamps[~usable] = UNTIMED
    return stamps


def values(channels: Sequence[Channel], fields: Fields, rows: NDArray[np.intp]) -> NDArray[np.float64] | None:
    """Return the channels' values in the messages at ``rows`` (m, number of channels).

    None where a channel is no column of numbers; NaN where a value is not to be taken.
    """
    found = np.empty((len(rows), len(channels)))
    for place, channel in enumerate(channels):
        column = _column(fields, channel.path)
        if column is None:
            return None
        found[:, place] = column[rows]
    with np.errstate(over="ignore", invalid="ignore"):
        found *= np.array([channel.scale for channel in channels])
        found += np.array([channel.offset for channel in channels])
    found[~(np.abs(found) <= MAX_VALUE)] = np.nan
    return found


def _column(fields: Fields, path: tuple[str | int, ...]) -> NDArray[np.generic] | None:
    name, *rest = path
    column = fields.get(name) if isinstance(name, str) else None
    if column is None or column.dtype.kind not in "iuf" or column.ndim != len(path):
        return None
    if not rest:
        return column
    step = rest[0]
    return column[:, step] if isinstance(step, int) and step < column.shape[1] else None
