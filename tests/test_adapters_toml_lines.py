"""Lines of keys in TOML: whatever the writer of a file does, each key is found where its statement stands."""

from __future__ import annotations

import tomllib
from typing import Any

import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st

from adapters.toml_tables import KeyPath, line_of

TEXT = '''\
# a comment with = and [brackets]
title = "x # no comment = y"
"quoted key".inner = 1

[table]
list = [ # why
  "a, b]",
  { deep = 1, more = [1,
      2] },
]
text = """
[not.a.header]
key = 3
"""
raw = \'\'\'
other = 4\'\'\'

[[vehicle]]
name = 'a'
  [vehicle.inner]
  key = 1
[[vehicle]]
name = 'b'
when = 2026-01-01T00:00:00Z # comment
'''

LEAVES = st.one_of(
    st.integers(-(2**40), 2**40), st.booleans(), st.text(max_size=12), st.floats(allow_nan=False, allow_infinity=False)
)
VALUES = st.recursive(
    LEAVES,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=12,
)


@pytest.mark.parametrize(
    ("path", "line"),
    [
        (("title",), 2),
        (("quoted key", "inner"), 3),
        (("table",), 5),
        (("table", "list"), 6),
        (("table", "list", 1, "more", 1), 6),
        (("table", "text"), 11),
        (("table", "raw"), 15),
        (("vehicle",), 18),
        (("vehicle", 0, "name"), 19),
        (("vehicle", 0, "inner", "key"), 21),
        (("vehicle", 1), 22),
        (("vehicle", 1, "name"), 23),
        (("vehicle", 1, "when"), 24),
    ],
)
def test_each_key_is_found_on_its_line(path: KeyPath, line: int) -> None:
    assert line_of(TEXT, path) == line


def test_strings_and_comments_hold_no_keys() -> None:
    assert [line_of(TEXT, path) for path in (("key",), ("other",), ("table", "key"))] == [None, None, 5]


def test_a_key_that_is_missing_has_the_line_of_its_table() -> None:
    assert line_of(TEXT, ("vehicle", 1, "profile")) == 22
    assert line_of(TEXT, ("speed",)) is None


def paths(value: Any, above: KeyPath = ()) -> set[KeyPath]:
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    found = {above} if above else set()
    return found.union(*(paths(item, (*above, key)) for key, item in inner))


@given(st.dictionaries(st.text(max_size=6), VALUES, max_size=4), st.booleans())
def test_every_key_of_any_file_is_found_where_a_statement_begins(content: dict[str, Any], multiline: bool) -> None:
    text = tomli_w.dumps(content, multiline_strings=multiline)
    for path in paths(tomllib.loads(text)):
        line = line_of(text, path)
        assert line is not None
        assert path not in paths(tomllib.loads("\n".join(text.split("\n")[: line - 1])))
