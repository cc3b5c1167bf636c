"""The plant for which an observer is designed: matrices, names, faults, disturbances and their scales.

In continuous time (``domain == "continuous"``; x' becomes x+ in a discrete model of fixed rate):

    x'  = A x + B v + r + c + G g(x) + E_f f_a + E_1 w_1    x (n,), v (s,), f_a (a1,), w_1 (q1,)
    y   = C x + D_f f_s + D_1 w_2                           y (p,), f_s (a2,), w_2 (q2,)
    v_i = sum_d taps[d] curve_i(u_i(k - d)),   curve_i(u) = c1 u + c2 u^2 + ...      known input nonlinearity
    r_o = sum_d taps[d] sum_i bend_oi(curve_i(u_i(k - d))) what effects of inputs do to a state besides B v
    g_i = g_i(H_i x),   a_ij <= dg_i/dnu_j <= b_ij                                    G is (n, m)

A sampled plant evaluates its nonlinearities in the middle of the sample that begins: nu = H x + H_v v + h + H_f f_a
(:mod:`gains.plants.discretise`).
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adapters.errors import ModelError
from adapters.toml_tables import KeyPath

FloatArray = NDArray[np.float64]
Domain = Literal["continuous", "discrete"]
FaultKind = Literal["actuator", "sensor"]

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,63}")
_RANK_TOLERANCE = 1e-9
"""Smallest singular value of independent columns of length one. Measured on the plants of the tests: dependent ones
have 3e-16 at most, independent ones 5e-3 and more."""


class PlantError(ModelError):
    """An impossible plant; ``path`` is the key of the mistake in a model file."""

    def __init__(self, message: str, *path: str | int) -> None:
        super().__init__(message)
        self.path: KeyPath = path


def _nothing() -> FloatArray:
    return np.zeros(0)


@dataclass(frozen=True, slots=True, eq=False)
class Fault:
    """One fault or attack channel."""

    name: str  # channel name in estimates and alarms
    kind: FaultKind  # whether it enters the states (a column of E_f) or the outputs (a column of D_f)
    # that column: (n,) or (p,). Empty with ``input``: the input's column of B
    column: FloatArray = field(default_factory=_nothing)
    # how fast an actuator fault may move, units per second: it sets the bandwidth. A sensor fault needs no such
    # assumption and ignores it
    rate: float = 1.0
    error: float = 1.0  # error of the estimate that matters, in ``unit``
    unit: str = ""  # unit of the estimate, for people
    # the input whose effect v the fault changes: estimate over command is then a relative loss
    input: str | None = None
    # how an actuator fault moves the arguments of all nonlinearities (arguments,); empty: zeros
    ahead: FloatArray = field(default_factory=_nothing)


@dataclass(frozen=True, slots=True, eq=False)
class Disturbance:
    """One unknown input of the states: column of E_1 (n,) and how large it is."""

    name: str
    column: FloatArray
    scale: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """One unknown input of the outputs: column of D_1 (p,) and how large it is."""

    name: str
    column: FloatArray
    scale: float = 1.0


Signal = TypeVar("Signal", Disturbance, Noise)


def on_each(kind: type[Signal], names: Sequence[str], scales: Iterable[float]) -> tuple[Signal, ...]:
    """Return a disturbance of each state (``disturbance_NAME``), or a noise of each output (``noise_NAME``)."""
    return tuple(
        kind(f"{kind.__name__.lower()}_{name}", column, float(scale))
        for name, column, scale in zip(names, np.eye(len(names)), scales, strict=True)
    )


@dataclass(frozen=True, slots=True, eq=False)
class Nonlinearity:
    """One scalar nonlinearity g_i(H_i x); it enters the states through column i of the plant's G."""

    expression: str  # text of g_i, for example ``"sin(v)"``
    arguments: tuple[str, ...]  # names of its arguments nu_j
    rows: FloatArray  # H_i (number of arguments, n): nu = rows x
    slopes: FloatArray  # bounds a_ij <= dg_i/dnu_j <= b_ij (number of arguments, 2)
    ranges: FloatArray  # box of the arguments on which the bounds hold (number of arguments, 2)
    # how fast each argument moves at most, per second (number of arguments,); empty if not stated. With them the error
    # of a sampled nonlinearity is one more disturbance (:mod:`gains.plants.discretise`)
    rates: FloatArray = field(default_factory=_nothing)
    # [H_v, h] (number of arguments, s + 1): what inputs and a constant add to the arguments; empty: zeros
    ahead: FloatArray = field(default_factory=_nothing)


