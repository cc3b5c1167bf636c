"""Protobuf types of what the monitor records: samples and estimates by channel name, and alarm events."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adapters.encoding.protobuf_rows import Columns, ProtobufRows
from adapters.encoding.protobuf_types import TIMESTAMP, Field, identifiers, message_class
from adapters.sample import Sample, Samples
from monitor.estimate import Estimate, Estimates, Layout
from monitor.event import AlarmEvent

_TIMES = (Field("time", TIMESTAMP), Field("vehicle_time_ns", "int64"), Field("index", "int64"))


class SampleType:
    """``fauio.<observer>.Sample``: the (u, y) one observer was fed.

    Parameters
    ----------
    layout : Layout
        Names of the observer's channels; characters that protobuf does not take become underscores.
    """

    def __init__(self, layout: Layout) -> None:
        self._u = identifiers(layout.inputs)
        self._y = identifiers(layout.outputs)
        flags = (Field("restart", "bool"), Field("complete", "bool"), Field("measured", "bool"))
        fields = (*_TIMES, Field("u", _numbers(self._u)), Field("y", _numbers(self._y)), *flags)
        self.pb_class = message_class(_package(layout), "Sample", fields)
        self._rows = ProtobufRows(self.pb_class)

    def record(self, sample: Sample) -> Any:
        """Return the protobuf message of a sample."""
        return self.pb_class(
            **_times(sample),
            u=_values(self._u, sample.u),
            y=_values(self._y, sample.y),
            restart=sample.restart,
            complete=sample.complete,
            measured=sample.measured,
        )

    def rows(self, samples: Samples) -> list[bytes]:
        """Return the serialized protobuf messages of samples."""
        columns: Columns = {
            **_columns_of_times(samples),
            "u": _columns(self._u, samples.u),
            "y": _columns(self._y, samples.y),
            "restart": samples.restart,
            "complete": samples.complete,
            "measured": samples.measured,
        }
        return self._rows.encode(columns, len(samples))


class EstimateType:
    """``fauio.<observer>.Estimate``: states, faults and residuals of one observer.

    Parameters
    ----------
    layout : Layout
        Names of the observer's channels; characters that protobuf does not take become underscores.
    """

    def __init__(self, layout: Layout) -> None:
        self._x = identifiers(layout.states)
        self._fault = identifiers(layout.faults)
        self._residual = identifiers(layout.outputs)
        fields = (
            *_TIMES,
            Field("x", _numbers(self._x)),
            Field("fault", _numbers(self._fault)),
            Field("isolated", _numbers(self._fault)),
            Field("residual", _numbers(self._residual)),
            Field("armed", "bool"),
            Field("sd", _numbers(self._fault)),
            Field("coasted_s", "double"),
        )
        self.pb_class = message_class(_package(layout), "Estimate", fields)
        self._rows = ProtobufRows(self.pb_class)

    def record(self, estimate: Estimate) -> Any:
        """Return the protobuf message of an estimate."""
        return self.pb_class(
            **_times(estimate.sample),
            x=_values(self._x, estimate.x),
            fault=_values(self._fault, estimate.fault),
            isolated=_values(self._fault, estimate.isolated),
            residual=_values(self._residual, estimate.residual),
            armed=estimate.armed,
            sd=_values(self._fault, estimate.sd),
            coasted_s=estimate.coasted_s,
        )

    def rows(self, estimates: Estimates) -> list[bytes]:
        """Return the serialized protobuf messages of estimates."""
        columns: Columns = {
            **_columns_of_times(estimates.samples),
            "x": _columns(self._x, estimates.x),
            "fault": _columns(self._fault, estimates.fault),
            "isolated": _columns(self._fault, estimates.isolated),
            "residual": _columns(self._residual, estimates.residual),
            "armed": estimates.armed,
            "sd": _columns(self._fault, estimates.sd),
            "coasted_s": estimates.coasted_s,
        }
        return self._rows.encode(columns, len(estimates))


def alarm_record(event: AlarmEvent) -> Any:
    """Return the protobuf message ``fauio.Alarm`` of an event; what is None in the event is absent."""
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
    return tuple(Field(name, "double") for name in names)


def _times(sample: Sample) -> dict[str, Any]:
    seconds, nanos = divmod(sample.time_ns, 1_000_000_000)
    time = {"seconds": seconds, "nanos": nanos}
    return {"time": time, "vehicle_time_ns": sample.vehicle_time_ns, "index": sample.index}


def _values(names: Sequence[str], values: NDArray[Any]) -> dict[str, float]:
    return dict(zip(names, values.tolist(), strict=True))


def _columns_of_times(samples: Samples) -> Columns:
    seconds, nanos = np.divmod(samples.time_ns, 1_000_000_000)
    time = {"seconds": seconds, "nanos": nanos}
    return {"time": time, "vehicle_time_ns": samples.vehicle_time_ns, "index": samples.index}


def _columns(names: Sequence[str], values: NDArray[np.float64]) -> Columns:
    return dict(zip(names, values.T, strict=True))
