"""Nonlinearities written as text: parsed against a whitelist, compiled to closures, differentiated.

The text becomes a tree of four kinds of nodes; nothing of it is ever evaluated by Python itself.
"""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import add, mul, sub, truediv
from typing import Any

from adapters.errors import ModelError

_LONGEST = 300
"""Largest number of letters. Physics needs tens; this bounds the work of Python's parser."""
_CHARACTERS = re.compile(r"[A-Za-z0-9_+\-*/(). ]*")
_DEEPEST = 40
"""Deepest nesting. The recursions over trees stay far from the interpreter's limit."""
_OPERATORS: dict[type[ast.operator], str] = {
    ast.Add: "+",
    ast.Sub: "-",
    ast.Mult: "*",
    ast.Div: "/",
    ast.Pow: "**",
}
_CONSTANTS = {"pi": math.pi}


@dataclass(frozen=True, slots=True)
class Number:
    """A constant."""

    value: float


@dataclass(frozen=True, slots=True)
class Argument:
    """The argument nu_j with index j."""

    index: int


@dataclass(frozen=True, slots=True)
class Apply:
    """A function of one operand."""

    function: str
    operand: Node


@dataclass(frozen=True, slots=True)
class Binary:
    """``left operator right``; the right side of ``**`` is always a Number."""

    operator: str
    left: Node
    right: Node


Node = Number | Argument | Apply | Binary

FUNCTIONS: dict[str, Callable[[float], float]] = {
    "sin": math.sin,
    "cos": math.cos,
    "tan": math.tan,
    "sinh": math.sinh,
    "cosh": math.cosh,
    "tanh": math.tanh,
    "atan": math.atan,
    "exp": math.exp,
    "log": math.log,
    "sqrt": math.sqrt,
    "abs": abs,
}
_SCALAR_FUNCTIONS = {**FUNCTIONS, "sign": lambda value: math.copysign(1.0, value) if value else 0.0}
_SCALAR_OPERATORS = {"+": add, "-": sub, "*": mul, "/": truediv, "**": math.pow}


def parse_expression(text: str, arguments: Sequence[str]) -> Node:
    """Return the tree of an expression.

    It consists of numbers, the names of its arguments, ``pi``, ``+ - * / **``, brackets and :data:`FUNCTIONS`.

    Raises
    ------
    ModelError
        It contains anything else; the message names that.
    """
    for name in arguments:
        if not name.isidentifier() or name in FUNCTIONS or name in _CONSTANTS:
            raise ModelError(f"'{name}' cannot be the name of an argument")
    if len(text) > _LONGEST:
        raise ModelError(f"the expression is longer than {_LONGEST} characters")
    if not _CHARACTERS.fullmatch(text):
        raise ModelError(f"{text!r} holds characters that no expression has")
    try:
        tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise ModelError(f"'{text}' is not an expression") from error
    return _convert(tree, text, list(arguments), _DEEPEST)


def compile_expression(text: str, arguments: Sequence[str]) -> Callable[..., float]:
    """Return :func:`compile_node` of the tree of an expression."""
    return compile_node(parse_expression(text, arguments))


def compile_node(node: Node) -> Callable[..., float]:
    """Return the tree as a function of scalars: NaN if it has no value, never an exception."""
    scalar = closure(node, _SCALAR_FUNCTIONS, _SCALAR_OPERATORS)

    def function(*values: float) -> float:
        try:
            return float(scalar(values))
        except (ArithmeticError, ValueError):
            return math.nan

    return function


def closure(
    node: Node, functions: Mapping[str, Callable[[Any], Any]], operators: Mapping[str, Callable[[Any, Any], Any]]
) -> Callable[[Sequence[Any]], Any]:
    """Return the tree as a function of its arguments, numbers or arrays as the functions and operators accept."""
    if isinstance(node, Number):
        value = node.value
        return lambda values: value
    if isinstance(node, Argument):
        index = node.index
        return lambda values: values[index]
    if isinstance(node, Apply):
        operand, function = closure(node.operand, functions, operators), functions[node.function]
        return lambda values: function(operand(values))
    left, right = (closure(side, functions, operators) for side in (node.left, node.right))
    operator = operators[node.operator]
    return lambda values: operator(left(values), right(values))


def derivative(node: Node, index: int) -> Node:
    """Return the partial derivative of the tree with respect to argument ``index``."""
    if isinstance(node, Number):
        return Number(0.0)
    if isinstance(node, Argument):
        return Number(float(node.index == index))
    if isinstance(node, Apply):
        return binary("*", _outer_derivative(node), derivative(node.operand, index))
    left, right = node.left, node.right
    if node.operator == "**":
        exponent = _number(right)
        outer = binary("*", Number(exponent), binary("**", left, Number(exponent - 1.0)))
        return binary("*", outer, derivative(left, index))
    d_left, d_right = derivative(left, index), derivative(right, index)
    if node.operator in "+-":
        return binary(node.operator, d_left, d_right)
    if node.operator == "*":
        return binary("+", binary("*", d_left, right), binary("*", left, d_right))
    quotient = binary("/", binary("*", left, d_right), binary("**", right, Number(2.0)))
    return binary("-", binary("/", d_left, right), quotient)


