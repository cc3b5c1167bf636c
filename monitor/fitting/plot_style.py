"""How all plots look: width, resolution, lines and letters."""

from __future__ import annotations

from typing import Any

WIDTH_IN = 8.0
DPI = 160
STYLE: dict[str, Any] = {
    "font.size": 8,
    # names come from outside: a dollar is a dollar
    "text.parse_math": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "lines.linewidth": 0.8,
    "lines.solid_joinstyle": "round",
    "legend.frameon": False,
    "legend.handlelength": 1.5,
    "hatch.linewidth": 0.4,
    "figure.constrained_layout.h_pad": 0.03,
    "figure.constrained_layout.w_pad": 0.08,
}
