"""One flat marker shown to a stereo camera at many places, with exact planes for depth and the simulator's noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from target_views import sight, square

from aruco.depth_noise import DepthNoise
from aruco.depth_patches import FaceDepth, face_depth, patches
from aruco.depth_verify import DepthCamera
from aruco.model import Camera
from aruco.pose_math import Array, Pose, exp_so3, make_pose
from aruco.rig_estimate import Placement, RigEstimate
from rigcal.sim.noise import DepthBias as SimulatedBias
from rigcal.sim.noise import DepthNoise as SimulatedNoise
from rigcal.sim.noise import fixed_error, measure_depth

K = np.array([[400.0, 0, 320], [0, 400.0, 240], [0, 0, 1]])
BASELINE_M = 0.15
FOCAL_BASELINE = K[0, 0] * BASELINE_M
CAMERA = Camera(name="a", width=640, height=480, K=K, baseline_m=BASELINE_M)
MARKER = square(0.45)
EXACT = SimulatedNoise(sigma_px=0.0, fixed_sigma_px=0.0, dropout=0.0)
NOISY = SimulatedNoise()
KNOWN: Mapping[str, DepthCamera] = {"a": DepthCamera(K=K, noise=DepthNoise(focal_baseline=FOCAL_BASELINE))}
# Range and place in the image go their own ways: near and far on either side, above and below.
SIDES = ((-0.5, -0.3), (0.5, -0.3), (-0.5, 0.3), (0.5, 0.3))
PLACES = [(x * z, y * z, z) for z in (1.5, 2.5, 4.0) for x, y in SIDES]


def pose(place: Sequence[float], tilt_deg: float = 15.0, about_rad: float = 0.0) -> Pose:
    """T_cam_target of the marker at a place (3,) [m], tilted against the image."""
    axis = np.array([np.cos(about_rad), np.sin(about_rad), 0.0])
    return make_pose(exp_so3(np.radians(tilt_deg) * axis), np.array(place))


def plane_depth(T_cam_target: Pose) -> Array:
    """(480, 640) exact depth of the marker's plane, which goes on for ever."""
    rows, columns = np.mgrid[:480, :640]
    rays = np.stack([(columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1], np.ones_like(rows)], axis=-1)
    n = T_cam_target[:3, 2]
    return (n @ T_cam_target[:3, 3]) / (rays @ n)


def shown(
    poses: Sequence[Pose],
    noise: SimulatedNoise = EXACT,
    bias: SimulatedBias | None = None,
    seed: int = 0,
    confidence: Array | None = None,
) -> list[FaceDepth]:
    """What the camera's depth measures on the marker, frame by frame."""
    rng = np.random.default_rng(seed)
    fixed = fixed_error((480, 640), noise, rng)
    faces: list[FaceDepth | None] = []
    for frame, T in enumerate(poses):
        (patch,) = patches(CAMERA, sight(CAMERA, T, MARKER, 0.0, rng), MARKER)
        depth, part = np.full((480, 640), np.nan, dtype=np.float32), around(patch.outline_px)
        exact = plane_depth(T).astype(np.float32)[part]
        depth[part] = measure_depth(exact, fixed[part], noise, bias or SimulatedBias(), FOCAL_BASELINE, rng)
        faces.append(face_depth(patch, depth, camera="a", frame=frame, confidence=confidence))
    return [face for face in faces if face is not None]


def around(outline_px: Array) -> tuple[slice, slice]:
    """Rows and columns that a marker takes up, and some more: noise of the whole image takes long."""
    low = np.maximum(outline_px.min(axis=0).astype(int) - 10, 0)
    high = outline_px.max(axis=0).astype(int) + 10
    return slice(low[1], high[1]), slice(low[0], high[0])


def rig(poses: Sequence[Pose], T_world_cam: Pose | None = None) -> RigEstimate:
    """A rig of that camera in the origin, or in another place than where it was."""
    frames = tuple(range(len(poses)))
    placed = Placement(
        T_world_cam=np.eye(4) if T_world_cam is None else T_world_cam,
        spread_rad=0.0,
        spread_m=0.0,
        frames=frames,
        n_views=len(frames),
        n_ambiguous=0,
    )
    return RigEstimate(cameras={"a": placed}, lost={}, T_world_target=dict(enumerate(poses)))
