"""The reference page of the configuration, written from its models.

``python -m monitor.configuration.config_page > docs/config.md`` brings it up to date.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from monitor.configuration.config import Config
from monitor.configuration.config_reading import model_in, toml_value

_HEAD = """# Configuration of the daemon

`fauio run --config FILE.toml` reads this file; `fauio run PROFILE --mavlink URL` needs none. Options of the command
line override its keys. Paths are relative to the file. Everything is checked before anything starts, and all mistakes
are told at once, a line each: `FILE:LINE: 'key' what is wrong; what to do`. Keys of the top level stand above the first
table. A worked example: [config-example.toml](config-example.toml).

This page is written by `python -m monitor.configuration.config_page`.
"""


def render() -> str:
    """Return the page as Markdown."""
    plain = {name: field for name, field in Config.model_fields.items() if model_in(field.annotation) is None}
    parts = [_HEAD, "## Top level\n", *_rows(plain)]
    for name, field in Config.model_fields.items():
        table = model_in(field.annotation)
        if table is None:
            continue
        header = f"[[{name}]]" if get_origin(field.annotation) is tuple else f"[{name}]"
        parts += [f"\n## `{header}`\n", f"{(table.__doc__ or '').strip()}\n", *_rows(table.model_fields)]
        if field.description:
            parts += [f"\n{field.description}"]
    return "\n".join(parts) + "\n"


def _rows(fields: dict[str, FieldInfo]) -> Iterator[str]:
    yield "| key | default | what it is | for example |\n|---|---|---|---|"
    for name, field in fields.items():
        example = "" if not field.examples else f"`{name} = {toml_value(field.examples[0])}`"
        what = "".join((field.description or "", *_choices(field.annotation)))
        yield f"| `{name}` | {_default(field)} | {what} | {example} |"


def _choices(annotation: Any) -> Iterator[str]:
    if get_origin(annotation) is Literal:
        yield f" One of {', '.join(f'`{choice}`' for choice in get_args(annotation))}."


def _default(field: FieldInfo) -> str:
    value = field.get_default()
    if value is None or isinstance(value, BaseModel):
        return ""
    return f"`{toml_value(value)}`"


if __name__ == "__main__":
    sys.stdout.write(render())
