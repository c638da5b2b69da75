"""An image in, the points of a calibration board in it out: ids, sub-pixel places and how sure they are.

Owns      finding a board by its markers, plain or inverted, which of its corners survive, telling mirrored boards.
Leaves    the measuring of corners to saddle_fit and corner_fit, poses to view_pose.

Markers are found plainly; a robust homography tells those that belong to the board from strangers, and where the inner
corners are; each is then measured from its own pixels. An image with fewer than two of the board's markers is searched
again with black and white exchanged, for inverted prints: what is found in an image depends on that image alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from aruco import lens
from aruco.board import AprilGrid, Board, CharucoBoard, board_geometry, board_markers, tag_turns, white_squares
from aruco.corner_fit import fit_corners
from aruco.detector import MAX_MISFIT, MAX_SHIFT_PX, MAX_SHIFT_SHARE, get_dictionary
from aruco.model import Camera, Detection
from aruco.pose_math import Array
from aruco.saddle_fit import Saddles, fit_saddles

# Fewer markers than this are no board: one of them may be a stranger.
MIN_MARKERS = 2
# A mirrored or misdescribed board shows many markers; a false find or two are no proof.
MIN_DIAGNOSED_MARKERS = 4
# A marker belongs to the board when it lies where the others say, within this share of its own side: a lens that
# nobody knows bends a board by less, a stranger is farther off.
MAX_STRAY_SHARE = 0.35
# Fewer of the markers agree: then this is another board, or its description has the pattern shifted in half its rows.
MIN_AGREEING_SHARE = 0.7
# Inner corners farther than this from the nearest marker found are guesses [squares, to the marker's middle].
MAX_GAP_SQUARES = 1.6
# Residual of a saddle as a share of its contrast: clean and noisy corners stay below 0.1.
MAX_SADDLE_MISFIT = 0.15
# A saddle fit that wanders farther than the markers' corners are ever wrong has found something else.
MAX_SADDLE_SHIFT_SQUARES = 0.15
MIN_CONTRAST_GREY = 12.0
MAX_SADDLE_SIGMA_PX = 0.5
# A corner this many robust deviations from where its board's others put it is no corner of it.
STRAY_SIGMAS, STRAY_FLOOR_PX = 8.0, 0.5


@dataclass(frozen=True, slots=True, eq=False)
class _Markers:
    """Markers of the board in one image: ids (n,) ascending, plain corners (n, 4, 2) in the pinhole image."""

    ids: NDArray[np.int64]
    quads: Array

    def __len__(self) -> int:
        return len(self.ids)

    def only(self, keep: NDArray[np.bool_]) -> _Markers:
        return _Markers(self.ids[keep], self.quads[keep])


class BoardDetector:
    """Finds one board in one image after another.

    Args:
        board: What to look for.

    A ChArUco board's detections hold its inner corners (n, 1, 2), an AprilGrid's its tags' corners (n, 4, 2), with the
    ids of ``board.board_geometry``.
    """

    def __init__(self, board: Board) -> None:
        self.board: Board = board
        self._geometry = board_geometry(board)
        markers = board_markers(board)
        self._ids = np.array(list(markers), dtype=np.int64)
        self._quads = np.array(list(markers.values()))[..., :2]  # (n, 4, 2) metres
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
        parameters.markerBorderBits = board.border_bits if isinstance(board, AprilGrid) else 1
        self._cv = cv2.aruco.ArucoDetector(get_dictionary(board.dictionary), parameters)

    def detect(self, image: NDArray[np.uint8], camera: Camera | None = None) -> Detection:
        """The board's points in an image.

        Args:
            image: (h, w) grey or (h, w, 3) BGR.
            camera: Whose lens bends the board; None for a pinhole.

        Returns:
            Ids ascending; nothing where the board is not seen.
        """
        for grey in _both_ways(image):
            markers = self._find(grey, camera)
            if len(markers) >= MIN_MARKERS:
                break
        else:
            return self._nothing()
        if isinstance(self.board, AprilGrid):
            return self._tags(grey, markers, camera)
        return self._corners(self.board, grey, markers, camera)

    def mirrored(self, image: NDArray[np.uint8]) -> bool:
        """Whether the board is seen in a mirror, or through its back: its markers decode only in the flipped image."""
        for grey in _both_ways(image):
            if len(self._find(grey, None)) >= MIN_MARKERS:
                return False
            flipped = np.ascontiguousarray(grey[:, ::-1])
            if len(self._find(flipped, None)) >= MIN_DIAGNOSED_MARKERS:
                return True
        return False

    def misplaced(self, image: NDArray[np.uint8]) -> bool:
        """Whether the board's markers are seen, but not where its description says.

        Columns and rows are exchanged, the pattern is OpenCV's legacy one, or it is another board of this dictionary.
        """
        for grey in _both_ways(image):
            if len(self._find(grey, None)) >= MIN_MARKERS:
                return False
            if len(self._plain(grey)) >= MIN_DIAGNOSED_MARKERS:
                return True
        return False

    def _nothing(self) -> Detection:
        k = 4 if isinstance(self.board, AprilGrid) else 1
        return Detection(ids=np.empty(0, np.int64), corners_px=np.empty((0, k, 2)), sigma_px=np.empty((0, k)))

    def _find(self, grey: NDArray[np.uint8], camera: Camera | None) -> _Markers:
        """The markers of the board that lie where its others say."""
        markers = self._plain(grey)
        quads = markers.quads
        if camera is not None:
            quads = lens.straighten(camera, quads.reshape(-1, 2)).reshape(-1, 4, 2)
        seen = np.asarray(np.isfinite(quads).all(axis=(1, 2)))
        return self._belonging(_Markers(markers.ids, quads).only(seen))

    def _plain(self, grey: NDArray[np.uint8]) -> _Markers:
        """Markers as OpenCV finds them in the recorded image; an id that is seen twice is ambiguous and left out."""
        if not grey.size:
            return _Markers(np.empty(0, np.int64), np.empty((0, 4, 2)))
        quads, ids, _ = self._cv.detectMarkers(grey)
        if ids is None or not len(ids):
            return _Markers(np.empty(0, np.int64), np.empty((0, 4, 2)))
        found = np.asarray(ids, dtype=np.int64).ravel()
        corners = np.asarray(quads, dtype=np.float64).reshape(-1, 4, 2)
        unique, counts = np.unique(found, return_counts=True)
        keep = np.isin(found, unique[counts == 1]) & np.isin(found, self._ids)
        order = np.flatnonzero(keep)[np.argsort(found[keep], kind="stable")]
        corners = corners[order]
        if isinstance(self.board, AprilGrid):
            corners = np.roll(corners, -tag_turns(self.board), axis=1)
        return _Markers(found[order], corners)

    def _belonging(self, markers: _Markers) -> _Markers:
        """Those whose corners one homography of the board explains."""
        if len(markers) < MIN_MARKERS:
            return markers.only(np.zeros(len(markers), dtype=bool))
        limit = MAX_STRAY_SHARE * _sides(markers.quads).min(axis=1)
        H = self._homography(markers, float(np.median(limit)))
        if H is None:
            return markers.only(np.zeros(len(markers), dtype=bool))
        stray = np.linalg.norm(_map(H, self._where(markers)) - markers.quads, axis=2).max(axis=1)
        near = markers.only(stray <= limit)
        enough = len(near) >= max(MIN_MARKERS, MIN_AGREEING_SHARE * len(markers))
        return near if enough else markers.only(np.zeros(len(markers), dtype=bool))

    def _where(self, markers: _Markers) -> Array:
        """Corners (n, 4, 2) of markers on the board [m]."""
        return self._quads[np.searchsorted(self._ids, markers.ids)]

    def _homography(self, markers: _Markers, limit_px: float) -> Array | None:
        # The seed of OpenCV's RANSAC is fixed: the same corners give the same homography.
        H, _ = cv2.findHomography(
            self._where(markers).reshape(-1, 2), markers.quads.reshape(-1, 2), cv2.RANSAC, limit_px
        )
        return None if H is None or not np.isfinite(H).all() else np.asarray(H, dtype=np.float64)

    def _tags(self, grey: NDArray[np.uint8], markers: _Markers, camera: Camera | None) -> Detection:
        """The tags of a grid, their corners measured."""
        cells = self._cv.getDictionary().markerSize + 2 * self._cv.getDetectorParameters().markerBorderBits
        H = self._homography(markers, MAX_STRAY_SHARE * float(np.median(_sides(markers.quads))))
        if H is None:
            return self._nothing()
        # The black squares at a tag's corners pull those apart by pixels; its middle stays, and so does the board.
        expected = _map(H, self._where(markers))
        quads = expected + (markers.quads - expected).mean(axis=1, keepdims=True)
        if camera is not None:
            quads = lens.bend(camera, quads.reshape(-1, 2)).reshape(-1, 4, 2)
        fit = fit_corners(grey, quads, cells, camera)
        side = _sides(quads).min(axis=1)
        good = (fit.misfit <= MAX_MISFIT) & (fit.shift_px <= np.maximum(MAX_SHIFT_PX, MAX_SHIFT_SHARE * side))
        return Detection(ids=markers.ids, corners_px=fit.corners_px, sigma_px=fit.sigma_px).only(good)

    def _corners(
        self, board: CharucoBoard, grey: NDArray[np.uint8], markers: _Markers, camera: Camera | None
    ) -> Detection:
        """The inner corners of a chessboard that markers are near, measured and agreed on."""
        ids, points = np.array(list(self._geometry), dtype=np.int64), np.concatenate(list(self._geometry.values()))
        saddles = self._predict(board, points[:, :2], markers)
        if saddles is None:
            return self._nothing()
        fit = fit_saddles(grey, saddles, camera)
        shortest = np.linalg.norm(saddles.axes_px, axis=2).min(axis=1)
        good = (
            (fit.misfit <= MAX_SADDLE_MISFIT)
            & (fit.contrast >= MIN_CONTRAST_GREY)
            & (fit.sigma_px <= MAX_SADDLE_SIGMA_PX)
            & (fit.shift_px <= np.maximum(MAX_SHIFT_PX, MAX_SADDLE_SHIFT_SQUARES * shortest))
        )
        good[good] = _agreeing(points[good, :2], fit.corners_px[good], camera)
        found = Detection(ids=ids, corners_px=fit.corners_px[:, None], sigma_px=fit.sigma_px[:, None])
        return found.only(good)

    def _predict(self, board: CharucoBoard, points: Array, markers: _Markers) -> Saddles | None:
        """Where the inner corners ``points`` (n, 2) [m] should be; NaN where no marker is near."""
        where = self._where(markers)
        H = self._homography(markers, MAX_STRAY_SHARE * float(np.median(_sides(markers.quads))))
        if H is None:
            return None
        # An unknown lens bends the board away from the homography; the nearest corners of markers know how much.
        bent = (markers.quads - _map(H, where)).reshape(-1, 2)
        distance = np.linalg.norm(points[:, None] - where.reshape(1, -1, 2), axis=2) / board.square_m
        weight = np.exp(-((distance / 0.6) ** 2)) + 1e-12
        local = weight @ bent / weight.sum(axis=1, keepdims=True)
        step = board.square_m * np.eye(2)
        centre = _map(H, points)
        axes = np.stack([(_map(H, points + step[k]) - _map(H, points - step[k])) / 2 for k in range(2)], axis=1)
        gap = np.linalg.norm(points[:, None] - where.mean(axis=1)[None], axis=2).min(axis=1) / board.square_m
        corners = np.where((gap <= MAX_GAP_SQUARES)[:, None], centre + local, np.nan)
        return Saddles(
            corners_px=corners,
            axes_px=axes,
            white_first=white_squares(board)[1:, 1:].ravel(),
            margin=(board.square_m - board.marker_m) / (2 * board.square_m),
        )


def _both_ways(image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """The image in grey, and with black and white exchanged."""
    plain = image if image.ndim == 2 or not image.size else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    grey = np.asarray(plain, dtype=np.uint8)
    return grey, 255 - grey


def _sides(quads: Array) -> Array:
    """Lengths (n, 4) of the sides of quads (n, 4, 2)."""
    return np.linalg.norm(np.roll(quads, -1, axis=1) - quads, axis=2)


def _map(H: Array, points: Array) -> Array:
    """Points (..., 2) through a homography."""
    mapped = points @ H[:, :2].T + H[:, 2]
    return mapped[..., :2] / mapped[..., 2:]


def _agreeing(points: Array, corners_px: Array, camera: Camera | None) -> NDArray[np.bool_]:
    """Which corners (n, 2) lie where a homography of all of them puts the board's points (n, 2) [m]."""
    straight = corners_px if camera is None else lens.straighten(camera, corners_px)
    if len(points) < 6:
        return np.ones(len(points), dtype=bool)
    H, _ = cv2.findHomography(points, straight, cv2.LMEDS)
    if H is None or not np.isfinite(H).all():
        return np.ones(len(points), dtype=bool)
    stray = np.linalg.norm(_map(np.asarray(H, dtype=np.float64), points) - straight, axis=1)
    return stray <= max(STRAY_SIGMAS * 1.4826 * float(np.median(stray)), STRAY_FLOOR_PX)
