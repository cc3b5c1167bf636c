"""What residuals say."""

import numpy as np

from gains.identification.residuals import residual_statistics


def test_white_normal_residuals_are_called_so() -> None:
    noise = np.random.default_rng(3).normal(size=(4000, 1))
    (found,) = residual_statistics(["y"], np.split(noise, 4))
    assert found.white
    assert found.note == "white; near normal"


def test_coloured_residuals_are_not() -> None:
    rng = np.random.default_rng(3)
    walk = np.convolve(rng.normal(size=4000), np.ones(5) / 5, mode="valid")[:, None]
    (found,) = residual_statistics(["y"], [walk])
    assert not found.white
    assert found.note.startswith("not white (correlation 0.8")


def test_heavy_tails_are_noted() -> None:
    (found,) = residual_statistics(["y"], [np.random.default_rng(3).standard_t(3, size=(4000, 1))])
    assert "heavy tails" in found.note