@dataclass(frozen=True, slots=True, eq=False)
class Plant:
    """A plant with its faults; every array is checked, copied and made read-only.

    Raises
    ------
    ModelError
        Shapes, names or numbers are impossible: the message names the key.
    """

    name: str  # the model's name
    # names of x, u and y
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    # (n, n), (n, s), (p, n)
    A: FloatArray
    B: FloatArray
    C: FloatArray
    domain: Domain = "continuous"  # whether the equations give x' or x+
    rate_hz: float | None = None  # samples per second of a discrete model, None in continuous time
    c: FloatArray = field(default_factory=_nothing)  # constant offset (n,); empty: zeros
    G: FloatArray = field(default_factory=_nothing)  # (n, m), a column for each nonlinearity; empty without any
    nonlinearities: tuple[Nonlinearity, ...] = ()  # the m scalar nonlinearities
    faults: tuple[Fault, ...] = ()  # actuator and sensor faults in any order
    disturbances: tuple[Disturbance, ...] = ()  # w_1
    noises: tuple[Noise, ...] = ()  # w_2
    # error of each state estimate that matters (n,); empty: ones
    state_errors: FloatArray = field(default_factory=_nothing)
    taps: tuple[float, ...] = (1.0,)  # delays of the inputs, newest first, sum 1; more than one in discrete models only
    # coefficients c1, c2, ... of each input's static curve; empty: v = u
    curves: tuple[tuple[float, ...], ...] = ()
    # coefficients of v, v^2, ... of each bend (n, s, degree), in discrete models; empty: none
    bends: FloatArray = field(default_factory=_nothing)
    description: str = ""  # a sentence for people; it does not enter the model's hash

    def __post_init__(self) -> None:
        n, s, p, m = len(self.states), len(self.inputs), len(self.outputs), len(self.nonlinearities)
        _check_names(self)
        _check_domain(self)

        def put(name: str, value: object) -> None:
            object.__setattr__(self, name, value)

        put("A", checked_array(self.A, (n, n), "A"))
        put("B", checked_array(self.B if np.size(self.B) else np.zeros((n, s)), (n, s), "B"))
        put("C", checked_array(self.C, (p, n), "C"))
        put("c", checked_array(self.c if np.size(self.c) else np.zeros(n), (n,), "c"))
        put("G", checked_array(self.G if np.size(self.G) else np.zeros((n, m)), (n, m), "G"))
        errors = self.state_errors if np.size(self.state_errors) else np.ones(n)
        put("state_errors", checked_array(errors, (n,), "error"))
        if np.any(self.state_errors <= 0.0):
            bad = self.states[int(np.argmax(self.state_errors <= 0.0))]
            raise PlantError(f"error.{bad} is not positive; it is the size of error that matters", "error", bad)
        put("taps", _checked_taps(self.taps))
        put("curves", _checked_curves(self.curves, self.inputs))
        bends = self.bends if np.any(self.bends) else np.zeros((n, s, 0))
        put("bends", checked_array(bends, (n, s, np.shape(bends)[-1]), "bends"))
        if self.domain == "continuous" and self.bends.any():
            raise PlantError("'bends' are known for the steps of a discrete model only", "bends")
        put("nonlinearities", tuple(_checked_nonlinearity(g, n, s, i) for i, g in enumerate(self.nonlinearities)))
        put("faults", tuple(_checked_fault(fault, self, i) for i, fault in enumerate(self.faults)))
        put("disturbances", tuple(_checked_signal(w, n, "disturbance", i) for i, w in enumerate(self.disturbances)))
        put("noises", tuple(_checked_signal(w, p, "noise", i) for i, w in enumerate(self.noises)))

    @property
    def actuator_faults(self) -> tuple[Fault, ...]:
        """Faults f_a in the order of E_f."""
        return tuple(fault for fault in self.faults if fault.kind == "actuator")

    @property
    def sensor_faults(self) -> tuple[Fault, ...]:
        """Faults f_s in the order of D_f."""
        return tuple(fault for fault in self.faults if fault.kind == "sensor")

    @property
    def fault_names(self) -> tuple[str, ...]:
        """Names of [f_a; f_s], the actuator faults first."""
        return tuple(fault.name for fault in (*self.actuator_faults, *self.sensor_faults))

    @property
    def E_f(self) -> FloatArray:
        """Directions of the actuator faults (n, a1)."""
        return _stacked((fault.column for fault in self.actuator_faults), len(self.states))

    @property
    def D_f(self) -> FloatArray:
        """Directions of the sensor faults (p, a2)."""
        return _stacked((fault.column for fault in self.sensor_faults), len(self.outputs))

    @property
    def E_1(self) -> FloatArray:
        """Directions of the disturbances (n, q1), not scaled."""
        return _stacked((w.column for w in self.disturbances), len(self.states))

    @property
    def D_1(self) -> FloatArray:
        """Directions of the noises (p, q2), not scaled."""
        return _stacked((w.column for w in self.noises), len(self.outputs))

    @property
    def E(self) -> FloatArray:
        """[E_1 0] (n, q) for w = [w_1; w_2], each in units of its scale."""
        scaled = self.E_1 * [w.scale for w in self.disturbances]
        return np.hstack([scaled, np.zeros((len(self.states), len(self.noises)))])

    @property
    def D(self) -> FloatArray:
        """[0 D_1] (p, q) for w = [w_1; w_2], each in units of its scale."""
        scaled = self.D_1 * [w.scale for w in self.noises]
        return np.hstack([np.zeros((len(self.outputs), len(self.disturbances))), scaled])

    @property
    def bent(self) -> NDArray[np.intp]:
        """Indices of the states with a bend (e,)."""
        return np.flatnonzero(self.bends.any(axis=(1, 2)))

    @property
    def B_r(self) -> FloatArray:
        """Columns of all known inputs [v; r] (n, s + e), r of the states with a bend."""
        return np.hstack([self.B, np.eye(len(self.states))[:, self.bent]])

    @property
    def H(self) -> FloatArray:
        """Arguments of all nonlinearities, one after the other: nu = H x (arguments, n)."""
        return np.vstack([np.zeros((0, len(self.states))), *(g.rows for g in self.nonlinearities)])

    @property
    def H_known(self) -> FloatArray:
        """Known part of those arguments besides x: [H_v, h] (arguments, s + 1)."""
        width = len(self.inputs) + 1
        rows = (g.ahead if g.ahead.size else np.zeros((len(g.arguments), width)) for g in self.nonlinearities)
        return np.vstack([np.zeros((0, width)), *rows])

    @property
    def H_f(self) -> FloatArray:
        """Effect of actuator faults on those arguments (arguments, a1)."""
        none = np.zeros(len(self.H))
        return _stacked((fault.ahead if fault.ahead.size else none for fault in self.actuator_faults), len(none))

    @property
    def errors(self) -> FloatArray:
        """Errors that matter of [x; f_s; f_a] (n + a2 + a1,)."""
        faults = [fault.error for fault in (*self.sensor_faults, *self.actuator_faults)]
        return np.concatenate([self.state_errors, faults])


