"""The part of the page about registered clouds: tables, the rig's plan before and after, clouds in 3D.

Owns      what is drawn of them.
Leaves    which points are shown to icp_views, figures to icp_table, what every page has to drawing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rigcal.report.drawing import LEGEND, MARGIN, DrawnWorld, as_html, cloud, colours_of, some
from rigcal.report.icp_table import Sheet
from rigcal.report.icp_views import LOW_SHARE, PLAN_HEIGHTS_M, CloudView, common_extent

if TYPE_CHECKING:
    import plotly.graph_objects as go

POINTS_A_CAMERA = 8000  # of each view: lines of walls stay lines when one zooms in

_PLAN = (
    "What stands upright, seen from above: walls and sides of furniture are lines, and lines of different colours that "
    "run side by side are clouds that do not meet. The buttons switch between the levelled rig and the one with its "
    "clouds registered; the view stays. Drag a box to look closer, double-click to go back. A click on a camera "
    "in the legend hides it, a double click shows it alone."
)
_CLOUDS = "Everything that the cameras see where at least two of them look, before and after."
# A room is flat: from nearer than a scene with height that is larger than life.
_EYE = {"eye": {"x": 1.3, "y": 1.3, "z": 1.0}, "center": {"x": 0, "y": 0, "z": -0.15}}
_STYLE = """<style>
.icp th, .icp td { text-align: right; vertical-align: top; }
.icp th:last-child, .icp td:last-child { text-align: right; }
.icp th.w, .icp td.w { text-align: left; }
p.icp { color: #555; font-size: .9em; }
h1 { margin-top: 2em; }
</style>"""


def icp_section(
    views: Sequence[CloudView],
    sheets: Sequence[Sheet],
    remarks: Sequence[str],
    facts: Sequence[str],
    *,
    up_y: int,
    floor_y: float,
) -> tuple[str, ...]:
    """The part as pieces of HTML; pictures only where clouds were registered.

    Args:
        views: Of the cameras with depth; none if nothing was registered.
        sheets: The tables.
        remarks: Sentences about single cameras.
        facts: What became of the rig, and what it asks for.
        up_y: 1 if the world's y axis points up, -1 if down.
        floor_y: Where the floor is.
    """
    return (
        f"{_STYLE}<h1>Clouds against clouds</h1>",
        *(f"<p>{escape(fact)}</p>" for fact in facts),
        *(sheet_table(sheet) for sheet in sheets[:1]),
        *(["<ul>", *(f"<li>{escape(remark)}</li>" for remark in remarks), "</ul>"] if remarks else []),
        *(sheet_table(sheet) for sheet in sheets[1:]),
        *(_pictures(views, DrawnWorld(up_y=up_y, floor_y=floor_y)) if views else ()),
    )


def _pictures(views: Sequence[CloudView], world: DrawnWorld) -> tuple[str, ...]:
    colours = colours_of([view.camera for view in views])
    return (
        f"<h2>Clouds from above, before and after</h2><p>{_PLAN}</p>",
        as_html(plan_figure(views, colours, world), "plan"),
        f"<h2>Clouds in 3D</h2><p>{_CLOUDS}</p>",
        as_html(clouds_figure(views, colours, world), "clouds"),
    )


def sheet_table(sheet: Sheet) -> str:
    """A table as HTML, its title as a heading."""
    is_word = [name in sheet.words for name in sheet.head]
    header = "".join(
        f"<th{_class(word)}>{escape(name.replace(chr(10), ' '))}</th>" for name, word in zip(sheet.head, is_word)
    )
    rows = [
        "<tr>" + "".join(f"<td{_class(word)}>{escape(cell)}</td>" for cell, word in zip(row, is_word)) + "</tr>"
        for row in sheet.rows
    ]
    body = "\n".join(rows)
    table = f'<table class="icp"><thead><tr>{header}</tr></thead><tbody>\n{body}\n</tbody></table>'
    return f'<h2>{escape(sheet.title)}</h2>{table}<p class="icp">{escape(sheet.legend)}</p>'


def _class(word: bool) -> str:
    return ' class="w"' if word else ""


def plan_figure(views: Sequence[CloudView], colours: Mapping[str, str], world: DrawnWorld) -> go.Figure:
    """Upright surfaces from above, before or after."""
    import plotly.graph_objects as go

    traces = [
        trace
        for is_after in (False, True)
        for view in views
        for trace in _plan_traces(view, colours[view.camera], world, is_after=is_after)
    ]
    figure = go.Figure(traces)
    extent = common_extent(views)
    # Seen from above, z runs down the page where y points up: x, z, y is left-handed then.
    z_range = extent.z[::-1] if world.up_y > 0 else extent.z
    figure.update_xaxes(title={"text": "x m"}, range=extent.x, constrain="domain", zeroline=False)
    figure.update_yaxes(title={"text": "z m"}, range=z_range, scaleanchor="x", constrain="domain", zeroline=False)
    figure.update_layout(updatemenus=[_switch(len(traces))], dragmode="zoom", plot_bgcolor="#f7f7f7")
    figure.update_layout(height=800, margin=MARGIN, legend=LEGEND)
    return figure


def _in_plan(view: CloudView, world: DrawnWorld) -> NDArray[np.intp]:
    """Indices of the points that are shown from above."""
    low, high = PLAN_HEIGHTS_M
    heights = world.drawn(view.before)[2]
    camera_height = float(world.drawn(view.centre_before[None])[2][0])
    low = min(low, max(LOW_SHARE * camera_height, 0.0))
    return some(np.nonzero(view.is_upright & (heights > low) & (heights < high))[0], POINTS_A_CAMERA)


def _switch(n_traces: int) -> dict[str, object]:
    """Buttons that show the first half of the traces, or the other."""
    half = n_traces // 2
    buttons = [
        {"label": label, "method": "restyle", "args": [{"visible": [not is_after] * half + [is_after] * half}]}
        for label, is_after in (("Before", False), ("After", True))
    ]
    place = {"x": 0, "xanchor": "left", "y": 1.01, "yanchor": "bottom"}
    return {"type": "buttons", "direction": "right", "buttons": buttons, "active": 1, "showactive": True, **place}


def _plan_traces(view: CloudView, colour: str, world: DrawnWorld, *, is_after: bool) -> list[go.Scattergl]:
    """A camera's points, and the camera itself."""
    import plotly.graph_objects as go

    name = escape(view.camera)
    points, centre = (view.after, view.centre_after) if is_after else (view.before, view.centre_before)
    x, z, height = world.drawn(points[_in_plan(view, world)])
    common = {"name": name, "legendgroup": name, "visible": is_after}
    cloud_of = go.Scattergl(
        x=np.asarray(x, dtype=np.float32),
        y=np.asarray(z, dtype=np.float32),
        customdata=np.asarray(height, dtype=np.float32),
        mode="markers",
        marker={"size": 2.2, "color": colour, "opacity": 0.7},
        hovertemplate=f"{name}: %{{x:.3f}}, %{{y:.3f}} m, height %{{customdata:.2f}} m<extra></extra>",
        **common,
    )
    marker = {"size": 11, "color": colour, "symbol": "diamond", "line": {"color": "#ffffff", "width": 1}}
    place = go.Scattergl(
        showlegend=False,
        x=[float(centre[0])],
        y=[float(centre[2])],
        mode="markers+text",
        marker=marker,
        text=[name],
        textposition="top center",
        hovertemplate=f"camera {name}: %{{x:.4f}}, %{{y:.4f}} m<extra></extra>",
        **common,
    )
    return [cloud_of, place]


def clouds_figure(views: Sequence[CloudView], colours: Mapping[str, str], world: DrawnWorld) -> go.Figure:
    """All clouds in one scene, before or after."""
    import plotly.graph_objects as go

    traces, extent = [], common_extent(views)
    for is_after in (False, True):
        for view in views:
            near = extent.holds(view.before)
            points = some((view.after if is_after else view.before)[near], POINTS_A_CAMERA)
            trace = cloud(*world.drawn(points), colours[view.camera], escape(view.camera), "height %{z:.3f} m")
            trace.visible = is_after
            traces.append(trace)
    figure = go.Figure(traces)
    scene = {**world.scene(title={"text": "height m"}), "aspectmode": "data", "camera": _EYE}
    figure.update_layout(scene=scene, updatemenus=[_switch(len(traces))], height=680, margin=MARGIN, legend=LEGEND)
    return figure
