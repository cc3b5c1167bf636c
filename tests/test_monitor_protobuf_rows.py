"""Many protobuf messages at once are, byte for byte, what protobuf writes one by one."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adapters.encoding.protobuf_types import TIMESTAMP, Field, message_class
from monitor.core.protobuf_rows import RowEncoder

RANGES = {
    "int32": (-(1 << 31), (1 << 31) - 1),
    "uint32": (0, (1 << 32) - 1),
    "int64": (-(1 << 63), (1 << 63) - 1),
    "uint64": (0, (1 << 64) - 1),
}
DTYPES = {"uint64": np.uint64, "double": np.float64, "float": np.float32, "bool": np.bool_}
KINDS = ("bool", "double", "float", "int32", "uint32", "int64", "uint64")
# numbers beyond 15 take tags of two bytes
FLAT = message_class(
    "t",
    "Flat",
    (
        *(Field(f"{kind}_{k}", kind) for k in range(3) for kind in KINDS),
        *(Field(f"many_{kind}", kind, repeated=True) for kind in KINDS),
    ),
)
NESTED = message_class(
    "t",
    "Nested",
    (Field("time", TIMESTAMP), Field("x", (Field("a", "double"), Field("b", "double"))), Field("index", "int64")),
)


def numbers(kind: str) -> st.SearchStrategy[Any]:
    if kind == "bool":
        return st.booleans()
    if kind in ("double", "float"):
        # of what is no number only the usual one: conversion may change the bits of others
        usual = st.floats(width=32 if kind == "float" else 64, allow_nan=False)
        return st.one_of(usual, st.sampled_from([0.0, -0.0, math.nan]))
    least, most = RANGES[kind]
    return st.one_of(st.integers(least, most), st.sampled_from([0, 1, 127, 128, least, most]))


@st.composite
def flat_rows(draw: st.DrawFn) -> list[dict[str, Any]]:
    length = draw(st.integers(0, 3))
    row = {f"{kind}_{k}": numbers(kind) for k in range(3) for kind in KINDS}
    row |= {f"many_{kind}": st.lists(numbers(kind), min_size=length, max_size=length) for kind in KINDS}
    return draw(st.lists(st.fixed_dictionaries(row), min_size=1, max_size=5))


def columns(rows: list[dict[str, Any]]) -> dict[str, np.ndarray[Any, Any]]:
    found = {}
    for name in rows[0]:
        kind = name.removeprefix("many_").partition("_")[0]
        values = np.array([row[name] for row in rows], DTYPES.get(kind, np.int64))
        found[name] = values.reshape(len(rows), -1) if name.startswith("many_") else values
    return found


@given(flat_rows())
def test_flat_messages_are_written_as_protobuf_writes_them(rows: list[dict[str, Any]]) -> None:
    expected = [FLAT(**row).SerializeToString() for row in rows]
    encoder, values = RowEncoder(FLAT), columns(rows)
    assert encoder.encode([values[name] for name in encoder.names], len(rows)) == expected


@given(st.lists(st.tuples(numbers("int64"), numbers("int32"), numbers("double"), numbers("int64")), min_size=1))
def test_nested_messages_are_written_as_protobuf_writes_them(rows: list[tuple[int, int, float, int]]) -> None:
    expected = [
        NESTED(time={"seconds": s, "nanos": n}, x={"a": a, "b": 0.0}, index=k).SerializeToString()
        for s, n, a, k in rows
    ]
    seconds, nanos, a, index = (np.array(column) for column in zip(*rows, strict=True))
    times, x = np.stack((seconds, nanos), axis=1), np.stack((a, np.zeros(len(rows))), axis=1)
    assert RowEncoder(NESTED).encode((times, x, index), len(rows)) == expected


def test_columns_of_any_kind_and_alignment_are_written() -> None:
    kind = message_class("t", "Wide", (Field("a", "double"), Field("b", "int64"), Field("c", "float")))
    packed = np.zeros(3, np.dtype([("_", "i1"), ("a", "f4"), ("b", "u2"), ("c", "f8")]))
    packed["a"], packed["b"], packed["c"] = (0.1, -0.0, math.inf), (1, 65535, 0), (1e300, 0.5, math.nan)
    rows = zip(*(packed[name].tolist() for name in ("a", "b", "c")), strict=True)
    expected = [kind(a=a, b=b, c=c).SerializeToString() for a, b, c in rows]
    assert RowEncoder(kind).encode([packed["a"], packed["b"], packed["c"]], 3) == expected
    backwards = [packed[name][::-1] for name in ("a", "b", "c")]
    assert RowEncoder(kind).encode(backwards, 3) == expected[::-1]
    assert (
        RowEncoder(kind).encode((packed["a"], 5, packed["c"]), 3)[0]
        == kind(a=packed["a"][0], b=5, c=1e300).SerializeToString()
    )


def test_values_out_of_range_or_of_another_kind_are_refused() -> None:
    rows = RowEncoder(message_class("t", "Small", (Field("n", "uint32"),)))
    swapped = np.array([1]).astype(">i8")
    for values in (-1, 1 << 32, 1.0, True, [[1]]):
        with pytest.raises(ValueError, match="field"):
            rows.encode((np.atleast_1d(values),), 1)
    for column in (swapped, np.array([1, 2]), np.array([1 + 1j]), np.array(["1"]), -1):
        with pytest.raises(ValueError, match="field"):
            rows.encode((column,), 1)
    with pytest.raises(ValueError, match="columns"):
        rows.encode((), 1)
    with pytest.raises(OverflowError):
        rows.encode((1 << 64,), 1)


def test_types_with_texts_are_refused() -> None:
    with pytest.raises(ValueError, match="no plain number"):
        RowEncoder(message_class("t", "Text", (Field("n", "string"),)))
