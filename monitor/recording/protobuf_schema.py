"""Protobuf types of the monitor's own records: samples and estimates by channel name, and alarm events."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from adapters.encoding.protobuf_types import TIMESTAMP, Field, identifiers, message_class
from adapters.sample import Samples
from monitor.core.protobuf_rows import RowEncoder
from monitor.estimate import Estimates, Layout
from monitor.event import AlarmEvent

_TIMES = (Field("time", TIMESTAMP), Field("vehicle_time_ns", "int64"), Field("index", "int64"))
_SECOND_NS = 1_000_000_000


class SampleType:
    """``fauio.<observer>.Sample``: the (u, y) that one observer was fed.

    Parameters
    ----------
    layout : Layout
        Names of the observer's channels; characters that protobuf does not take become underscores.
    """

    def __init__(self, layout: Layout) -> None:
        flags = (Field("restart", "bool"), Field("complete", "bool"), Field("measured", "bool"))
        fields = (*_TIMES, Field("u", _numbers(layout.inputs)), Field("y", _numbers(layout.outputs)), *flags)
        self.pb_class = message_class(_package(layout), "Sample", fields)
        self._rows = RowEncoder(self.pb_class)

    def rows(self, samples: Samples) -> list[bytes]:
        """Return the serialized messages of samples."""
        columns = (*_times(samples), samples.u, samples.y, samples.restart, samples.complete, samples.measured)
        return self._rows.encode(columns, len(samples))


class EstimateType:
    """``fauio.<observer>.Estimate``: states, faults and residuals of one observer.

    Parameters
    ----------
    layout : Layout
        Names of the observer's channels; characters that protobuf does not take become underscores.
    """

    def __init__(self, layout: Layout) -> None:
        faults = _numbers(layout.faults)
        fields = (
            *_TIMES,
            Field("x", _numbers(layout.states)),
            Field("fault", faults),
            Field("isolated", faults),
            Field("residual", _numbers(layout.outputs)),
            Field("armed", "bool"),
            Field("sd", faults),
            Field("coasted_s", "double"),
        )
        self.pb_class = message_class(_package(layout), "Estimate", fields)
        self._rows = RowEncoder(self.pb_class)

    def rows(self, estimates: Estimates) -> list[bytes]:
        """Return the serialized messages of estimates."""
        columns = (
            *_times(estimates.samples),
            estimates.x,
            estimates.fault,
            estimates.isolated,
            estimates.residual,
            estimates.armed,
            estimates.sd,
            estimates.coasted_s,
        )
        return self._rows.encode(columns, len(estimates))


def alarm_record(event: AlarmEvent) -> Any:
    """Return the protobuf message ``fauio.Alarm`` of an event; fields that are None in the event are absent."""
    return _alarm_class()(**event.to_json())


@functools.cache
def _alarm_class() -> Any:
    texts = ("id", "vehicle", "observer", "channel", "kind", "state", "severity")
    fields = (
        *(Field(name, "string") for name in texts),
        Field("estimate", "double", optional=True),
        Field("relative", "double", optional=True),
        Field("unit", "string"),
        Field("threshold", "double"),
        Field("time_ns", "int64"),
        Field("vehicle_time_ms", "int64"),
        Field("since_ns", "int64"),
        Field("peak", "double", optional=True),
        Field("message", "string"),
        Field("seq", "int64"),
        Field("acknowledged", "bool"),
        Field("latched", "bool"),
        Field("shelved_until_ns", "int64", optional=True),
        Field("creeping", "bool"),
        Field("recurring", "bool"),
    )
    return message_class("fauio", "Alarm", fields)


def _package(layout: Layout) -> str:
    return f"fauio.{identifiers((layout.observer,))[0]}"


def _numbers(names: Sequence[str]) -> tuple[Field, ...]:
    return tuple(Field(name, "double") for name in identifiers(names))


def _times(samples: Samples) -> tuple[Any, ...]:
    """Return the columns of the fields that samples and estimates begin with."""
    timestamps = np.empty((len(samples), 2), np.int64)
    np.divmod(samples.time_ns, _SECOND_NS, out=(timestamps[:, 0], timestamps[:, 1]))
    return timestamps, samples.vehicle_time_ns, samples.index
