"""Text from elsewhere, shown without what would drive a terminal."""

from __future__ import annotations


def printable(text: str) -> str:
    """Return a text with a question mark for each control character, line ends included."""
    return "".join(c if c.isprintable() else "?" for c in text)
