"""The parts of a page that needs nothing but itself: escaped text, tables, lists, its style and its frame."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape

from adapters.errors import printable
from monitor.views.palette import DARK, LIGHT
from replay.reports.plot import colour_variables


class Html(str):
    """Text that is markup already; all other text is escaped."""

    __slots__ = ()


_STYLE = """
:root { color-scheme: light dark; LIGHT --faint: #f4f5f7; --line: #d5d8dc; }
@media (prefers-color-scheme: dark) { :root { DARK --faint: #1e2227; --line: #3a4047; } }
@media print { :root { color-scheme: light; LIGHT --faint: #f4f5f7; --line: #d5d8dc; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 2rem 1.25rem 4rem; max-width: 60rem; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; overflow-wrap: anywhere; }
h1 { font-size: 1.6rem; line-height: 1.25; margin: 0 0 .25rem; }
h2 { font-size: 1.2rem; margin: 2.5rem 0 .75rem; padding-bottom: .25rem; border-bottom: 1px solid var(--line); }
h3 { font-size: 1.02rem; margin: 0 0 .5rem; }
p { margin: .5rem 0; max-width: 46rem; }
.note { color: var(--ink); opacity: .72; font-size: .9rem; }
.verdict { font-size: 1.1rem; font-weight: 600; padding: .6rem .9rem; margin: 1rem 0; background: var(--faint);
  border-left: .4rem solid var(--series2); }
.warning { border-left-color: var(--series1); }
.critical { border-left-color: var(--series5); }
.unknown { border-left-color: var(--muted); }
article { background: var(--faint); border-left: .4rem solid var(--muted); padding: .8rem 1rem; margin: .9rem 0; }
article.warning { border-left-color: var(--series1); }
article.critical { border-left-color: var(--series5); }
dl { display: grid; grid-template-columns: minmax(8rem, max-content) 1fr; gap: .15rem 1rem; margin: 0; }
dt { opacity: .72; }
dd { margin: 0; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .84rem; font-variant-numeric: tabular-nums;
  overflow-wrap: normal; margin-bottom: 1rem; }
th, td { text-align: left; vertical-align: top; padding: .25rem .8rem .25rem 0; border-bottom: 1px solid var(--line); }
th { font-weight: 600; }
td.number { white-space: nowrap; }
.number { text-align: right; }
code { font: .88em ui-monospace, "SF Mono", Menlo, Consolas, monospace; }
figure { margin: 1rem 0; }
svg { display: block; width: 100%; height: auto; fill: var(--ink); }
svg * { stroke-linejoin: round; stroke-linecap: butt; }
.picture { overflow-x: auto; }
@media screen and (max-width: 40rem) {
  dl { grid-template-columns: 1fr; }
  dd { margin-bottom: .4rem; }
  .picture svg { min-width: 42rem; }
  td:last-child:not(.number) { min-width: 11rem; }
}
@media print {
  body { max-width: none; padding: 0; font-size: 10pt; }
  * { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
  .wide, .picture { overflow: visible; }
  article, tr, .verdict { break-inside: avoid; }
  h2, h3 { break-after: avoid; }
  thead { display: table-header-group; }
  figure { break-inside: avoid; }
  figure svg { max-height: 24cm; }
}
@page { margin: 1.6cm; }
"""


def html_text(value: object) -> Html:
    """Return a text escaped, without control characters: names come from outside."""
    return value if isinstance(value, Html) else Html(escape(printable(str(value))))


def element(tag: str, *content: object, **attributes: str) -> Html:
    """Return an element; content that is not :class:`Html` is escaped.

    In names of attributes ``_`` stands for ``-``, at the end for nothing.
    """
    said = "".join(f' {name.rstrip("_").replace("_", "-")}="{escape(value)}"' for name, value in attributes.items())
    return Html(f"<{tag}{said}>{joined_html(content)}</{tag}>")


def joined_html(parts: Iterable[object]) -> Html:
    """Return parts one behind the other, escaped where they are no :class:`Html`."""
    return Html("".join(map(html_text, parts)))


def facts(pairs: Iterable[tuple[str, object]]) -> Html:
    """Return names and what they are."""
    return element("dl", *(part for name, value in pairs for part in (element("dt", name), element("dd", value))))


def table(heads: Sequence[str], rows: Iterable[Sequence[object]], numbers: Sequence[int] = ()) -> Html:
    """Return a table; the columns at ``numbers`` are set to the right."""

    def cells(tag: str, row: Sequence[object]) -> Iterable[Html]:
        return (
            element(tag, value, class_="number") if place in numbers else element(tag, value)
            for place, value in enumerate(row)
        )

    head = element("thead", element("tr", *cells("th", heads)))
    body = element("tbody", *(element("tr", *cells("td", row)) for row in rows))
    return element("div", element("table", head, body), class_="wide")


def section(title: str, *content: object) -> Html:
    """Return a section under its heading."""
    return element("section", element("h2", title), *content)


def page(title: str, *content: object) -> Html:
    """Return the whole page; it may load nothing and run nothing."""
    head = element(
        "head",
        Html('<meta charset="utf-8">'),
        Html("""<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'">"""),
        Html('<meta name="viewport" content="width=device-width, initial-scale=1">'),
        Html('<meta name="color-scheme" content="light dark">'),
        element("title", title),
        element("style", Html(_style())),
    )
    return Html(f'<!DOCTYPE html>\n<html lang="en">{head}<body><main>{joined_html(content)}</main></body></html>\n')


def _style() -> str:
    themes: Mapping[str, str] = {
        word: " ".join(f"{name}: {colour};" for name, colour in colour_variables(theme).items())
        for word, theme in (("LIGHT", LIGHT), ("DARK", DARK))
    }
    style = _STYLE
    for word, colours in themes.items():
        style = style.replace(word, colours)
    return style
