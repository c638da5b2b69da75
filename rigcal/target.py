"""What stands in the room: a box of markers or a board, and how it is found in images.

Owns      one type for both, from a marker map or a board's description.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from aruco.detector import MarkerDetector
from aruco.marker_geometry import Face, load_faces
from aruco.model import Camera, Detection
from aruco.pose_math import Array


class Detector(Protocol):
    """Finds the target's corners in one image after another."""

    def detect(self, image: NDArray[np.uint8], camera: Camera | None = None) -> Detection:
        """The corners of an image; see MarkerDetector.detect and BoardDetector.detect."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Target:
    """The faces of a target, where its corners are, and what finds them."""

    faces: Sequence[Face]  # its flat sides, for alignment
    geometry: Mapping[int, Array]  # id -> (k, 3) corners [m], target frame
    detector: Detector
    dictionary: str = ""  # of a marker box; empty for a board, which knows its own
    digest: str = ""  # SHA-256 of the description


def marker_target(faces: Sequence[Face], dictionary: str, *, digest: str = "") -> Target:
    """A target of markers on flat faces.

    Raises:
        InputError: Unknown dictionary.
    """
    geometry = {marker: corners for face in faces for marker, corners in zip(face.ids, face.corners)}
    detector = MarkerDetector(dictionary, geometry)
    return Target(faces=faces, geometry=geometry, detector=detector, dictionary=dictionary, digest=digest)


def marker_target_from_file(path: Path, dictionary: str) -> Target:
    """A target of markers from a map; raises like load_faces and marker_target."""
    faces = load_faces(path)
    return marker_target(faces, dictionary, digest=hashlib.sha256(path.read_bytes()).hexdigest())


def board_target(description: str) -> Target:
    """A ChArUco or AprilGrid board from ``charuco:...``, ``aprilgrid:...`` or a YAML file.

    Raises:
        InputError: The description is none of a board.
    """
    from aruco.board import board_face, board_geometry, board_text, parse_board
    from aruco.board_detector import BoardDetector

    board = parse_board(description)
    return Target(
        faces=[board_face(board)],
        geometry=board_geometry(board),
        detector=BoardDetector(board),
        digest=hashlib.sha256(board_text(board).encode()).hexdigest(),
    )
