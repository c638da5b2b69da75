"""Where cameras and target of a simulated rig are.

Owns      drawing cameras and target poses from a rig's parameters, so that the markers are seen.
Leaves    furniture to room.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aruco import lens
from aruco.alignment import rotation_align_vectors
from aruco.box_target import SIDES
from aruco.errors import InputError
from aruco.model import Camera
from aruco.pose_math import Array, Pose, exp_so3, invert_transform, make_pose, transform_points
from rigcal.sim.rigs import Rig
from rigcal.sim.scene import Target, target_panels

# A marker counts as seen when a camera looks at it less obliquely than this and it lies this far inside the image.
_MIN_COSINE = 0.35
_BORDER_PX = 16.0
# A camera looks down by at most this angle: a rig, not a bird's eye view.
_MAX_PITCH_RAD = np.deg2rad(55.0)
_TRIALS = 4000
# An open target's panels have a thickness: without it, the one that lies on the floor would flicker with it.
_PANEL_THICKNESS_M = 0.002
# A carried target stays this close to the middle of the room, and this low.
_CARRY_RADIUS_M = 0.7
_CARRY_HEIGHT_M = 1.0
_CARRY_TILT_RAD = np.deg2rad(35.0)
# A board is held up at about this height, and turned in its plane by so much (standard deviation).
_BOARD_HEIGHT_M = 1.15
_BOARD_LIFT_M = 0.3
_BOARD_TURN_RAD = np.deg2rad(30.0)
_FIRST_SERIAL = 41000001


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Arrangement:
    """Cameras and target of one rig."""

    cameras: tuple[Camera, ...]
    T_world_cam: tuple[Pose, ...]
    T_world_target: tuple[Pose, ...]  # one a frame


def arrange(rig: Rig, target: Target, rng: np.random.Generator) -> Arrangement:
    """Draw a rig.

    Raises:
        InputError: The target has no such face to rest on, or no place shows its markers.
    """
    cameras = tuple(_camera(rig, index, rng) for index in range(rig.n_cameras))
    if target.board is not None:
        return _arrange_board(rig, cameras, target, rng)
    T_world_rest = resting_pose(target, rig.resting_face, rng.uniform(0, 2 * np.pi))
    aim = np.array([0.0, 0.5, 0.0]) if rig.moving else T_world_rest[:3, 3]
    T_world_cam = tuple(
        _camera_pose(rig, k, camera, target, T_world_rest, aim, rng) for k, camera in enumerate(cameras)
    )
    if rig.moving:
        places = tuple(_carried_pose(k, cameras, T_world_cam, target, rng) for k in range(rig.n_frames))
    else:
        places = (T_world_rest,) * rig.n_frames
    return Arrangement(
        cameras=tuple(_with_options(rig, camera, rng) for camera in cameras),
        T_world_cam=T_world_cam,
        T_world_target=places,
    )


def resting_pose(target: Target, face: str, yaw_rad: float) -> Pose:
    """T_world_target of a target in the middle of the room that lies on one of its sides.

    Args:
        target: What lies there.
        face: Name of a face, or of a side of the body (bottom, top, front, back, left, right).
        yaw_rad: Turn about the vertical.

    Raises:
        InputError: There is no such face.
    """
    upright = rotation_align_vectors(_outward(target, face), np.array([0.0, -1.0, 0.0]))
    R = exp_so3(np.array([0.0, yaw_rad, 0.0])) @ upright
    lowest = min(panel.vertices[:, 1].min() for panel in target_panels(target, make_pose(R, np.zeros(3))))
    return make_pose(R, np.array([0.0, -lowest + (0.0 if target.closed else _PANEL_THICKNESS_M), 0.0]))


def _outward(target: Target, name: str) -> Array:
    for face in target.faces:
        if face.name == name:
            c0, c1, _, c3 = face.corners[0]
            normal = np.cross(c1 - c0, c3 - c0)
            return normal * np.sign(normal @ c0) / np.linalg.norm(normal)
    if name not in SIDES:
        known = dict.fromkeys([*(face.name for face in target.faces), *SIDES])
        raise InputError(f"{name}: the target has no such face to rest on; known: {', '.join(known)}.")
    return np.array(SIDES[name][0], dtype=np.float64)


def seen_markers(camera: Camera, T_world_cam: Pose, target: Target, T_world_target: Pose) -> dict[int, Array]:
    """The markers that a camera sees well, by id, with their projected corners (4, 2) [px].

    Well means: less than 70 degrees from face-on and wholly inside of the image. Nothing else may stand in the way.
    """
    T_cam_target = invert_transform(T_world_cam) @ T_world_target
    seen: dict[int, Array] = {}
    for face in target.faces:
        for marker, corners in zip(face.ids, face.corners):
            c = transform_points(T_cam_target, corners)
            normal, centre = np.cross(c[1] - c[0], c[3] - c[0]), c.mean(axis=0)
            cosine = normal @ centre / (np.linalg.norm(normal) * np.linalg.norm(centre))
            pixels = lens.project(camera, c)
            limit = np.array([camera.width, camera.height]) - 1 - _BORDER_PX
            if cosine > _MIN_COSINE and (pixels > _BORDER_PX).all() and (pixels < limit).all():
                seen[marker] = pixels
    return seen


def look_at(centre: Array, at: Array, roll_rad: float = 0.0) -> Pose:
    """T_world_cam of a camera at ``centre`` (3,) that looks towards ``at`` (3,), its x axis level without roll."""
    z = (at - centre) / np.linalg.norm(at - centre)
    x = np.cross(z, [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z], axis=1)
    return make_pose(R @ exp_so3(np.array([0.0, 0.0, roll_rad])), centre)


def _camera(rig: Rig, index: int, rng: np.random.Generator) -> Camera:
    focal = rig.focal_px * (1 + rng.uniform(-0.01, 0.01))
    cx, cy = (rig.width - 1) / 2 + rng.uniform(-8, 8), (rig.height - 1) / 2 + rng.uniform(-8, 8)
    return Camera(
        name=str(_FIRST_SERIAL + index),
        width=rig.width,
        height=rig.height,
        K=np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1]]),
        baseline_m=rig.baseline_m,
    )


def _with_options(rig: Rig, camera: Camera, rng: np.random.Generator) -> Camera:
    # Drawn always, so that the same seed means the same places with and without distortion.
    bent = rng.normal([-0.12, 0.03, 0.0, 0.0, 0.0], [0.02, 0.003, 5e-4, 5e-4, 0.0])
    return Camera(
        name=camera.name,
        width=camera.width,
        height=camera.height,
        K=camera.K,
        distortion=bent if rig.distortion else np.zeros(5),
        baseline_m=rig.baseline_m if rig.depth else None,
    )


def _camera_pose(
    rig: Rig, index: int, camera: Camera, target: Target, T_world_target: Pose, aim: Array, rng: np.random.Generator
) -> Pose:
    sector = 2 * np.pi / rig.n_cameras
    for trial in range(_TRIALS):
        # Evenly around the target; anywhere if that shows nothing, as with a target printed on few sides.
        spread = 0.3 * sector if trial < 40 else np.pi
        T_world_cam, pitch = _looking(rig, index * sector + rng.uniform(-spread, spread), aim, rng)
        if pitch < _MAX_PITCH_RAD and seen_markers(camera, T_world_cam, target, T_world_target):
            return T_world_cam
    raise InputError(f"rig {rig.name}: no place shows a marker to camera {camera.name}; let it rest on another face.")


def _looking(rig: Rig, azimuth: float, aim: Array, rng: np.random.Generator) -> tuple[Pose, float]:
    """T_world_cam of a camera in a direction from ``aim`` (3,), which it looks at roughly, and how far down [rad]."""
    height, distance = rng.uniform(*rig.camera_height_m), rng.uniform(*rig.distance_m)
    pitch = np.arcsin(np.clip((height - aim[1]) / distance, -1, 1))
    level = distance * np.cos(pitch)
    centre = np.array([aim[0] + level * np.cos(azimuth), height, aim[2] + level * np.sin(azimuth)])
    return look_at(centre, aim + rng.uniform(-0.15, 0.15, 3), rng.normal(0, np.deg2rad(2))), float(pitch)


def _carried_pose(
    frame: int,
    cameras: tuple[Camera, ...],
    T_world_cam: tuple[Pose, ...],
    target: Target,
    rng: np.random.Generator,
) -> Pose:
    """A pose that the camera whose turn it is shares with another one."""
    turn = frame % len(cameras)
    for _ in range(_TRIALS):
        T_world_target = _carried(target, rng)
        sees = [bool(seen_markers(c, T, target, T_world_target)) for c, T in zip(cameras, T_world_cam)]
        if sees[turn] and sum(sees) >= min(2, len(cameras)):
            return T_world_target
    raise InputError("no place shows the moved target to two cameras at once; give them a wider view.")


def _carried(target: Target, rng: np.random.Generator) -> Pose:
    face, yaw = rng.choice([face.name for face in target.faces]), rng.uniform(0, 2 * np.pi)
    T_world_target = resting_pose(target, str(face), yaw)
    angle, radius = rng.uniform(0, 2 * np.pi), _CARRY_RADIUS_M * np.sqrt(rng.uniform())
    shift = np.array([radius * np.cos(angle), 0.0, radius * np.sin(angle)])
    tilt = np.eye(3)
    if rng.uniform() < 0.6:
        axis = rng.normal(size=3)
        tilt = exp_so3(rng.uniform(0, _CARRY_TILT_RAD) * axis / np.linalg.norm(axis))
        # Held with its middle between the height of its own diagonal and a metre.
        shift[1] = rng.uniform(0.87 * target.body_side_m, _CARRY_HEIGHT_M) - T_world_target[1, 3]
    return make_pose(tilt @ T_world_target[:3, :3], T_world_target[:3, 3] + shift)


def _arrange_board(rig: Rig, cameras: tuple[Camera, ...], target: Target, rng: np.random.Generator) -> Arrangement:
    """Cameras on an arc around +X, and a board that is held up to them."""
    aim = np.array([0.0, _BOARD_HEIGHT_M, 0.0])
    sector = np.deg2rad(rig.arc_deg) / rig.n_cameras
    azimuths = (np.arange(rig.n_cameras) - (rig.n_cameras - 1) / 2) * sector
    T_world_cam = tuple(_looking(rig, azimuth + rng.uniform(-0.3, 0.3) * sector, aim, rng)[0] for azimuth in azimuths)
    places = tuple(_held_pose(rig, k, cameras, T_world_cam, target, rng) for k in range(rig.n_frames))
    return Arrangement(
        cameras=tuple(_with_options(rig, camera, rng) for camera in cameras),
        T_world_cam=T_world_cam,
        T_world_target=places,
    )


def _held_pose(
    rig: Rig,
    frame: int,
    cameras: tuple[Camera, ...],
    T_world_cam: tuple[Pose, ...],
    target: Target,
    rng: np.random.Generator,
) -> Pose:
    """A pose in which the camera whose turn it is and another one see at least half of the board's markers."""
    turn, wanted = frame % len(cameras), sum(len(face.ids) for face in target.faces) / 2
    for _ in range(_TRIALS):
        T_world_target = _held(rig, target, rng)
        sees = [len(seen_markers(c, T, target, T_world_target)) >= wanted for c, T in zip(cameras, T_world_cam)]
        above = all(transform_points(T_world_target, face.corners)[..., 1].min() > 0 for face in target.faces)
        if above and sees[turn] and sum(sees) >= min(2, len(cameras)):
            return T_world_target
    raise InputError(f"rig {rig.name}: no place shows the board to two cameras at once; give them a wider view.")


