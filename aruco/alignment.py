"""Turning the world the way the user wants it: which way is up, and the rotation that makes it +Y.

Owns      face normals and axes of a target, the decision about up, the rotation of the world.
Leaves    the floor's height to ground_plane; the covariances of a turned world to the caller (``pose_math.adjoint``).

A target resting on a side has gravity along one of its face axes. Which axis, and which way along it, the cameras
tell: they are mounted more or less level, look level or downwards, and do not stand far below the target.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from loguru import logger

from aruco.errors import CalibrationError, InputError
from aruco.marker_geometry import Face
from aruco.model import UpAxis
from aruco.pose_math import Array, Pose, make_pose, skew

# The faces of the two shipped targets, for callers that have corners but no names. Their ids overlap.
FACE_MARKER_MAP: dict[str, list[int]] = {
    "a": [16, 17, 18, 19],
    "b": [20, 21, 22, 23],
    "c": [24, 25, 26, 27],
    "bottom": [21],
    "top": [23],
    "front": [24],
    "back": [22],
    "left": [25],
    "right": [26],
}

# A box folded by hand is square to a few degrees; the axes of a many-sided target lie 30 degrees and more apart.
PARALLEL_LIMIT_DEG = 10.0
# Scores closer than this differ by the rounding of the map's coordinates only.
TIE_LIMIT = 1e-6
# Tripod heads and wall brackets are set by eye: about 5 degrees, rarely 10.
SIGMA_ROLL_DEG = 5.0
# Rigs look level or downwards. A wrong candidate turns the pitch by 90 degrees, so a range of 80 leaves 5 degrees
# of doubt on either side; its middle is such that 70 degrees down (20 degrees up, if misread) is as safe as level.
PITCH_RANGE_DEG = (-5.0, 75.0)
SIGMA_PITCH_DEG = 5.0
# Cameras stand beside or above the target; a target on a table 0.7 m high may look down on a low tripod.
SIGMA_BELOW_M = 0.5
# One camera in fifty is mounted sideways or upside down: no camera's vote weighs more than ln(50) = 3.9.
ODD_MOUNT_SHARE = 0.02
# The best direction must explain the cameras e^2 = 7 times as well as the next: half of what one camera can say.
MIN_MARGIN = 2.0
# Half the cameras rolled by more than two sigma: the target itself probably does not lie level.
ROLL_WARNING_DEG = 2.0 * SIGMA_ROLL_DEG


def _unit(vector: Array, name: str) -> Array:
    v = np.asarray(vector, dtype=np.float64)
    if v.shape != (3,):
        raise ValueError(f"{name}: want shape (3,), got {v.shape}")
    # Scaled first, so that the squares of tiny and huge vectors neither vanish nor overflow.
    largest = float(np.abs(v).max())
    if not (math.isfinite(largest) and largest > 0.0):
        raise ValueError(f"{name}: want a finite vector other than zero, got {v.tolist()}")
    v = v / largest
    return v / np.linalg.norm(v)


def compute_face_normal(corners: Array) -> Array:
    """The unit normal ``cross(c1 - c0, c3 - c0)`` of a marker.

    Args:
        corners: (4, 3) [m]; in ArUco's order the normal points into the print.

    Returns:
        (3,) unit vector, in the frame of the corners.

    Raises:
        ValueError: Wrong shape, not finite, or collapsed to a line.
    """
    c = np.asarray(corners, dtype=np.float64)
    if c.shape != (4, 3):
        raise ValueError(f"corners: want shape (4, 3), got {c.shape}")
    return _unit(np.cross(c[1] - c[0], c[3] - c[0]), "normal of the corners")


def rotation_align_vectors(from_vec: Array, to_vec: Array) -> Array:
    """The smallest rotation (3, 3) with ``R @ from = to`` for the directions of two vectors (3,) (Rodrigues).

    Exactly opposite vectors are joined by a half turn about the coordinate axis most nearly perpendicular to them.

    Raises:
        ValueError: A vector is zero or not finite.
    """
    a, b = _unit(from_vec, "from_vec"), _unit(to_vec, "to_vec")
    if a @ b >= 0.0:
        return _acute_rotation(a, b)
    # Near a half turn Rodrigues' formula divides by zero: make the half turn first, about the same axis.
    axis = np.cross(a, b)
    if np.linalg.norm(axis) < 1e-8:
        axis = np.eye(3)[int(np.argmin(np.abs(a)))]
    axis = _unit(axis - a * (a @ axis), "axis")
    return _acute_rotation(-a, b) @ (2.0 * np.outer(axis, axis) - np.eye(3))


def _acute_rotation(a: Array, b: Array) -> Array:
    W = skew(np.cross(a, b))
    return np.eye(3) + W + W @ W / (1.0 + a @ b)


def apply_alignment_to_pose(T: Pose, R_align: Array) -> Pose:
    """``[[R_align, 0], [0, 1]] @ T``: a pose (4, 4) in the world turned by ``R_align`` (3, 3), translation too."""
    return make_pose(np.asarray(R_align, dtype=np.float64), np.zeros(3)) @ np.asarray(T, dtype=np.float64)


def get_face_normal_from_geometry(
    face_name: str,
    marker_geometry: Mapping[int, Array],
    *,
    face_map: Mapping[str, Sequence[int]] | None = None,
) -> Array | None:
    """The unit mean (3,) of the normals of a face's markers.

    Args:
        face_name: A name in ``face_map``.
        marker_geometry: Marker id -> (4, 3) corners [m].
        face_map: Face -> marker ids, for instance ``load_face_mapping``'s; default FACE_MARKER_MAP.

    Returns:
        None for an unknown name, for a face with an id that the geometry lacks (the ids of different targets overlap,
        so a partial face is a wrong face), and for normals that disagree.
    """
    ids = (FACE_MARKER_MAP if face_map is None else face_map).get(face_name, ())
    if not ids or any(marker not in marker_geometry for marker in ids):
        return None
    return _common_normal([marker_geometry[marker] for marker in ids])


def _common_normal(quads: Sequence[Array] | Array) -> Array | None:
    normals = np.array([compute_face_normal(quad) for quad in quads])
    total = normals.sum(axis=0)
    if np.linalg.norm(total) < 1e-6:
        return None
    mean = _unit(total, "normal of the face")
    return mean if float((normals @ mean).min()) >= math.cos(math.radians(PARALLEL_LIMIT_DEG)) else None


def detect_ground_face(
    visible_marker_ids: Collection[int],
    marker_geometry: Mapping[int, Array],
    camera_up_vector: Array = np.array([0, -1, 0]),  # noqa: B008 the contract's default, never changed
    *,
    face_map: Mapping[str, Sequence[int]] | None = None,
) -> tuple[str, Array] | None:
    """The visible face whose normal points most along a vector.

    Args:
        visible_marker_ids: Ids seen; faces without any of them do not compete.
        marker_geometry: Marker id -> (4, 3) corners [m] in the target's frame.
        camera_up_vector: (3,) up, which the caller has turned into the target's frame.
        face_map: As for ``get_face_normal_from_geometry``.

    Returns:
        Name and unit normal (3,); ties go to the face with more markers. None if no mapped marker is visible.
    """
    up = _unit(camera_up_vector, "camera_up_vector")
    faces = FACE_MARKER_MAP if face_map is None else face_map
    candidates: list[tuple[float, int, str, Array]] = []
    for name, ids in faces.items():
        normal = get_face_normal_from_geometry(name, marker_geometry, face_map=faces)
        if normal is None or not any(marker in visible_marker_ids for marker in ids):
            continue
        candidates.append((float(normal @ up), len(ids), name, normal))
        logger.debug("ground face candidate {}: score {:.3f}", name, candidates[-1][0])
    if not candidates:
        return None
    best = max(score for score, *_ in candidates)
    _, _, name, normal = max((c for c in candidates if c[0] >= best - TIE_LIMIT), key=lambda c: c[1])
    return name, normal


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FaceAxis:
    """A direction, up to sign, that faces of the target are perpendicular to."""

    direction: Array  # (3,) unit, target frame; the normal of the first face
    faces: tuple[Face, ...]
    signs: tuple[int, ...]  # +1 where a face's normal points along the direction, -1 against it
    normals: Array  # (n, 3) unit normals of the faces


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class UpCandidate:
    """One direction that may be up, and what each camera says about it."""

    up_target: Array  # (3,) unit, target frame
    ground_face: str  # the lowest face across this direction
    log_likelihoods: Array  # (number of cameras,), each at least ln(ODD_MOUNT_SHARE)

    @property
    def score(self) -> float:
        """The summed log-likelihood; zero at best."""
        return float(self.log_likelihoods.sum())


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class UpDecision:
    """Which way is up in the target's frame, and how sure the cameras are."""

    candidates: tuple[UpCandidate, ...]  # best first
    is_guess: bool = False  # of a moved target: no several frames share the direction, it is that of one frame

    @property
    def up_target(self) -> Array:
        """The unit vector (3,) against gravity, target frame."""
        return self.candidates[0].up_target

    @property
    def ground_face(self) -> str:
        """The face that up belongs to: of two opposite ones the lower, which the target lies on."""
        return self.candidates[0].ground_face

    @property
    def margin(self) -> float:
        """Log-likelihood of the best candidate minus that of the second best; at least MIN_MARGIN."""
        return self.candidates[0].score - self.candidates[1].score


