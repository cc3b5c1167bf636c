"""Text becomes text, whatever it holds; markup stays markup."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from replay.reports.report_html import Html, element, facts, html_text, page, table


@given(st.text())
def test_no_text_opens_an_element_or_leaves_an_attribute(words: str) -> None:
    assert "<" not in html_text(words)
    assert html_text(words).isprintable()
    made = element("p", words, aria_label=words)
    assert made.count("<") == made.count(">") == 2
    assert made.count('"') == 2


def test_markup_is_not_escaped_twice() -> None:
    assert element("p", element("b", "a & b"), "<") == "<p><b>a &amp; b</b>&lt;</p>"
    assert html_text(Html("<br>")) == "<br>"


def test_attributes_have_their_names() -> None:
    assert element("div", class_="a", aria_label="b") == '<div class="a" aria-label="b"></div>'


def test_tables_and_lists_of_facts() -> None:
    assert table(("a", "b"), [("x", 1)], numbers=(1,)) == (
        '<div class="wide"><table><thead><tr><th>a</th><th class="number">b</th></tr></thead>'
        '<tbody><tr><td>x</td><td class="number">1</td></tr></tbody></table></div>'
    )
    assert facts([("a", "b")]) == "<dl><dt>a</dt><dd>b</dd></dl>"


def test_a_page_has_its_colours() -> None:
    made = page("t", "words")
    assert made.count("--series0: #0072B2;") == 2
    assert made.count("--series0: #56B4E9;") == 1
