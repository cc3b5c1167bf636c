"""Expressions are parsed against a whitelist, compiled to safe scalar functions and differentiated."""

import math

import pytest
from gains_samples import trees
from hypothesis import given, settings
from hypothesis import strategies as st

from adapters.errors import ModelError
from gains.plants.expression import (
    FUNCTIONS,
    Apply,
    Argument,
    Node,
    Number,
    compile_expression,
    compile_node,
    derivative,
    parse_expression,
)

ARGUMENTS = ("a", "b")


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("sin(a)", math.sin(0.5)),
        ("a*b", 1.0),
        ("-a + +b", 1.5),
        ("a/sqrt(1 + a**2)", 0.5 / math.sqrt(1.25)),
        ("2*pi", 2 * math.pi),
        ("(a - b)**3", -3.375),
        ("abs(-a)", 0.5),
        ("1e-3*exp(b)", 1e-3 * math.exp(2)),
    ],
)
def test_an_expression_has_the_value_of_its_text(text: str, value: float) -> None:
    assert compile_expression(text, ARGUMENTS)(0.5, 2.0) == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_function_of_the_whitelist_can_be_differentiated(name: str) -> None:
    node = parse_expression(f"{name}(a)", ("a",))
    g, slope, at, h = compile_node(node), compile_node(derivative(node, 0)), 0.7, 1e-6
    assert slope(at) == pytest.approx((g(at + h) - g(at - h)) / (2 * h), rel=1e-7)


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os')",
        "a.real",
        "lambda: a",
        "a if b else a",
        "[a for a in b]",
        "a**b",
        "sin(a, b)",
        "sin(v=a)",
        "open(a)",
        "'a'",
        "1e999",
        "10**400",
        "a[0]",
        "a and b",
        "a < b",
        "1j",
        "True",
        "a @ b",
        "a // b",
        "c",
        "sin",
        "sign(a)",
        "exp(1000)",
        "",
        "a +",
        "a\n+ b",
        "-" * 250 + "a",
        "abs(" * 50 + "a" + ")" * 50,
        "a + " * 100 + "a",
    ],
)
def test_what_is_no_expression_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(ModelError) as caught:
        compile_expression(text, ARGUMENTS)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["sin", "pi", "1a", "a b", ""])
def test_an_argument_needs_a_name_of_its_own(name: str) -> None:
    with pytest.raises(ModelError, match="cannot be the name"):
        compile_expression("1", (name,))


@pytest.mark.parametrize(
    ("text", "at"), [("sqrt(a)", -1.0), ("log(a)", 0.0), ("1/a", 0.0), ("exp(a)", 1e4), ("a**0.5", -1.0)]
)
def test_outside_its_domain_an_expression_is_nan_and_never_raises(text: str, at: float) -> None:
    assert math.isnan(compile_expression(text, ("a",))(at))


def test_constant_slopes_are_folded_to_numbers() -> None:
    assert derivative(parse_expression("2*a + b/4 - 3", ARGUMENTS), 0) == Number(2.0)
    assert derivative(parse_expression("2*a + b/4 - 3", ARGUMENTS), 1) == Number(0.25)
    assert derivative(parse_expression("sin(b)", ARGUMENTS), 0) == Number(0.0)


LARGEST = 1e4


def dual(node: Node, point: tuple[float, ...], index: int) -> tuple[float, float]:
    """Return value and derivative by the chain rule on numbers, an error where either grows too large to compare."""
    if isinstance(node, Number):
        return node.value, 0.0
    if isinstance(node, Argument):
        return point[node.index], float(node.index == index)
    if isinstance(node, Apply):
        x, dx = dual(node.operand, point, index)
        slopes = {
            "sin": math.cos,
            "cos": lambda t: -math.sin(t),
            "tanh": lambda t: 1 - math.tanh(t) ** 2,
            "atan": lambda t: 1 / (1 + t * t),
            "exp": math.exp,
            "sqrt": lambda t: 0.5 / math.sqrt(t),
            "log": lambda t: 1 / t,
        }
        value, slope = FUNCTIONS[node.function](x), slopes[node.function](x) * dx
    else:
        (x, dx), (y, dy) = dual(node.left, point, index), dual(node.right, point, index)
        value, slope = {
            "+": lambda: (x + y, dx + dy),
            "-": lambda: (x - y, dx - dy),
            "*": lambda: (x * y, dx * y + x * dy),
            "/": lambda: (x / y, (dx * y - x * dy) / y**2),
            "**": lambda: (math.pow(x, y), y * math.pow(x, y - 1) * dx),
        }[node.operator]()
    if not (1 / LARGEST < abs(value) < LARGEST and abs(slope) < LARGEST):
        raise OverflowError
    return value, slope


@settings(deadline=None)
@given(trees(), st.integers(-200, 200), st.integers(-200, 200), st.integers(0, 1))
def test_derivatives_agree_with_the_chain_rule_on_numbers(node: Node, a: int, b: int, index: int) -> None:
    try:
        value, slope = dual(node, (a / 100, b / 100), index)
    except (ArithmeticError, ValueError):
        return
    assert compile_node(node)(a / 100, b / 100) == pytest.approx(value, rel=1e-6, abs=1e-6)
    assert compile_node(derivative(node, index))(a / 100, b / 100) == pytest.approx(slope, rel=1e-4, abs=1e-4)
