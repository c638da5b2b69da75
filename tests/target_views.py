"""Views of a target without images: exact projections of its markers, with noise, solved for the pose."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from marker_pictures import make_camera

from aruco import lens
from aruco.box_target import STANDARD_BOX_IDS, box_faces
from aruco.model import Camera, Detection
from aruco.pose_math import Array, Pose, exp_so3, invert_transform, make_pose, pose_distance, transform_points
from aruco.view_pose import View, solve_view

CAMERA = make_camera()


def box(side_m: float = 0.6) -> dict[int, Array]:
    """Marker id -> corners of a box with one marker of three quarters of its side on each of its six sides."""
    faces = box_faces(side_m, 0.75 * side_m, STANDARD_BOX_IDS)
    return {marker: corners for face in faces for marker, corners in zip(face.ids, face.corners)}


def square(side_m: float, marker: int = 0) -> dict[int, Array]:
    """One marker in the plane z = 0, printed on the side of -z: seen upright by a camera that looks along +z."""
    half = side_m / 2
    return {marker: np.array([[-half, -half, 0.0], [half, -half, 0.0], [half, half, 0.0], [-half, half, 0.0]])}


def looking_at(centre: Array, at: Array, roll_rad: float = 0.0) -> Pose:
    """T_world_cam of a camera at a place that looks at another, upright in a world whose +Y is up, then rolled."""
    z = (at - centre) / np.linalg.norm(at - centre)
    x = np.cross(z, [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    return make_pose(np.stack([x, np.cross(z, x), z], axis=1) @ exp_so3(np.array([0.0, 0.0, roll_rad])), centre)


def tilted(tilt_deg: float, about_rad: float, turn_rad: float, distance_m: float) -> Pose:
    """T_cam_target of a square straight ahead, tilted about an axis in the image and turned in its own plane."""
    axis = np.array([np.cos(about_rad), np.sin(about_rad), 0.0])
    R = exp_so3(np.radians(tilt_deg) * axis) @ exp_so3(np.array([0.0, 0.0, turn_rad]))
    return make_pose(R, np.array([0.05, -0.03, distance_m]))


def any_pose(rng: np.random.Generator, angle_rad: float = np.pi, shift_m: float = 1.0) -> Pose:
    axis = rng.standard_normal(3)
    return make_pose(exp_so3(rng.uniform(0, angle_rad) * axis / np.linalg.norm(axis)), shift_m * rng.standard_normal(3))


def facing(corners_cam: Array) -> float:
    """The cosine between a marker's print and the ray to it; positive where the camera sees the print."""
    into = np.cross(corners_cam[1] - corners_cam[0], corners_cam[3] - corners_cam[0])
    middle = corners_cam.mean(axis=0)
    return float(into @ middle / (np.linalg.norm(into) * np.linalg.norm(middle)))


def sight(
    camera: Camera,
    T_cam_target: Pose,
    geometry: Mapping[int, Array],
    sigma_px: float,
    rng: np.random.Generator,
    *,
    most: int = 99,
    only: Collection[int] | None = None,
) -> Detection:
    """The markers that face the camera, at most so many, the most frontal ones; exact where ``sigma_px`` is zero."""
    in_camera = {marker: transform_points(T_cam_target, corners) for marker, corners in geometry.items()}
    frontal = {marker: facing(corners) for marker, corners in in_camera.items() if only is None or marker in only}
    seen = sorted(sorted((m for m in frontal if frontal[m] > 0.15), key=lambda m: -frontal[m])[:most])
    corners = np.array([lens.project(camera, in_camera[m]) for m in seen]).reshape(-1, 4, 2)
    return Detection(
        ids=np.array(seen, dtype=np.int64),
        corners_px=corners + sigma_px * rng.standard_normal(corners.shape),
        sigma_px=np.full((len(seen), 4), max(sigma_px, 1e-3)),
    )


def views_of(
    cameras: Mapping[str, Pose],
    T_world_target: Mapping[int, Pose],
    geometry: Mapping[int, Array],
    sigma_px: float,
    rng: np.random.Generator,
    *,
    most: int = 99,
    sees: Mapping[str, Collection[int]] | None = None,
) -> list[View]:
    """The views of cameras (name -> T_world_cam) in frames (frame -> T_world_target); ``sees`` limits the frames."""
    views: list[View] = []
    for name, T_world_cam in cameras.items():
        camera = make_camera(name)
        for frame, T in T_world_target.items():
            if sees is None or frame in sees[name]:
                detection = sight(camera, invert_transform(T_world_cam) @ T, geometry, sigma_px, rng, most=most)
                view = solve_view(camera, frame, detection, geometry)
                if view is not None:
                    views.append(view)
    return views


def pose_error(T_a: Pose, T_b: Pose) -> tuple[float, float]:
    """Degrees and millimetres between two poses."""
    angle, distance = pose_distance(T_a, T_b)
    return float(np.degrees(angle)), 1e3 * distance
