"""Dashboard and alert rules: they ask for metrics and labels that exist."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest

from monitor.service.metrics import METRICS

FOLDER = Path(__file__).parent.parent / "grafana"
NAMES = {row.name: {*row.labels, "instance", "job"} for row in METRICS}
NAMES |= {f"{row.name}_bucket": {*row.labels, "le"} for row in METRICS if row.kind == "histogram"}
ALARM = 'fauio_alarm_active{vehicle="copter-1",observer="motors",channel="motor1",severity="%s"}'
FIRES = {
    "FauioCritical": (ALARM % "critical", "1x8"),
    "FauioWarning": (ALARM % "warning", "1x8"),
    "FauioBlind": ('fauio_vehicle_state{vehicle="copter-1",state="blind"}', "1x8"),
    "FauioSilent": ('fauio_vehicle_state{vehicle="copter-1",state="stale"}', "1x8"),
    "FauioTrouble": ("fauio_healthy", "0x8"),
    "FauioGone": ('up{job="fauio"}', "0x8"),
    "FauioJournalLoses": ("fauio_journal_dropped_total", "0+1x8"),
    "FauioDrops": ("fauio_inbox_dropped_total", "0+1x8"),
    "": (ALARM % "warning", "0x8"),
}
"""The series that make each alert fire, and one that makes none."""
WORD = re.compile(r"\b((?:fauio|process)_\w+)(?:\{([^}]*)\})?")


def expressions(found: Any) -> list[str]:
    """Return every query in a dashboard."""
    if isinstance(found, dict):
        own = [text for key in ("expr", "query") if isinstance(text := found.get(key), str)]
        return own + [text for value in found.values() for text in expressions(value)]
    return [text for value in found for text in expressions(value)] if isinstance(found, list) else []


def rules() -> list[str]:
    text = (FOLDER / "fauio-alerts.yml").read_text()
    return re.findall(r"expr: (.*)", text)


@pytest.mark.parametrize("queries", [expressions(json.loads((FOLDER / "fauio-dashboard.json").read_text())), rules()])
def test_every_metric_and_label_that_is_asked_for_exists(queries: list[str]) -> None:
    asked = [match for text in queries for match in WORD.finditer(text)]
    assert len(asked) >= 8
    for match in asked:
        assert match[1] in NAMES, match[0]
        assert set(re.findall(r"(\w+)=", match[2] or "")) <= NAMES[match[1]], match[0]


def test_legends_and_summaries_name_labels_that_exist() -> None:
    labels = set().union(*NAMES.values())
    said = (FOLDER / "fauio-dashboard.json").read_text() + (FOLDER / "fauio-alerts.yml").read_text()
    assert set(re.findall(r"\{\{ ?(?:\$labels\.)?(\w+) ?\}\}", said)) <= labels


def promtool(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["promtool", *map(str, arguments)], capture_output=True, text=True, check=False)


@pytest.mark.system
def test_prometheus_takes_the_rules_and_every_query_of_the_dashboard(tmp_path: Path) -> None:
    dashboard = json.loads((FOLDER / "fauio-dashboard.json").read_text())
    queries = [text for text in expressions(dashboard) if WORD.search(text) and not text.startswith("label_values")]
    assert len(queries) >= 8
    rows = [{"record": f"query{number}", "expr": text} for number, text in enumerate(queries)]
    (tmp_path / "queries.json").write_text(json.dumps({"groups": [{"name": "dashboard", "rules": rows}]}))
    done = promtool("check", "rules", FOLDER / "fauio-alerts.yml", tmp_path / "queries.json")
    assert (done.returncode, done.stderr) == (0, ""), done.stdout


@pytest.mark.system
def test_each_alert_fires_by_its_own_series_alone(tmp_path: Path) -> None:
    assert set(FIRES) == {"", *re.findall(r"alert: (\w+)", (FOLDER / "fauio-alerts.yml").read_text())}
    tests = []
    for alert, (series, values) in FIRES.items():
        given = {"fauio_healthy": "1x8", series: values}
        tests.append(
            {
                "interval": "15s",
                "input_series": [{"series": name, "values": text} for name, text in given.items()],
                "promql_expr_test": [
                    {
                        "expr": 'count by (alertname) (ALERTS{alertstate="firing"})',
                        "eval_time": "2m",
                        "exp_samples": [{"labels": f'{{alertname="{alert}"}}', "value": 1}] if alert else [],
                    }
                ],
            }
        )
    content = {"rule_files": [str(FOLDER / "fauio-alerts.yml")], "evaluation_interval": "15s", "tests": tests}
    (tmp_path / "tests.json").write_text(json.dumps(content))
    done = promtool("test", "rules", tmp_path / "tests.json")
    assert done.returncode == 0, done.stdout + done.stderr
