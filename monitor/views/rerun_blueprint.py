"""How a Rerun viewer opens: a tab per observer with faults, thresholds and residuals, above the alarms."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import rerun.blueprint as rrb
from rerun.blueprint.components import AbsoluteTimeRange
from rerun.encodings import TimeRange, TimeRangeBoundary

from monitor.estimate import Layout
from monitor.views.panels import Panels
from monitor.views.rerun_scene import entity_path

Limits = tuple[float, float]
Root = tuple[str, ...]
Stretch = tuple[int, int]
"""From when to when, nanoseconds on the vehicle's clock."""

FAULTS_BELOW = 4
"""Panels of faults one below the other; more get a second column. Chosen for a laptop's screen."""
LEAST_SHARE = 3
"""Height of the faults' views, of which residuals have 1.5: they are what is looked at."""


def blueprint(
    tabs: Sequence[rrb.Vertical | rrb.Tabs | rrb.Grid],
    roots: Sequence[Root] = ((),),
    *,
    follow: bool = False,
    active: int = 0,
    stretch: Stretch | None = None,
) -> rrb.Blueprint:
    """Return the layout of the viewer: tabs above the states and texts of all alarms.

    ``roots`` are the beginnings of each vehicle's entity paths. The viewer follows the newest Unix time, or shows the
    vehicle's time; ``active`` says which tab is open, ``stretch`` what of the
    vehicle's time is shown first.
    """
    alarms = rrb.Horizontal(
        rrb.StateTimelineView(
            origin="/",
            contents=[f"+ /{entity_path(*root, 'alarms')}/**" for root in roots],
            name="alarms",
            time_view=_axis(stretch),
        ),
        rrb.TextLogView(
            origin="/", contents=[f"+ /{entity_path(*root, 'log')}" for root in roots], name="alarm events"
        ),
        column_shares=[3, 2],
    )
    rows: list[Any] = [rrb.Tabs(*tabs, active_tab=active), alarms] if tabs else [alarms]
    time_panel = (
        rrb.TimePanel(timeline="unix_time", play_state="following", state="collapsed")
        if follow
        else rrb.TimePanel(
            timeline="vehicle_time",
            state="collapsed",
            time_selection=None if stretch is None else AbsoluteTimeRange(*stretch),
        )
    )
    return rrb.Blueprint(
        rrb.Vertical(*rows, row_shares=[4, 1][: len(rows)]),
        time_panel,
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def observer_tab(
    layout: Layout,
    panels: Panels,
    limits: Mapping[int, Limits],
    quiet_limits: Limits | None,
    root: Root = (),
    stretch: Stretch | None = None,
) -> rrb.Vertical:
    """Return an observer's views, one below the other.

    ``limits`` are the ends of the vertical axis by place of the channel, others scale by themselves; ``quiet_limits``
    those of the channels that share a view, in units of their thresholds. ``root`` is the beginning of the entity
    paths, ``stretch`` what of the vehicle's time is shown first.
    """
    base = f"/{entity_path(*root, layout.observer)}"

    def view(name: str, *parts: str, limits: Limits | None = None) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(
            origin=base,
            contents=[f"+ {base}/{part}/**" for part in parts],
            name=f"{layout.observer} / {name}",
            axis_x=_axis(stretch),
            axis_y=None if limits is None else rrb.ScalarAxis(range=limits),
        )

    faults = []
    for place in panels.alone:
        parts = (entity_path(group, layout.faults[place]) for group in ("isolated", "threshold", "span", "truth"))
        faults.append(view(layout.faults[place], *parts, limits=limits.get(place)))
    rows: list[Any] = []
    if faults:
        rows.append(rrb.Grid(*faults, grid_columns=-(-len(faults) // FAULTS_BELOW), name="faults"))
    if panels.together:
        rows.append(view("quiet channels, in units of their thresholds", "quiet", limits=quiet_limits))
    rows.append(view("residuals", "residual"))
    rows.append(rrb.Horizontal(view("inputs", "input"), view("outputs", "output")))
    shares = [max(LEAST_SHARE, min(len(faults), FAULTS_BELOW))] * bool(faults) + [1.5] * (len(rows) - bool(faults))
    return rrb.Vertical(*rows, row_shares=shares, name=layout.observer)


def raw_tab(messages: Iterable[str], root: Root = ()) -> rrb.Grid:
    """Return the tab of the telemetry, a view per message."""
    views = [
        rrb.TimeSeriesView(origin=f"/{entity_path(*root, 'raw', message)}", name=message, axis_x=_axis())
        for message in messages
    ]
    return rrb.Grid(*views, name="raw channels")


def _axis(stretch: Stretch | None = None) -> rrb.TimeAxis:
    """Return an axis of time that all views share, or one that shows a stretch of it first: no shared one can."""
    if stretch is None:
        return rrb.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal)
    return rrb.TimeAxis(view_range=TimeRange(*(TimeRangeBoundary.absolute(nanos=end_ns) for end_ns in stretch)))
