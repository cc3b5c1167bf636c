"""The daemon's health as Prometheus metrics: one table says name, type, labels and where each value comes from."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from importlib.metadata import version
from typing import Literal, get_args

from prometheus_client.exposition import choose_encoder
from prometheus_client.metrics_core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    Metric,
)
from prometheus_client.registry import Collector

from monitor.event import Severity
from monitor.service.health import Health, VehicleState, problems

MetricValues = Iterable[tuple[tuple[str, ...], float]]


@dataclass(frozen=True, slots=True)
class MetricRow:
    """One metric."""

    name: str
    kind: Literal["counter", "gauge", "histogram"]
    labels: tuple[str, ...]
    help: str  # what it counts
    # label values and number of each series; not asked of a histogram
    values: Callable[[Health], MetricValues] = lambda health: ()


def render(health: Health, accept: str = "") -> tuple[bytes, str]:
    """Return all metrics as text and its content type: OpenMetrics for an ``Accept`` header that asks for it."""
    encode, content_type = choose_encoder(accept)
    return encode(HealthCollector(lambda: health)), content_type


class HealthCollector(Collector):
    """What a registry of prometheus-client, or one of its encoders, collects metrics from."""

    def __init__(self, snapshot: Callable[[], Health]) -> None:
        self._snapshot = snapshot

    def collect(self) -> Iterator[Metric]:
        """Yield every metric of one snapshot."""
        health = self._snapshot()
        for row in METRICS:
            if row.kind == "histogram":
                yield _latency_histogram(row, health)
                continue
            made = CounterMetricFamily if row.kind == "counter" else GaugeMetricFamily
            family = made(row.name, row.help, labels=row.labels)
            for labels, value in row.values(health):
                family.add_metric([_label(label) for label in labels], value)
            yield family


def metrics_table() -> str:
    """Return all metrics as a Markdown table."""
    rows = [
        f"| `{row.name}` | {row.kind} | {', '.join(row.labels)} | {row.help} |"
        for row in sorted(METRICS, key=lambda row: row.name)
    ]
    return "\n".join(["| metric | type | labels | what |", "|---|---|---|---|", *rows])


def _latency_histogram(row: MetricRow, health: Health) -> HistogramMetricFamily:
    family = HistogramMetricFamily(row.name, row.help, labels=row.labels)
    for vehicle in health.vehicles:
        histogram = vehicle.latency_buckets
        if histogram is None:
            continue
        bounds = [*map(repr, histogram.bounds_s), "+Inf"]
        family.add_metric(
            [_label(vehicle.name)], list(zip(bounds, histogram.counts, strict=True)), sum_value=histogram.sum_s
        )
    return family


def _label(text: str) -> str:
    return text.encode(errors="backslashreplace").decode()


def _one(value: Callable[[Health], float]) -> Callable[[Health], MetricValues]:
    return lambda health: [((), value(health))]


def _journal(name: str) -> Callable[[Health], MetricValues]:
    return lambda health: [] if health.journal is None else [((), getattr(health.journal, name))]


def _vehicle(name: str) -> Callable[[Health], MetricValues]:
    return lambda health: [((vehicle.name,), getattr(vehicle, name)) for vehicle in health.vehicles]


def _recorder(name: str) -> Callable[[Health], MetricValues]:
    return lambda health: [
        ((vehicle.name,), getattr(vehicle.recorder, name)) for vehicle in health.vehicles if vehicle.recorder
    ]


def _link(name: str) -> Callable[[Health], MetricValues]:
    return lambda health: [((link.name,), getattr(link, name)) for link in health.links]


def _states(health: Health) -> MetricValues:
    for vehicle in health.vehicles:
        for state in get_args(VehicleState):
            yield (vehicle.name, state), float(vehicle.state == state)


def _active(health: Health) -> MetricValues:
    for vehicle in health.vehicles:
        for severity in get_args(Severity):
            yield (vehicle.name, severity), vehicle.active.get(severity, 0)


def _recent_latency(health: Health) -> MetricValues:
    for vehicle in health.vehicles:
        latency = vehicle.latency
        for quantile, value in (("0.5", latency.p50_s), ("0.99", latency.p99_s), ("1", latency.max_s)):
            yield (vehicle.name, quantile), value


def _samples(health: Health) -> MetricValues:
    for vehicle in health.vehicles:
        for observer in vehicle.observers:
            yield (vehicle.name, observer.name), observer.samples


def _observer_losses(health: Health) -> MetricValues:
    for vehicle in health.vehicles:
        for observer in vehicle.observers:
            for reason, count in observer.losses.items():
                yield (vehicle.name, observer.name, reason), count


def _link_losses(health: Health) -> MetricValues:
    for link in health.links:
        for reason, count in link.losses.items():
            yield (link.name, reason), count


def _recorder_trouble(health: Health) -> MetricValues:
    for vehicle in health.vehicles:
        if vehicle.recorder is not None:
            yield (vehicle.name,), float(vehicle.recorder.trouble is not None)


_OF_VEHICLE = ("vehicle",)
_OF_OBSERVER = ("vehicle", "observer")
_OF_LINK = ("link",)

METRICS = (
    MetricRow(
        "fauio_build_info",
        "gauge",
        ("version",),
        "1, with the version of fauio",
        lambda health: [((version("fauio"),), 1.0)],
    ),
    MetricRow(
        "fauio_healthy",
        "gauge",
        (),
        "1 while /healthz answers 200",
        _one(lambda health: float(not problems(health))),
    ),
    MetricRow("fauio_vehicle_state", "gauge", ("vehicle", "state"), "1 for the state the vehicle is in", _states),
    MetricRow(
        "fauio_vehicle_messages_total",
        "counter",
        _OF_VEHICLE,
        "messages that the vehicle's pipeline took",
        _vehicle("messages"),
    ),
    MetricRow(
        "fauio_vehicle_messages_dropped_total",
        "counter",
        _OF_VEHICLE,
        "messages of the vehicle dropped before its pipeline",
        _vehicle("dropped"),
    ),
    MetricRow("fauio_vehicle_alarm_events_total", "counter", _OF_VEHICLE, "alarm events", _vehicle("events")),
    MetricRow(
        "fauio_vehicle_active_alarms", "gauge", ("vehicle", "severity"), "active alarms, by severity now", _active
    ),
    MetricRow(
        "fauio_vehicle_latency_seconds",
        "histogram",
        _OF_VEHICLE,
        "from the arrival of a message to what follows from it, since the start",
    ),
    MetricRow(
        "fauio_vehicle_latency_recent_seconds",
        "gauge",
        ("vehicle", "quantile"),
        "the same over the last interval: median, 99th percentile, largest",
        _recent_latency,
    ),
    MetricRow("fauio_observer_samples_total", "counter", _OF_OBSERVER, "samples fed to the observer", _samples),
    MetricRow(
        "fauio_observer_losses_total",
        "counter",
        (*_OF_OBSERVER, "reason"),
        "measurements that the observer did without",
        _observer_losses,
    ),
    MetricRow("fauio_recorder_records_total", "counter", _OF_VEHICLE, "records written", _recorder("records")),
    MetricRow(
        "fauio_recorder_lost_total", "counter", _OF_VEHICLE, "records that could not be written", _recorder("lost")
    ),
    MetricRow(
        "fauio_recorder_trouble", "gauge", _OF_VEHICLE, "1 while the vehicle cannot be recorded", _recorder_trouble
    ),
    MetricRow("fauio_link_connected", "gauge", _OF_LINK, "1 while the link is open", _link("connected")),
    MetricRow("fauio_link_messages_total", "counter", _OF_LINK, "messages received", _link("messages")),
    MetricRow(
        "fauio_link_losses_total", "counter", ("link", "reason"), "what was lost on the link or refused", _link_losses
    ),
    MetricRow("fauio_journal_open", "gauge", (), "1 while the journal's file is open", _journal("open")),
    MetricRow("fauio_journal_events_total", "counter", (), "alarm events committed", _journal("written")),
    MetricRow("fauio_journal_pending_events", "gauge", (), "alarm events that wait for the disk", _journal("pending")),
    MetricRow(
        "fauio_journal_dropped_total",
        "counter",
        (),
        "alarm events lost because too many were waiting",
        _journal("dropped"),
    ),
    MetricRow(
        "fauio_journal_conflicts_total",
        "counter",
        (),
        "alarm events whose number another event has",
        _journal("conflicts"),
    ),
    MetricRow(
        "fauio_journal_rejected_total",
        "counter",
        (),
        "alarm events and freeze frames that no row can hold",
        _journal("rejected"),
    ),
    MetricRow("fauio_journal_pruned_total", "counter", (), "old events deleted to keep the bound", _journal("pruned")),
    MetricRow(
        "fauio_loop_age_seconds",
        "gauge",
        (),
        "time since the main loop last came round",
        _one(lambda health: health.process.loop_age_s),
    ),
    MetricRow(
        "fauio_inbox_messages",
        "gauge",
        (),
        "messages waiting for the main loop",
        _one(lambda health: health.process.inbox_depth),
    ),
    MetricRow(
        "fauio_inbox_capacity_messages",
        "gauge",
        (),
        "the most that can wait",
        _one(lambda health: health.process.inbox_capacity),
    ),
    MetricRow(
        "fauio_inbox_dropped_total",
        "counter",
        (),
        "messages dropped because more were waiting",
        _one(lambda health: health.process.inbox_dropped),
    ),
    MetricRow(
        "process_resident_memory_bytes",
        "gauge",
        (),
        "resident memory",
        _one(lambda health: health.process.resident_bytes),
    ),
    MetricRow(
        "process_cpu_seconds_total", "counter", (), "processor time used", _one(lambda health: health.process.cpu_s)
    ),
)
