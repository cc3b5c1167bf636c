"""The picture of ``bench/detection.py``: delay against size of the fault, one marker for each detector."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from pathlib import Path

from accounting import Result
from flights import Fault

from monitor.views.palette import BLACK, BLUE, ORANGE, PURPLE, SKY

STYLES = (("X", BLACK), ("o", BLUE), ("s", ORANGE), ("^", PURPLE), ("D", SKY))
_APART_POINTS = 7.0
_FASTEST_S = 0.01
_SLOWEST_S = 200.0
_MISSED_S = 450.0


def draw(results: Sequence[Result], detectors: Sequence[str], path: Path) -> None:
    """Draw the delays of all faults, a panel for each quantity; ramps with their final size and open markers."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.ticker import FuncFormatter, NullLocator
    from matplotlib.transforms import offset_copy

    panels: dict[str, list[tuple[Result, int, Fault]]] = {}
    for result in results:
        for k, fault in enumerate(result.flight.faults):
            panels.setdefault(quantity(fault), []).append((result, k, fault))
    panels = dict(sorted(panels.items(), key=lambda panel: -len(panel[1])))
    widths = [3.0 if len(faults) > 2 else 1.0 for faults in panels.values()]
    figure, axes = plt.subplots(
        1,
        len(panels),
        figsize=(2.4 + 1.75 * sum(widths), 4.8),
        layout="constrained",
        sharey=True,
        squeeze=False,
        width_ratios=widths,
    )
    for axis, (title, faults) in zip(axes[0], panels.items(), strict=True):
        sizes = [size(fault) for _, _, fault in faults]
        for n, (name, (marker, colour)) in enumerate(zip(detectors, STYLES, strict=False)):
            shift = _APART_POINTS * (n - (len(detectors) - 1) / 2)
            beside = offset_copy(axis.transData, figure, x=shift, units="points")
            for place, (result, k, fault) in enumerate(faults):
                delay = result.found[name].verdicts[k].delay_s
                x = float(place) if title == "other" else sizes[place]
                y = _MISSED_S if delay is None else min(max(delay, _FASTEST_S), _SLOWEST_S)
                ramp = fault.truth is not None and fault.truth.ramp_s > 0.0
                face = "none" if ramp else colour
                axis.plot(x, y, marker, color=colour, mfc=face, ms=7, mew=1.4, ls="none", transform=beside)
        axis.set_yscale("log")
        axis.set_ylim(_FASTEST_S, 800.0)
        axis.axhspan(_SLOWEST_S * 1.3, 800.0, color=BLACK, alpha=0.06, lw=0)
        axis.set_xlabel(title)
        places = [float(k) for k in range(len(faults))] if title == "other" else sorted(set(sizes))
        span = max(places) - min(places) or abs(places[0]) or 1.0
        margin = (0.18 if len(faults) > 2 else 0.4) * span
        axis.set_xlim(min(places) - margin, max(places) + margin)
        if title == "other":
            axis.set_xticks(places, [_short(fault) for _, _, fault in faults])
        elif len(places) <= 8:
            axis.set_xticks(places, [f"{place:g}" for place in places])
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    ticks = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, _MISSED_S)
    axes[0, 0].set_yticks(ticks)
    axes[0, 0].yaxis.set_major_formatter(FuncFormatter(lambda y, _: "missed" if y == _MISSED_S else f"{y:g}"))
    axes[0, 0].yaxis.set_minor_locator(NullLocator())
    axes[0, 0].set_ylabel("delay until the alarm (s)")
    handles = [
        mpl.lines.Line2D([], [], marker=marker, color=colour, ls="none", ms=7, label=name)
        for name, (marker, colour) in zip(detectors, STYLES, strict=False)
    ]
    handles.append(mpl.lines.Line2D([], [], marker="o", color=BLACK, mfc="none", ls="none", ms=7, label="open: ramp"))
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _short(fault: Fault) -> str:
    """Return what is at fault, in few letters."""
    return "\n".join(sorted(fault.channels)) or fault.kind.replace("_", "\n")


def quantity(fault: Fault) -> str:
    """Return what the size of a fault is the size of: the label of its panel."""
    if fault.truth is None:
        return "other"
    if fault.truth.unit == "share":
        part = fault.truth.channel.rstrip("0123456789")
        return f"loss of {part} (%)"
    return f"{fault.truth.channel.split('_')[0]} ({fault.truth.unit})"


def size(fault: Fault) -> float:
    """Return the size in the unit of its panel; 0 where it is not known."""
    if fault.truth is None or not isfinite(fault.truth.size):
        return 0.0
    return round(100 * fault.truth.size, 3) if fault.truth.unit == "share" else abs(fault.truth.size)
