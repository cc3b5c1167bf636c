"""Slope bounds hold everywhere on the box, are tight, and declared ones are proven or refuted."""

import math

import pytest
from gains_samples import trees
from hypothesis import given, settings
from hypothesis import strategies as st

from adapters.errors import ModelError
from gains.plants.expression import Node, compile_node, parse_expression
from gains.plants.slopes import check_slopes, enclosure, slope_bounds

EVERYWHERE = (-math.inf, math.inf)


@pytest.mark.parametrize(
    ("text", "arguments", "box", "bounds"),
    [
        ("sin(v)", ("v",), [EVERYWHERE], [(-1, 1)]),
        ("tanh(v)", ("v",), [EVERYWHERE], [(0, 1)]),
        ("atan(v)", ("v",), [EVERYWHERE], [(0, 1)]),
        ("abs(v)", ("v",), [EVERYWHERE], [(-1, 1)]),
        ("2*v", ("v",), [EVERYWHERE], [(2, 2)]),
        ("v**2", ("v",), [(-1, 3)], [(-2, 6)]),
        ("v1*v2", ("v1", "v2"), [(-2, 3), (-1, 4)], [(-1, 4), (-2, 3)]),
        ("sqrt(v)", ("v",), [(0.25, 1)], [(0.5, 1)]),
        ("log(v)", ("v",), [(0.5, math.inf)], [(0, 2)]),
        ("v/sqrt(1 + v**2)", ("v",), [(-5, 5)], [(26**-1.5, 1)]),
        ("v/(1 + v**2)", ("v",), [(-10, 10)], [(-0.125, 1)]),
        ("exp(-v**2)", ("v",), [EVERYWHERE], [(-math.sqrt(2 / math.e), math.sqrt(2 / math.e))]),
        ("sin(v)*cos(v)", ("v",), [(-9, 9)], [(-1, 1)]),
        ("tan(v)", ("v",), [(-1, 1)], [(1, 1 + math.tan(1) ** 2)]),
        ("cosh(v) + sinh(v)", ("v",), [(0, 1)], [(1, math.e)]),
        ("3", ("v",), [EVERYWHERE], [(0, 0)]),
    ],
)
def test_slope_bounds_are_derived_and_tight(
    text: str, arguments: tuple[str, ...], box: list[tuple[float, float]], bounds: list[tuple[float, float]]
) -> None:
    for found, expected in zip(slope_bounds(text, arguments, box), bounds, strict=True):
        assert found == pytest.approx(expected, rel=2e-4, abs=2e-4)
        assert found[0] <= expected[0] + 1e-12
        assert found[1] >= expected[1] - 1e-12


@pytest.mark.parametrize(("text", "box"), [("v**2", EVERYWHERE), ("exp(v)", EVERYWHERE), ("sqrt(v)", (0.0, 1.0))])
def test_an_unbounded_slope_asks_for_a_range(text: str, box: tuple[float, float]) -> None:
    with pytest.raises(ModelError, match=r"no bound for v in .*range"):
        slope_bounds(text, ("v",), [box])


@pytest.mark.parametrize(("text", "box"), [("1/v", (-1.0, 1.0)), ("log(v)", (-2.0, -1.0)), ("tan(v)", (0.0, 3.0))])
def test_an_expression_without_a_value_on_its_box_is_refused(text: str, box: tuple[float, float]) -> None:
    with pytest.raises(ModelError, match=r"no value, or a pole"):
        slope_bounds(text, ("v",), [box])


def test_declared_slopes_that_hold_are_accepted() -> None:
    check_slopes("sin(v)", ("v",), [EVERYWHERE], [(-1.0, 1.0)])
    check_slopes("v/(1 + v**2)", ("v",), [(-10.0, 10.0)], [(-0.125, 1.0)])
    check_slopes("v1*v2", ("v1", "v2"), [(-1.0, 1.0)] * 2, [(-1.0, 1.0)] * 2)


def test_a_violated_slope_is_refused_with_the_point_and_the_slope_there() -> None:
    with pytest.raises(ModelError, match=r"with respect to v is 1 at v = 0, above the declared 0\.5"):
        check_slopes("sin(v)", ("v",), [EVERYWHERE], [(-1.0, 0.5)])
    with pytest.raises(ModelError, match=r"with respect to b is -2 at .*b = .*, below the declared -1"):
        check_slopes("a*b", ("a", "b"), [(-2.0, 2.0), (-9.0, 9.0)], [(-9.0, 9.0), (-1.0, 2.0)])


def test_a_slope_that_cannot_be_proven_is_refused_saying_so() -> None:
    with pytest.raises(ModelError, match="could not be proven"):
        check_slopes("v/sqrt(1 + v**2)", ("v",), [EVERYWHERE], [(0.0, 1.0)])


@settings(deadline=None)
@given(trees(), st.lists(st.floats(-3, 3), min_size=2, max_size=2), st.lists(st.floats(0, 2), min_size=2, max_size=2))
def test_an_enclosure_holds_every_value_on_its_box(node: Node, low: list[float], width: list[float]) -> None:
    box = tuple((a, a + w) for a, w in zip(low, width, strict=True))
    try:
        least, largest = enclosure(node, box)
    except ArithmeticError:
        return
    g, tolerance = compile_node(node), 1e-9
    for s in (0.0, 0.3, 0.8, 1.0):
        for t in (0.0, 0.5, 1.0):
            value = g(*(a + part * (b - a) for part, (a, b) in zip((s, t), box, strict=True)))
            if math.isfinite(value):
                assert least - tolerance * (1 + abs(value)) <= value <= largest + tolerance * (1 + abs(value))


def test_an_expression_that_would_take_forever_is_refused() -> None:
    names = tuple("abcdefghijkl")
    text = "sin(" + "*".join(names) + ")"
    with pytest.raises(ModelError, match="too much to bound its slope: use fewer arguments or a simpler expression"):
        slope_bounds(text, names, [EVERYWHERE] * len(names))


def test_arguments_that_an_expression_does_not_depend_on_cost_nothing() -> None:
    names = tuple("abcdefghijklmnopqrst")
    bounds = slope_bounds("sin(a)", names, [EVERYWHERE] * len(names))
    assert bounds[0] == pytest.approx((-1.0, 1.0), abs=1e-4)
    assert set(bounds[1:]) == {(0.0, 0.0)}


def test_an_even_power_beyond_the_largest_number_is_enclosed() -> None:
    least, largest = enclosure(parse_expression("x**2", ["x"]), ((-1e200, -1e199),))
    assert 0.0 < least < math.inf
    assert largest == math.inf
