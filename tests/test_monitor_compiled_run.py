"""Compiled code gives nonlinearities the values that scalars have."""

import math

import numpy as np
import pytest
from gains_samples import trees
from hypothesis import example, given
from hypothesis import strategies as st

from gains.plants.expression import FUNCTIONS, Node, compile_node, parse_expression
from gains.plants.postfix import postfix
from monitor.estimation import compiled_run

SPECIAL = [0.0, -0.0, 1.0, 1e-300, 1e300, -1e300, 710.0, math.inf, -math.inf, math.nan]
numbers = st.one_of(st.sampled_from(SPECIAL), st.floats(-5, 5))


@pytest.fixture(scope="module")
def value():  # noqa: ANN201  # a function of Numba's
    """Return the compiled evaluation of one program."""
    import numba

    compiled_run._compiled()
    evaluated = compiled_run._value

    @numba.njit(error_model="numpy")
    def of(codes: np.ndarray, operands: np.ndarray, nu: np.ndarray) -> float:
        return evaluated(codes, operands, nu, np.zeros(len(codes) + 1))

    return of


@given(tree=trees(), row=st.tuples(numbers, numbers))
@example(tree=parse_expression("atan(1/v)", ("v", "w")), row=(0.0, 0.0))
@example(tree=parse_expression("1/cosh(v)", ("v", "w")), row=(1e3, 0.0))
@example(tree=parse_expression("1/v**0.5", ("v", "w")), row=(-1.0, 0.0))
def test_an_expression_has_a_value_exactly_where_a_scalar_has_one(value, tree: Node, row: tuple[float, float]) -> None:  # noqa: ANN001
    program = postfix(tree)
    found, expected = value(program.codes, program.operands, np.array(row)), compile_node(tree)(*row)
    assert math.isnan(found) == math.isnan(expected)


@given(v=st.floats(-3, 3), name=st.sampled_from(sorted(FUNCTIONS)))
def test_functions_agree_with_the_scalar_ones(value, v: float, name: str) -> None:  # noqa: ANN001
    tree = parse_expression(f"2*{name}(v)-v**2/3", ("v",))
    program = postfix(tree)
    found = value(program.codes, program.operands, np.array([v]))
    np.testing.assert_allclose(found, compile_node(tree)(v), rtol=1e-13, atol=1e-14)
