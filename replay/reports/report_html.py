"""The parts of a self-contained page: escaped text, tables, lists, the page's frame."""

from base64 import b64encode
from collections.abc import Iterable, Sequence
from hashlib import sha256
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template

from adapters.errors import printable
from monitor.views.palette import DARK, LIGHT, Theme


class Html(str):
    """Text that is markup already; all other text is escaped."""

    __slots__ = ()


def html_text(value: object) -> Html:
    """Return a text escaped, without control characters: names come from untrusted sources."""
    return value if isinstance(value, Html) else Html(escape(printable(str(value))))


def element(tag: str, *content: object, **attributes: str) -> Html:
    """Return an element; content that is not :class:`Html` is escaped.

    In names of attributes ``_`` stands for ``-``, and a final ``_`` is dropped.
    """
    said = "".join(f' {name.rstrip("_").replace("_", "-")}="{html_text(value)}"' for name, value in attributes.items())
    return Html(f"<{tag}{said}>{joined_html(content)}</{tag}>")


def joined_html(parts: Iterable[object]) -> Html:
    """Return parts joined together, escaped unless they are :class:`Html`."""
    return Html("".join(map(html_text, parts)))


def facts(pairs: Iterable[tuple[str, object]]) -> Html:
    """Return a list of names and their values."""
    return element("dl", *(part for name, value in pairs for part in (element("dt", name), element("dd", value))))


def table(heads: Sequence[str], rows: Iterable[Sequence[object]], numbers: Sequence[int] = ()) -> Html:
    """Return a table; the columns at ``numbers`` are aligned right."""

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


def folded(title: str, *content: object) -> Html:
    """Return a section that opens with a click on its title; it is open on paper."""
    return element("details", element("summary", title), *content)


def page(title: str, *content: object, charts: str = "[]") -> Html:
    """Return the whole page: it may load nothing, and run only the script that draws its ``charts`` (JSON)."""
    scripts = [read_uplot("uPlot.iife.min.js"), Path(__file__).with_name("report.js").read_text()]
    if charts == "[]":
        scripts = []
    hashes = (
        " ".join(f"'sha256-{b64encode(sha256(script.encode()).digest()).decode()}'" for script in scripts) or "'none'"
    )
    policy = f"default-src 'none'; style-src 'unsafe-inline'; script-src {hashes}"
    head = element(
        "head",
        Html('<meta charset="utf-8">'),
        Html(f"""<meta http-equiv="Content-Security-Policy" content="{policy}">"""),
        Html('<meta name="viewport" content="width=device-width, initial-scale=1">'),
        Html('<meta name="color-scheme" content="light dark">'),
        element("title", title),
        element("style", Html(read_uplot("uPlot.min.css") + _style())),
    )
    data = element("script", Html(charts), id="charts", type="application/json") if scripts else ""
    run = joined_html(element("script", Html(script)) for script in scripts)
    body = element("body", element("main", *content), data, run)
    return Html(f'<!DOCTYPE html>\n<html lang="en">{head}{body}</html>\n')


def read_uplot(name: str) -> str:
    """Return a file of the bundled uPlot."""
    return (files("monitor.views") / "uplot" / name).read_text()


def _style() -> str:
    light, dark = (
        " ".join(f"{name}: {colour};" for name, colour in colour_variables(theme).items()) for theme in (LIGHT, DARK)
    )
    return Template(Path(__file__).with_name("report.css").read_text()).substitute(light=light, dark=dark)


def colour_variables(theme: Theme) -> dict[str, str]:
    """Return a theme's colours by the names of CSS variables; no name occurs twice."""
    names = {"--paper": theme.paper, "--ink": theme.ink, "--muted": theme.muted}
    series = {f"--series{index}": colour for index, colour in enumerate(theme.series) if colour != theme.ink}
    return names | series
