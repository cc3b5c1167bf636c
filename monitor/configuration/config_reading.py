"""A TOML file to a checked model: every mistake in it, one line each, with its own line number."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterable, Mapping
from copy import deepcopy
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar, get_args

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from adapters.errors import ConfigError
from monitor.configuration.toml_lines import KeyPath, key_lines, line_of

M = TypeVar("M", bound=BaseModel)

_SHOWN = 60
_NEAR = 0.7
_DEEPEST = 32
_AT_LINE = re.compile(r" \(at line (\d+), column (\d+)\)")
_KINDS = {
    "string_type": "text in quotes",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "finite_number": "a finite number",
    "bool_type": "true or false",
    "tuple_type": "a list",
    "dict_type": "a table",
    "model_type": "a table",
    "is_instance_of": "a path in quotes",
}
_BOUNDS = {
    "greater_than": ("gt", "more than"),
    "greater_than_equal": ("ge", "at least"),
    "less_than": ("lt", "less than"),
    "less_than_equal": ("le", "at most"),
}


class _Mistake(NamedTuple):
    """Where something is wrong, what, and the keys that are not to be judged because of it."""

    path: KeyPath
    what: str
    broken: tuple[KeyPath, ...]


class _Conflict(Protocol):
    """A contradiction between keys, as :class:`monitor.configuration.config_checks.Conflict` has it."""

    @property
    def path(self) -> KeyPath: ...
    @property
    def what(self) -> str: ...
    @property
    def others(self) -> tuple[KeyPath, ...]: ...


def read_model(
    model: type[M], path: str | Path | None, given: Mapping[str, Any], conflicts: Callable[[M], Iterable[_Conflict]]
) -> M:
    """Read a file, put what was given on the command line over it, and check everything.

    Parameters
    ----------
    model : type[M]
        What it has to be.
    path : str | Path | None
        The file, None for none.
    given : Mapping[str, Any]
        Keys of the top level that override the file's.
    conflicts : Callable[[M], Iterable[_Conflict]]
        Finds what contradicts itself although each value is right.

    Raises
    ------
    ConfigError
        With one line for each mistake, in the order of the file.
    """
    text = "" if path is None else _text(path)
    content = _parsed(path, text) | dict(given)
    context = {"folder": Path() if path is None else Path(path).parent}
    mistakes: list[_Mistake] = []
    found: M | None = None
    left = content
    # without the keys that are wrong, what is left is judged all the same
    while found is None:
        try:
            found = model.model_validate(left, context=context)
        except ValidationError as error:
            new = _mistakes(error, model, left)
            mistakes += new
            left = _without(left, new)
    broken = [path for mistake in mistakes for path in mistake.broken]
    for conflict in conflicts(found):
        if not any(_concerns(path, on) for path in broken for on in (conflict.path, *conflict.others)):
            mistakes.append(_Mistake(_present(conflict.path, content), conflict.what, ()))
    if not mistakes:
        return found
    lines = key_lines(text)
    places = [_place(path, lines, given, mistake.path) for mistake in mistakes]
    order = sorted(range(len(mistakes)), key=lambda k: places[k][0])
    raise ConfigError(*(f"{places[k][1]} {mistakes[k].what}" for k in order))


def _text(path: str | Path) -> str:
    try:
        return Path(path).read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: no such file; docs/config-example.toml is one to begin with") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not valid TOML: byte {error.start} is no UTF-8; save it as UTF-8") from error


def _parsed(path: str | Path | None, text: str) -> dict[str, Any]:
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        at = _AT_LINE.search(str(error))
        line = at[1] if at else str(text.count("\n") + 1)
        what = _AT_LINE.sub("", str(error)).removesuffix(" (at end of document)")
        column = f"column {at[2]}" if at else "end of file"
        raise ConfigError(f"{path}:{line}: not valid TOML at {column}: {what}") from error
    except RecursionError as error:
        raise ConfigError(f"{path}: not valid TOML: nested too deeply") from error
    except ValueError as error:
        raise ConfigError(f"{path}: not valid TOML: a number in it is too long") from error
    level: list[Any] = [content]
    for _ in range(_DEEPEST):
        level = [inner for outer in level for inner in (outer.values() if isinstance(outer, dict) else outer)]
        level = [value for value in level if isinstance(value, dict | list)]
    if level:
        raise ConfigError(f"{path}: nested more than {_DEEPEST} levels deep; nothing here needs that")
    return content


def _mistakes(error: ValidationError, model: type[BaseModel], content: Mapping[str, Any]) -> list[_Mistake]:
    found = []
    for detail in error.errors(include_url=False):
        path = _present(tuple(part for part in detail["loc"] if part != "[key]"), content)
        if detail["type"] == "extra_forbidden":
            what, meant = _unknown(path, model)
            found.append(_Mistake(path, what, (path, *meant)))
        else:
            what = _sentence(detail["type"], detail, _field(path, model), path)
            found.append(_Mistake(path, what, (path,)))
    return found


def _sentence(kind: str, detail: Mapping[str, Any], field: FieldInfo | None, path: KeyPath) -> str:
    context = detail.get("ctx", {})
    shown = _shown(detail["input"])
    if kind == "value_error":
        return str(context["error"])
    if kind in _BOUNDS:
        key, words = _BOUNDS[kind]
        return f"is {shown}; it must be {words} {context[key]:g}"
    if kind == "literal_error":
        return f"is {shown}; it must be {context['expected']}"
    if kind == "tuple_type" and isinstance(detail["input"], Mapping):
        return f"is a single table; write [[{path[-1]}]]"
    what = f"is {shown}, which is not {_KINDS[kind]}" if kind in _KINDS else f"is {shown}: {detail['msg']}"
    examples = field.examples if field is not None and isinstance(path[-1], str) else None
    if examples:
        return f"{what}; write for example {path[-1]} = {toml_value(examples[0])}"
    return f"{what}; write it as one"


def toml_value(value: Any) -> str:
    """Return a value as TOML, on one line."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_toml_key(key)} = {toml_value(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(toml_value(item) for item in value) + "]"
    return f"{value:g}" if isinstance(value, float) and value.is_integer() and abs(value) < 1e6 else str(value)


