"""Markdown of generated pages: tables, and the words of docstrings and help texts as prose."""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from collections.abc import Iterable, Sequence
from typing import Literal, get_args, get_origin, get_type_hints

_ROLE = re.compile(r":\w+:`~?([^`]+)`")
_WHERE_IN_CODE = re.compile(r" \(:mod:`[^`]+`\)")
_LITERAL = re.compile(r"``([^`]+)``")
_CODE = re.compile(r"(`[^`]+`)")
_COMMAND = re.compile(r"'(fauio [^']+)'")
_OPTION = re.compile(r"(?<![\w-])(--[a-z][a-z0-9-]*)")
_HEADER = re.compile(r"^(\S[^:\n]*) : (.+)$", re.MULTILINE)


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table; columns that are empty in every row are left out."""
    body = list(rows)
    kept = [i for i in range(len(head)) if any(row[i] for row in body)]
    lines = [[head[i] for i in kept], ["---"] * len(kept), *([_cell(row[i]) for i in kept] for row in body)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def code(text: str) -> str:
    """Return a text as code, nothing where it is empty."""
    return f"`{text}`" if text else ""


def block(text: str, language: str = "text") -> str:
    """Return a text as a fenced block."""
    fence = "`" * max(3, 1 + max(map(len, re.findall(r"`+", text)), default=0))
    return f"{fence}{language}\n{text.rstrip()}\n{fence}"


def prose(text: str) -> str:
    """Return words of a docstring or help text as one paragraph: literals, commands and options as code."""
    text = _WHERE_IN_CODE.sub("", " ".join(text.split()))
    text = _LITERAL.sub(r"`\1`", _ROLE.sub(r"`\1`", text))
    text = _COMMAND.sub(r"`\1`", text)
    return "".join(part if part.startswith("`") else _plain(part) for part in _CODE.split(text))


def parameters_of(described: type) -> dict[str, tuple[str, str]]:
    """Return type and description of each parameter that a class's NumPy docstring documents, by name.

    Where it documents none, they are in the comments at the fields.
    """
    doc = inspect.cleandoc(described.__doc__ or "")
    section = re.search(r"^Parameters\n-+\n(.*?)(?=^\w+\n-+\n|\Z)", doc, re.MULTILINE | re.DOTALL)
    if section is None:
        return _commented_fields(described)
    found = {}
    headers = list(_HEADER.finditer(section[1]))
    for header, following in zip(headers, [*headers[1:], None], strict=True):
        words = section[1][header.end() : following.start() if following else None]
        for name in header[1].split(", "):
            found[name] = (header[2], prose(re.sub(r"\bNone\b", "no value", words)))
    return found


def _commented_fields(described: type) -> dict[str, tuple[str, str]]:
    """Return type and description of a data class's fields from the comments beside or above them.

    A field without a comment is described together with the one before.
    """
    found: dict[str, tuple[str, str]] = {}
    for base in reversed(described.__mro__[:-1]):
        source = textwrap.dedent(inspect.getsource(base))
        lines, hints, words = source.splitlines(), get_type_hints(base), ""
        for field in ast.walk(ast.parse(source)):
            if not isinstance(field, ast.AnnAssign) or not isinstance(field.target, ast.Name):
                continue
            above = field.lineno - 1
            while lines[above - 1].lstrip().startswith("#"):
                above -= 1
            beside = lines[(field.end_lineno or field.lineno) - 1].partition("  # ")[2]
            comments = lines[above : field.lineno - 1] or [beside]
            text = " ".join(comment.strip().removeprefix("# ") for comment in comments)
            if text:
                text = prose(re.sub(r"\bNone\b", "no value", text))
                words = text[0].upper() + text[1:].rstrip(".") + "."
            found[field.target.id] = (_type_text(hints[field.target.id], ast.unparse(field.annotation)), words)
    return found


def _type_text(hint: object, annotation: str) -> str:
    """Return a field's type as it is written, the choices of one that is one of several texts."""
    literal = next((one for one in (hint, *get_args(hint)) if get_origin(one) is Literal), None)
    return annotation if literal is None else "{" + ", ".join(f'"{choice}"' for choice in get_args(literal)) + "}"


def _plain(text: str) -> str:
    for character in "\\*[]":
        text = text.replace(character, f"\\{character}")
    return _OPTION.sub(r"`\1`", text.replace("<", "&lt;"))


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
