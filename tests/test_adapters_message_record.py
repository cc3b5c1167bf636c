"""Records of messages: whatever source they came from, the same message comes back."""

from __future__ import annotations

import json
from math import inf
from pathlib import Path

import jsonschema
import pytest

from adapters.encoding.message_record import decoder, encode
from adapters.logs.mcap_log import MessageLogWriter
from adapters.logs.mcap_reader import MessageLogReader
from adapters.message import Message, silence
from adapters.source import JOURNAL, LINK, MAVLINK, OPERATOR, ZENOH


@pytest.mark.parametrize(
    "message",
    [
        Message(LINK, "signing", 5, {"forged": 3, "replayed": 0, "unsigned": 1}, system=7, component=9),
        Message(LINK, "signing", 5, {"forged": 1, "replayed": 0, "unsigned": 0}, system=255),
        Message(OPERATOR, "acknowledge", 5, {"id": "01J", "system_id": 3}),
        Message(JOURNAL, "alarm", 5, {"id": "01J"}),
        Message(ZENOH, "arm/telemetry", 5, {"system_id": "text"}),
        silence(5),
    ],
)
def test_a_message_comes_back_with_its_ids(message: Message) -> None:
    record = encode(message)
    decode = decoder(record.topic, "json", None)
    assert record.encoding == "json"
    assert decode(record.data, 5) == message


def test_what_a_link_found_names_its_ids_as_mavlink_records_do() -> None:
    record = encode(Message(LINK, "signing", 5, {"forged": 3}, system=7))
    assert json.loads(record.data) == {"forged": 3, "system_id": 7, "component_id": 0}


def test_what_a_link_found_survives_a_recording(tmp_path: Path) -> None:
    findings = [Message(LINK, "signing", 5 + k, {"forged": k}, system=k) for k in range(1, 4)]
    with MessageLogWriter(tmp_path / "log.mcap") as log:
        for finding in findings:
            log.write(finding)
    assert list(MessageLogReader(tmp_path / "log.mcap")) == findings


@pytest.mark.parametrize(
    "data", [b'{"system_id": "1"}', b'{"component_id": null}', b"[]", b"{", b'{"system_id": true}']
)
def test_a_finding_that_is_no_record_of_ours_is_refused(data: bytes) -> None:
    decode = decoder("/link/signing", "json", None)
    with pytest.raises(ValueError):
        decode(data, 0)


@pytest.mark.parametrize(
    "data",
    [
        b'{"system_id": 1, "component_id": 1, "fields": [1]}',
        b'{"system_id": [1], "component_id": 1, "fields": {}}',
        b'{"system_id": 1, "component_id": 256, "fields": {}}',
        b'{"system_id": -1, "component_id": 1, "fields": {}}',
        b'{"system_id": 1, "fields": {}}',
    ],
)
def test_a_mavlink_message_that_is_no_record_of_ours_is_refused(data: bytes) -> None:
    decode = decoder("/mavlink/ATTITUDE", "json", None)
    with pytest.raises(ValueError, match="record of ATTITUDE"):
        decode(data, 0)


@pytest.mark.parametrize(
    ("name", "stamp"),
    [("SCALED_PRESSURE", {"time_boot_ms": 1_710_773_350_354.25}), ("SERVO_OUTPUT_RAW", {"time_usec": 1 << 40})],
)
def test_stamps_of_an_onboard_log_come_back_as_they_were(name: str, stamp: dict[str, float]) -> None:
    from pymavlink.dialects.v20 import ardupilotmega

    [table] = [one for one in ardupilotmega.mavlink_map.values() if one.msgname == name]
    zeros = [0.0 if kind == "float" else 0 for kind in table.fieldtypes]
    message = Message(MAVLINK, name, 5, dict(zip(table.fieldnames, zeros, strict=True)) | stamp, 1, 1)
    record = encode(message)
    assert record.encoding == "protobuf"
    assert record.schema is not None
    decode = decoder(record.topic, record.encoding, record.schema)
    assert decode is not None
    assert repr(decode(record.data, 5)) == repr(message)


def test_rules_of_operators_have_a_schema_and_are_json_that_every_reader_takes(tmp_path: Path) -> None:
    fields = {
        "latched": ['say "Infinity" twice'],
        "out_of_service": [],
        "flood_raised": 10,
        "flood_s": 60.0,
        "system": 1,
        "alarms": {"motors": {"motor1": {"threshold": 0.05, "fast": inf}}},
    }
    message = Message(OPERATOR, "rules", 5, fields)
    record = encode(message)
    assert record.schema is not None
    assert record.schema.name == "fauio.Rules"
    jsonschema.validate(fields, json.loads(record.schema.data))
    assert set(json.loads(record.schema.data)["properties"]) == set(fields)
    assert json.loads(record.data, parse_constant=pytest.fail) == fields
    path = tmp_path / "log.mcap"
    with MessageLogWriter(path) as log:
        log.write(message)
    assert list(MessageLogReader(path)) == [message]
