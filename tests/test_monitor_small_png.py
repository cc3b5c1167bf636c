"""Palettes of pictures: the commonest colours to the bit, the others as the nearest of them."""

from __future__ import annotations

import numpy as np

from monitor.fitting.small_png import COLOURS, to_palette


def test_few_colours_are_kept_to_the_bit() -> None:
    picture = np.random.default_rng(1).choice(np.array([0, 86, 255], np.uint8), (40, 30, 3))
    places, palette = to_palette(picture)
    assert (palette[places] == picture).all()


def test_of_many_the_commonest_are_kept_and_the_others_are_near() -> None:
    picture = np.full((100, 100, 3), (0, 114, 178), np.uint8)
    picture[:20, :, :] = np.random.default_rng(2).integers(0, 256, (20, 100, 3))
    places, palette = to_palette(picture)
    assert len(palette) == COLOURS
    assert (palette[places][20:] == picture[20:]).all()
    assert np.abs(palette[places].astype(int) - picture).mean() < 10
