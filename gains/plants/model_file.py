"""Plant models as TOML files: reading with errors that name the key, writing for people, hashing the content.

    name, description, domain = "continuous" | "discrete", rate_hz, states, inputs, outputs
    A, B, C               nested lists, or tables of rows by name: [A] link_rate = { link_angle = -48.6 }
    offset                c, by state
    taps, curves          input nonlinearity: delays; coefficients of u, u^2, ... for all inputs or by input
    bends                 by state and input: coefficients of v, v^2, ... of what is added to the effect B v
    [[nonlinearity]]      expression, arguments (name -> row over states), into (column of G), slope, range
    [[fault]]             name, kind, input | into, rate, error, unit
    [[disturbance]]       name, into (states), scale
    [[noise]]             name, into (outputs), scale
    [error]               default, and by state

A vector over names is a list, a table { name = number } or one name, whose entry then is 1.
"""

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from adapters.errors import ModelError
from adapters.output_file import write_file
from adapters.toml_tables import Table, TomlFile, read_toml, toml_value
from gains.plants.model_table import one_line, read_by_name, read_intervals, read_matrix, read_rows, read_vector
from gains.plants.plant import (
    Disturbance,
    Domain,
    Fault,
    FaultKind,
    FloatArray,
    Noise,
    Nonlinearity,
    Plant,
    PlantError,
    padded_curves,
)
from gains.plants.slopes import check_slopes, slope_bounds

BUILTIN_MODELS = ("arm", "arm-disturbed")

_DOMAINS: dict[str, Domain] = {"continuous": "continuous", "discrete": "discrete"}
_KINDS: dict[str, FaultKind] = {"actuator": "actuator", "sensor": "sensor"}


def load_model(name_or_path: str | Path) -> Plant:
    """Return the built-in model of that name, or the model in the file of that path.

    Raises
    ------
    ModelError
        There is neither, or the file is no valid model.
    """
    if str(name_or_path) in BUILTIN_MODELS:
        return builtin_model(str(name_or_path))
    if not Path(name_or_path).exists() and Path(name_or_path).suffix != ".toml":
        raise ModelError(
            f"{name_or_path}: neither a file nor a built-in model; the built-in models are {', '.join(BUILTIN_MODELS)}"
        )
    return read_model(name_or_path)


def builtin_model(name: str) -> Plant:
    """Return the built-in model of that name; another name is a ModelError."""
    if name not in BUILTIN_MODELS:
        raise ModelError(f"{name}: no built-in model; there are {', '.join(BUILTIN_MODELS)}")
    return read_model(Path(__file__).parent.parent / "models" / f"{name}.toml")


def read_model(path: str | Path) -> Plant:
    """Read a plant model.

    Raises
    ------
    ModelError
        The file cannot be read or is no valid model; the message has a line for each mistake, with file, line and key.
    """
    file = read_toml(path, ModelError)
    parameters = file.root.raw("parameters")
    if isinstance(parameters, dict) and parameters:
        free = [name for name, value in parameters.items() if isinstance(value, dict)] or list(parameters)
        raise ModelError(
            f"{path}: has free parameters ({', '.join(free)}), which recordings decide: "
            f"fauio fit --vehicle custom --model {path} LOG ... -o PROFILE; a plain model with their values is then in "
            "PROFILE"
        )
    return read_plant(file)


def write_model(plant: Plant, path: str | Path) -> None:
    """Write a plant model with tables by name; :func:`read_model` gives an equal plant back."""
    write_file(path, _text(model_document(plant)))


