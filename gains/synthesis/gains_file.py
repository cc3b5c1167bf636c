"""Compiled gains: all that the running observer needs, in a readable JSON file that is read back without rounding."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from types import NoneType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adapters.errors import ModelError
from adapters.output_file import write_file
from adapters.toml_tables import is_number
from gains.plants.expression import compile_expression

FORMAT = 2
"""Number of the layout: a reader refuses layouts that it does not know."""
_ADDED: Mapping[str, Any] = {name: {"shape": [0, 0], "rows": []} for name in ("L_q", "F_q", "L_z", "input_bends")}
"""Fields that earlier files do not have, and the values that they stand for there."""
_LARGEST_FILE = 16 << 20
"""Largest size of a file, bytes. A quadrotor has 10,000, the sensors of a vehicle 26,000; a file of unknown origin must
not fill the memory."""


@dataclass(frozen=True, slots=True)
class ScalarNonlinearity:
    """Text of a nonlinearity g_i and the names of its arguments."""

    expression: str
    arguments: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Gains:
    """A compiled observer; :mod:`monitor.estimation.affine` runs its recursion."""

    # name and hash of the plant model it was designed for
    model: str
    model_hash: str
    # synthesis, and ``"discrete"`` or ``"continuous"`` before compilation
    method: str
    domain: str
    rate_hz: float  # samples per second
    # names of x (n), u (s), y (p) and of [f_a; f_s] (a1 + a2)
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    faults: tuple[str, ...]
    # ``"actuator"`` or ``"sensor"``, and the unit, of each fault
    fault_kinds: tuple[str, ...]
    fault_units: tuple[str, ...]
    # index of the input whose effect each actuator fault changes, None if it changes none
    fault_inputs: tuple[int | None, ...]
    input_taps: tuple[float, ...]  # delays h_0, h_1, ... that are folded into the matrices
    input_curves: NDArray[np.float64]  # coefficients c1, c2, ... of v = curve(u) (s, degree)
    # coefficients over v of the bends of e states, a row for each state and input (e s, degree); v is [v; r] below
    input_bends: NDArray[np.float64]
    # the nonlinearities g_i (m of them), their arguments in the order of ``argument_matrix``
    nonlinearities: tuple[ScalarNonlinearity, ...]
    # [s+; zeta^; fa^; yt] = step_matrix [s; v; y; 1; g], nu = argument_matrix [s; v; y; 1] and s = initial_matrix [v;
    # y; 1] at a restart
    step_matrix: NDArray[np.float64]
    argument_matrix: NDArray[np.float64]
    initial_matrix: NDArray[np.float64]
    # the observer's matrices as the theory writes them, for people; empty if it has another structure
    K: NDArray[np.float64]
    L_i: NDArray[np.float64]
    L_p: NDArray[np.float64]
    L1: NDArray[np.float64]
    F: NDArray[np.float64]
    N: NDArray[np.float64]
    J: NDArray[np.float64]
    L_q: NDArray[np.float64]
    F_q: NDArray[np.float64]
    L_z: NDArray[np.float64]
    report: Mapping[str, Any]  # figures of the design: bound, norm, certificate

    @property
    def known(self) -> int:
        """Number of known inputs [v; r], s + e."""
        return len(self.inputs) + len(self.input_bends) // max(len(self.inputs), 1)


def write_gains(gains: Gains, path: str | Path) -> None:
    """Write a gains file; floats are written so that reading gives the same bits."""
    document: dict[str, Any] = {"format": FORMAT}
    for field in fields(Gains):
        value = getattr(gains, field.name)
        if isinstance(value, np.ndarray):
            value = {"shape": list(value.shape), "rows": value.tolist()}
        elif field.name == "nonlinearities":
            value = [{"expression": g.expression, "arguments": list(g.arguments)} for g in value]
        elif isinstance(value, tuple):
            value = list(value)
        document[field.name] = value
    write_file(path, _one_row_per_line(document))


def read_gains(path: str | Path) -> Gains:
    """Read a gains file.

    Raises
    ------
    ModelError
        The file is missing, too large, not JSON, of another format, or its matrices do not fit together.
    """
    path = Path(path)
    try:
        too_large = path.stat().st_size > _LARGEST_FILE
        document = None if too_large else json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ModelError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise ModelError(f"{path}: not JSON; make gains with 'fauio design'") from error
    if too_large:
        raise ModelError(f"{path}: larger than {_LARGEST_FILE >> 20} MiB; this is no gains file")
    if not isinstance(document, dict) or document.get("format") not in (1, FORMAT):
        raise ModelError(f"{path}: 'format' is not {FORMAT}; make the file again with 'fauio design'")
    document = {**_ADDED, **document}
    missing = [field.name for field in fields(Gains) if field.name not in document]
    if missing:
        raise ModelError(f"{path}: '{missing[0]}' is missing; make the file again with 'fauio design'")
    try:
        values: dict[str, Any] = {
            field.name: _READERS[str(field.type)](field.name, document) for field in fields(Gains)
        }
        gains = Gains(**values)
        _check_shapes(gains)
    except ModelError as error:
        raise ModelError(f"{path}: {error}; make the file again with 'fauio design'") from error
    return gains


def _check_shapes(gains: Gains) -> None:
    n, s, p, v = len(gains.states), len(gains.inputs), len(gains.outputs), gains.known
    kinds = gains.fault_kinds
    if not len(gains.faults) == len(kinds) == len(gains.fault_units) == len(gains.fault_inputs):
        raise ModelError("'faults', 'fault_kinds', 'fault_units' and 'fault_inputs' differ in length")
    if set(kinds) - {"actuator", "sensor"} or list(kinds) != sorted(kinds):
        raise ModelError("'fault_kinds' is not actuator faults first, then sensor faults")
    if any(index is not None and not 0 <= index < s for index in gains.fault_inputs):
        raise ModelError("'fault_inputs' names an input that does not exist")
    if gains.rate_hz <= 0.0:
        raise ModelError("'rate_hz' is not positive")
    a1 = kinds.count("actuator")
    nz = n + len(kinds) - a1
    # A continuous design has its own states, and matrices for people only if it has the paper's structure.
    continuous = gains.domain == "continuous"
    nq = len(gains.L_i) if len(gains.L_i) == 2 * a1 and not continuous else a1
    ns = len(gains.initial_matrix) if continuous else nz + nq + v * (len(gains.input_taps) - 1)
    m = len(gains.nonlinearities)
    arguments = sum(len(g.arguments) for g in gains.nonlinearities)
    compiled = {
        "step_matrix": (ns + nz + a1 + p, ns + v + p + 1 + m),
        "argument_matrix": (arguments, ns + v + p + 1),
        "initial_matrix": (ns, v + p + 1),
    }
    structural = {
        "L1": (nz, n),
        "F": (nz, p),
        "N": (nz, nz),
        "J": (nz, p),
        "K": (nz, p),
        "L_i": (nq, p),
        "L_p": (a1, p),
        "L_q": (nq, n),
        "F_q": (nq, p),
        "L_z": (nz, p),
    }
    for name, shape in (compiled | structural).items():
        actual = getattr(gains, name).shape
        if actual != shape and not ((continuous or name in _ADDED) and name in structural and actual == (0, 0)):
            raise ModelError(f"'{name}' is {actual} where the names make it {shape}")
    if gains.input_curves.shape[0] != s or gains.input_curves.shape[1] < 1:
        raise ModelError("'input_curves' does not have a row for each input")
    if len(gains.input_bends) != (v - s) * s:
        raise ModelError("'input_bends' does not have a row for each input")


def _text(key: str, document: Mapping[str, Any]) -> str:
    if not isinstance(document[key], str):
        raise ModelError(f"'{key}' is not text")
    return str(document[key])


def _list(key: str, document: Mapping[str, Any], what: str = "", *kinds: type) -> tuple[Any, ...]:
    """Return a list; ``what`` says what its entries have to be, ``kinds`` are their types, any if there are none."""
    values = document[key]
    if not isinstance(values, list):
        raise ModelError(f"'{key}' is not a list")
    if kinds and not all(type(value) in kinds for value in values):
        raise ModelError(f"'{key}' is not a list of {what}")
    return tuple(values)


def _names(key: str, document: Mapping[str, Any]) -> tuple[str, ...]:
    return _list(key, document, "names", str)


def _finite(key: str, value: Any) -> float:
    if not is_number(value):
        raise ModelError(f"'{key}' is not a finite number")
    return float(value)


def _matrix(key: str, document: Mapping[str, Any]) -> NDArray[np.float64]:
    entry = document[key]
    try:
        rows, columns = entry["shape"]
        if not {type(x) for row in entry["rows"] for x in row} <= {int, float}:
            raise TypeError
        matrix = np.array(entry["rows"], dtype=np.float64)
        if not np.isfinite(matrix).all():
            raise ValueError
        return matrix.reshape(rows, columns)
    except (TypeError, ValueError, KeyError, OverflowError) as error:
        raise ModelError(f"'{key}' is not a matrix of finite numbers") from error


def _nonlinearity(key: str, entry: Any) -> ScalarNonlinearity:
    if not isinstance(entry, dict) or not isinstance(entry.get("expression"), str):
        raise ModelError(f"'{key}' has an entry without an expression")
    if "arguments" not in entry:
        raise ModelError(f"'{key}' has an entry without arguments")
    nonlinearity = ScalarNonlinearity(entry["expression"], _names("arguments", entry))
    compile_expression(nonlinearity.expression, nonlinearity.arguments)
    return nonlinearity


# by the type of a field
_READERS: Mapping[str, Callable[[str, Mapping[str, Any]], Any]] = {
    "str": _text,
    "float": lambda key, document: _finite(key, document[key]),
    "tuple[str, ...]": _names,
    "tuple[int | None, ...]": lambda key, document: _list(key, document, "indices", int, NoneType),
    "tuple[float, ...]": lambda key, document: tuple(_finite(key, item) for item in _list(key, document)),
    "tuple[ScalarNonlinearity, ...]": lambda key, document: tuple(
        _nonlinearity(key, entry) for entry in _list(key, document)
    ),
    "NDArray[np.float64]": _matrix,
    "Mapping[str, Any]": lambda key, document: document[key] if isinstance(document[key], dict) else {},
}


def _one_row_per_line(document: Mapping[str, Any]) -> str:
    parts = []
    for key, value in document.items():
        text = json.dumps(value)
        if isinstance(value, dict) and "rows" in value:
            rows: Sequence[Any] = value["rows"]
            body = ",\n   ".join(json.dumps(row) for row in rows)
            text = f'{{"shape": {json.dumps(value["shape"])}, "rows": [\n   {body}]}}'
        parts.append(f" {json.dumps(key)}: {text}")
    return "{\n" + ",\n".join(parts) + "\n}\n"
