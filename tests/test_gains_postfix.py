"""Postfix programs have the values of the expressions that they are made from, on arrays and in compiled loops."""

import math

import numpy as np
from gains_samples import trees
from hypothesis import example, given
from hypothesis import strategies as st

from gains.plants.expression import FUNCTIONS, Node, compile_node, parse_expression
from gains.plants.postfix import evaluate, postfix

SPECIAL = [0.0, -0.0, 1.0, -1.0, 1e-300, 1e300, -1e300, 710.0, math.inf, -math.inf, math.nan]
numbers = st.one_of(st.sampled_from(SPECIAL), st.floats(-5, 5))


@given(tree=trees(), rows=st.lists(st.tuples(numbers, numbers), min_size=1, max_size=10))
@example(tree=parse_expression("atan(1/v)", ("v", "w")), rows=[(0.0, 0.0)])
@example(tree=parse_expression("1/cosh(v)", ("v", "w")), rows=[(1e3, 0.0)])
@example(tree=parse_expression("1/v**0.5", ("v", "w")), rows=[(-1.0, 0.0), (math.inf, 0.0)])
def test_arrays_have_a_value_exactly_where_scalars_have_one(tree: Node, rows: list[tuple[float, float]]) -> None:
    expected = [compile_node(tree)(*row) for row in rows]
    found = np.broadcast_to(evaluate(postfix(tree), np.array(rows).T), len(rows))
    np.testing.assert_array_equal(np.isnan(found), np.isnan(expected))


@given(v=st.floats(-3, 3), name=st.sampled_from(sorted(FUNCTIONS)))
def test_functions_agree_with_the_scalar_ones(v: float, name: str) -> None:
    tree = parse_expression(f"2*{name}(v)-v**2/3", ("v",))
    found = float(evaluate(postfix(tree), [np.array([v])])[0])
    np.testing.assert_allclose(found, compile_node(tree)(v), rtol=1e-13, atol=1e-14)
