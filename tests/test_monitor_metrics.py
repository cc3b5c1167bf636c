"""Metrics by the conventions of Prometheus, of every part of the snapshot; the documentation names each of them."""

import subprocess
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from prometheus_client import CollectorRegistry
from prometheus_client.parser import text_string_to_metric_families

from monitor.recording.archive import ArchiveStatistics
from monitor.recording.journal import JournalStatistics
from monitor.service.health import (
    ChannelHealth,
    Health,
    LinkHealth,
    ObserverHealth,
    ProcessHealth,
    VehicleHealth,
    health_json,
    problems,
)
from monitor.service.latency import Latencies
from monitor.service.metrics import METRICS, HealthCollector, render

ROOT = Path(__file__).parent.parent
UNITS = ("_total", "_seconds", "_bytes", "_ratio", "_info", "_messages", "_events", "_alarms", "_active")
FLAGS = (
    "fauio_estimate",
    "fauio_threshold",
    "fauio_healthy",
    "fauio_vehicle_state",
    "fauio_recorder_trouble",
    "fauio_link_connected",
    "fauio_journal_open",
)


def health() -> Health:
    histogram = Latencies()
    histogram.add(milliseconds * 1_000_000 for milliseconds in (1, 2, 3, 40))
    return Health(
        process=ProcessHealth(
            0.25, inbox_depth=3, inbox_capacity=10, inbox_dropped=4, resident_bytes=1 << 20, cpu_s=2.5
        ),
        vehicles=(
            VehicleHealth(
                "copter-1",
                "monitoring",
                messages=100,
                dropped=2,
                events=7,
                active={"critical": 1},
                observers=(ObserverHealth("motors", 90, {"late": 5}), ObserverHealth("inertial", 80)),
                channels=(
                    ChannelHealth("motors", "motor1", "fraction of full command", -0.03, 0.018, "critical"),
                    ChannelHealth("link", "telemetry"),
                ),
                latency=histogram.end_interval(),
                latency_buckets=histogram.buckets(),
                recorder=ArchiveStatistics(50, 1),
            ),
            VehicleHealth("rover", "stale"),
        ),
        links=(LinkHealth("udpin:127.0.0.1:14550", messages=102, losses={"lost": 6}),),
        journal=JournalStatistics(written=7, pruned=1),
    )


def series(text: bytes) -> dict[tuple[str, frozenset[tuple[str, str]]], float]:
    families = text_string_to_metric_families(text.decode())
    return {
        (sample.name, frozenset(sample.labels.items())): sample.value
        for family in families
        for sample in family.samples
    }


def test_every_part_of_the_snapshot_is_a_series() -> None:
    found = series(render(health())[0])

    def value(name: str, **labels: str) -> float:
        return found[name, frozenset(labels.items())]

    assert value("fauio_vehicle_messages_total", vehicle="copter-1") == 100
    assert value("fauio_vehicle_messages_dropped_total", vehicle="copter-1") == 2
    assert value("fauio_vehicle_state", vehicle="rover", state="stale") == 1
    assert value("fauio_vehicle_state", vehicle="rover", state="monitoring") == 0
    assert value("fauio_vehicle_active_alarms", vehicle="copter-1", severity="critical") == 1
    assert value("fauio_vehicle_active_alarms", vehicle="copter-1", severity="warning") == 0
    assert value("fauio_observer_samples_total", vehicle="copter-1", observer="inertial") == 80
    assert value("fauio_observer_losses_total", vehicle="copter-1", observer="motors", reason="late") == 5
    assert value("fauio_vehicle_latency_recent_seconds", vehicle="copter-1", statistic="largest") == 0.04
    motor = {"vehicle": "copter-1", "observer": "motors", "channel": "motor1"}
    assert value("fauio_alarm_active", **motor, severity="critical") == 1
    assert value("fauio_alarm_active", **motor, severity="warning") == 0
    assert value("fauio_estimate", **motor, unit="fraction of full command") == -0.03
    assert value("fauio_threshold", **motor, unit="fraction of full command") == 0.018
    link = {"vehicle": "copter-1", "observer": "link", "channel": "telemetry"}
    assert value("fauio_alarm_active", **link, severity="critical") == 0
    assert sum(name == "fauio_estimate" for name, _ in found) == 1
    assert value("fauio_vehicle_latency_seconds_count", vehicle="copter-1") == 4
    assert value("fauio_vehicle_latency_seconds_bucket", vehicle="copter-1", le="0.004194304") == 3
    assert value("fauio_vehicle_latency_seconds_bucket", vehicle="copter-1", le="+Inf") == 4
    assert value("fauio_vehicle_latency_seconds_sum", vehicle="copter-1") == pytest.approx(0.046)
    assert value("fauio_recorder_lost_total", vehicle="copter-1") == 1
    assert value("fauio_recorder_trouble", vehicle="copter-1") == 0
    assert value("fauio_link_losses_total", link="udpin:127.0.0.1:14550", reason="lost") == 6
    assert value("fauio_journal_events_total") == 7
    assert value("fauio_inbox_dropped_total") == 4
    assert value("process_resident_memory_bytes") == 1 << 20
    assert value("process_cpu_seconds_total") == 2.5
    assert value("fauio_healthy") == 1