def model_hash(plant: Plant) -> str:
    """Return SHA-256 (hex) over the content: every number, name and expression, not the file's looks."""
    content = {
        "name": plant.name,
        "domain": plant.domain,
        "rate_hz": plant.rate_hz,
        "states": plant.states,
        "inputs": plant.inputs,
        "outputs": plant.outputs,
        "matrices": [matrix.tolist() for matrix in (plant.A, plant.B, plant.C, plant.c, plant.G)],
        "taps": plant.taps,
        "curves": plant.curves,
        **({"bends": plant.bends.tolist()} if plant.bends.size else {}),
        "nonlinearities": [
            [
                g.expression,
                g.arguments,
                g.rows.tolist(),
                g.slopes.tolist(),
                g.ranges.tolist(),
                *_stated(g.rates, g.ahead),
            ]
            for g in plant.nonlinearities
        ],
        "faults": [
            [f.name, f.kind, f.column.tolist(), f.rate, f.error, f.unit, f.input, *_stated(f.ahead)]
            for f in plant.faults
        ],
        "disturbances": [[w.name, w.column.tolist(), w.scale] for w in plant.disturbances],
        "noises": [[w.name, w.column.tolist(), w.scale] for w in plant.noises],
        "state_errors": plant.state_errors.tolist(),
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _stated(*arrays: FloatArray) -> list[Any]:
    """Return the arrays if one of them is not zero: empty ones leave the hashes of earlier models unchanged."""
    return [array.tolist() for array in arrays] if any(array.any() for array in arrays) else []


def read_plant(file: TomlFile) -> Plant:
    """Return the plant of a model's parsed TOML, as :func:`read_model` does of a file."""
    root = file.root
    states, inputs, outputs = root.texts("states"), root.texts("inputs"), root.texts("outputs")
    # nothing below can be read without names
    file.check()
    name, description = root.text("name", check=one_line), root.text("description", "", one_line)
    domain = _DOMAINS[root.choice("domain", list(_DOMAINS), "continuous")]
    rate_hz = root.number("rate_hz") if root.has("rate_hz") else None
    A, B = read_matrix(root, "A", states, states), read_matrix(root, "B", states, inputs)
    C, c = read_matrix(root, "C", outputs, states), read_vector(root, "offset", states)
    taps, curves = root.numbers("taps", [1.0]), read_by_name(root, "curves", inputs, [1.0])
    bent, tables = root.table("bends"), root.tables("nonlinearity")
    bends = padded_curves([curve for state in states for curve in read_by_name(bent, state, inputs, [0.0])])
    bent.done()
    faults = [_fault(table, states, outputs) for table in root.tables("fault")]
    read = [_nonlinearity(table, states, inputs, [fault.name for fault in faults]) for table in tables]
    nonlinearities = [(g, into) for g, into, _ in read]
    moved = np.vstack([np.zeros((0, len(faults))), *(rows for _, _, rows in read)])
    faults = [replace(fault, ahead=moved[:, k]) for k, fault in enumerate(faults)]
    disturbances = [Disturbance(*_signal(table, states)) for table in root.tables("disturbance")]
    noises = [Noise(*_signal(table, outputs)) for table in root.tables("noise")]
    errors = _errors(root.table("error"), states)
    root.done()
    file.check()
    try:
        return Plant(
            name=name,
            description=description,
            domain=domain,
            rate_hz=rate_hz,
            states=states,
            inputs=inputs,
            outputs=outputs,
            A=A,
            B=B,
            C=C,
            c=c,
            G=np.column_stack([into for _, into in nonlinearities]) if nonlinearities else np.zeros(0),
            nonlinearities=tuple(g for g, _ in nonlinearities),
            faults=tuple(faults),
            disturbances=tuple(disturbances),
            noises=tuple(noises),
            state_errors=errors,
            taps=taps,
            curves=tuple(curves),
            bends=bends.reshape(len(states), len(inputs), bends.shape[1]),
        )
    except PlantError as error:
        file.mistake(error.path, str(error), named=False)
        file.check()
        raise


def _nonlinearity(
    table: Table, states: Sequence[str], inputs: Sequence[str], faults: Sequence[str]
) -> tuple[Nonlinearity, FloatArray, FloatArray]:
    """Return g_i, its column of G and how faults move its arguments; undeclared slopes are derived."""
    expression = table.text("expression")
    into = read_vector(table, "into", states)
    if not into.any() and table.good("into"):
        table.mistake("into", "is missing or zero; it says which states the expression drives")
    arguments, rows = read_rows(table, "arguments", states)
    ranges = read_intervals(table, "range", arguments, (-math.inf, math.inf))
    slopes = read_intervals(table, "slope", arguments, None) if table.has("slope") else None
    rates = read_vector(table, "rate", arguments)
    known = np.column_stack([read_matrix(table, "inputs", arguments, inputs), read_vector(table, "offset", arguments)])
    moved = read_matrix(table, "faults", arguments, faults)
    table.done()
    if table.good("expression", "arguments", "range", "slope"):
        try:
            if slopes is None:
                slopes = slope_bounds(expression, arguments, ranges)
            else:
                check_slopes(expression, arguments, ranges, slopes)
        except ModelError as error:
            table.mistake("expression", f": {error}")
    return Nonlinearity(expression, arguments, rows, np.array(slopes), np.array(ranges), rates, known), into, moved


def _fault(table: Table, states: Sequence[str], outputs: Sequence[str]) -> Fault:
    kind = _KINDS[table.choice("kind", list(_KINDS))]
    by_input = table.has("input")
    if by_input == table.has("into"):
        table.mistake("into", ": give either 'into' or, for an actuator fault, 'input'")
    fault = Fault(
        name=table.text("name", check=one_line),
        kind=kind,
        input=table.text("input", check=one_line) if by_input else None,
        column=np.zeros(0) if by_input else read_vector(table, "into", states if kind == "actuator" else outputs),
        rate=table.number("rate", 1.0),
        error=table.number("error", 1.0),
        unit=table.text("unit", "", one_line),
    )
    table.done()
    return fault


def _signal(table: Table, names: Sequence[str]) -> tuple[str, FloatArray, float]:
    signal = table.text("name", check=one_line), read_vector(table, "into", names), table.number("scale", 1.0)
    table.done()
    return signal


def _errors(table: Table, states: Sequence[str]) -> FloatArray:
    default = table.number("default", 1.0)
    errors = np.array([table.number(state, default) for state in states])
    table.done()
    return errors


def model_document(plant: Plant) -> dict[str, Any]:
    """Return the tables of a plant's model file without default values."""
    document: dict[str, Any] = {"name": plant.name}
    if plant.description:
        document["description"] = plant.description
    document["domain"] = plant.domain
    if plant.rate_hz is not None:
        document["rate_hz"] = plant.rate_hz
    document |= {"states": plant.states, "inputs": plant.inputs, "outputs": plant.outputs}
    if plant.taps != (1.0,):
        document["taps"] = plant.taps
    if len(set(plant.curves)) == 1 and plant.curves[0] != (1.0,):
        document["curves"] = plant.curves[0]
    if plant.c.any():
        document["offset"] = _by_name(plant.c, plant.states)
    document |= {
        "A": _rows_by_name(plant.A, plant.states, plant.states),
        "B": _rows_by_name(plant.B, plant.states, plant.inputs),
        "C": _rows_by_name(plant.C, plant.outputs, plant.states),
    }
    if len(set(plant.curves)) > 1:
        document["curves"] = dict(zip(plant.inputs, plant.curves, strict=True))
    if plant.bends.size:
        rows = {plant.states[i]: plant.bends[i].tolist() for i in plant.bent}
        document["bends"] = {state: dict(zip(plant.inputs, row, strict=True)) for state, row in rows.items()}
    document |= {
        "nonlinearity": [_nonlinearity_table(plant, i) for i in range(len(plant.nonlinearities))],
        "fault": [_fault_table(plant, fault) for fault in plant.faults],
        "disturbance": [_signal_table(w, plant.states) for w in plant.disturbances],
        "noise": [_signal_table(w, plant.outputs) for w in plant.noises],
        "error": dict(zip(plant.states, plant.state_errors.tolist(), strict=True)),
    }
    return document


def _nonlinearity_table(plant: Plant, index: int) -> dict[str, Any]:
    g = plant.nonlinearities[index]
    table = {
        "expression": g.expression,
        "arguments": {name: _by_name(g.rows[j], plant.states) for j, name in enumerate(g.arguments)},
        "into": _by_name(plant.G[:, index], plant.states),
        "slope": dict(zip(g.arguments, g.slopes.tolist(), strict=True)),
    }
    if np.isfinite(g.ranges).any():
        table["range"] = dict(zip(g.arguments, g.ranges.tolist(), strict=True))
    first = sum(len(other.arguments) for other in plant.nonlinearities[:index])
    known = plant.H_known[first : first + len(g.arguments)]
    faults = [fault for fault in plant.faults if fault.ahead.any()]
    moved = np.array([fault.ahead[first : first + len(g.arguments)] for fault in faults]).T
    more = {
        "rate": _by_name(g.rates, g.arguments) if g.rates.size else {},
        "inputs": _rows_by_name(known[:, :-1], g.arguments, plant.inputs),
        "offset": _by_name(known[:, -1], g.arguments),
        "faults": _rows_by_name(moved, g.arguments, [fault.name for fault in faults]) if faults else {},
    }
    return table | {key: value for key, value in more.items() if value}


def _fault_table(plant: Plant, fault: Fault) -> dict[str, Any]:
    names = plant.states if fault.kind == "actuator" else plant.outputs
    table: dict[str, Any] = {"name": fault.name, "kind": fault.kind}
    table |= {"into": _by_name(fault.column, names)} if fault.input is None else {"input": fault.input}
    table |= {"rate": fault.rate, "error": fault.error}
    return table | ({"unit": fault.unit} if fault.unit else {})


def _signal_table(signal: Disturbance | Noise, names: Sequence[str]) -> dict[str, Any]:
    return {"name": signal.name, "into": _by_name(signal.column, names), "scale": signal.scale}


def _by_name(vector: FloatArray, names: Sequence[str]) -> dict[str, float]:
    return {name: value for name, value in zip(names, vector.tolist(), strict=True) if value}


def _rows_by_name(matrix: FloatArray, rows: Sequence[str], columns: Sequence[str]) -> dict[str, dict[str, float]]:
    return {row: _by_name(matrix[i], columns) for i, row in enumerate(rows) if matrix[i].any()}


def _text(document: Mapping[str, Any]) -> str:
    """Return a document as TOML: top-level tables as sections, everything below them on one line."""
    lines, sections = [], []
    for key, value in document.items():
        is_list_of_tables = isinstance(value, list)
        if isinstance(value, Mapping) or is_list_of_tables:
            for table in value if is_list_of_tables else [value]:
                entries = [f"{name} = {toml_value(entry)}" for name, entry in table.items()]
                sections += ["", f"[[{key}]]" if is_list_of_tables else f"[{key}]", *entries]
        else:
            lines.append(f"{key} = {toml_value(value)}")
    return "\n".join([*lines, *sections]) + "\n"
