"""A page about a levelled rig: the rig on its floor, heights before and after in 3D and as maps, a table of figures.

Owns      what is drawn, and that it is one self-contained HTML file.
Leaves    which points are floor, and the figures, to floor_views, what every page has to drawing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from aruco.pose_math import Array, transform_points
from rigcal.report.drawing import LEGEND, MARGIN, DrawnWorld, as_html, cloud, colours_of, some
from rigcal.report.floor_views import FloorFigures, FloorView, common_limit_mm, told

if TYPE_CHECKING:
    import plotly.graph_objects as go

POINTS_A_CAMERA = 4000  # of each 3D view: enough to see a surface, few enough to turn it smoothly
FRUSTUM_SHARE = 0.12  # of how far a camera sees; rigs stand on desks and in halls

_BEFORE = (
    "Before: the rig has been turned and shifted as a whole only. After: each camera's pitch, roll and height have "
    "been corrected too. Heights are drawn larger than life."
)
_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2em auto; max-width: 1180px; padding: 0 1em; color: #222; }
h1 { font-size: 1.6em; } h2 { font-size: 1.2em; margin-top: 2em; }
table { border-collapse: collapse; } th, td { padding: .25em .8em; text-align: right; border-bottom: 1px solid #ddd; }
th:first-child, td:first-child, th:last-child, td:last-child { text-align: left; }
"""


def floor_page(
    views: Sequence[FloorView],
    figures: Sequence[FloorFigures],
    facts: Sequence[str],
    *,
    up_y: int,
    floor_y: float,
    more: Sequence[str] = (),
) -> str:
    """The page as HTML.

    Args:
        views: What the cameras with depth see.
        figures: One a camera of the rig.
        facts: Sentences about the whole rig, told first.
        up_y: 1 if the world's y axis points up, -1 if down.
        floor_y: Where the floor is in the levelled world.
        more: Further sections, as HTML.
    """
    limit_mm = common_limit_mm(views, up_y, floor_y)
    colours = colours_of([view.camera for view in views])
    world = DrawnWorld(up_y=up_y, floor_y=floor_y)
    return "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>The rig on its floor</title>',
            f"<style>{_STYLE}</style></head><body><h1>The rig on its floor</h1>",
            *(f"<p>{escape(fact)}</p>" for fact in facts),
            "<h2>Every camera's floor against the common one</h2>",
            figures_table(figures),
            "<h2>The levelled rig</h2>",
            as_html(rig_figure(views, colours, world), "rig", with_library=True),
            f"<h2>Heights of the floor, before and after</h2><p>{_BEFORE}</p>",
            as_html(heights_figure(views, colours, world, limit_mm), "heights"),
            "<h2>Height maps</h2><p>The floor's pixels in each camera's image; grey is no floor.</p>",
            as_html(maps_figure(views, world, limit_mm), "maps"),
            *more,
            "</body></html>\n",
        ]
    )


def figures_table(figures: Sequence[FloorFigures]) -> str:
    """The cameras' figures as an HTML table."""
    head = ("camera", "tilt before", "tilt after", "height before", "height after", "turned by", "raised by", "outcome")
    rows = [
        (
            escape(f.camera),
            told(f.tilt_before_deg, ".3f", "°"),
            told(f.tilt_after_deg, ".3f", "°"),
            told(f.height_before_mm, "+.1f", " mm"),
            told(f.height_after_mm, "+.1f", " mm"),
            told(f.turned_deg, ".3f", "°"),
            told(f.raised_mm, "+.1f", " mm"),
            escape(f.told),
        )
        for f in figures
    ]
    header = "".join(f"<th>{name}</th>" for name in head)
    body = "\n".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{header}</tr></thead><tbody>\n{body}\n</tbody></table>"


def rig_figure(views: Sequence[FloorView], colours: Mapping[str, str], world: DrawnWorld) -> go.Figure:
    """Every camera and what it sees, true to scale."""
    import plotly.graph_objects as go

    figure = go.Figure()
    for view in views:
        colour, name = colours[view.camera], escape(view.camera)
        points = some(view.points_cam[np.isfinite(view.points_cam).all(axis=-1)], POINTS_A_CAMERA)
        x, z, height = world.drawn(transform_points(view.T_after_cam, points))
        figure.add_trace(cloud(x, z, height, colour, name, "height %{z:.2f} m"))
        x, z, height = world.drawn(_frustum(view))
        line = {"color": colour, "width": 4}
        figure.add_trace(
            go.Scatter3d(x=x, y=z, z=height, mode="lines", line=line, legendgroup=name, showlegend=False, name=name)
        )
    scene = world.scene(title={"text": "height m"})
    figure.update_layout(scene={**scene, "aspectmode": "data"}, height=620, margin=MARGIN, legend=LEGEND)
    return figure