def padded_curves(curves: Sequence[Sequence[float]]) -> FloatArray:
    """Return the coefficients of the inputs' static curves as one array (s, degree)."""
    padded = np.zeros((len(curves), max(map(len, curves), default=1)))
    for row, curve in zip(padded, curves, strict=True):
        row[: len(curve)] = curve
    return padded


def checked_array(value: ArrayLike, shape: tuple[int, ...], key: str, *path: str | int) -> FloatArray:
    """Return a read-only copy of ``value`` as floats of the given shape; ``path``: its key in a model file.

    Raises
    ------
    PlantError
        It is no array of numbers, has another shape or contains NaN or infinity.
    """
    at = path or (key,)
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise PlantError(f"'{key}' is not a rectangular array of numbers", *at) from error
    if array.shape != shape:
        raise PlantError(f"'{key}' is {_size(array.shape)} but the names make it {_size(shape)}", *at)
    if not np.all(np.isfinite(array)):
        raise PlantError(f"'{key}' holds a number that is not finite", *at)
    array += 0.0  # turns -0.0 into 0.0, so that equal models hash equally
    array.setflags(write=False)
    return array


def _check_names(plant: Plant) -> None:
    if not _NAME.fullmatch(plant.name):
        raise PlantError(f"'name' is '{plant.name}'; use a letter, then letters, digits, _ and -", "name")
    groups = {
        "states": plant.states,
        "inputs": plant.inputs,
        "outputs": plant.outputs,
        "fault": tuple(fault.name for fault in plant.faults),
        "disturbance": tuple(w.name for w in plant.disturbances),
        "noise": tuple(w.name for w in plant.noises),
    }
    for key, names in groups.items():
        for name in names:
            if not isinstance(name, str) or not _NAME.fullmatch(name):
                raise PlantError(f"'{key}' has the name '{name}'; use a letter, then letters, digits, _ and -", key)
            if names.count(name) > 1:
                raise PlantError(f"'{key}' has the name '{name}' twice", key)
    if "default" in plant.states:
        raise PlantError("'states' has the name 'default', which stands for all states in 'error'", "states")
    for key in ("states", "outputs"):
        if not groups[key]:
            raise PlantError(f"'{key}' is empty; a plant needs at least one", key)


