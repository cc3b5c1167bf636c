"""Packages depend in one direction only, modules say what they do, and start-up stays light."""

import ast
import re
import subprocess
import sys
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
ALLOWED = {
    "adapters": set(),
    "gains": {"adapters"},
    "monitor": {"adapters", "gains"},
    "replay": {"adapters", "gains", "monitor"},
}
HEAVY = {
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
    "rich",
    "importlib.metadata",  # a quarter of the time in which the command line is built
}


INTERFACES = {
    "add_parsers",  # of a module of commands, called by fauio.py
    "main",  # of a module that is run
    "preview",  # of a kind of vehicle
}
"""Names that several modules define on purpose, with one meaning for all of them."""


def modules() -> list[Path]:
    return [path for package in ALLOWED for path in sorted((ROOT / package).rglob("*.py"))]


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@cache
def imports(path: Path) -> list[ast.Import | ast.ImportFrom]:
    return [node for node in ast.walk(parsed(path)) if isinstance(node, ast.Import | ast.ImportFrom)]


def imported_packages(path: Path) -> set[str]:
    found = set()
    for node in imports(path):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif node.module and node.level == 0:
            found.add(node.module.split(".")[0])
    return found


@pytest.mark.parametrize("package", ALLOWED)
def test_modules_import_only_packages_upstream_of_their_own(package: str) -> None:
    own = [path for path in modules() if path.relative_to(ROOT).parts[0] == package]
    foreign = {str(path): (imported_packages(path) & set(ALLOWED)) - {package} - ALLOWED[package] for path in own}
    assert {path: packages for path, packages in foreign.items() if packages} == {}


def test_every_module_begins_with_what_it_does() -> None:
    assert [str(path) for path in modules() if not path.read_text().startswith('"""')] == []


def public_names(path: Path) -> dict[str, ast.stmt]:
    """Return the classes, functions and named types that a module defines for others."""
    found: dict[str, ast.stmt] = {}
    for node in parsed(path).body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            found[node.name] = node
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                # constants in capitals belong to their module
                if isinstance(target, ast.Name) and not target.id.isupper():
                    found[target.id] = node
    return {name: node for name, node in found.items() if not name.startswith("_")}


def test_a_public_name_has_one_meaning() -> None:
    meanings: dict[str, dict[str, ast.stmt]] = {}
    for path in modules():
        for name, node in public_names(path).items():
            meanings.setdefault(name, {})[str(path.relative_to(ROOT))] = node
    several = {
        name: sorted(places)
        for name, places in meanings.items()
        if len(places) > 1 and len({ast.unparse(node) for node in places.values()}) > 1
    }
    assert {name: places for name, places in several.items() if name not in INTERFACES} == {}


def folder(path: Path) -> str:
    """Return the folder of a module; at the top of a package each module stands for itself."""
    inside = path.relative_to(ROOT)
    return str(inside.parent) if len(inside.parts) > 2 else str(inside)


def imported_modules(path: Path) -> set[Path]:
    """Return our modules that one imports, wherever in it the import stands."""
    found = set()
    for node in imports(path):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in ALLOWED:
            base = ROOT.joinpath(*node.module.split("."))
            names = [base / f"{alias.name}.py" for alias in node.names]
            found |= {name if name.is_file() else base.with_suffix(".py") for name in names}
    return {module for module in found if module.is_file()}


def test_no_folder_imports_one_that_imports_it() -> None:
    graph: dict[str, set[str]] = {}
    for path in modules():
        graph.setdefault(folder(path), set()).update(folder(module) for module in imported_modules(path))
    graph = {name: found - {name} for name, found in graph.items()}
    assert len(list(TopologicalSorter(graph).static_order())) >= len(graph) > 30


def test_the_architecture_page_names_every_folder_and_only_what_is_there() -> None:
    page = (ROOT / "docs/architecture.md").read_text()
    named = set()
    package = place = ROOT
    for line in page.splitlines():
        row = [cell.strip() for cell in line.split("|")[1:-1]]
        if len(row) != 3 or set(row[0]) <= {"-"}:
            continue
        name = row[0].strip("`")
        if (ROOT / name).is_dir() and row[2] == "begin with":
            package = ROOT / name
            continue
        place = package if name == "(top)" else package / name
        named.add(place)
        missing = [module for module in re.findall(r"`([\w.]+\.py)`", row[2]) if not (place / module).is_file()]
        assert missing == []
    assert named >= {path.parent for path in modules() if path.parent.parent != ROOT and path.parent.name != "models"}
    elsewhere = re.findall(r"`((?:[\w]+/)+[\w.]*)`", page)
    assert [
        name for name in elsewhere if not any((base / name).exists() for base in (ROOT, *map(ROOT.joinpath, ALLOWED)))
    ] == []


MONITOR = """
import monitor.service.live, replay.player
from monitor.profile import read_profile
read_profile("replay/data/quad")
"""


@pytest.mark.parametrize(
    ("code", "heavy"),
    [
        ("import fauio; fauio.build_parser()", HEAVY),
        ("import monitor.bus.subscriber, monitor.bus.status_watch, monitor.console.operator_client", {"numpy"}),
        (MONITOR, {"scipy", "cvxpy", "prometheus_client", "monitor.fitting", "gains.identification"}),
    ],
)
def test_commands_start_without_heavy_packages(code: str, heavy: set[str]) -> None:
    code += "\nimport sys; print(' '.join(sys.modules))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT).stdout
    assert not heavy & {part for name in loaded.split() for part in (name, name.split(".")[0])}
