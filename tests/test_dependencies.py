"""The page of dependencies names what pyproject.toml asks for, and every extra is asked for by something."""

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
EXTRAS = PROJECT["project"]["optional-dependencies"]
PAGE = (ROOT / "docs/dependencies.md").read_text()


def name_of(requirement: str) -> str:
    return re.split(r"[<>=!~;\[ ]", requirement)[0]


def test_every_requirement_has_its_reason_and_nothing_else_has_a_row() -> None:
    needed = {name_of(requirement) for requirement in PROJECT["project"]["dependencies"]}
    optional = {
        name_of(requirement): extra for extra, found in EXTRAS.items() for requirement in found if extra != "dev"
    }
    rows = [
        row.split("|")[1].strip()
        for row in PAGE.splitlines()
        if row.startswith("| ") and not row.startswith("| package")
    ]
    named = {name.strip(): row for row in rows for name in row.partition(" (extra")[0].split(",")}
    assert set(named) == needed | set(optional)
    assert [name for name, extra in optional.items() if f"(extra `{extra}`)" not in named[name]] == []
    for requirement in (*PROJECT["build-system"]["requires"], *EXTRAS["dev"]):
        assert re.search(rf"\b{name_of(requirement)}\b", PAGE), requirement


@pytest.mark.parametrize("extra", sorted(set(EXTRAS) - {"dev", "docs"}))
def test_every_extra_is_asked_for_by_a_command_or_a_benchmark(extra: str) -> None:
    folders = ("bench",) if extra in ("bench", "fuzz") else ("monitor", "replay")
    modules = {name_of(requirement).removesuffix("-sdk") for requirement in EXTRAS[extra]}
    text = "".join(path.read_text() for folder in folders for path in (ROOT / folder).rglob("*.py"))
    assert [module for module in modules if not re.search(rf"\b(import|from) {module}\b", text)] == []
    if extra not in ("bench", "fuzz"):
        assert f"fauio[{extra}]" in text
