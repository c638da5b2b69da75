"""What the page about a levelled rig shows: floor and nothing else, heights with the right sign, no mirrored room."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from floor_rooms import FOCAL_BASELINE, ROOM, K, Wall, cameras, depth_image, tilted

from aruco.depth_noise import DepthNoise
from aruco.ground_plane import FloorCorrection, FloorPlane
from aruco.pose_math import Pose, exp_so3, make_pose
from rigcal.report.floor_page import POINTS_A_CAMERA, DrawnWorld, heights_figure, maps_figure, rig_figure
from rigcal.report.floor_views import FloorView, common_limit_mm, floor_figures, floor_view, told

TRUE = cameras()["cam0"]
OFF = tilted(TRUE, (0.5, 0.0), 0.03)
TABLE = Wall(1, 0.5, (-0.7, -0.7), (0.3, 0.3))
TURN = np.diag([1.0, -1.0, -1.0, 1.0])


def view(*, T_before: Pose = OFF, T_after: Pose = TRUE, up_y: int = 1, seen: bool = True) -> FloorView:
    """A camera above a floor with a table on it, whose pose was off and is right now."""
    return floor_view(
        "cam0",
        depth_image(TRUE, (*ROOM, TABLE)),
        K,
        T_before_cam=T_before,
        T_after_cam=T_after,
        floor=FloorPlane(np.array([0.0, up_y, 0.0]), 0.0) if seen else None,
        sigma_m=DepthNoise(focal_baseline=FOCAL_BASELINE).sigma_m,
    )


def traces(figure: Any) -> list[Any]:
    return list(figure.data)


def test_heights_are_those_above_the_floor_before_and_after() -> None:
    before, after = view().before_m(1, 0.0), view().after_m(1, 0.0)
    assert np.nanmedian(after) == pytest.approx(0.0, abs=2e-3)  # noise of 3 mm, 5000 pixels
    assert np.nanmedian(before) == pytest.approx(0.03, abs=0.02)  # raised by 30 mm, and aslant
    assert np.nanmedian(view().after_m(1, -0.2)) == pytest.approx(0.2, abs=2e-3)


def test_heights_are_the_same_where_y_points_down() -> None:
    down = view(T_before=TURN @ OFF, T_after=TURN @ TRUE, up_y=-1)
    assert np.allclose(down.before_m(-1, 0.0), view().before_m(1, 0.0), equal_nan=True)
    assert np.allclose(down.after_m(-1, 0.0), view().after_m(1, 0.0), equal_nan=True)


def test_tables_and_walls_are_no_floor() -> None:
    shown = view()
    world = shown.points_cam @ TRUE[:3, :3].T + TRUE[:3, 3]
    assert not shown.is_floor[world[..., 1] > 0.25].any()
    assert shown.is_floor.mean() > 0.2
    # A camera without a floor of its own shows none.
    assert not view(seen=False).is_floor.any()


def test_a_few_far_points_do_not_make_the_colours() -> None:
    # 30 mm and half a degree over 4 m: some 65 mm at the far end.
    assert 30 <= common_limit_mm([view()], 1, 0.0) <= 80
    # Nothing but noise still has colours of a readable scale.
    assert common_limit_mm([view(T_before=TRUE)], 1, 0.0) >= 5


@pytest.mark.parametrize("up_y", [1, -1])
def test_the_room_is_not_drawn_mirrored(up_y: int) -> None:
    world = DrawnWorld(up_y=up_y, floor_y=0.0)
    axes = np.stack(world.drawn(np.eye(3)), axis=1)  # where x, y, z of the world point to in the picture
    reversed_axes = [world.scene()[f"{axis}axis"].get("autorange") == "reversed" for axis in "xyz"]
    assert np.linalg.det(axes) * (-1) ** sum(reversed_axes) == pytest.approx(1.0)
    assert axes[1] @ [0, 0, 1] == up_y


def test_figures_hold_every_camera_and_not_too_much() -> None:
    views, world = [view(), view(seen=False)], DrawnWorld(up_y=1, floor_y=0.0)
    colours = {"cam0": "#000000"}
    assert len(traces(rig_figure(views, colours, world))) == 4  # a cloud and a frustum each
    heights = traces(heights_figure(views, colours, world, 50.0))
    assert len(heights) == 4
    assert all(len(trace["x"]) <= POINTS_A_CAMERA for trace in heights)
    assert len(traces(maps_figure(views, world, 50.0))) == 2  # only the camera that sees the floor


def test_what_rounds_to_zero_has_no_sign() -> None:
    assert told(-0.04, "+.1f", " mm") == "0.0 mm"
    assert told(0.0, "+.1f") == "0.0"
    assert told(-0.0004, ".3f") == "0.000"
    assert told(-0.06, "+.1f") == "-0.1"
    assert told(1.23, "+.1f") == "+1.2"
    assert told(math.nan, ".1f", " mm") == "-"


def test_figures_of_one_camera_in_both_worlds() -> None:
    turn = make_pose(exp_so3(np.radians([0.3, 0.0, 0.0])), np.zeros(3))
    raised = make_pose(np.eye(3), np.array([0.0, 0.02, 0.0]))
    correction = FloorCorrection(tilt_before_deg=0.3, tilt_after_deg=0.0, height_before_m=-0.02, height_after_m=0.0)
    figures = floor_figures("a", TRUE, raised @ turn @ TRUE, correction, reason="", up_y=1)
    assert figures.turned_deg == pytest.approx(0.3)
    assert figures.height_before_mm == pytest.approx(-20)
    down = floor_figures("a", TURN @ TRUE, TURN @ raised @ TRUE, None, reason="why", up_y=-1)
    assert down.raised_mm == pytest.approx(20)
    assert math.isnan(down.tilt_before_deg)
    assert (figures.told, down.told) == ("levelled", "whole rig only: why")