def _frustum(view: FloorView) -> Array:
    """A pyramid (n, 3) from the camera's centre to its image's corners, as one line; levelled world [m]."""
    depth_m = view.points_cam[..., 2]
    seen_m = float(np.median(depth_m[np.isfinite(depth_m)])) if np.isfinite(depth_m).any() else 1.0
    points = np.vstack([np.zeros(3), FRUSTUM_SHARE * seen_m * view.corner_rays])
    return transform_points(view.T_after_cam, points[[0, 1, 2, 0, 3, 4, 0, 1, 4, 3, 2]])


def heights_figure(
    views: Sequence[FloorView], colours: Mapping[str, str], world: DrawnWorld, limit_mm: float
) -> go.Figure:
    """Heights of the floor's points, before and after, in two scenes that are larger than life upwards."""
    from plotly.subplots import make_subplots

    titles = ("Before: heights in mm", "After: heights in mm")
    kinds = [[{"type": "scene"}, {"type": "scene"}]]
    figure = make_subplots(
        rows=1,
        cols=2,
        specs=kinds,
        subplot_titles=titles,
        horizontal_spacing=0.02,
    )
    for view in views:
        points = some(view.points_cam[view.is_floor], POINTS_A_CAMERA)
        for column, T_world_cam in enumerate((view.T_before_cam, view.T_after_cam), start=1):
            x, z, height = world.drawn(transform_points(T_world_cam, points))
            trace = cloud(x, z, 1e3 * height, colours[view.camera], escape(view.camera), "%{z:.1f} mm")
            trace.showlegend = column == 1
            figure.add_trace(trace, row=1, col=column)
    heights = {"title": {"text": "height mm"}, "range": [-1.5 * limit_mm, 1.5 * limit_mm]}
    scene = {**world.scene(**heights), "aspectmode": "manual", "aspectratio": {"x": 1.2, "y": 1.2, "z": 0.55}}
    figure.update_layout(scene=scene, scene2=scene, height=560, margin=MARGIN, legend=LEGEND)
    return figure


def maps_figure(views: Sequence[FloorView], world: DrawnWorld, limit_mm: float) -> go.Figure:
    """Heights of the floor in each camera's image, before and after, on one symmetric colour scale."""
    import plotly.graph_objects as go
    from plotly.subplots import make_subplots

    shown = [view for view in views if view.is_floor.any()]
    titles = [f"camera {escape(view.camera)}, {when}" for view in shown for when in ("before", "after")]
    rows = max(1, len(shown))
    spacing = 0.06 / rows
    figure = make_subplots(rows=rows, cols=2, subplot_titles=titles, horizontal_spacing=0.03, vertical_spacing=spacing)
    for row, view in enumerate(shown, start=1):
        h, w = view.is_floor.shape
        axes = {"x": view.step_px * np.arange(w), "y": view.step_px * np.arange(h)}
        maps = (view.before_m(world.up_y, world.floor_y), view.after_m(world.up_y, world.floor_y))
        for column, heights in enumerate(maps, start=1):
            mm = np.round(1e3 * heights, 1).astype(np.float32)
            picture = go.Heatmap(z=mm, **axes, coloraxis="coloraxis", hovertemplate="%{z:.1f} mm<extra></extra>")
            figure.add_trace(picture, row=row, col=column)
    figure.update_xaxes(visible=False)
    figure.update_yaxes(visible=False, autorange="reversed")
    bar = {"title": {"text": "mm"}, "lenmode": "pixels", "len": 340, "y": 1, "yanchor": "top"}
    scale = {"colorscale": "RdBu_r", "cmin": -limit_mm, "cmax": limit_mm, "colorbar": bar}
    figure.update_layout(coloraxis=scale, plot_bgcolor="#d0d0d0", height=60 + 340 * rows, margin=MARGIN)
    return figure
