"""Every number at the head of a module has its reason beside it.

``python tests/test_constants.py`` lists the constants that lack one.
"""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("adapters", "gains", "monitor", "replay")
CONSTANT = re.compile(r"_?[A-Z][A-Z0-9_]*")
COMPILED = re.compile(r"(?:cdef\s+(?:\w+\s+)+?)?(_?[A-Z][A-Z0-9_]*)\s*=[^=]*\d")
"""A constant of a Cython module, which ``ast`` cannot read."""
SPEAKS_FOR_ITSELF = re.compile(
    r"_?(SECOND|MINUTE|HOUR|DAY)_(NS|US|MS|S)|_?NS_PER_(SECOND|MS|US)|_?MEGABYTE|NANOSECONDS|_?MAX_U?INT\d+"
    r"|_?G|_?(STANDARD_)?GRAVITY|_?TURN|_?WGS84_\w+|_?UNIT_ROUNDOFF"
)
"""Names of units, limits of types and constants of nature: their values are no choice."""


class Constant(NamedTuple):
    """A number, or a collection of numbers, that a module names."""

    path: Path
    line: int
    name: str
    value: str
    explained: bool


def numbers(value: ast.expr) -> Iterator[float]:
    """Yield the numbers in an expression that functions inside it do not compute."""
    if isinstance(value, ast.Lambda):
        return
    if isinstance(value, ast.Constant) and isinstance(value.value, int | float) and not isinstance(value.value, bool):
        yield value.value
    if isinstance(value, ast.Call | ast.Dict) and (named := [n for child in children(value) for n in numbers(child)]):
        yield from (number for number in named if number)  # a zero among other things is no choice
        return
    for child in children(value):
        yield from numbers(child)


def children(value: ast.expr) -> list[ast.expr]:
    """Return the expressions that one is made of."""
    found = (child.value if isinstance(child, ast.keyword) else child for child in ast.iter_child_nodes(value))
    return [child for child in found if isinstance(child, ast.expr)]


def of_module(path: Path) -> Iterator[Constant]:
    """Yield the constants of a module.

    A value that is computed from another constant has that one's reason, but for units. A reason is a string below the
    constant, or a comment above it, at the end of its line or between its lines; one above a run of constants without a
    blank line is the reason of them all.
    """
    text = path.read_text()
    lines = text.splitlines()
    alone = {number for number, line in enumerate(lines, 1) if line.startswith("#")}
    body = ast.parse(text).body
    covered_until = -1  # the last line that a comment above a run of assignments still covers
    for node, following in zip(body, [*body[1:], None], strict=True):
        first, last = node.lineno, node.end_lineno or node.lineno
        above = first - 1 in alone or first - 1 == covered_until
        covered_until = last if above else -1
        if (
            not isinstance(node, ast.Assign | ast.AnnAssign)
            or node.value is None
            or not any(True for _ in numbers(node.value))
        ):
            continue
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        names = [name.id for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)]
        if not all(CONSTANT.fullmatch(name) for name in names):
            continue
        below = isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant)
        beside = has_comment(lines[first - 1 : last])
        used = {name.id for name in ast.walk(node.value) if isinstance(name, ast.Name) and CONSTANT.fullmatch(name.id)}
        computed = any(not SPEAKS_FOR_ITSELF.fullmatch(name) for name in used)
        named = computed or all(SPEAKS_FOR_ITSELF.fullmatch(name) for name in names)
        yield Constant(path, first, ", ".join(names), ast.unparse(node.value), below or beside or above or named)


def has_comment(lines: list[str]) -> bool:
    """Return whether there is a comment in the lines of a statement."""
    if not any("#" in line for line in lines):
        return False
    tokens = tokenize.generate_tokens(io.StringIO("\n".join(lines)).readline)
    return any(token.type == tokenize.COMMENT for token in tokens)


def of_compiled_module(path: Path) -> Iterator[Constant]:
    """Yield the constants of a Cython module, whose syntax is read line by line."""
    lines = path.read_text().splitlines()
    covered = False
    for k, line in enumerate(lines):
        found = COMPILED.match(line)
        covered = (k > 0 and lines[k - 1].startswith("#")) or (covered and found is not None)
        if found:
            below = k + 1 < len(lines) and lines[k + 1].startswith('"""')
            explained = covered or below or "#" in line or bool(SPEAKS_FOR_ITSELF.fullmatch(found[1]))
            yield Constant(path, k + 1, found[1], line.partition("=")[2].strip(), explained)


def unexplained(folder: Path) -> list[Constant]:
    """Return the constants below a folder that have no reason beside them."""
    python = (constant for path in sorted(folder.rglob("*.py")) for constant in of_module(path))
    compiled = (constant for path in sorted(folder.rglob("*.pyx")) for constant in of_compiled_module(path))
    return [constant for constant in (*python, *compiled) if not constant.explained]


def lines_of(constants: list[Constant]) -> list[str]:
    """Return a line for each constant: where it is, its name and its value."""
    return [f"{c.path.relative_to(ROOT)}:{c.line}: {c.name} = {c.value:.60}" for c in constants]


@pytest.mark.parametrize("package", PACKAGES)
def test_every_constant_has_a_reason_beside_it(package: str) -> None:
    assert lines_of(unexplained(ROOT / package)) == []


@pytest.mark.parametrize(
    ("text", "explained"),
    [
        ("_LIMIT = 3.0", False),
        ("_LIMIT = 3.0  # of the standard", True),
        ('_LIMIT = 3.0\n"""Of the standard."""', True),
        ("# Of the standard.\n_LIMIT = 3.0", True),
        ("# Of the standard.\n_LOW = 1.0\n_LIMIT = 3.0", True),
        ("# Of the standard.\n_LOW = 1.0\n\n_LIMIT = 3.0", False),
        ("_LOW = 1.0  # of the standard\n_LIMIT = 3.0", False),
        ("_GRAVITY = 9.80665", True),
        ("_LIMIT = 2 * _SIZE", True),
        ("_LIMIT = 2 * SECOND_NS", False),
    ],
)
def test_a_reason_is_a_string_below_or_a_comment_above_or_beside(tmp_path: Path, text: str, explained: bool) -> None:
    module = tmp_path / "module.py"
    module.write_text(text + "\n")
    assert [constant.explained for constant in of_module(module)][-1] is explained


if __name__ == "__main__":
    print("\n".join(line for package in PACKAGES for line in lines_of(unexplained(ROOT / package))))  # noqa: T201
