"""Expressions as postfix programs: rows of numbers that array code and compiled loops evaluate alike.

A program is a list of instructions for a stack machine: push a constant, push an argument, or take operands off the
stack and push the result. It has a value exactly where :func:`gains.plants.expression.compile_node` gives one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gains.plants.expression import FUNCTIONS, Apply, Argument, Node, Number

Array = NDArray[np.float64]

NUMBER, ARGUMENT = 0, 1
OPERATIONS = {name: code for code, name in enumerate(("+", "-", "*", "/", "**", *FUNCTIONS), start=2)}
"""Codes of what takes operands off the stack: an operator two, a function one."""

_NAMES = {code: name for name, code in OPERATIONS.items()}
_OPERATORS: dict[str, Callable[[Array, Array], Array]] = {
    "+": np.add,
    "-": np.subtract,
    "*": np.multiply,
    "/": np.divide,
    "**": np.power,
}
_FUNCTIONS: dict[str, Callable[[Array], Array]] = {
    name: getattr(np, {"atan": "arctan"}.get(name, name)) for name in FUNCTIONS
}
# Finite operands can take these beyond every float, or to a pole: an expression has no value there.
_UNBOUNDED = ("sinh", "cosh", "exp", "log")


class Program(NamedTuple):
    """Codes of the instructions (length,) and their operands (length,): a constant or the index of an argument."""

    codes: NDArray[np.int64]
    operands: Array


def postfix(node: Node) -> Program:
    """Return the program of an expression."""
    steps = list(_steps(node))
    return Program(np.array([code for code, _ in steps], dtype=np.int64), np.array([value for _, value in steps]))


def evaluate(program: Program, arguments: Sequence[Array]) -> Array:
    """Return the expression at arrays of arguments of one shape: NaN where it has no value.

    Values differ from those of :mod:`math` in the last bits at most.
    """
    stack: list[Array] = []
    with np.errstate(all="ignore"):
        for code, operand in zip(program.codes.tolist(), program.operands.tolist(), strict=True):
            if code == NUMBER:
                stack.append(np.array(operand))
            elif code == ARGUMENT:
                stack.append(arguments[int(operand)])
            elif (name := _NAMES[code]) in _FUNCTIONS:
                stack.append(_applied(name, stack.pop()))
            else:
                right = stack.pop()
                stack.append(_combined(name, stack.pop(), right))
    return stack.pop()


def _steps(node: Node) -> list[tuple[int, float]]:
    if isinstance(node, Number):
        return [(NUMBER, node.value)]
    if isinstance(node, Argument):
        return [(ARGUMENT, float(node.index))]
    if isinstance(node, Apply):
        return [*_steps(node.operand), (OPERATIONS[node.function], 0.0)]
    return [*_steps(node.left), *_steps(node.right), (OPERATIONS[node.operator], 0.0)]


def _applied(name: str, operand: Array) -> Array:
    value = _FUNCTIONS[name](operand)
    return np.where(np.isinf(value) & np.isfinite(operand), np.nan, value) if name in _UNBOUNDED else value


def _combined(operator: str, left: Array, right: Array) -> Array:
    value = _OPERATORS[operator](left, right)
    if operator == "/":
        return np.where(right == 0.0, np.nan, value)
    return np.where(np.isinf(value) & np.isfinite(left), np.nan, value) if operator == "**" else value
