"""Options and arguments as users write them."""

from __future__ import annotations

import argparse
from pathlib import Path

from adapters.command_line import option


def test_an_option_is_added_as_users_write_it() -> None:
    parser = argparse.ArgumentParser()
    option(parser, "logs LOG", "recordings", Path, nargs="+")
    option(parser, "-o --out DIR", "folder", Path, default=Path("out"))
    option(parser, "--name NAME", "a text")
    option(parser, "-q --quiet", "a flag")
    args = parser.parse_args(["a.tlog", "b.tlog", "--name", "x", "-q"])
    assert vars(args) == {"logs": [Path("a.tlog"), Path("b.tlog")], "out": Path("out"), "name": "x", "quiet": True}
    assert "[-o DIR]" in parser.format_usage()
