"""A drawn figure as a small PNG: its 256 commonest colours, all others as the nearest of them."""

from __future__ import annotations

import io
import os
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from adapters.output_file import write_file

if TYPE_CHECKING:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

COLOURS = 256


def save_small(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Write a figure with a canvas of Agg as a PNG with a palette: a third of the size, no difference to the eye.

    Large areas and lines keep their colours to the bit; what moves are shades at the edges of lines.
    """
    from PIL import Image

    canvas = cast("FigureCanvasAgg", figure.canvas)
    canvas.draw()
    places, palette = to_palette(np.asarray(canvas.buffer_rgba())[:, :, :3])
    picture = Image.fromarray(places)
    picture.putpalette(palette.tobytes())
    dpi = float(figure.dpi)
    encoded = io.BytesIO()
    picture.save(encoded, format="PNG", optimize=True, dpi=(dpi, dpi))
    write_file(path, encoded.getvalue())


def to_palette(picture: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return each pixel's place in a palette (height, width) and the palette (at most 256, 3).

    Parameters
    ----------
    picture : NDArray[np.uint8]
        Red, green and blue (height, width, 3).
    """
    wide = picture.astype(np.uint32)
    packed = wide[:, :, 0] << 16 | wide[:, :, 1] << 8 | wide[:, :, 2]
    colours, inverse, counts = np.unique(packed, return_inverse=True, return_counts=True)
    rgb = np.stack((colours >> 16, colours >> 8 & 255, colours & 255), axis=1).astype(np.float32)
    kept = np.sort(np.argsort(-counts, kind="stable")[:COLOURS])
    squares = (rgb[kept] ** 2).sum(axis=1)
    nearest = np.argmin(squares - 2.0 * rgb @ rgb[kept].T, axis=1)
    return nearest[inverse].reshape(packed.shape).astype(np.uint8), rgb[kept].astype(np.uint8)