def face_axes(faces: Sequence[Face]) -> list[FaceAxis]:
    """The distinct axes of a target's faces, in the order of the faces; crooked faces have none."""
    groups: list[list[tuple[Face, int, Array]]] = []
    for face in faces:
        normal = _common_normal(face.corners) if face.ids else None
        if normal is None:
            logger.debug("face {} has no single normal and is no candidate for the ground", face.name)
            continue
        for group in groups:
            cosine = float(group[0][2] @ normal)
            if abs(cosine) >= math.cos(math.radians(PARALLEL_LIMIT_DEG)):
                group.append((face, 1 if cosine > 0 else -1, normal))
                break
        else:
            groups.append([(face, 1, normal)])
    return [
        FaceAxis(direction=group[0][2], faces=names, signs=signs, normals=np.array(normals))
        for group in groups
        for names, signs, normals in [tuple(zip(*group))]
    ]


def find_up(
    T_target_cam: Mapping[str, Pose],
    faces: Sequence[Face],
    *,
    ground_face: str | None = None,
    ground_marker_id: int | None = None,
) -> UpDecision:
    """Decide which way is up from how the cameras are mounted.

    Candidates are both directions of every face axis of the target, seen or not; the one that best explains all
    cameras as upright wins. A face given by name, or else by marker, limits them to its own axis; the cameras still
    decide the sign, because a target may lie on that face or on the one across.

    Args:
        T_target_cam: Camera -> (4, 4) pose in the target's frame; at least one.
        faces: The target's faces.
        ground_face: Name of a face that is level.
        ground_marker_id: Id of a marker on a face that is level; ignored when ``ground_face`` is given.

    Raises:
        InputError: The face or marker is not in the map, or the map has no flat face.
        CalibrationError: There is no camera, or two candidates explain the cameras about equally well.
    """
    if not T_target_cam:
        raise CalibrationError("No camera has a pose, so nothing tells which way is up; check that the target is seen.")
    axes = face_axes(faces)
    if not axes:
        raise InputError("The marker map has no flat face to align with; leave out --auto-align.")
    named = specified_face(faces, ground_face, ground_marker_id)
    if named is not None:
        logger.info("using specified ground face: {}", named.name)
        axes = face_axes([named])
        if not axes:
            raise InputError(f"The markers of face {named.name} do not lie in one plane; name another ground face.")
    candidates = rank_candidates(T_target_cam, axes, lowest_of=faces)
    decision = UpDecision(candidates=candidates)
    for candidate in candidates:
        logger.debug(
            "up candidate {} {}: score {:.2f}", candidate.ground_face, _shown(candidate.up_target), candidate.score
        )
    logger.info("up direction: margin {:.1f} over the second best (at least {:g})", decision.margin, MIN_MARGIN)
    if decision.margin < MIN_MARGIN:
        raise CalibrationError(_ambiguity_message(decision, list(T_target_cam), faces, named))
    return decision


