"""Records held by the ten thousand come back as they were, and the garbage collector does not search them."""

import gc
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st
from test_monitor_black_box import ENCODER, black_box, message

from adapters.encoding.record import Record, Schema
from monitor.recording.packed_record import RecordPacking

times = st.integers(-(2**63), 2**63 - 1)
schemas = st.none() | st.builds(Schema, st.text(max_size=3), st.just("protobuf"), st.binary(max_size=3))
records = st.builds(
    Record, st.text(max_size=3), st.just("json"), schemas, st.binary(), times, st.integers(0, 255), st.none() | times
)


@given(st.lists(records))
def test_packed_records_come_back_as_they_were(found: list[Record]) -> None:
    packing = RecordPacking()
    packed = [packing.pack(record) for record in found]
    assert [packing.unpack(one) for one in packed] == found
    assert [packing.topic(one) for one in packed] == [record.topic for record in found]
    assert [packing.time_ns(one) for one in packed] == [record.time_ns for record in found]


def test_what_a_black_box_holds_is_nothing_that_the_garbage_collector_searches(tmp_path: Path) -> None:
    box = black_box(tmp_path)
    box.record(*ENCODER.message(message(0)))
    gc.collect()
    before = len(gc.get_objects())
    for k in range(3000):
        box.record(*ENCODER.message(message(k / 1000)))
    gc.collect()
    assert box.statistics().held_records == 3001
    assert len(gc.get_objects()) - before < 300
