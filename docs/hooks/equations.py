"""Equations as MathML, which browsers typeset by themselves: no script, no font, nothing loaded from elsewhere."""

from __future__ import annotations

import html
import re

from latex2mathml.converter import convert

# What pymdownx.arithmatex makes of $...$ and of blocks marked math.
_EQUATION = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\\[(\[](?P<tex>.*?)\\[)\]]</(?P=tag)>',
    re.DOTALL,
)


def typeset(page: str) -> str:
    """Return a page's HTML with its equations as MathML."""
    return _EQUATION.sub(_mathml, page)


def _mathml(match: re.Match[str]) -> str:
    display = match["tag"] == "div"
    tex = html.unescape(match["tex"]).strip().replace("{aligned}", "{split}")  # the same under the name that it knows
    mathml = convert(tex, display="block" if display else "inline")
    return f'<div class="equation">{mathml}</div>' if display else mathml
