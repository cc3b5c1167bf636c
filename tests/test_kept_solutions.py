"""A solution that is kept is the one that the solver found, and is given for nothing but the same inequality."""

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gains_samples import random_plant
from kept_solutions import digest, kept_solutions

from gains.analysis.augment import augment, error_model
from gains.synthesis.bounded_real import Demands, Solution, inequality, solve_bounded_real
from gains.synthesis.conditioning import kalman_coordinates


def test_a_kept_solution_is_the_solvers_to_the_bit_and_no_other_inequality_has_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant = random_plant(32, 1, 1)
    model = error_model(plant, augment(plant), 1)
    problem = inequality(model, kalman_coordinates(model), Demands(1e-3))
    solve = kept_solutions(tmp_path)
    expected, _ = solve_bounded_real(problem)
    first, _ = solve(problem, None)
    calls = []

    def unsolved(*given: object) -> tuple[None, float]:
        calls.append(given)
        return None, 0.0

    monkeypatch.setattr("kept_solutions.solve_bounded_real", unsolved)
    again, _ = solve(replace(problem, name="of another name"), None)
    assert calls == []
    for field in fields(Solution):
        found = [np.asarray(getattr(one, field.name)) for one in (expected, first, again)]
        assert found[0].tobytes() == found[1].tobytes() == found[2].tobytes()
    others = (
        (replace(problem, A=np.nextafter(problem.A, np.inf)), None),
        (replace(problem, asked=Demands(1e-4)), None),
        (problem, (1.0, 0.0)),
    )
    for other, fixed in others:
        assert solve(other, fixed) == (None, 0.0)
    assert len(calls) == len(others)


def test_what_differs_in_type_shape_or_place_differs() -> None:
    values: list[list[Any]] = [
        [np.zeros(4)], [np.zeros((2, 2))], [np.zeros(4, np.float32)], [np.zeros(2), np.zeros(2)],
        [None], [0.0], [0], ["0"], [[0], 0], [0, [0]], [{"a": 0}], [{"b": 0}],
    ]  # fmt: skip
    assert len({digest(*one) for one in values}) == len(values)
