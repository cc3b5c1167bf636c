"""Published schemas: the files agree with the package, and what is really published agrees with them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jsonschema import Draft202012Validator
from loopback import event
from test_monitor_recorder import LAYOUT, estimates

import fauio
from monitor.bus.payload import estimate_json, to_json
from monitor.bus.schemas import SCHEMAS, schema_text

ROOT = Path(__file__).parent.parent
FOLDER = ROOT / "docs/schemas"


def valid(name: str, payload: bytes) -> bool:
    return Draft202012Validator(SCHEMAS[name]).is_valid(json.loads(payload))


def test_the_published_files_are_those_of_the_package() -> None:
    assert {path.name for path in FOLDER.iterdir()} == {f"{name}.json" for name in SCHEMAS}
    for name in SCHEMAS:
        assert (FOLDER / f"{name}.json").read_text() == schema_text(name), "run python docs/hooks/schema_files.py"


@pytest.mark.parametrize("name", SCHEMAS)
def test_each_is_a_schema_with_a_title_and_a_description(name: str) -> None:
    Draft202012Validator.check_schema(SCHEMAS[name])
    assert SCHEMAS[name]["title"].startswith("fauio.")
    assert SCHEMAS[name]["description"]


def test_alarm_events_are_as_published() -> None:
    events = [event(1), event(2, estimate=None, relative=float("nan"), shelved_until_ns=5), event(3, state="shelved")]
    assert all(valid("alarm", to_json(one.to_json())) for one in events)
    assert valid("alarms", to_json([one.to_json() for one in events]))
    assert not valid("alarm", to_json(event(1, state="on fire").to_json()))
    assert valid("command_reply", to_json({"ok": True, "event": event(1).to_json()}))
    assert not valid("command_reply", to_json({"ok": False, "event": event(1).to_json()}))
    assert valid("command_error", to_json({"error": "no such alarm"}))


@pytest.mark.parametrize(
    ("request_body", "right"),
    [
        ({"id": "01J"}, True),
        ({"channel": "motors/motor1", "minutes": 5, "by": "eva", "reason": "landing"}, True),
        ({"channel": "motor1"}, False),
        ({"id": "01J", "channel": "motors/motor1"}, False),
        ({"by": "eva"}, False),
        ({"id": "01J", "minutes": 0}, False),
    ],
)
def test_a_command_names_one_alarm(request_body: dict[str, Any], right: bool) -> None:
    assert valid("command_request", to_json(request_body)) is right


def test_estimates_are_as_published() -> None:
    made = estimates(0)
    made.fault[0, 0] = np.nan
    payload = estimate_json(LAYOUT, made, 0)
    assert valid("estimate", to_json(payload))
    assert valid("estimate", to_json(payload | {"sd": {"motor1": 0.1}}))
    assert not valid("estimate", to_json(payload | {"coasted_s": -1.0}))


def test_the_command_prints_one_or_all(capsys: pytest.CaptureFixture[str]) -> None:
    assert fauio.main(["schema", "status"]) == 0
    assert json.loads(capsys.readouterr().out) == SCHEMAS["status"]
    assert fauio.main(["schema"]) == 0
    assert json.loads(capsys.readouterr().out) == SCHEMAS
    assert fauio.main(["schema", "weather"]) == 2
    assert "there is none; there are alarm" in capsys.readouterr().err