def specified_face(faces: Sequence[Face], name: str | None, marker_id: int | None) -> Face | None:
    """The face that a user named, by name before marker; None where neither is given, InputError if unknown."""
    if name is not None:
        for face in faces:
            if face.name == name:
                return face
        raise InputError(f"--ground-face {name}: the marker map has no such face; known: {_known(faces)}.")
    if marker_id is not None:
        for face in faces:
            if marker_id in face.ids:
                return face
        ids = ", ".join(str(marker) for marker in sorted(marker for face in faces for marker in face.ids))
        raise InputError(f"--ground-marker-id {marker_id}: the marker map has no such marker; known: {ids}.")
    return None


def _known(faces: Sequence[Face]) -> str:
    return ", ".join(face.name for face in faces)


def rank_candidates(
    T_target_cam: Mapping[str, Pose], axes: Sequence[FaceAxis], *, lowest_of: Sequence[Face]
) -> tuple[UpCandidate, ...]:
    """Both directions of every axis, the one that best explains the cameras as upright first."""
    poses = np.array(list(T_target_cam.values()))
    corners = np.concatenate([face.corners.reshape(-1, 3) for face in lowest_of])
    candidates = []
    for axis in axes:
        for sign in (1, -1):
            name, up = _ground_of(axis, sign * axis.direction)
            lowest = float((corners @ up).min())
            likelihoods = upright_log_likelihoods(poses, up, lowest)
            candidates.append(UpCandidate(up_target=up, ground_face=name, log_likelihoods=likelihoods))
    return tuple(sorted(candidates, key=lambda candidate: -candidate.score))


