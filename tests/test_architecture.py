"""Packages depend in one direction only, modules stay small, and start-up stays light."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
ALLOWED = {
    "adapters": set(),
    "gains": set(),
    "monitor": {"adapters", "gains"},
    "replay": {"adapters", "gains", "monitor"},
}
HEAVY = {
    "numba",
    "numpy",
    "scipy",
    "cvxpy",
    "clarabel",
    "rerun",
    "zenoh",
    "pymavlink",
    "matplotlib",
    "mcap",
    "google",
    "pydantic",
    "rich",
}
LONGEST_MODULE = 400


def modules() -> list[Path]:
    return [path for package in ALLOWED for path in sorted((ROOT / package).rglob("*.py"))]


def imported_packages(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            found.add(node.module.split(".")[0])
    return found


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(ROOT)))
def test_a_module_imports_only_packages_upstream_of_its_own(path: Path) -> None:
    package = path.relative_to(ROOT).parts[0]
    foreign = (imported_packages(path) & set(ALLOWED)) - {package}
    assert foreign <= ALLOWED[package]


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(ROOT)))
def test_a_module_begins_with_what_it_does_and_stays_short(path: Path) -> None:
    text = path.read_text()
    assert text.startswith('"""')
    assert len(text.splitlines()) <= LONGEST_MODULE


def test_the_architecture_page_names_every_module() -> None:
    page = (ROOT / "docs/architecture.md").read_text()
    missing = [
        str(path.relative_to(ROOT))
        for path in modules()
        if path.stem not in ("__init__", "errors", "commands") and f"`{path.stem}`" not in page
    ]
    assert missing == []


def test_the_command_line_starts_without_heavy_packages() -> None:
    code = "import sys, fauio; fauio.build_parser(); print(' '.join(sys.modules))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT).stdout
    assert not HEAVY & {name.split(".")[0] for name in loaded.split()}
