"""Records of onboard logs stand in MCAP typed and whole, and come back as they were."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from hypothesis import given, settings
from hypothesis import strategies as st

from adapters.batch import Batch, Columns, one_message
from adapters.encoding.log_schema import LogProtobuf, to_protobuf
from adapters.encoding.message_record import encode
from adapters.logs.mcap_log import MessageLogWriter
from adapters.logs.mcap_reader import read_mcap_messages
from adapters.message import Message
from adapters.source import DATAFLASH, ULOG
from monitor.recording.record_encoder import RecordEncoder

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


def columns(name: str, fields: dict[str, Any]) -> Columns:
    index = np.arange(2)
    return Columns(ULOG, name, 0, 0, index, 5 + index, fields)


@pytest.mark.parametrize(
    "fields",
    [
        {"t": np.array([1, 2], np.uint64), "x": np.array([0.1, 0.0], np.float32), "ok": np.array([True, False])},
        {"q": np.array([[1.0, 0.5], [0.0, -0.0]]), "n": np.array([[1], [200]], np.uint8)},
        # each of these is kept as JSON
        {"a b": np.array([1, 2])},
        {"n": np.array([1, 2**63], np.uint64)},
        {"nothing": np.empty((2, 0))},
    ],
)
def test_columns_are_encoded_as_their_messages_are(fields: dict[str, Any]) -> None:
    encoder = RecordEncoder(())
    given = columns("topic/1", fields)
    rows = dict(enumerate(one_message(given, row) for row in range(2)))
    together, singly = encoder.batch(Batch(2, (given,), {})), encoder.batch(Batch(2, (), rows))
    assert together == singly
    assert [time_ns for _, _, time_ns in together] == [5, 6]


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