def _ground_of(axis: FaceAxis, up: Array) -> tuple[str, Array]:
    """The lowest face of an axis, and its own normal turned upwards: that is the side the target rests on.

    By place and not by the sign of the normal, which turns with the order of the corners. Faces of one plane: first
    those whose normal points up, then those with more markers.
    """
    heights = [float(np.mean(face.corners.reshape(-1, 3) @ up)) for face in axis.faces]
    upward = axis.normals @ up
    low = [k for k, height in enumerate(heights) if height <= min(heights) + TIE_LIMIT]
    k = max(low, key=lambda k: (upward[k] > 0, len(axis.faces[k].ids)))
    return axis.faces[k].name, axis.normals[k] * np.sign(upward[k])


def upright_log_likelihoods(T_target_cam: Array, up: Array, lowest_m: float) -> Array:
    """How well a direction explains each camera as upright.

    Roll is how far the camera's x axis is from level, pitch the turn about it: 0 level, 90 straight down, -90
    straight up, 180 on its head. A Gaussian of roll, of pitch outside PITCH_RANGE_DEG and of the depth of the camera
    below the target, mixed with a share of odd mounts that caps what one camera can say.

    Args:
        T_target_cam: (n, 4, 4) poses.
        up: (3,) unit candidate, target frame.
        lowest_m: The target's lowest corner along ``up``.

    Returns:
        (n,) from ln(ODD_MOUNT_SHARE) to 0.
    """
    roll_deg, pitch_deg = _roll_and_pitch_deg(T_target_cam[:, :3, :3], up)
    low, high = PITCH_RANGE_DEG
    outside_deg = np.maximum(low - pitch_deg, pitch_deg - high).clip(min=0.0)
    below_m = (lowest_m - T_target_cam[:, :3, 3] @ up).clip(min=0.0)
    squares = (roll_deg / SIGMA_ROLL_DEG) ** 2 + (outside_deg / SIGMA_PITCH_DEG) ** 2 + (below_m / SIGMA_BELOW_M) ** 2
    return np.logaddexp(math.log1p(-ODD_MOUNT_SHARE) - 0.5 * squares, math.log(ODD_MOUNT_SHARE))


