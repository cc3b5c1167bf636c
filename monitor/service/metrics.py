"""The daemon's health as Prometheus metrics, from one table of name, type, labels and source of each value."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import astuple, dataclass
from importlib.metadata import version
from operator import attrgetter
from typing import Any, Literal, NamedTuple, get_args

from prometheus_client.exposition import choose_encoder
from prometheus_client.metrics_core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    Metric,
)
from prometheus_client.registry import Collector

from monitor.event import Severity
from monitor.service.health import Health, LinkHealth, VehicleHealth, VehicleState, problems


@dataclass(frozen=True, slots=True)
class MetricRow:
    """One metric; by Prometheus' conventions it is a counter if its name ends in ``_total``."""

    name: str
    labels: tuple[str, ...]
    help: str  # what it counts
    # label values and number of each series; None: a histogram of the vehicles' latencies
    values: Callable[[Health], Iterable[tuple[tuple[str, ...], float]]] | None = None

    @property
    def kind(self) -> Literal["counter", "gauge", "histogram"]:
        """Its type in Prometheus."""
        return "histogram" if self.values is None else "counter" if self.name.endswith("_total") else "gauge"


def render(health: Health, accept: str = "") -> tuple[bytes, str]:
    """Return all metrics as text, and its content type: OpenMetrics if the ``Accept`` header asks for it."""
    encode, content_type = choose_encoder(accept)
    return encode(HealthCollector(lambda: health)), content_type


class HealthCollector(Collector):
    """The collector from which a registry of prometheus-client, or its encoder, takes the metrics."""

    def __init__(self, snapshot: Callable[[], Health]) -> None:
        self._snapshot = snapshot

    def collect(self) -> Iterator[Metric]:
        """Yield every metric of one snapshot."""
        health = self._snapshot()
        for row in METRICS:
            if row.values is None:
                yield _latency_histogram(row, health)
                continue
            made = CounterMetricFamily if row.kind == "counter" else GaugeMetricFamily
            family = made(row.name, row.help, labels=row.labels)
            for labels, value in row.values(health):
                family.add_metric([_label(label) for label in labels], value)
            yield family


def _latency_histogram(row: MetricRow, health: Health) -> HistogramMetricFamily:
    family = HistogramMetricFamily(row.name, row.help, labels=row.labels)
    for vehicle in health.vehicles:
        if (histogram := vehicle.latency_buckets) is not None:
            buckets = zip([*map(repr, histogram.bounds_s), "+Inf"], histogram.counts, strict=True)
            family.add_metric([_label(vehicle.name)], list(buckets), sum_value=histogram.sum_s)
    return family


def _label(text: str) -> str:
    return text.encode(errors="backslashreplace").decode()


class _Parts(NamedTuple):
    """The parts of a snapshot that are of one kind, and the names of their labels."""

    labels: tuple[str, ...]
    of: Callable[[Health], Iterable[tuple[tuple[str, ...], Any]]]

    def row(self, name: str, read: str | Callable[[Any], Any], about: str, label: str | None = None) -> MetricRow:
        """Return the metric of an attribute of each part; each value of a mapping has its key as one more label."""
        get = attrgetter(read) if isinstance(read, str) else read

        def values(health: Health) -> Iterator[tuple[tuple[str, ...], float]]:
            for own, part in self.of(health):
                value = get(part)
                yield from (
                    [(own, value)] if label is None else (((*own, key), element) for key, element in value.items())
                )

        return MetricRow(name, self.labels if label is None else (*self.labels, label), about, values)


def _one_of(choices: Any, name: str) -> Callable[[Any], dict[str, float]]:
    """Return series that are 1 for the value of a part's attribute and 0 for the other choices."""
    return lambda part: {choice: float(getattr(part, name) == choice) for choice in get_args(choices)}


def _active(vehicle: VehicleHealth) -> dict[str, float]:
    return {severity: vehicle.active.get(severity, 0) for severity in get_args(Severity)}


def _figure(name: str) -> Callable[[LinkHealth], float]:
    return lambda link: math.nan if (value := getattr(link.figures, name)) is None else value


_HEALTH = _Parts((), lambda health: [((), health)])
_JOURNAL = _Parts((), lambda health: [] if health.journal is None else [((), health.journal)])
_LINK = _Parts(("link",), lambda health: [((link.name,), link) for link in health.links])
_OUTLET = _Parts(("outlet",), lambda health: [((outlet.name,), outlet) for outlet in health.outlets])
_VEHICLE = _Parts(("vehicle",), lambda health: [((vehicle.name,), vehicle) for vehicle in health.vehicles])
_RECORDER = _Parts(
    ("vehicle",),
    lambda health: [((vehicle.name,), vehicle.recorder) for vehicle in health.vehicles if vehicle.recorder is not None],
)
_OBSERVER = _Parts(
    ("vehicle", "observer"),
    lambda health: [
        ((vehicle.name, observer.name), observer) for vehicle in health.vehicles for observer in vehicle.observers
    ],
)
_EVIDENCE = _Parts(
    _OBSERVER.labels,
    lambda health: [(own, observer) for own, observer in _OBSERVER.of(health) if observer.evidence_age_s is not None],
)

_CHANNEL = _Parts(
    ("vehicle", "observer", "channel"),
    lambda health: [
        ((vehicle.name, part.observer, part.name), part) for vehicle in health.vehicles for part in vehicle.channels
    ],
)


