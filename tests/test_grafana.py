"""Dashboard and alert rules: they ask for metrics and labels that exist."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from monitor.service.metrics import METRICS

FOLDER = Path(__file__).parent.parent / "grafana"
NAMES = {row.name: {*row.labels, "instance", "job"} for row in METRICS}
NAMES |= {f"{row.name}_bucket": {*row.labels, "le"} for row in METRICS if row.kind == "histogram"}
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