def _toml_key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else toml_value(key)


def _shown(value: Any) -> str:
    text = toml_value(value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]} ..."


def _unknown(path: KeyPath, model: type[BaseModel]) -> tuple[str, tuple[KeyPath, ...]]:
    """Say that a key is unknown and what may be meant; return also the path of that."""
    *above, key = path
    known = (_table(tuple(above), model) or model).model_fields
    near = get_close_matches(str(key), known, 1, _NEAR)
    what = "is not a key of this table"
    if above and key in model.model_fields:
        return f"{what}, but one of the top level; move it above the first [table]", ((key,),)
    if near:
        return f"{what}; did you mean '{near[0]}'?", ((*above, near[0]),)
    homes = [name for name in model.model_fields if key in getattr(_table((name,), model), "model_fields", ())]
    if homes:
        return f"{what}; it belongs into {' or '.join(f'[{name}]' for name in homes)}", ((homes[0], key),)
    return f"{what}; known here: {', '.join(sorted(known))}", ()


def _field(path: KeyPath, model: type[BaseModel]) -> FieldInfo | None:
    if not path:
        return None
    table = _table(path[:-1], model)
    return table.model_fields.get(str(path[-1])) if table is not None else None


def _table(path: KeyPath, model: type[BaseModel]) -> type[BaseModel] | None:
    """Return the model of the table at a path, None where there is none."""
    table: type[BaseModel] | None = model
    for key in path:
        if isinstance(key, str):
            field = table.model_fields.get(key) if table is not None else None
            table = model_in(field.annotation) if field is not None else None
    return table


def model_in(annotation: Any) -> type[BaseModel] | None:
    """Return the model a type is or holds, None where it holds none."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((found for part in get_args(annotation) if (found := model_in(part)) is not None), None)


def _present(path: KeyPath, content: Any) -> KeyPath:
    """Return the part of a path that the content has, and the key after it: a single text is its own list."""
    for k, key in enumerate(path):
        if isinstance(content, Mapping):
            content = content.get(key) if isinstance(key, str) else None
        elif isinstance(content, list | tuple) and isinstance(key, int) and key < len(content):
            content = content[key]
        else:
            return path[:k]
    return path


def _without(content: Mapping[str, Any], mistakes: Iterable[_Mistake]) -> dict[str, Any]:
    """Return the content without the keys that are wrong; a list goes as a whole, its places would shift."""
    left = deepcopy(dict(content))
    for mistake in mistakes:
        path = mistake.path
        while path and isinstance(path[-1], int):
            path = path[:-1]
        table: Any = left
        for key in path[:-1]:
            # a mistake before may have taken the table away already
            table = table[key] if isinstance(key, int) and isinstance(table, list | tuple) else table.get(key, {})
        if isinstance(table, dict):
            table.pop(path[-1], None)
    return left


def _concerns(broken: KeyPath, path: KeyPath) -> bool:
    """Return whether a key that is wrong is the one at a path, holds it or is its element."""
    return path[: len(broken)] == broken or (broken[: len(path)] == path and isinstance(broken[-1], int))


def _place(
    file: str | Path | None, lines: dict[KeyPath, int], given: Mapping[str, Any], path: KeyPath
) -> tuple[int, str]:
    """Return a line to sort by, and the beginning of the message."""
    dotted = ""
    for key in path:
        dotted += f"[{key}]" if isinstance(key, int) else f".{_toml_key(key)}" if dotted else _toml_key(key)
    line = None if path[0] in given else line_of(lines, path)
    if line is not None:
        return line, f"{file}:{line}: '{dotted}'"
    return 0, f"{'command line' if file is None or path[0] in given else file}: '{dotted}'"