def _roll_and_pitch_deg(R_target_cam: Array, up: Array) -> tuple[Array, Array]:
    x, y, z = np.moveaxis(np.einsum("nij,i->nj", R_target_cam, up), 1, 0)
    return np.degrees(np.arcsin(np.clip(x, -1.0, 1.0))), np.degrees(np.arctan2(-z, -y))


def _ambiguity_message(decision: UpDecision, cameras: list[str], faces: Sequence[Face], named: Face | None) -> str:
    first, second = decision.candidates[:2]
    doubt = (
        f"Which way is up is ambiguous: {first.ground_face} {_shown(first.up_target)} explains the cameras only "
        f"{decision.margin:.1f} better than {second.ground_face} {_shown(second.up_target)} (log-likelihood; needs "
        f"{MIN_MARGIN:g})."
    )
    if named is None:
        return f"{doubt} Name a level face of the target with --ground-face; known: {_known(faces)}."
    odd = [name for name, vote in zip(cameras, first.log_likelihoods) if vote < 0.5 * math.log(ODD_MOUNT_SHARE)]
    return (
        f"{doubt} Along face {named.name} these cameras are not upright: {', '.join(odd) or 'none'}; check their "
        f"mounting (sideways, upside down), or name another face with --ground-face; known: {_known(faces)}."
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AlignedWorld:
    """The cameras in the turned world; its origin stays where the target's is."""

    R_align: Array  # (3, 3) rotation R_aligned_target
    T_world_cam: Mapping[str, Pose]


def align_world(T_target_cam: Mapping[str, Pose], decision: UpDecision, *, up_axis: UpAxis = "+y") -> AlignedWorld:
    """Turn the world so that up becomes +Y, or -Y, and tell every camera's up vector in it.

    Args:
        T_target_cam: Camera -> (4, 4) pose in the target's frame.
        decision: From ``find_up``.
        up_axis: "+y": Y points up; "-y": the same world after a half turn about x, Y points down.

    Raises:
        InputError: Another up axis.
    """
    logger.info(
        "Detected ground face: {}, normal: {}, applying alignment", decision.ground_face, _shown(decision.up_target)
    )
    world = turn_upright(T_target_cam, decision.up_target, up_axis=up_axis)
    _warn_if_rolled(T_target_cam, decision.up_target)
    return world


def turn_upright(T_world_cam: Mapping[str, Pose], up_world: Array, *, up_axis: UpAxis = "+y") -> AlignedWorld:
    """Turn the world so that a known direction becomes +Y, or -Y; see align_world.

    Args:
        T_world_cam: Camera -> (4, 4) pose.
        up_world: (3,) direction against gravity in the same world.
        up_axis: As for align_world.

    Raises:
        InputError: Another up axis.
    """
    if up_axis not in ("+y", "-y"):
        raise InputError(f"--up-axis {up_axis}: known: +y, -y.")
    R_align = rotation_align_vectors(up_world, np.array([0.0, 1.0, 0.0]))
    if up_axis == "-y":
        R_align = np.diag([1.0, -1.0, -1.0]) @ R_align
    poses = {name: apply_alignment_to_pose(T, R_align) for name, T in T_world_cam.items()}
    for name, T in poses.items():
        logger.info("camera {}: up vector {} in the new world", name, _shown(-T[:3, 1]))
    return AlignedWorld(R_align=R_align, T_world_cam=poses)


def _warn_if_rolled(T_target_cam: Mapping[str, Pose], up: Array) -> None:
    rolls_deg, _ = _roll_and_pitch_deg(np.array(list(T_target_cam.values()))[:, :3, :3], up)
    median_deg = float(np.median(np.abs(rolls_deg)))
    if median_deg > ROLL_WARNING_DEG:
        logger.warning(
            "half the cameras are rolled by {:.0f} degrees or more in the aligned world: does the target lie level?",
            median_deg,
        )


def _shown(vector: Array) -> str:
    # Adding zero turns -0.0, which round leaves behind, into 0.0.
    rounded = np.round(vector, 3) + 0.0
    return "[" + ", ".join(f"{value:.3f}" for value in rounded) + "]"
