"""Blocks say exactly what the messages say one by one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adapters.batch import cut, each, messages, pack
from adapters.message import Message, silence
from adapters.source import CLOCK, LINK, MAVLINK, ZENOH

NUMBERS = st.one_of(st.integers(-(1 << 64), 1 << 64), st.integers(0, 9), st.floats(), st.booleans())
VALUES = st.one_of(NUMBERS, NUMBERS, st.lists(NUMBERS, max_size=3), st.text(max_size=3), st.none())
MESSAGES = st.builds(
    Message,
    source=st.sampled_from((MAVLINK, MAVLINK, ZENOH, CLOCK, LINK)),
    name=st.sampled_from("ab"),
    received_ns=st.integers(0, 1 << 62),
    fields=st.dictionaries(st.sampled_from("xy"), VALUES),
    system=st.integers(0, 1),
    component=st.integers(0, 1),
)


def key(message: Message) -> str:
    # Not a number equals nothing; the text also tells int, float and bool apart.
    return repr(message)


@given(st.lists(MESSAGES, max_size=20), st.integers(0, 20), st.integers(0, 20))
def test_a_block_gives_back_its_messages_whole_and_cut(stretch: list[Message], start: int, stop: int) -> None:
    block = pack(stretch)
    assert [key(one) for one in messages(block)] == [key(one) for one in stretch]
    start, stop = sorted((min(start, block.count), min(stop, block.count)))
    assert [key(one) for one in messages(cut(block, start, stop))] == [key(one) for one in stretch[start:stop]]


@given(st.lists(st.floats(), min_size=1, max_size=20))
def test_numbers_of_one_name_and_sender_become_one_column(values: list[float]) -> None:
    block = pack([Message(ZENOH, "k", n, {"x": x, "n": n, "l": [n, 1]}) for n, x in enumerate(values)])
    (columns,) = block.columns
    assert not block.others
    assert columns.fields["x"].tobytes() == np.array(values).tobytes()
    assert columns.fields["n"].dtype == np.int64
    assert columns.fields["l"].shape == (len(values), 2)


@pytest.mark.parametrize(
    "second",
    [
        {"x": 1},
        {"x": "1.0"},
        {"y": 1.0},
        {"x": 1.0, "y": 1.0},
        {"x": [1.0]},
        {"x": {"y": 1.0}},
        {"x": None},
        {"x": True},
    ],
)
def test_messages_that_differ_in_kind_stay_messages(second: dict[str, Any]) -> None:
    stretch = [Message(ZENOH, "k", 1, {"x": 1.0}), Message(ZENOH, "k", 2, second)]
    block = pack(stretch)
    assert not block.columns
    assert list(messages(block)) == stretch


def test_what_is_no_telemetry_stays_a_message() -> None:
    block = pack([silence(1), silence(2)])
    assert not block.columns
    assert len(block.others) == 2


def test_messages_of_columns_have_only_the_fields_that_are_asked_for() -> None:
    columns = pack([Message(MAVLINK, "a", at, {"x": at, "y": 2.0 * at}, 1, 1) for at in range(3)]).columns[0]
    assert [message.fields for message in each(columns, ("y", "z"))] == [{"y": 0.0}, {"y": 2.0}, {"y": 4.0}]