def test_each_row_of_the_table_is_exported_with_its_type_and_its_labels() -> None:
    registry = CollectorRegistry()
    registry.register(HealthCollector(health))
    families = {family.name: family for family in registry.collect()}
    assert len(families) == len(METRICS)
    for row in METRICS:
        family = families[row.name.removesuffix("_total")]
        assert (family.type, family.documentation) == (row.kind, row.help)
        assert all(set(sample.labels) - {"le"} == set(row.labels) for sample in family.samples)


def test_names_follow_the_conventions_of_prometheus() -> None:
    for row in METRICS:
        assert row.name.startswith(("fauio_", "process_"))
        assert row.name.endswith("_total") == (row.kind == "counter")
        assert row.name.endswith(UNITS) or row.name in FLAGS


def test_the_page_of_metrics_has_their_table() -> None:
    rows = [
        f"| `{row.name}` | {row.kind} | {', '.join(row.labels)} | {row.help} |"
        for row in sorted(METRICS, key=lambda row: row.name)
    ]
    table = "\n".join(["| metric | type | labels | what |", "|---|---|---|---|", *rows])
    assert table in (ROOT / "docs/metrics.md").read_text()


@given(st.text())
def test_any_name_is_a_label(name: str) -> None:
    named = Health(ProcessHealth(), links=(LinkHealth(name),))
    assert b"fauio_link_connected{" in render(named)[0]


def test_openmetrics_is_given_to_whoever_asks_for_it() -> None:
    text, content_type = render(health(), "application/openmetrics-text; version=1.0.0")
    assert content_type.startswith("application/openmetrics-text")
    assert text.endswith(b"# EOF\n")


@pytest.mark.parametrize(
    ("unwell", "complaint"),
    [
        (Health(ProcessHealth(loop_age_s=7.0)), "the main loop has not run for 7 s"),
        (Health(ProcessHealth(inbox_depth=5, inbox_capacity=5)), "the inbox is full (5 messages)"),
        (
            Health(ProcessHealth(inbox_dropped_minute=3)),
            "the monitor does not keep up: 3 messages dropped",
        ),
        (
            Health(ProcessHealth(), links=(LinkHealth("udp:x", unread=4),)),
            "the monitor does not keep up: 4 packets",
        ),
        (Health(ProcessHealth(), links=(LinkHealth("udp:x", answers=False),)), "link udp:x does not answer"),
        (
            Health(
                ProcessHealth(), (VehicleHealth("rover", "stale", recorder=ArchiveStatistics(trouble="disk full")),)
            ),
            "rover is not recorded: disk full",
        ),
        (
            Health(ProcessHealth(), journal=JournalStatistics(pending=3, last_error="disk full")),
            "3 alarm events wait for the journal: disk full",
        ),
        (
            Health(ProcessHealth(), journal=JournalStatistics(open=False, last_error="locked")),
            "the journal cannot be opened: locked",
        ),
    ],
)
def test_trouble_of_the_monitor_is_a_problem(unwell: Health, complaint: str) -> None:
    (problem,) = problems(unwell)
    assert problem.startswith(complaint)
    assert health_json(unwell)["status"] == "trouble"


def test_a_silent_vehicle_and_a_closed_link_are_alarms_and_no_problem_of_the_monitor() -> None:
    quiet = Health(ProcessHealth(), (VehicleHealth("rover", "stale"),), (LinkHealth("tcp:x", connected=False),))
    assert problems(quiet) == []


def test_the_process_knows_its_memory() -> None:
    assert ProcessHealth().resident_bytes > 1 << 20


@pytest.mark.system
def test_prometheus_finds_no_fault_with_the_text() -> None:
    done = subprocess.run(["promtool", "check", "metrics"], input=render(health())[0], capture_output=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"")