def _check_domain(plant: Plant) -> None:
    if plant.domain not in ("continuous", "discrete"):
        raise PlantError(f"'domain' is '{plant.domain}'; use 'continuous' or 'discrete'", "domain")
    if plant.domain == "continuous":
        if plant.rate_hz is not None:
            raise PlantError(
                "'rate_hz' belongs to a discrete model; leave it out or set domain = \"discrete\"", "rate_hz"
            )
        if len(plant.taps) > 1:
            raise PlantError("'taps' are delays in samples and need a discrete model", "taps")
    elif plant.rate_hz is None or not (np.isfinite(plant.rate_hz) and plant.rate_hz > 0.0):
        raise PlantError("'rate_hz' is missing or not positive; a discrete model has a fixed rate", "rate_hz")


def _checked_taps(taps: Iterable[float]) -> tuple[float, ...]:
    values = tuple(float(tap) for tap in taps)
    if not values or not np.all(np.isfinite(values)):
        raise PlantError("'taps' is empty or holds a number that is not finite", "taps")
    if abs(sum(values) - 1.0) > 1e-6:
        raise PlantError(f"'taps' add up to {sum(values):g}; they must add up to 1 (put the gain into B)", "taps")
    return values


def _checked_curves(curves: tuple[tuple[float, ...], ...], inputs: tuple[str, ...]) -> tuple[tuple[float, ...], ...]:
    if not curves:
        return ((1.0,),) * len(inputs)
    if len(curves) != len(inputs):
        raise PlantError(f"'curves' has {len(curves)} entries for {len(inputs)} inputs", "curves")
    values = tuple(tuple(float(x) + 0.0 for x in curve) for curve in curves)
    for name, curve in zip(inputs, values, strict=True):
        if not curve or not np.all(np.isfinite(curve)) or not any(curve):
            raise PlantError(
                f"'curves.{name}' needs finite coefficients of u, u^2, ... and one that is not zero", "curves", name
            )
    return values


def _checked_nonlinearity(g: Nonlinearity, n: int, s: int, index: int) -> Nonlinearity:
    key, path, count = f"nonlinearity '{g.expression}'", ("nonlinearity", index), len(g.arguments)
    if not count:
        raise PlantError(f"{key} has no arguments", *path, "arguments")
    slopes = checked_array(g.slopes, (count, 2), f"{key}: slope", *path, "slope")
    ranges = np.array(g.ranges, dtype=np.float64)
    if ranges.shape != (count, 2) or np.isnan(ranges).any() or np.any(ranges[:, 0] >= ranges[:, 1]):
        raise PlantError(f"{key}: 'range' needs a lower and a higher bound for each argument", *path, "range")
    ranges.setflags(write=False)
    if np.any(slopes[:, 0] > slopes[:, 1]):
        raise PlantError(f"{key}: 'slope' needs the lower bound before the upper one", *path, "slope")
    rates = checked_array(g.rates, (count,), f"{key}: rate", *path, "rate") if np.any(g.rates) else _nothing()
    if np.any(rates < 0.0):
        slowest = np.min(rates)
        raise PlantError(f"{key}: 'rate' holds {slowest:g}; an argument moves at a positive rate", *path, "rate")
    ahead = checked_array(g.ahead, (count, s + 1), f"{key}: ahead", *path) if np.any(g.ahead) else _nothing()
    return replace(
        g,
        rows=checked_array(g.rows, (count, n), f"{key}: arguments", *path, "arguments"),
        slopes=slopes,
        ranges=ranges,
        rates=rates,
        ahead=ahead,
    )


