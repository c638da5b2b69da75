"""What the page shows of registered clouds: walls as lines from above, nothing mirrored, before and after apart."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from floor_rooms import ROOM, K, Wall, cameras, depth_image

from aruco.depth_bias import DepthBias
from aruco.icp_types import CameraMove, ICPMetrics, ICPResult
from aruco.pose_math import Pose, make_pose
from rigcal.report.drawing import DrawnWorld
from rigcal.report.icp_page import POINTS_A_CAMERA, clouds_figure, icp_section, plan_figure, sheet_table
from rigcal.report.icp_table import remarks_of, sheets_of
from rigcal.report.icp_views import CloudView, cloud_view, common_extent

TRUE = cameras()["cam0"]
TURN = np.diag([1.0, -1.0, -1.0, 1.0])
BOX = (Wall(0, -0.4, (0.0, -0.5), (0.9, 0.5)), Wall(1, 0.9, (-0.9, -0.5), (-0.4, 0.5)))
SHIFT = make_pose(np.eye(3), np.array([0.01, 0.0, 0.0]))


def view(T: Pose = TRUE) -> CloudView:
    """A camera before a box and walls, which registration shifts by 10 mm along x."""
    depth = depth_image(TRUE, (*ROOM, *BOX))
    return cloud_view("cam0", depth, depth, K, T_before_cam=T, T_after_cam=SHIFT @ T)


def test_upright_is_what_stands_upright() -> None:
    shown = view()
    upright, rest = shown.before[shown.is_upright], shown.before[~shown.is_upright]
    on_walls = (np.abs(np.abs(upright[:, [0, 2]]) - 4) < 0.15).any(axis=1) | (np.abs(upright[:, 0] + 0.4) < 0.05)
    # Noise of 3 mm over 12 cm turns few normals by 30 degrees; edges of the grid's windows turn some.
    assert on_walls.mean() > 0.9
    on_floor = np.abs(rest[:, 1]) < 0.03
    assert on_floor.mean() > 0.6
    assert (np.abs(upright[:, 1]) < 0.02).mean() < 0.05


def test_before_and_after_are_the_same_pixels_at_their_poses() -> None:
    shown = view()
    assert np.allclose(shown.after - shown.before, [0.01, 0.0, 0.0], atol=1e-12)
    assert np.allclose(shown.centre_after - shown.centre_before, [0.01, 0.0, 0.0])
    depth = depth_image(TRUE, ROOM)
    nearer = cloud_view("cam0", depth, 0.99 * depth, K, T_before_cam=TRUE, T_after_cam=TRUE)
    ranges = [np.linalg.norm(points - TRUE[:3, 3], axis=1) for points in (nearer.before, nearer.after)]
    assert np.allclose(ranges[1] / ranges[0], 0.99)


@pytest.mark.parametrize("up_y", [1, -1])
def test_the_plan_is_not_mirrored(up_y: int) -> None:
    world = DrawnWorld(up_y=up_y, floor_y=0.0)
    T = TRUE if up_y > 0 else TURN @ TRUE
    figure: Any = plan_figure([view(T)], {"cam0": "#000000"}, world)
    # On the page right and up, seen by somebody who looks down: right x up is the way to his eyes.
    up_page = np.sign(np.subtract(*figure.layout.yaxis.range[::-1]))
    right, up = np.array([1.0, 0.0, 0.0]), up_page * np.array([0.0, 0.0, 1.0])
    assert np.cross(right, up) @ [0.0, up_y, 0.0] == 1.0
    assert figure.layout.xaxis.range[0] < figure.layout.xaxis.range[1]
    # A metre is a metre both ways.
    assert figure.layout.yaxis.scaleanchor == "x"


def test_the_floor_is_not_in_the_plan() -> None:
    figure: Any = plan_figure([view()], {"cam0": "#000000"}, DrawnWorld(up_y=1, floor_y=0.0))
    heights = np.concatenate([trace.customdata for trace in figure.data if trace.customdata is not None])
    assert heights.min() > 0.05
    assert heights.max() < 2.2
    assert sorted(trace.mode for trace in figure.data) == ["markers", "markers", "markers+text", "markers+text"]


def test_what_one_camera_sees_in_the_distance_does_not_make_the_plan() -> None:
    near, far = view(), view()
    points = np.concatenate([far.before, np.random.default_rng(0).uniform(30, 40, (len(far.before), 3))])
    upright = np.concatenate([far.is_upright] * 2)
    far = dataclasses.replace(far, before=points, after=points, is_upright=upright)
    alone, both = common_extent([near]), common_extent([near, far])
    # The walls, 4 m from the middle on either side, and a margin.
    assert np.allclose([*both.x, *both.z], [*alone.x, *alone.z], atol=0.3)
    assert max(*both.x, *both.z) < 6
    figure: Any = clouds_figure([near, far], {"cam0": "#000000"}, DrawnWorld(up_y=1, floor_y=0.0))
    assert max(trace.x.max() for trace in figure.data) < 6
    # Clouds that share nothing are shown whole.
    apart = dataclasses.replace(far, before=far.before + 50, after=far.after + 50)
    assert common_extent([near, apart]).x[1] > 50


def test_the_buttons_show_one_or_the_other() -> None:
    views = [view(), view()]
    figure: Any = clouds_figure(views, {"cam0": "#000000"}, DrawnWorld(up_y=1, floor_y=0.0))
    assert len(figure.data) == 4
    assert all(len(trace.x) <= POINTS_A_CAMERA for trace in figure.data)
    before, after = (button.args[0]["visible"] for button in figure.layout.updatemenus[0].buttons)
    assert before == [True, True, False, False]
    assert after == [trace.visible for trace in figure.data] == [False, False, True, True]
    plan: Any = plan_figure(views, {"cam0": "#000000"}, DrawnWorld(up_y=1, floor_y=0.0))
    shown = [trace.x[0] for trace in plan.data if trace.visible and trace.mode == "markers+text"]
    # What is shown first is the result: the camera 10 mm on.
    assert shown == pytest.approx([TRUE[0, 3] + 0.01] * 2)
    after = plan.layout.updatemenus[0].buttons[1].args[0]["visible"]
    assert after == [trace.visible for trace in plan.data]


def test_nothing_registered_has_a_sentence_and_no_pictures() -> None:
    pieces = icp_section((), (), (), ("ICP refinement failed: no overlap.", "Look <here>."), up_y=1, floor_y=0.0)
    assert len(pieces) == 3
    assert "no overlap" in pieces[1]
    assert pieces[2] == "<p>Look &lt;here&gt;.</p>"


def test_biases_are_told_in_their_own_units() -> None:
    biases = {
        "a": DepthBias(scale=0.002, inverse_depth=0.1 / 84, focal_baseline=84.0),
        "b": DepthBias(model="offset", offset_m=0.003, covariance=np.diag([1e-6, 1e-6])),
        "c": DepthBias(inverse_depth=0.002),
    }
    metrics = ICPMetrics(success=True, biases=biases)
    (sheet,) = sheets_of(metrics, ("a", "b", "c"), {"a": DepthBias(scale=-0.001), "b": DepthBias(scale=0.001)}, "a")
    rows = {row[0]: row[1:] for row in sheet.rows}
    assert rows["a"] == ("-0.10", "+0.20", "-", "0.00 px", "+0.10 px", "-", "yes")
    # What was a stereo camera's bias is no offset.
    assert rows["b"] == ("+0.10", "0.00", "0.10", "-", "+3.00 mm", "1.00 mm", "no, pose kept")
    assert rows["c"][4] == "+2.00 /km"


def test_pairs_of_many_cameras_are_listed_where_they_overlap_and_counted_where_not() -> None:
    meets = ICPResult(np.eye(4), 0.5, 0.01, np.eye(6), converged=True)
    told = {"overlap_m2": 0.0, "verdict": "do not overlap: so much is shared", "overlaps": False}
    apart = ICPResult(np.eye(4), 0.0, np.nan, np.zeros((6, 6)), False, **told)
    few = {("a", "b"): meets, ("a", "c"): apart, ("b", "c"): apart}
    (pairs,) = sheets_of(ICPMetrics(True, per_pair_results=few), "abc", {})
    assert [row[:2] for row in pairs.rows] == [("a", "b"), ("a", "c"), ("b", "c")]
    assert pairs.rows[1][2:] == ("0.00", "-", "-", "-", "-", "-", "-", "do not overlap")
    assert "do not overlap" not in pairs.legend
    names = [f"{k:02d}" for k in range(20)]
    many = {(a, b): meets if int(b) == int(a) + 1 else apart for a in names for b in names if a < b}
    (pairs,) = sheets_of(ICPMetrics(True, per_pair_results=many), names, {})
    assert len(pairs.rows) == 19
    assert "171 more pairs of clouds do not overlap." in pairs.legend


def test_outcomes_and_remarks() -> None:
    moves = {
        "a": CameraMove(accepted=False, reason=""),
        "b": CameraMove(accepted=True, reason="it <fits> & more"),
        "c": CameraMove(accepted=False, reason="its cloud overlaps no other"),
    }
    pair = ICPResult(np.eye(4), 0.5, 0.01, np.eye(6), converged=True)
    metrics = ICPMetrics(success=True, cameras=moves, reference_camera="a", per_pair_results={("a", "b"): pair})
    sheet, pairs = sheets_of(metrics, ("a", "b", "c", "d"), {})
    assert [row[1] for row in sheet.rows] == ["reference", "moved", "took no part", "took no part"]
    assert sheet.rows[2][2] == "-"
    assert pairs.rows[0][:2] == ("a", "b")
    assert remarks_of(metrics) == (
        "camera b: it <fits> & more",
        "camera c: its cloud overlaps no other",
    )
    assert '<td class="w">took no part</td>' in sheet_table(sheet)
    pieces = icp_section((), (sheet,), remarks_of(metrics), ("done",), up_y=1, floor_y=0.0)
    assert "it &lt;fits&gt; &amp; more" in "".join(pieces)
