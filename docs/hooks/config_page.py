"""The reference page of the configuration, written from its models.

``python docs/hooks/config_page.py > docs/config.md`` brings it up to date.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

from adapters.toml_tables import toml_value
from monitor.configuration.config import Config, entries

_HEAD = """# Configuration of the daemon

`fauio run --config FILE.toml` reads this file; `fauio run PROFILE --mavlink URL` needs none. Options of the command
line override its keys. Paths are relative to the file. Everything is checked before anything starts, and all mistakes
are reported at once, a line each: `FILE:LINE: 'key' what is wrong; what to do`. Keys of the top level stand above the
first table. A worked example: [config-example.toml](config-example.toml).

This page is written by `python docs/hooks/config_page.py`.
"""


def config_page() -> str:
    """Return the page as Markdown."""
    parts = [_HEAD, "## Top level\n", *_rows(Config)]
    for name, (default, entry) in entries(Config).items():
        if entry.table is not None:
            header = f"[[{name}]]" if isinstance(default, tuple) else f"[{name}]"
            parts += [f"\n## `{header}`\n", f"{(entry.table.__doc__ or '').strip()}\n", *_rows(entry.table)]
            if entry.description:
                parts += [f"\n{entry.description}"]
    return "\n".join(parts) + "\n"


def _rows(kind: type) -> Iterator[str]:
    yield "| key | default | what it is | for example |\n|---|---|---|---|"
    for name, (default, entry) in entries(kind).items():
        if entry.table is None:
            choices = f" One of {', '.join(f'`{choice}`' for choice in entry.choices)}." if entry.choices else ""
            shown = "" if default is None else f"`{toml_value(default)}`"
            yield f"| `{name}` | {shown} | {entry.description}{choices} | `{name} = {toml_value(entry.example)}` |"


if __name__ == "__main__":
    sys.stdout.write(config_page())
