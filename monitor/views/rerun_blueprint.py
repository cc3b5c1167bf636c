"""The layout of a Rerun viewer: a tab per observer with faults, thresholds and residuals, above the alarms."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.components import AbsoluteTimeRange
from rerun.encodings import TimeRange, TimeRangeBoundary

from monitor.estimate import Layout
from monitor.recording.foxglove_records import EARTH_M
from monitor.views.panels import Panels
from monitor.views.rerun_scene import entity_path
from monitor.views.way import Way

Limits = tuple[float, float]
Root = tuple[str, ...]
Stretch = tuple[int, int]
"""Begin and end of a time range, nanoseconds on the vehicle's clock."""

_TILE_PX = 256.0
"""Pixels of a map tile; one shows the world at zoom 0 (https://wiki.openstreetmap.org/wiki/Zoom_levels)."""
_MAP_PX = 250.0
"""Assumed size of the map's view, pixels. Chosen: on a laptop's screen the view is some 400 wide and 300 high."""
_MOST_ZOOM = 19.0
"""Largest zoom: tiles of OpenStreetMap exist up to it."""
_LEAST_M = 20.0
"""Least size of the way for the zoom, metres. Chosen: a hover drawn larger would show the receiver's noise as a way."""
FAULTS_BELOW = 4
"""Panels of faults below each other; more get a second column. Chosen for a laptop's screen."""
LEAST_SHARE = 3
"""Height of the faults' views, relative to 2 for all others: people look at them most."""


def blueprint(
    tabs: Sequence[rrb.Vertical | rrb.Tabs | rrb.Grid],
    roots: Sequence[Root] = ((),),
    *,
    follow: bool = False,
    active: int = 0,
    stretch: Stretch | None = None,
    way: Way | None = None,
) -> rrb.Blueprint:
    """Return the layout of the viewer: tabs, beside them the ``way`` if there is one, above states and texts of alarms.

    ``roots`` are the beginnings of each vehicle's entity paths. The viewer follows the newest Unix time, or shows the
    vehicle's time; ``active`` is the number of the open tab, ``stretch`` the part of the vehicle's time that is shown
    first.
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
    views: Any = rrb.Tabs(*tabs, active_tab=active)
    if way is not None:
        views = rrb.Horizontal(views, _way_views(way), column_shares=[2, 1])
    rows: list[Any] = [views, alarms] if tabs else [alarms]
    time_panel = (
        rrb.TimePanel(timeline="unix_time", play_state="following", state="collapsed")
        if follow
        else rrb.TimePanel(
            timeline="vehicle_time",
            state="collapsed",
            # the viewer's blueprint has no cursor (rerun-sdk 0.41): the viewer opens at the begin of the recording
            play_state=None if stretch is None else "paused",
            time_selection=None if stretch is None else AbsoluteTimeRange(*stretch),
            loop_mode=None if stretch is None else "selection",
        )
    )
    return rrb.Blueprint(
        rrb.Vertical(*rows, row_shares=[4, 1][: len(rows)]),
        time_panel,
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def _way_views(way: Way) -> rrb.Vertical:
    """Return the map, and the way in space with the vehicle's pose."""
    extent_m = max(float(np.ptp(way.metres(way.places)[:, :2], axis=0).max()), _LEAST_M)
    around_m = 2.0 * math.pi * EARTH_M * math.cos(math.radians(way.places[0, 0]))
    zoom = math.log2(_MAP_PX / _TILE_PX * around_m / extent_m)
    return rrb.Vertical(
        rrb.MapView(origin="/map", zoom=min(zoom, _MOST_ZOOM), name="map: GPS red, by the estimates blue"),
        rrb.Spatial3DView(origin="/space", name="attitude and track, east, north, up (m)"),
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

    ``limits`` are the ends of the vertical axis by index of the channel, others scale by themselves; ``quiet_limits``
    those of the channels that share a view, in units of their thresholds. ``root`` is the beginning of the entity
    paths, ``stretch`` the part of the vehicle's time that is shown first.
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

    def each(name: str, part: str, columns: Sequence[str]) -> rrb.Grid:
        """Return a view for each series of an entity, as their units differ."""
        path = f"{base}/{part}"
        views = [
            rrb.TimeSeriesView(
                origin=base,
                contents=[f"+ {path}"],
                name=column,
                axis_x=_axis(stretch),
                overrides={path: rr.SeriesLines.from_fields(visible_series=[other is column for other in columns])},
            )
            for column in columns
        ]
        return rrb.Grid(*views, name=f"{layout.observer} / {name}")

    faults = []
    for place in panels.alone:
        parts = (entity_path(group, layout.faults[place]) for group in ("isolated", "threshold", "span", "truth"))
        faults.append(view(layout.faults[place], *parts, limits=limits.get(place)))
    rows: list[Any] = []
    if faults:
        rows.append(rrb.Grid(*faults, grid_columns=-(-len(faults) // FAULTS_BELOW), name="faults"))
    below: list[Any] = []
    if panels.together:
        below.append(view("quiet channels, in units of their thresholds", "quiet", limits=quiet_limits))
    below += [
        each("residuals", "residual", layout.outputs),
        each("inputs", "input", layout.inputs),
        each("outputs", "output", layout.outputs),
    ]
    rows.append(rrb.Tabs(*below))
    return rrb.Vertical(*rows, row_shares=[LEAST_SHARE, 2][-len(rows) :], name=layout.observer)


def raw_tab(messages: Iterable[str], root: Root = ()) -> rrb.Grid:
    """Return the tab of the telemetry, a view per message."""
    views = [
        rrb.TimeSeriesView(origin=f"/{entity_path(*root, 'raw', message)}", name=message, axis_x=_axis())
        for message in messages
    ]
    return rrb.Grid(*views, name="raw channels")


def _axis(stretch: Stretch | None = None) -> rrb.TimeAxis:
    """Return an axis of time that all views share, or one that first shows a range, which a shared axis cannot."""
    if stretch is None:
        return rrb.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal)
    return rrb.TimeAxis(view_range=TimeRange(*(TimeRangeBoundary.absolute(nanos=end_ns) for end_ns in stretch)))
