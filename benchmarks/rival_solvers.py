"""Other ways from the same corners to camera poses, to compare with: plain averaging, OpenCV's calibrateMultiview.

Owns      the corners of a board that several cameras saw, and each way of solving them.
Leaves    finding corners to aruco.board_detector, running and timing the ways to suite.rivals.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from aruco import moved_target
from aruco.model import Camera, Detection
from aruco.pose_math import Array, Pose, invert_transform, make_pose, rvec_tvec_to_matrix
from aruco.rig_estimate import RigEstimate
from aruco.view_pose import solve_view, variance_factor
from rigcal.solve.joint import adjust_rig

MIN_POINTS = 4  # of a plane, for a pose


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Corners:
    """What several cameras saw of a board that was moved; every point of it is a detection of its own."""

    cameras: tuple[Camera, ...]
    detections: Mapping[str, Mapping[int, Detection]]  # camera -> frame -> points of the board
    geometry: Mapping[int, Array]  # point -> (1, 3) [m], board frame

    @property
    def frames_of(self) -> dict[str, set[int]]:
        """Camera -> frames in which it sees the board."""
        return {name: set(seen) for name, seen in self.detections.items()}

    def exchanged(self, camera: str, pair: tuple[int, int]) -> Corners:
        """Two frames of one camera exchanged, as if their images had each other's stamp."""
        one, other = pair
        mine = self.detections[camera]
        swapped = {**mine, one: mine[other], other: mine[one]}
        return replace(self, detections={**self.detections, camera: swapped})

    def shaken(self, sigma_px: float, rng: np.random.Generator) -> Corners:
        """Noise of a standard deviation on every coordinate, of which the corners' own sigmas do not know."""

        def shake(seen: Detection) -> Detection:
            return replace(seen, corners_px=seen.corners_px + rng.normal(0, sigma_px, seen.corners_px.shape))

        shaken = {name: {f: shake(seen) for f, seen in by_frame.items()} for name, by_frame in self.detections.items()}
        return replace(self, detections=shaken)


def ours(corners: Corners) -> dict[str, Pose]:
    """What a calibration does: average single views, then adjust all of them together."""
    average = _average(corners)
    return _poses(adjust_rig(average, corners.cameras, corners.detections, corners.geometry, moving=True).rig)


def our_average(corners: Corners) -> dict[str, Pose]:
    """What a calibration starts from: single views averaged, weighted by their information, without outliers."""
    return _poses(_average(corners))


def plain_average(corners: Corners) -> dict[str, Pose]:
    """The textbook: PnP in every frame, relative poses of two cameras averaged with equal weights, then chained.

    Cameras are chained along the links with the most frames. The mean rotation is the one nearest to the mean matrix
    (Hartley et al., "Rotation averaging", 2013: the chordal mean).
    """
    T_cam_board = {camera.name: _solved_views(camera, corners) for camera in corners.cameras}
    first, *waiting = (camera.name for camera in corners.cameras)
    T_world_cam: dict[str, Pose] = {first: np.eye(4)}
    while waiting:
        links = [(len(T_cam_board[i].keys() & T_cam_board[j].keys()), i, j) for i in T_world_cam for j in waiting]
        n_frames, i, j = max(links)
        if not n_frames:
            break
        waiting.remove(j)
        T_world_cam[j] = T_world_cam[i] @ _plain_mean(T_cam_board[i], T_cam_board[j])
    return T_world_cam


def multiview(corners: Corners, *, whole_boards: bool) -> dict[str, Pose]:
    """OpenCV 5's calibrateMultiview with the same intrinsics, which it keeps.

    Args:
        corners: Points that a view lacks are handed over as (-1, -1), as its documentation asks for.
        whole_boards: Use only views in which every point of the board was found.
    """
    opencv: Any = cv2  # the stubs of OpenCV 4 do not know what came with 5
    n_points = len(corners.geometry)
    board = np.concatenate([corners.geometry[k] for k in range(n_points)]).astype(np.float32)
    frames = sorted({frame for seen in corners.detections.values() for frame in seen})
    views = [[corners.detections[camera.name].get(frame) for frame in frames] for camera in corners.cameras]
    used = [[seen is not None and (len(seen) == n_points or not whole_boards) for seen in row] for row in views]
    n_cameras = len(corners.cameras)
    *_, turns, shifts = opencv.calibrateMultiview(
        [board] * len(frames),
        [[_image_points(seen, n_points) for seen in row] for row in views],
        [(camera.width, camera.height) for camera in corners.cameras],
        np.array(used, dtype=np.uint8),
        np.full(n_cameras, opencv.CALIB_MODEL_PINHOLE, dtype=np.uint8),
        [camera.K.copy() for camera in corners.cameras],
        [camera.distortion.copy() for camera in corners.cameras],
        None,
        None,
        flagsForIntrinsics=np.full(n_cameras, opencv.CALIB_FIX_INTRINSIC, dtype=np.int32),
        flags=opencv.CALIB_USE_INTRINSIC_GUESS,
    )
    T_cam_first = [_pose(turn, shift) for turn, shift in zip(turns, shifts)]
    return {camera.name: invert_transform(T) for camera, T in zip(corners.cameras, T_cam_first)}


def _average(corners: Corners) -> RigEstimate:
    views, scale2 = [], {}
    for camera in corners.cameras:
        seen = corners.detections[camera.name].items()
        mine = [view for f, d in seen if (view := solve_view(camera, f, d, corners.geometry)) is not None]
        views += mine
        scale2[camera.name] = variance_factor(mine)
    return moved_target.place_cameras(views, scale2)


def _poses(rig: RigEstimate) -> dict[str, Pose]:
    return {name: placement.T_world_cam for name, placement in rig.cameras.items()}


def _solved_views(camera: Camera, corners: Corners) -> dict[int, Pose]:
    """Frame -> T_cam_board by OpenCV's iterative PnP."""
    poses: dict[int, Pose] = {}
    for frame, seen in corners.detections[camera.name].items():
        if len(seen) < MIN_POINTS:
            continue
        points = np.concatenate([corners.geometry[int(k)] for k in seen.ids])
        solved, rvec, tvec = cv2.solvePnP(points, seen.corners_px.reshape(-1, 2), camera.K, camera.distortion)
        if solved:
            poses[frame] = _pose(np.asarray(rvec, dtype=np.float64), np.asarray(tvec, dtype=np.float64))
    return poses


def _plain_mean(T_i_board: Mapping[int, Pose], T_j_board: Mapping[int, Pose]) -> Pose:
    """T_i_j, the mean over all frames that both see."""
    T = np.mean([T_i_board[f] @ invert_transform(T_j_board[f]) for f in T_i_board.keys() & T_j_board.keys()], axis=0)
    U, _, Vt = np.linalg.svd(T[:3, :3])
    turn = np.diag([1.0, 1.0, float(np.linalg.det(U @ Vt))])
    return make_pose(U @ turn @ Vt, T[:3, 3])


def _pose(turn: Array, shift: Array) -> Pose:
    """Of a rotation vector or matrix: calibrateMultiview is said to return matrices, and returns vectors."""
    return rvec_tvec_to_matrix(turn, shift) if np.size(turn) == 3 else make_pose(turn.reshape(3, 3), shift)


def _image_points(seen: Detection | None, n_points: int) -> NDArray[np.float32]:
    """(n_points, 2) pixels; -1 where a point was not seen."""
    pixels = np.full((n_points, 2), -1.0, dtype=np.float32)
    if seen is not None:
        pixels[seen.ids] = seen.corners_px[:, 0]
    return pixels