def _held(rig: Rig, target: Target, rng: np.random.Generator) -> Pose:
    """A board somewhere near the middle, its print towards somewhere on the cameras' arc, tilted and turned."""
    facing = np.deg2rad(rig.arc_deg) / 2 * rng.uniform(-1, 1)
    out = np.array([np.cos(facing), 0.0, np.sin(facing)])
    # A board's print is seen against its z axis if y runs down, along it if y runs up.
    upright = look_at(np.zeros(3), -out)[:3, :3]
    c0, c1, _, c3 = target.faces[0].corners[0]
    if np.cross(c1 - c0, c3 - c0)[2] < 0:
        upright = upright @ np.diag([1.0, -1.0, -1.0])
    axis = rng.normal(size=3)
    tilt = exp_so3(rng.uniform(0, _CARRY_TILT_RAD) * axis / np.linalg.norm(axis))
    R = tilt @ upright @ exp_so3(np.array([0.0, 0.0, rng.normal(0, _BOARD_TURN_RAD)]))
    angle, radius = rng.uniform(0, 2 * np.pi), _CARRY_RADIUS_M * np.sqrt(rng.uniform())
    height = _BOARD_HEIGHT_M + rng.uniform(-_BOARD_LIFT_M, _BOARD_LIFT_M)
    middle = np.array([radius * np.cos(angle), height, radius * np.sin(angle)])
    return make_pose(R, middle - R @ target.centre_m)