def _checked_fault(fault: Fault, plant: Plant, index: int) -> Fault:
    key, path = f"fault '{fault.name}'", ("fault", index)
    if fault.kind not in ("actuator", "sensor"):
        raise PlantError(f"{key}: 'kind' is '{fault.kind}'; use 'actuator' or 'sensor'", *path, "kind")
    column = fault.column
    if fault.input is not None:
        if fault.kind != "actuator":
            raise PlantError(f"{key}: 'input' belongs to an actuator fault", *path, "input")
        if fault.input not in plant.inputs:
            raise PlantError(
                f"{key}: there is no input '{fault.input}'; there are {', '.join(plant.inputs)}", *path, "input"
            )
        own = plant.B[:, plant.inputs.index(fault.input)]
        if np.size(column) and not np.array_equal(column, own):
            raise PlantError(f"{key}: its column is not that of the input '{fault.input}' in B", *path, "input")
        column = own
    size = len(plant.states) if fault.kind == "actuator" else len(plant.outputs)
    column = checked_array(column, (size,), f"{key}: into", *path, "into")
    if not column.any():
        symbol = "E_f" if fault.kind == "actuator" else "D_f"
        raise PlantError(f"{key}: its direction ({symbol}) is zero: it touches nothing", *path)
    for name, value in (("rate", fault.rate), ("error", fault.error)):
        if not (np.isfinite(value) and value > 0.0):
            raise PlantError(f"{key}: '{name}' is {value}; it must be positive", *path, name)
    reach = (sum(len(g.arguments) for g in plant.nonlinearities),)
    ahead = checked_array(fault.ahead, reach, f"{key}: ahead", *path) if np.any(fault.ahead) else _nothing()
    return replace(fault, column=column, rate=float(fault.rate), error=float(fault.error), ahead=ahead)


def _checked_signal(signal: Signal, size: int, key: str, index: int) -> Signal:
    where, path = f"{key} '{signal.name}'", (key, index)
    if not (np.isfinite(signal.scale) and signal.scale >= 0.0):
        raise PlantError(f"{where}: 'scale' is {signal.scale}; it cannot be negative", *path, "scale")
    column = checked_array(signal.column, (size,), f"{where}: into", *path, "into")
    if not column.any():
        raise PlantError(f"{where}: 'into' is zero: it touches nothing", *path, "into")
    return replace(signal, column=column, scale=float(signal.scale))


def check_independence(plant: Plant) -> None:
    """Refuse faults whose directions depend on each other with a ModelError that names them.

    A plant may have such faults, so that a check can explain them; no observer could distinguish them.
    """
    for symbol, columns, faults in (
        ("E_f", plant.E_f / plant.state_errors[:, None], plant.actuator_faults),
        ("D_f", plant.D_f, plant.sensor_faults),
    ):
        dependent = first_dependent(columns)
        if dependent is not None:
            others = ", ".join(f"'{other.name}'" for other in faults[:dependent])
            raise ModelError(
                f"{plant.name}: fault '{faults[dependent].name}': its direction ({symbol}) is a combination of those "
                f"of {others}: they cannot be told apart; leave one out"
            )


def first_dependent(columns: FloatArray) -> int | None:
    """Return the first column that depends on those before it, for columns in any units; rows are taken as they are."""
    norms = np.linalg.norm(columns, axis=0)
    for i in range(columns.shape[1]):
        unit = columns[:, : i + 1] / norms[: i + 1]
        if i >= len(columns) or np.linalg.svd(unit, compute_uv=False)[-1] < _RANK_TOLERANCE:
            return i
    return None


def _stacked(columns: Iterable[FloatArray], rows: int) -> FloatArray:
    stacked = list(columns)
    return np.column_stack(stacked) if stacked else np.zeros((rows, 0))


def _size(shape: tuple[int, ...]) -> str:
    return " x ".join(str(length) for length in shape) or "one number"
