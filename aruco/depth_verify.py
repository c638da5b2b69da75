"""Does measured depth agree with where the target is?

Owns      errors of depth at marker corners and over faces, camera by camera.
Leaves    sampling to depth_patches, slopes to depth_trends, words to depth_words, correcting to depth_refine.

An error is measured minus predicted depth: positive where the camera measures too far. A known bias is taken out of
the measurement first. Pixels whose confidence is worse than depth_pool.WORST_CONFIDENCE are left out, and so is a
marker with too few others or with several surfaces on it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from aruco.depth_agreement import DepthAgreement, DepthErrors, DepthRow
from aruco.depth_bias import DepthBias
from aruco.depth_noise import DepthNoise
from aruco.depth_patches import FaceDepth, typical_ratio
from aruco.depth_tiles import face_sigma_m, face_tiles, predicted_inverse
from aruco.depth_trends import TileErrors, trends
from aruco.pose_math import Array, Pose, invert_transform
from aruco.rig_estimate import RigEstimate

__all__ = ["DepthAgreement", "DepthCamera", "DepthErrors", "DepthRow", "verify_depth"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthCamera:
    """What has to be known of a camera to compare its depth."""

    K: Array  # (3, 3) of the depth image
    noise: DepthNoise


def verify_depth(
    faces: Mapping[str, Sequence[FaceDepth]],
    rig: RigEstimate,
    cameras: Mapping[str, DepthCamera],
    biases: Mapping[str, DepthBias] | None = None,
) -> dict[str, DepthAgreement]:
    """Compare measured depth with where a rig says that the target is.

    Args:
        faces: Camera -> what it measured.
        rig: Poses of cameras and target.
        cameras: Camera -> intrinsics and noise of its depth.
        biases: Camera -> its bias, where it is known; taken out of the measurement.

    Returns:
        Camera -> agreement, for every camera of the rig that measured anything.
    """
    known = biases or {}
    found: dict[str, DepthAgreement] = {}
    for name, measured in faces.items():
        if name in rig.cameras and measured:
            T_cam_world, camera = invert_transform(rig.cameras[name].T_world_cam), cameras[name]
            compared = [
                _compared(face, T_cam_world @ rig.T_world_target[face.frame], camera, known.get(name))
                for face in measured
                if face.frame in rig.T_world_target
            ]
            found[name] = _agreement(name, measured, compared, camera, known.get(name))
    return found


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Compared:
    """One face that was compared."""

    face: FaceDepth  # of what took part, its bias taken out
    T_cam_target: Pose
    inside: DepthErrors  # pixels
    corners: DepthErrors
    rows: tuple[DepthRow, ...]


def _compared(face: FaceDepth, T_cam_target: Pose, camera: DepthCamera, bias: DepthBias | None) -> _Compared | None:
    """One face; None where its pixels are too few or of several surfaces."""
    predicted, measured = face.predicted_m(T_cam_target, camera.K), _corrected(face.measured_m, bias)
    good = face.trusted & np.isfinite(predicted) & np.isfinite(measured)
    if math.isnan(typical_ratio(measured[good], predicted[good])):
        return None
    inside = _errors(measured[good], predicted[good], face, camera)
    at_corner, beside = face.predicted_corners_m(T_cam_target), _corrected(face.corner_depth_m, bias)
    seen = np.flatnonzero(np.isfinite(beside) & (at_corner > 0))
    corners = _errors(beside[seen], at_corner[seen], face, camera)
    return _Compared(
        face=replace(face, pixels=face.pixels[good], measured_m=measured[good], confidence=None),
        T_cam_target=T_cam_target,
        inside=inside,
        corners=corners,
        rows=(_face_row(face, good, inside, camera), *_corner_rows(face, seen, corners)),
    )


def _corrected(measured_m: Array, bias: DepthBias | None) -> Array:
    return measured_m if bias is None else bias.corrected(measured_m)


def _errors(measured_m: Array, predicted_m: Array, face: FaceDepth, camera: DepthCamera) -> DepthErrors:
    sigma_m = camera.noise.averaged_sigma_m(predicted_m, face.n_averaged)
    return DepthErrors(predicted_m=predicted_m, errors_m=measured_m - predicted_m, sigma_m=sigma_m)


def _tile_errors(compared: Sequence[_Compared], camera: DepthCamera) -> TileErrors:
    """The errors of all faces, tile by tile; faces in the same part of the image share what is fixed of them."""
    poses = {c.face.frame: c.T_cam_target for c in compared}
    frames, T_cam_target = list(poses), list(poses.values())
    tiles = face_tiles([c.face for c in compared], 0, frames, T_cam_target, camera.K, camera.noise)
    range_m = 1.0 / predicted_inverse(tiles, T_cam_target)
    return TileErrors(
        places=tiles.ray[:, :2],
        range_m=range_m,
        errors_m=1.0 / tiles.inverse - range_m,
        sigma_m=tiles.sigma * range_m**2,
        alone_m=tiles.alone * range_m**2,
    )


def _face_row(face: FaceDepth, good: NDArray[np.bool_], inside: DepthErrors, camera: DepthCamera) -> DepthRow:
    x_px, y_px = face.pixels[good].mean(axis=0)
    predicted_m = float(np.median(inside.predicted_m))
    return DepthRow(
        camera=face.camera,
        frame=face.frame,
        marker=face.marker,
        corner=None,
        x_px=float(x_px),
        y_px=float(y_px),
        predicted_m=predicted_m,
        # Pixel by pixel beside the prediction: on a tilted marker the middle of all depths has another place.
        recorded_m=predicted_m + float(np.median(face.measured_m[good] - inside.predicted_m)),
        error_m=inside.median_m,
        sigma_m=face_sigma_m(predicted_m, len(inside), face.n_averaged, camera.noise),
        n_pixels=len(inside),
        n_averaged=face.n_averaged,
    )


def _corner_rows(face: FaceDepth, seen: NDArray[np.int64], corners: DepthErrors) -> list[DepthRow]:
    return [
        DepthRow(
            camera=face.camera,
            frame=face.frame,
            marker=face.marker,
            corner=int(k),
            x_px=float(face.corners_px[k, 0]),
            y_px=float(face.corners_px[k, 1]),
            predicted_m=float(corners.predicted_m[i]),
            recorded_m=float(face.corner_depth_m[k]),
            error_m=float(corners.errors_m[i]),
            sigma_m=float(corners.sigma_m[i]),
            n_pixels=1,
            n_averaged=face.n_averaged,
        )
        for i, k in enumerate(seen.tolist())
    ]


def _agreement(
    name: str,
    measured: Sequence[FaceDepth],
    compared: Sequence[_Compared | None],
    camera: DepthCamera,
    bias: DepthBias | None,
) -> DepthAgreement:
    kept = [c for c in compared if c is not None]
    inside, corners = _together([c.inside for c in kept]), _together([c.corners for c in kept])
    near, far = (inside.predicted_m.min(), inside.predicted_m.max()) if len(inside) else (math.nan, math.nan)
    trusted = np.concatenate([face.trusted for face in measured])
    return DepthAgreement(
        camera=name,
        corners=corners,
        faces=inside,
        rows=tuple(row for c in kept for row in c.rows),
        trends=trends(_tile_errors(kept, camera)),
        range_m=(float(near), float(far)),
        n_faces=len(kept),
        n_frames=len({c.face.frame for c in kept}),
        n_left_out=len(compared) - len(kept),
        untrusted_share=float(1.0 - trusted.mean()),
        bias=bias,
    )


def _together(errors: Sequence[DepthErrors]) -> DepthErrors:
    return DepthErrors(
        predicted_m=np.concatenate([np.empty(0), *(e.predicted_m for e in errors)]),
        errors_m=np.concatenate([np.empty(0), *(e.errors_m for e in errors)]),
        sigma_m=np.concatenate([np.empty(0), *(e.sigma_m for e in errors)]),
    )
