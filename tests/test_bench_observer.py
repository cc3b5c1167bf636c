"""What the benchmark compares is the same recursion."""

import sys
from pathlib import Path

import numpy as np
import pytest

from monitor.estimation.affine import AffineObserver

sys.path.insert(0, str(Path(__file__).parents[1] / "bench"))
from observer_cases import arm_case, in_c, joined, linear_case, textbook


@pytest.mark.parametrize("make", [arm_case, linear_case])
def test_textbook_and_c_give_what_the_live_observer_gives(make, tmp_path: Path) -> None:  # noqa: ANN001
    case = make(300)
    expected = joined(AffineObserver([case.gains]).run(case.u, case.y))
    for run in (textbook(case), in_c(case, tmp_path)):
        if run is None:
            continue
        for ours, theirs in zip(run(case.u, case.y), expected, strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=1e-10 * np.abs(theirs).max())
