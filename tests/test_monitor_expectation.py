"""The plant of observers that compare measurements with what is expected of them."""

from __future__ import annotations

import numpy as np

from gains.synthesis.blocks import design_blocks
from gains.synthesis.certificate import certify
from gains.synthesis.compilation import compile_gains
from monitor.estimation.affine import AffineObserver
from monitor.fitting.expectation import Expectation, expectation_plant


def test_each_fault_shows_in_its_own_measurement() -> None:
    expected = [Expectation(f"line{n}", 0.1, f"fault{n}", "m", 0.5, 1.0, 1.0) for n in (1, 2)]
    plant = expectation_plant("any", 10.0, ("a", "b"), expected)
    design = design_blocks(plant)
    gains = compile_gains(plant, design, certify(plant, design))
    u = np.ones((200, 2))
    y = u + np.where(np.arange(200)[:, None] >= 100, [2.0, 0.0], 0.0)
    found = AffineObserver([gains]).run(u, y).fault
    np.testing.assert_allclose(found[99], 0.0, atol=1e-6)
    np.testing.assert_allclose(found[-1], [2.0, 0.0], atol=0.01)
