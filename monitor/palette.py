"""Colours that people with any colour vision tell apart (Okabe and Ito 2008), and what they stand for."""

from __future__ import annotations

from monitor.event import Severity

BLUE = "#0072B2"
ORANGE = "#E69F00"
GREEN = "#009E73"
PURPLE = "#CC79A7"
SKY = "#56B4E9"
VERMILION = "#D55E00"
BLACK = "#000000"
YELLOW = "#F0E442"
GREY = "#8C8C8C"

SERIES = (BLUE, ORANGE, GREEN, PURPLE, SKY, VERMILION, BLACK, YELLOW)
SEVERITY: dict[Severity, str] = {"warning": ORANGE, "critical": VERMILION}


def series_colour(index: int) -> str:
    """Return the colour of the series with this number; they repeat after eight."""
    return SERIES[index % len(SERIES)]


def rgba(colour: str, alpha: float = 1.0) -> tuple[int, int, int, int]:
    """Return a ``#RRGGBB`` colour as four numbers from 0 to 255."""
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return red, green, blue, round(255 * alpha)
