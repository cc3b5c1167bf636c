"""Records of onboard logs stand in MCAP typed and whole, and come back as they were."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from hypothesis import given, settings
from hypothesis import strategies as st

from adapters.encoding.log_schema import LogProtobuf, to_protobuf
from adapters.encoding.message_record import encode
from adapters.logs.mcap_log import MessageLogWriter
from adapters.logs.mcap_reader import read_mcap_messages
from adapters.message import Message
from adapters.source import DATAFLASH, ULOG

SCALARS = st.one_of(
    st.integers(-(2**63), 2**63 - 1), st.floats(allow_nan=False), st.booleans(), st.text(st.characters(codec="utf-8"))
)
LISTS = st.one_of(*(st.lists(kind, min_size=1, max_size=4) for kind in (st.integers(-9, 9), st.booleans())))
NAMES = st.from_regex(r"[a-z][a-z0-9]{0,5}", fullmatch=True)
FIELDS = st.recursive(
    st.dictionaries(NAMES, SCALARS | LISTS, max_size=4),
    lambda inner: st.dictionaries(NAMES, SCALARS | inner | inner.map(lambda one: [one, one]), max_size=3),
    max_leaves=6,
)


@settings(max_examples=60, deadline=None)
@given(fields=FIELDS)
def test_any_record_comes_back_as_it_was(fields: dict[str, Any]) -> None:
    schema, data = to_protobuf(Message(ULOG, "topic/1", 5, fields))
    found = LogProtobuf(schema.name, schema.data).fields(data)
    assert found == fields
    assert repr(found) == repr(fields)


def test_the_schema_names_source_topic_and_types() -> None:
    schema, _ = to_protobuf(Message(DATAFLASH, "IMU/1", 5, {"TimeUS": 1, "GyrX": 0.5, "name": "x", "a": [1, 2]}))
    assert (schema.name, schema.encoding) == ("dataflash.IMU", "protobuf")
    fields = FileDescriptorSet.FromString(schema.data).file[0].message_type[0].field
    assert [(one.name, one.type, one.label) for one in fields] == [
        ("TimeUS", 3, 1),
        ("GyrX", 1, 1),
        ("name", 9, 1),
        ("a", 3, 3),
    ]


@pytest.mark.parametrize(
    "fields",
    [{"a": 2**63}, {"a b": 1}, {"a": []}, {"a": [1, "x"]}, {"a": [[1]]}, {"a": None}, {"a_b": 1, "aB": 2}],
    ids=["too large", "no name", "empty", "unlike", "lists", "nothing", "names alike"],
)
def test_what_no_type_can_hold_is_kept_as_json(tmp_path: Path, fields: dict[str, Any]) -> None:
    message = Message(ULOG, "odd", 5, fields)
    with pytest.raises(ValueError):
        to_protobuf(message)
    assert encode(message).encoding == "json"
    with MessageLogWriter(tmp_path / "a.mcap") as log:
        log.write(message)
    assert list(read_mcap_messages(tmp_path / "a.mcap")) == [message]
