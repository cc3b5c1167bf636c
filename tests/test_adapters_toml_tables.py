"""Documents written for people read back as they were, with their arrays on one line each."""

import tomllib
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from adapters.toml_tables import toml_text

VALUES = st.recursive(
    st.booleans() | st.integers(-(2**53), 2**53) | st.floats(allow_nan=False) | st.text("a ,[]\"\\\n#='é", max_size=12),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text("ab.[ ", max_size=3), inner, max_size=3),
    max_leaves=12,
)


@given(st.dictionaries(st.text("abc. ", max_size=4), VALUES, max_size=5))
def test_a_document_reads_back_as_it_was(content: dict[str, Any]) -> None:
    assert tomllib.loads(toml_text(content)) == content


def test_numbers_and_names_are_on_as_few_lines_as_hold_them() -> None:
    text = toml_text(
        {"names": ["roll", "pitch"], "matrix": [[1.0, 2.5], [3.0, 4.0]], "long": ["x" * 60, "y" * 60, "z"]}
    )
    assert text.splitlines() == [
        'names = ["roll", "pitch"]',
        "matrix = [",
        "    [1.0, 2.5],",
        "    [3.0, 4.0],",
        "]",
        "long = [",
        f'    "{"x" * 60}",',
        f'    "{"y" * 60}", "z",',
        "]",
    ]