def _sized(name: str) -> _Parts:
    """Return the channels with a known size, with its unit."""
    return _Parts(
        (*_CHANNEL.labels, "unit"),
        lambda health: [
            ((*own, part.unit), part) for own, part in _CHANNEL.of(health) if getattr(part, name) is not None
        ],
    )


METRICS = (
    MetricRow("fauio_build_info", ("version",), "1, with the version of fauio", lambda _: [((version("fauio"),), 1.0)]),
    _HEALTH.row("fauio_healthy", lambda health: float(not problems(health)), "1 while /healthz answers 200"),
    _VEHICLE.row("fauio_vehicle_state", _one_of(VehicleState, "state"), "1 for the state the vehicle is in", "state"),
    _VEHICLE.row("fauio_vehicle_messages_total", "messages", "messages that the vehicle's pipeline took"),
    _VEHICLE.row(
        "fauio_vehicle_messages_dropped_total", "dropped", "messages of the vehicle dropped before its pipeline"
    ),
    _VEHICLE.row("fauio_vehicle_alarm_events_total", "events", "alarm events"),
    _VEHICLE.row("fauio_vehicle_active_alarms", _active, "active alarms, by severity now", "severity"),
    _CHANNEL.row(
        "fauio_alarm_active",
        _one_of(Severity, "severity"),
        "1 while the channel's alarm is active with that severity and not shelved, of every channel that can be one",
        "severity",
    ),
    _sized("estimate").row("fauio_estimate", "estimate", "size of the fault attributed to the channel, in `unit`"),
    _sized("threshold").row("fauio_threshold", "threshold", "size from which its alarm is raised, in `unit`"),
    MetricRow(
        "fauio_vehicle_latency_seconds",
        ("vehicle",),
        "from the arrival of a message to its results, since the start",
    ),
    _VEHICLE.row(
        "fauio_vehicle_latency_recent_seconds",
        lambda vehicle: dict(zip(("median", "p99", "largest"), astuple(vehicle.latency), strict=True)),
        "the same over the last interval: median, 99th percentile, largest",
        "statistic",
    ),
    _OBSERVER.row("fauio_observer_samples_total", "samples", "samples fed to the observer"),
    _OBSERVER.row("fauio_evidence_ratio", "share", "share of the last minute in which the observer had evidence"),
    _EVIDENCE.row(
        "fauio_evidence_age_seconds",
        "evidence_age_s",
        "time since the observer had evidence; absent while it never had",
    ),
    _OBSERVER.row("fauio_observer_losses_total", "losses", "measurements that the observer lacked", "reason"),
    _RECORDER.row("fauio_recorder_records_total", "records", "records written"),
    _RECORDER.row("fauio_recorder_lost_total", "lost", "records that could not be written"),
    _RECORDER.row(
        "fauio_recorder_trouble",
        lambda recorder: float(recorder.trouble is not None),
        "1 while the vehicle cannot be recorded",
    ),
    _LINK.row("fauio_link_connected", "connected", "1 while the link is open"),
    _LINK.row("fauio_link_messages_total", "messages", "messages received"),
    _LINK.row("fauio_link_delay_seconds", _figure("delay_s"), "mean delay of messages against the quickest one"),
    _LINK.row("fauio_link_jitter_seconds", _figure("jitter_s"), "mean change of the delay between two messages"),
    _LINK.row("fauio_link_lost_ratio", _figure("lost_share"), "share of the last minute's packets that was lost"),
    _LINK.row("fauio_link_losses_total", "losses", "messages lost on the link or refused", "reason"),
    _JOURNAL.row("fauio_journal_open", "open", "1 while the journal's file is open"),
    _JOURNAL.row("fauio_journal_events_total", "written", "alarm events committed"),
    _JOURNAL.row("fauio_journal_pending_events", "pending", "alarm events that wait for the disk"),
    _JOURNAL.row("fauio_journal_dropped_total", "dropped", "alarm events lost because too many were waiting"),
    _JOURNAL.row("fauio_journal_conflicts_total", "conflicts", "alarm events whose number another event has"),
    _JOURNAL.row("fauio_journal_rejected_total", "rejected", "alarm events and freeze frames that no row can hold"),
    _JOURNAL.row("fauio_journal_pruned_total", "pruned", "old events deleted to keep the bound"),
    _OUTLET.row("fauio_notify_sent_total", "sent", "messages to people that were delivered"),
    _OUTLET.row("fauio_notify_failed_total", "failed", "tries that failed"),
    _OUTLET.row("fauio_notify_dropped_total", "dropped", "notices that were never delivered"),
    _OUTLET.row("fauio_notify_waiting_messages", "waiting", "notices that wait: for the limit, or for the next try"),
    _HEALTH.row("fauio_loop_age_seconds", "process.loop_age_s", "time since the main loop last ran"),
    _HEALTH.row("fauio_inbox_messages", "process.inbox_depth", "messages waiting for the main loop"),
    _HEALTH.row("fauio_inbox_capacity_messages", "process.inbox_capacity", "the most that can wait"),
    _HEALTH.row("fauio_inbox_dropped_total", "process.inbox_dropped", "messages dropped because more were waiting"),
    _HEALTH.row("process_resident_memory_bytes", "process.resident_bytes", "resident memory"),
    _HEALTH.row("process_cpu_seconds_total", "process.cpu_s", "processor time used"),
)