def binary(operator: str, left: Node, right: Node) -> Node:
    """Return ``left operator right`` with constants folded, so that constant slopes are recognised."""
    if isinstance(left, Number) and isinstance(right, Number):
        folded = compile_node(Binary(operator, left, right))()
        if math.isfinite(folded):
            return Number(folded)
    if operator == "*" and Number(0.0) in (left, right):
        return Number(0.0)
    if operator in "/" and left == Number(0.0):
        return left
    if operator in "+-" and right == Number(0.0):
        return left
    if operator == "+" and left == Number(0.0):
        return right
    if operator in ("*", "/", "**") and right == Number(1.0):
        return left
    if operator == "*" and left == Number(1.0):
        return right
    if operator == "**" and right == Number(0.0):
        return Number(1.0)
    if operator == "*" and left == right:
        return Binary("**", left, Number(2.0))
    return Binary(operator, left, right)


def argument_indices(node: Node) -> frozenset[int]:
    """Return the indices of the arguments that the tree depends on."""
    if isinstance(node, Argument):
        return frozenset({node.index})
    if isinstance(node, Apply):
        return argument_indices(node.operand)
    if isinstance(node, Binary):
        return argument_indices(node.left) | argument_indices(node.right)
    return frozenset()


def is_smooth(node: Node) -> bool:
    """Return whether the tree has a second derivative wherever it has a value."""
    if isinstance(node, Apply):
        return node.function not in ("abs", "sign") and is_smooth(node.operand)
    return not isinstance(node, Binary) or (is_smooth(node.left) and is_smooth(node.right))


def _convert(tree: ast.expr, text: str, arguments: list[str], depth: int) -> Node:
    if depth == 0:
        raise ModelError(f"'{text}' is nested too deeply")
    if isinstance(tree, ast.Constant) and isinstance(tree.value, int | float) and not isinstance(tree.value, bool):
        return Number(_finite(tree.value, text))
    if isinstance(tree, ast.Name):
        if tree.id in arguments:
            return Argument(arguments.index(tree.id))
        if tree.id in _CONSTANTS:
            return Number(_CONSTANTS[tree.id])
        raise ModelError(f"'{text}' has the unknown name '{tree.id}'; its arguments are {', '.join(arguments)}")
    if isinstance(tree, ast.UnaryOp) and isinstance(tree.op, ast.USub | ast.UAdd):
        operand = _convert(tree.operand, text, arguments, depth - 1)
        return operand if isinstance(tree.op, ast.UAdd) else binary("*", Number(-1.0), operand)
    if isinstance(tree, ast.BinOp) and type(tree.op) in _OPERATORS:
        left = _convert(tree.left, text, arguments, depth - 1)
        right = _convert(tree.right, text, arguments, depth - 1)
        if isinstance(tree.op, ast.Pow) and not isinstance(right, Number):
            raise ModelError(f"'{text}' has an exponent that is no number; write exp(...) instead")
        node = binary(_OPERATORS[type(tree.op)], left, right)
        if isinstance(left, Number) and isinstance(right, Number):
            return Number(_finite(compile_node(node)(), text))
        return node
    if isinstance(tree, ast.Call):
        return _convert_call(tree, text, arguments, depth)
    part = ast.get_source_segment(text.strip(), tree) or text
    raise ModelError(f"'{text}' holds '{part}', which is not allowed in an expression")


def _convert_call(tree: ast.Call, text: str, arguments: list[str], depth: int) -> Node:
    name = tree.func.id if isinstance(tree.func, ast.Name) else None
    if name not in FUNCTIONS or tree.keywords or len(tree.args) != 1:
        raise ModelError(f"'{text}' calls something else than one of {', '.join(FUNCTIONS)} with one operand")
    node = Apply(name, _convert(tree.args[0], text, arguments, depth - 1))
    return Number(_finite(compile_node(node)(), text)) if isinstance(node.operand, Number) else node


def _finite(value: float, text: str) -> float:
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ModelError(f"'{text}' holds a constant that is not finite")
    return number


def _outer_derivative(node: Apply) -> Node:
    u = node.operand
    one, two = Number(1.0), Number(2.0)
    outer: dict[str, Callable[[], Node]] = {
        "sin": lambda: Apply("cos", u),
        "cos": lambda: binary("*", Number(-1.0), Apply("sin", u)),
        "tan": lambda: binary("+", one, Binary("**", node, two)),
        "sinh": lambda: Apply("cosh", u),
        "cosh": lambda: Apply("sinh", u),
        "tanh": lambda: binary("-", one, Binary("**", node, two)),
        "atan": lambda: binary("/", one, binary("+", one, binary("**", u, two))),
        "exp": lambda: node,
        "log": lambda: binary("/", one, u),
        "sqrt": lambda: binary("/", Number(0.5), node),
        "abs": lambda: Apply("sign", u),
    }
    return outer[node.function]()


def _number(node: Node) -> float:
    if not isinstance(node, Number):
        raise TypeError("the exponent of a power is a Number")
    return node.value
