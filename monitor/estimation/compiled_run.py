"""Whole arrays through an observer step by step in machine code: the optional path, with Numba.

One loop serves every observer: sizes, matrices and nonlinearities (as programs of :mod:`gains.plants.postfix`) are its
arguments, so it is compiled once on a machine and kept in Numba's cache.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gains.plants.postfix import ARGUMENT, NUMBER, OPERATIONS
from monitor.errors import ExtraMissingError
from monitor.estimation.recursion import Recursion

Array = NDArray[np.float64]

_LINE = 8
"""Numbers in a cache line."""

_ADD, _SUBTRACT, _MULTIPLY, _DIVIDE, _POWER = (OPERATIONS[name] for name in ("+", "-", "*", "/", "**"))
_SIN, _COS, _TAN, _ATAN = (OPERATIONS[name] for name in ("sin", "cos", "tan", "atan"))
_SINH, _COSH, _TANH = (OPERATIONS[name] for name in ("sinh", "cosh", "tanh"))
_EXP, _LOG, _SQRT, _ABS = (OPERATIONS[name] for name in ("exp", "log", "sqrt", "abs"))


class CompiledRun:
    """State of one observer that runs in compiled code.

    Parameters
    ----------
    recursion : Recursion
        Its matrices.

    Attributes
    ----------
    state : NDArray[np.float64]
        s before the next sample (ns,); set it to start anywhere.

    Raises
    ------
    ExtraMissingError
        Numba is not installed.
    """

    def __init__(self, recursion: Recursion) -> None:
        programs = recursion.nonlinearities
        self._advance = _compiled()
        self._step_T = _in_cache_lines(recursion.step.T)
        self._arguments_T = np.ascontiguousarray(recursion.arguments.T)
        self._codes = np.concatenate([np.zeros(0, dtype=np.int64), *(one.codes for one in programs)])
        self._operands = np.concatenate(
            [
                np.zeros(0),
                *(
                    one.operands + np.where(one.codes == ARGUMENT, span.start, 0)
                    for one, span in zip(programs, recursion.spans, strict=True)
                ),
            ]
        )
        self._ends = np.cumsum([len(one.codes) for one in programs], dtype=np.int64)
        self.state = np.zeros(recursion.ns)

    def advance(self, v: Array, y: Array, out: Array) -> None:
        """Take N samples, v (N, s) and y (N, p), and write the estimates into ``out`` (N, n + a + p)."""
        state = np.array(self.state, dtype=np.float64)
        # One kind of array only (contiguous, writable): for any other the loop would be compiled again.
        v, y = np.require(v, np.float64, ["C", "W"]), np.require(y, np.float64, ["C", "W"])
        self._advance(self._step_T, self._arguments_T, self._codes, self._operands, self._ends, state, v, y, out)
        self.state = state


def _in_cache_lines(matrix: Array) -> Array:
    """Return a matrix whose rows begin with cache lines, filled up with zeros: loads across two cost a quarter more."""
    rows, columns = matrix.shape
    wide = -(-columns // _LINE) * _LINE
    memory = np.zeros(rows * wide + _LINE)
    start = -memory.ctypes.data % (8 * _LINE) // 8
    lines = memory[start : start + rows * wide].reshape(rows, wide)
    lines[:, :columns] = matrix
    return lines


@cache
def _compiled() -> Callable[..., None]:
    try:
        import numba
    except ImportError as error:
        raise ExtraMissingError(
            "the compiled path needs Numba, which is not installed: pip install 'fauio[fast]'"
        ) from error
    # Products may be fused with the sum they go into: that rounds once less, and keeps what is not a number.
    options: dict[str, Any] = {"error_model": "numpy", "nogil": True, "fastmath": {"contract"}}
    numba.extending.register_jitable(**options)(_value)
    try:
        compiled: Callable[..., None] = numba.njit(cache=True, **options)(_advance)
    except RuntimeError:
        # No directory takes the cache (a read-only installation without a home): compile anew in each process.
        compiled = numba.njit(**options)(_advance)
    return compiled


def _advance(
    step_T: Array,
    arguments_T: Array,
    codes: NDArray[np.int64],
    operands: Array,
    ends: NDArray[np.int64],
    state: Array,
    v: Array,
    y: Array,
    out: Array,
) -> None:
    ns, s, p, m = len(state), v.shape[1], y.shape[1], len(ends)
    columns, rows = step_T.shape
    nw = s + p + 1
    z, total = np.zeros(columns), np.zeros(rows)
    nu, stack = np.zeros(arguments_T.shape[1]), np.zeros(len(codes) + 1)
    z[:ns] = state
    z[ns + nw - 1] = 1.0
    for k in range(len(v)):
        for j in range(s):
            z[ns + j] = v[k, j]
        for j in range(p):
            z[ns + s + j] = y[k, j]
        if m:
            nu[:] = 0.0
            for j in range(ns + nw):
                for i in range(len(nu)):
                    nu[i] += arguments_T[j, i] * z[j]
            begin = 0
            for i in range(m):
                z[ns + nw + i] = _value(codes[begin : ends[i]], operands[begin : ends[i]], nu, stack)
                begin = ends[i]
        total[:] = 0.0
        for j in range(0, columns - 3, 4):
            a, b, c, d = z[j], z[j + 1], z[j + 2], z[j + 3]
            for i in range(rows):
                total[i] += step_T[j, i] * a + step_T[j + 1, i] * b + (step_T[j + 2, i] * c + step_T[j + 3, i] * d)
        for j in range(columns - columns % 4, columns):
            for i in range(rows):
                total[i] += step_T[j, i] * z[j]
        for i in range(ns):
            z[i] = total[i]
        for i in range(out.shape[1]):
            out[k, i] = total[ns + i]
    state[:] = z[:ns]


def _value(codes: NDArray[np.int64], operands: Array, nu: Array, stack: Array) -> float:
    """Evaluate a program of :mod:`gains.plants.postfix`: NaN where it has no value."""
    top = -1
    for at in range(len(codes)):
        code = codes[at]
        if code in (NUMBER, ARGUMENT):
            top += 1
            stack[top] = operands[at] if code == NUMBER else nu[int(operands[at])]
            continue
        right = stack[top]
        if code <= _POWER:
            top -= 1
        x = stack[top]
        value = math.nan
        if code == _SIN:
            value = math.sin(x)
        elif code == _COS:
            value = math.cos(x)
        elif code == _ADD:
            value = x + right
        elif code == _SUBTRACT:
            value = x - right
        elif code == _MULTIPLY:
            value = x * right
        elif code == _DIVIDE:
            if right != 0.0:
                value = x / right
        elif code == _ABS:
            value = abs(x)
        elif code == _TAN:
            value = math.tan(x)
        elif code == _ATAN:
            value = math.atan(x)
        elif code == _TANH:
            value = math.tanh(x)
        elif code == _SQRT:
            if x >= 0.0:
                value = math.sqrt(x)
        else:
            if code == _POWER:
                value = math.pow(x, right)
            elif code == _EXP:
                value = math.exp(x)
            elif code == _SINH:
                value = math.sinh(x)
            elif code == _COSH:
                value = math.cosh(x)
            elif code == _LOG and x > 0.0:
                value = math.log(x)
            if math.isinf(value) and math.isfinite(x):
                value = math.nan
        stack[top] = value
    return float(stack[0])
