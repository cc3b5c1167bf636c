"""Colours that people with any colour vision tell apart (Okabe and Ito 2008), and their meanings."""

from collections.abc import Mapping
from dataclasses import dataclass

from monitor.event import Severity

BLUE = "#0072B2"
ORANGE = "#E69F00"
GREEN = "#009E73"
PURPLE = "#CC79A7"
SKY = "#56B4E9"
VERMILION = "#D55E00"
BLACK = "#000000"
WHITE = "#FFFFFF"
YELLOW = "#F0E442"
GREY = "#8C8C8C"

SERIES = (BLUE, ORANGE, GREEN, PURPLE, SKY, VERMILION, BLACK, YELLOW)
SEVERITY: dict[Severity, str] = {"warning": ORANGE, "critical": VERMILION}
ANY_GROUND = (BLUE, ORANGE, GREEN, PURPLE, SKY, VERMILION)
"""The colours that are readable on white and on black, for viewers that choose their own background."""


@dataclass(frozen=True, slots=True)
class Theme:
    """The same colours for a light and a dark background; the k-th colour has the same meaning in both."""

    paper: str  # the ground
    ink: str  # text and axes; measurements and commands, and dashed known true sizes
    muted: str  # lines in the background, the band between the thresholds
    series: tuple[str, ...]  # series by number; the first is an estimate, the third a residual
    severity: Mapping[Severity, str]

    @property
    def estimate(self) -> str:
        """Colour of estimates."""
        return self.series[0]

    @property
    def residual(self) -> str:
        """Colour of residuals."""
        return self.series[2]


LIGHT = Theme(WHITE, BLACK, GREY, SERIES, SEVERITY)
DARK = Theme(
    paper="#15181C",
    ink="#E8EAED",
    muted="#9AA0A6",
    series=(SKY, ORANGE, "#1FBF92", PURPLE, "#2E86C8", "#F0742B", "#E8EAED", YELLOW),
    severity={"warning": ORANGE, "critical": "#F0742B"},
)


def any_ground_colour(index: int) -> str:
    """Return the colour of the ``index``-th series on an unknown background; they repeat after six."""
    return ANY_GROUND[index % len(ANY_GROUND)]


def rgba(colour: str, alpha: float = 1.0) -> tuple[int, int, int, int]:
    """Return a ``#RRGGBB`` colour as four numbers from 0 to 255."""
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return red, green, blue, round(255 * alpha)
