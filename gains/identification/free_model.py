"""Plant models with free parameters: a model file whose entries may be expressions of named parameters.

    [parameters]
    stiffness = { start = 40.0, min = 1.0, max = 200.0 }     free: estimated from recordings
    ratio = 0.4                                              fixed
    [A]
    motor_rate = { motor_angle = "-stiffness", link_angle = "stiffness" }

A text is an expression in A, B, C, offset, curves, in ``into`` and ``arguments``, and in ``scale``, ``rate`` and
``error``; a nonlinearity's own expression may name parameters beside its arguments. The tables ``channels`` (where
inputs and outputs come from) and ``phase`` (when samples count) are kept as parsed for the reader of recordings.
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from adapters.errors import ModelError
from adapters.toml_tables import Table, TomlFile, read_toml
from gains.identification.simulation import Dynamics, Vectorised, compile_vectorised
from gains.plants.expression import compile_expression, parse_expression
from gains.plants.model_file import read_plant
from gains.plants.model_table import read_by_name, read_matrix, read_rows, read_vector
from gains.plants.plant import FloatArray, Plant, padded_curves

_EXTRA = ("parameters", "channels", "phase")
_MATRICES = ("A", "B", "C")
_WORD = re.compile(r"(?<![\w.])[A-Za-z_]\w*")


@dataclass(frozen=True, slots=True)
class Parameter:
    """A free parameter: the start value of its estimation and its bounds, in its own unit."""

    name: str
    start: float
    low: float
    high: float

    @property
    def size(self) -> float:
        """Order of magnitude of the parameter."""
        width = self.high - self.low
        return abs(self.start) or (width / 10.0 if 0.0 < width < math.inf else 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class FreeModel:
    """A model file with free parameters."""

    path: str  # the file, for errors
    document: Mapping[str, Any]  # its parsed TOML without the tables below
    # the free parameters in the order of the file, which is that of the values of all methods
    parameters: tuple[Parameter, ...]
    fixed: Mapping[str, float]  # the other parameters
    file: TomlFile  # the file, for its tables ``channels`` and ``phase``
    example: Plant  # the plant at the start values

    @property
    def start(self) -> FloatArray:
        """Start values of the free parameters (k,)."""
        return np.array([parameter.start for parameter in self.parameters])

    def plant(self, values: Sequence[float] | FloatArray) -> Plant:
        """Return the plant with the free parameters at ``values`` (k,), or raise a ModelError with file and key."""
        return read_plant(self._resolved(self._named(values)))

    def dynamics(self, values: Sequence[float] | FloatArray) -> Dynamics:
        """Return the dynamics for a simulation, without the slope bounds that make :meth:`plant` slow."""
        named, plant = self._named(values), self.example
        names = tuple(named)
        file = self._resolved(named, ("offset", "curves", "nonlinearity", *_MATRICES))
        root = file.root
        terms = root.tables("nonlinearity")
        into = [read_vector(term, "into", plant.states) for term in terms]
        dynamics = Dynamics(
            rate_hz=plant.rate_hz,
            A=read_matrix(root, "A", plant.states, plant.states),
            B=read_matrix(root, "B", plant.states, plant.inputs),
            C=read_matrix(root, "C", plant.outputs, plant.states),
            c=read_vector(root, "offset", plant.states),
            G=np.column_stack(into) if into else np.zeros((len(plant.states), 0)),
            rows=tuple(read_rows(term, "arguments", plant.states)[1] for term in terms),
            functions=tuple(
                _vectorised(raw["expression"], (*raw["arguments"], *names))
                for raw in self.document.get("nonlinearity", [])
            ),
            parameters=np.array(list(named.values())),
            curves=padded_curves(read_by_name(root, "curves", plant.inputs, [1.0])),
        )
        file.check()
        return dynamics

    def words_of(self, term: int) -> frozenset[str]:
        """Return the names in the expression of nonlinearity number ``term``."""
        return frozenset(_WORD.findall(self.document["nonlinearity"][term]["expression"]))

    def declares_scale(self, kind: str, index: int) -> bool:
        """Return whether entry ``index`` of 'disturbance' or 'noise' states its scale; otherwise a fit estimates it."""
        return "scale" in self.document[kind][index]

    def _resolved(self, named: Mapping[str, float], keys: Collection[str] | None = None) -> TomlFile:
        """Return the document, or these keys of it, with numbers for the expressions of parameters."""
        document = self.document if keys is None else {key: self.document[key] for key in keys if key in self.document}
        try:
            return TomlFile(self.path, _resolved(document, named), ModelError)
        except ModelError as error:
            raise ModelError(f"{self.path}: {error}") from error

    def _named(self, values: Sequence[float] | FloatArray) -> dict[str, float]:
        free = {p.name: float(value) for p, value in zip(self.parameters, values, strict=True)}
        return {**free, **self.fixed}


def read_free_model(path: str | Path) -> FreeModel:
    """Read a model with free parameters; a plain model is one without any.

    Raises
    ------
    ModelError
        The file cannot be read or is no valid model at the start values; the message is one line with file and key.
    """
    file = read_toml(path, ModelError)
    root = file.root
    free, fixed = _parameters(root.table("parameters"))
    for name in _EXTRA:
        root.table(name)
    start = {parameter.name: parameter.start for parameter in free} | fixed
    model = {key: root.raw(key) for key in root if key not in _EXTRA}
    _check_arguments(root, tuple(start))
    file.check()
    used: set[str] = set()
    try:
        resolved = _resolved(model, start, used)
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from error
    example = read_plant(file.changed(resolved))
    for name in start:
        if name not in used:
            file.mistake(("parameters", name), "is used nowhere in the model")
    file.check()
    return FreeModel(str(path), model, free, fixed, file, example)


def _parameters(table: Table) -> tuple[tuple[Parameter, ...], dict[str, float]]:
    free, fixed = [], {}
    for name in table:
        try:
            parse_expression(name, [name])
        except ModelError:
            table.mistake(name, ": the name is taken or no plain word of letters and digits")
            continue
        if not isinstance(table.raw(name), Mapping):
            fixed[name] = table.number(name)
            continue
        entry = table.table(name)
        if not entry.has("start"):
            entry.mistake("start", "is missing; estimation needs a value to start from")
            continue
        start, low, high = entry.number("start"), entry.number("min", -math.inf), entry.number("max", math.inf)
        entry.done()
        if entry.good() and not (low <= start <= high and low < high):
            table.mistake(name, f"starts at {start:g}, which is not between {low:g} and {high:g}")
        free.append(Parameter(name, start, low, high))
    return tuple(free), fixed


def _check_arguments(root: Table, names: Sequence[str]) -> None:
    for term in root.tables("nonlinearity"):
        arguments = term.table("arguments")
        for argument in arguments:
            if argument in names:
                arguments.mistake(argument, "is also the name of a parameter")


def _resolved(document: Mapping[str, Any], named: Mapping[str, float], used: set[str] | None = None) -> dict[str, Any]:
    """Return a model's document with every expression of parameters replaced by its number.

    ``used`` collects the names of these parameters.
    """
    resolved = dict(document)
    number = _Resolver(named, set() if used is None else used)
    for key in _MATRICES:
        resolved[key] = _each(resolved.get(key, {}), lambda row: _each(row, number))
    for key in ("offset", "error"):
        resolved[key] = _each(resolved.get(key, {}), number)
    if "curves" in resolved:
        resolved["curves"] = _each(resolved["curves"], lambda curve: number(_each(curve, number)))
    for key in ("nonlinearity", "fault", "disturbance", "noise"):
        if key in resolved and _tables(resolved, key):
            resolved[key] = [_resolved_term(table, number) for table in resolved[key]]
    return {key: value for key, value in resolved.items() if value != {}}


def _resolved_term(table: Mapping[str, Any], number: _Resolver) -> dict[str, Any]:
    """Return one [[nonlinearity]], [[fault]], [[disturbance]] or [[noise]] with numbers for expressions."""
    resolved = dict(table)
    for key in ("scale", "rate", "error"):
        if key in resolved:
            resolved[key] = number(resolved[key])
    if "into" in resolved:
        resolved["into"] = _each(resolved["into"], number)
    if "arguments" in resolved:
        resolved["arguments"] = _each(resolved["arguments"], lambda row: _each(row, number))
    if isinstance(resolved.get("expression"), str):
        resolved["expression"] = _WORD.sub(number.word, resolved["expression"])
    return resolved


class _Resolver:
    """Turns expressions of parameters into numbers and records the names of the parameters."""

    def __init__(self, named: Mapping[str, float], used: set[str]) -> None:
        self._named = named
        self.used = used

    def __call__(self, value: Any) -> Any:
        """Return the number of an expression; a value that is no text is returned unchanged and checked elsewhere."""
        if not isinstance(value, str):
            return value
        number = _compiled(value, tuple(self._named))(*self._named.values())
        self.used.update(word for word in _WORD.findall(value) if word in self._named)
        if not math.isfinite(number):
            at = ", ".join(f"{name} = {x:g}" for name, x in self._named.items() if name in _WORD.findall(value))
            raise ModelError(f"'{value}' has no value at {at}; narrow the bounds of the parameters")
        return number

    def word(self, match: re.Match[str]) -> str:
        """Return a word of an expression; a parameter becomes its number in brackets."""
        name = match.group()
        if name not in self._named:
            return name
        self.used.add(name)
        return f"({self._named[name]!r})"


def _each(value: Any, change: Callable[[Any], Any]) -> Any:
    """Return a list or table with every entry changed; a text in place of it is a name and is returned unchanged."""
    if isinstance(value, Mapping):
        return {key: change(entry) for key, entry in value.items()}
    return [change(entry) for entry in value] if isinstance(value, list) else value


def _tables(document: Mapping[str, Any], key: str) -> list[Mapping[str, Any]]:
    tables = document.get(key, [])
    return tables if isinstance(tables, list) and all(isinstance(table, Mapping) for table in tables) else []


_compiled = functools.lru_cache(maxsize=1024)(compile_expression)


@functools.lru_cache(maxsize=1024)
def _vectorised(text: str, names: tuple[str, ...]) -> Vectorised:
    return compile_vectorised(parse_expression(text, names))
