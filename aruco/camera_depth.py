"""What one camera's depth saw of a resting scene, checked at birth.

Owns      CameraDepth, and whether it fits together.
Leaves    making one to depth_pool, keeping it to depth_save.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aruco.depth_image import check_depth, with_holes
from aruco.depth_pool import KeptFrame, PooledDepth
from aruco.errors import InputError
from aruco.model import name_trouble
from aruco.pose_math import Array

# The principal point lies near the middle: where it is farther off (share of the image), intrinsics are those of
# another resolution. Half and twice the resolution put it at a quarter and at the whole.
MAX_OFF_CENTRE = 0.2
# Focal lengths over the longer side of the image: fields of view from half a degree to 178.
FOCAL_SHARES = (0.01, 100.0)
MAX_CONFIDENCE = 100
# So many measurements of a pixel can be counted in 16 bits, and no more images can have been pooled.
MAX_POOLED = np.iinfo(np.uint16).max
_INT64 = np.iinfo(np.int64)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraDepth:
    """What one camera saw of the resting scene."""

    depth: NDArray[np.float32]  # (H, W) metres along the optical axis, NaN = none
    K: Array  # (3, 3) of the depth image
    confidence: NDArray[np.uint8] | None = None  # (H, W) 0..100, lower is more trustworthy
    spread: NDArray[np.float32] | None = None  # (H, W) robust standard deviation over time [m]
    count: NDArray[np.uint16] | None = None  # (H, W) measurements pooled
    n_frames: int = 1  # images pooled
    baseline_m: float | None = None  # stereo cameras: distance of the two eyes
    frames: Mapping[int, KeptFrame] = field(default_factory=dict)  # single images that were pooled, by stamp [ns]

    def __post_init__(self) -> None:
        """Check that everything has the size of the depth, and the intrinsics; InputError says what does not."""
        if np.ndim(self.depth) != 2:
            raise InputError(f"depth must be an image (H, W), got shape {np.shape(self.depth)}.")
        with np.errstate(over="ignore"):  # beyond single precision nothing is a depth; infinite is a hole
            object.__setattr__(self, "depth", np.asarray(self.depth, dtype=np.float32))
        images = {"confidence": self.confidence, "spread": self.spread, "count": self.count}
        images |= {f"frame {stamp}": frame.depth for stamp, frame in self.frames.items()}
        for name, image in images.items():
            if image is not None and np.shape(image) != self.depth.shape:
                raise InputError(f"{name} of shape {np.shape(image)} beside depth of {self.depth.shape}.")
        object.__setattr__(self, "confidence", _counted("confidence", self.confidence, MAX_CONFIDENCE, np.uint8))
        object.__setattr__(self, "count", _counted("count", self.count, MAX_POOLED, np.uint16))
        object.__setattr__(self, "K", _checked_intrinsics(self.K))
        if not 1 <= self.n_frames <= MAX_POOLED:
            raise InputError(f"n_frames must be positive and at most {MAX_POOLED}, got {self.n_frames}.")
        if self.baseline_m is not None and not (math.isfinite(self.baseline_m) and self.baseline_m > 0):
            raise InputError(f"baseline must be positive metres, got {self.baseline_m}.")

    @property
    def focal_baseline(self) -> float | None:
        """Focal length times baseline [px m]; None where the baseline is not known."""
        return None if self.baseline_m is None else float(self.K[0, 0]) * self.baseline_m

    def as_camera_data(self) -> dict[str, Any]:
        """The form in which ground_plane and icp_registration take it."""
        return {
            "depth": self.depth,
            "K": self.K,
            "confidence": self.confidence,
            "spread": self.spread,
            "count": self.count,
            "baseline": self.baseline_m,
            "n_frames": self.n_frames,
        }


def camera_depth(pooled: PooledDepth, *, K: Array, baseline_m: float | None = None) -> CameraDepth:
    """Pooled depth with the intrinsics (3, 3) of its images; raises InputError where they are none."""
    return CameraDepth(
        depth=pooled.depth,
        K=K,
        confidence=pooled.confidence,
        spread=pooled.spread,
        count=pooled.count,
        n_frames=pooled.n_frames,
        baseline_m=baseline_m,
        frames=pooled.frames,
    )


def check_name(name: str, where: str) -> str:
    """A camera's name, if it can be that of a group in a store, of a folder and of an entry in an extrinsics file.

    Raises:
        InputError: It cannot.
    """
    if trouble := name_trouble(name):
        raise InputError(f"{where}: {name[:40]!r} cannot be a camera's name: {trouble}; rename the camera.")
    return name


def check_camera(camera: CameraDepth, where: str, *, may_be_blind: bool = False) -> None:
    """Find out whether a camera's depth can be worked with.

    Args:
        camera: What it saw.
        where: File and camera, for the message.
        may_be_blind: Depth without any measurement passes.

    Raises:
        InputError: The depth is none (see depth_image.check_depth), a kept frame has no stamp or score that can be
            one, or the intrinsics are those of another size.
    """
    (with_holes if may_be_blind else check_depth)(camera.depth, where)
    for stamp, frame in camera.frames.items():
        with_holes(frame.depth, f"{where}, frame {stamp}")
        if not _INT64.min <= stamp <= _INT64.max:
            raise InputError(
                f"{where}, frame {stamp}: this is no stamp in ns of 64 bits; check the recording's stamps."
            )
        if not 0.0 <= frame.score <= 1.0:
            raise InputError(f"{where}, frame {stamp}: score must be from 0 to 1, got {frame.score}; pool it again.")
    size = np.array(camera.depth.shape[::-1])
    shares = np.diag(camera.K)[:2] / size.max()
    if shares.min() < FOCAL_SHARES[0] or shares.max() > FOCAL_SHARES[1] or abs(camera.K[0, 1]) > camera.K[0, 0]:
        raise InputError(
            f"{where}: intrinsics with focal lengths of {camera.K[0, 0]:.4g} and {camera.K[1, 1]:.4g} pixels and skew "
            f"{camera.K[0, 1]:.4g} are no camera of {size[0]} x {size[1]} pixels; give those of the depth image."
        )
    centre = camera.K[:2, 2]
    if (np.abs((centre + 0.5) / size - 0.5) > MAX_OFF_CENTRE).any():
        raise InputError(
            f"{where}: intrinsics with the principal point at ({centre[0]:.0f}, {centre[1]:.0f}) do not fit depth of "
            f"{size[0]} x {size[1]} pixels; give those of the depth image's resolution."
        )


def _counted(
    name: str, image: Any, most: int, kind: type[np.unsignedinteger[Any]]
) -> NDArray[np.unsignedinteger[Any]] | None:
    """An image of whole numbers from 0 to ``most`` in its own type; a cast would let others wrap around."""
    if image is None:
        return None
    given = np.asarray(image)
    if given.dtype.kind not in "ui" or (given.size and (given.min() < 0 or given.max() > most)):
        raise InputError(f"{name} must hold whole numbers from 0 to {most} ({np.dtype(kind)}).")
    return given.astype(kind, copy=False)


def _checked_intrinsics(K: Any) -> Array:
    matrix = np.array(K, dtype=np.float64)
    if matrix.shape != (3, 3):
        raise InputError(f"intrinsics must be a matrix (3, 3), got shape {matrix.shape}.")
    if not np.isfinite(matrix).all():
        raise InputError("intrinsics hold NaN or infinite numbers; give those of the depth image.")
    if matrix[0, 0] <= 0 or matrix[1, 1] <= 0 or matrix[1, 0] != 0 or not np.allclose(matrix[2], [0, 0, 1]):
        raise InputError("intrinsics are no camera matrix [[fx, s, cx], [0, fy, cy], [0, 0, 1]] with positive fx, fy.")
    matrix.setflags(write=False)
    return matrix
