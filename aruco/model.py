"""The vocabulary: what a recording, a camera, a sighting and a result are.

Owns      frozen types, checked at birth, and the protocols Recording and Progress.
Leaves    reading files to rigcal.sources; lens formulas to lens.

Arrays inside these types are read-only. Camera axes are OpenCV's (x right, y down, z forward); pixel (0, 0) is the
centre of the top left pixel.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, get_args, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from aruco.errors import InputError
from aruco.pose_math import Array, Pose, checked_pose

DistortionModel = Literal["plumb_bob", "rational_polynomial", "equidistant"]

# How many coefficients a model has, and how many a file may give (the rest are zero).
COEFFICIENTS: dict[DistortionModel, tuple[int, ...]] = {
    "plumb_bob": (0, 4, 5),
    "rational_polynomial": (8,),
    "equidistant": (4,),
}

# Larger images than this are taken for a damaged header, not for a camera.
MAX_IMAGE_SIDE_PX = 32768
MAX_NAME_BYTES = 200  # file systems hold 255, of which suffixes take some


def _frozen_array(values: Any, shape: tuple[int, ...], name: str) -> Array:
    array = np.array(values, dtype=np.float64)
    if array.shape != shape:
        raise InputError(f"{name}: want shape {shape}, got {array.shape}.")
    if not np.isfinite(array).all():
        raise InputError(f"{name}: holds NaN or infinite numbers.")
    array.setflags(write=False)
    return array


def _checked_intrinsics(K: Any, name: str) -> Array:
    matrix = _frozen_array(K, (3, 3), name)
    if matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
        raise InputError(f"{name}: focal lengths must be positive, got fx={matrix[0, 0]:g}, fy={matrix[1, 1]:g}.")
    if not np.allclose(matrix[2], [0, 0, 1]) or matrix[1, 0] != 0:
        raise InputError(f"{name}: not a camera matrix [[fx, s, cx], [0, fy, cy], [0, 0, 1]].")
    return matrix


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Camera:
    """One camera's intrinsics, as its recording states them."""

    name: str
    width: int
    height: int
    K: Array  # (3, 3) of the image as recorded
    distortion_model: DistortionModel = "plumb_bob"
    distortion: Array = field(default_factory=lambda: np.zeros(5))  # in OpenCV's order
    depth_K: Array | None = None  # (3, 3) of the depth image; None: like K
    depth_scale: float = 0.001  # metres per unit of a 16-bit depth image
    baseline_m: float | None = None  # stereo cameras: distance of the two eyes

    def __post_init__(self) -> None:
        """Check every field; see InputError's message for what is wrong."""
        who = f"camera {self.name}"
        if not self.name or self.name.startswith("_"):
            raise InputError(f"{who}: names that start with _ are no cameras in extrinsics files; rename its folder.")
        if not (0 < self.width <= MAX_IMAGE_SIDE_PX and 0 < self.height <= MAX_IMAGE_SIDE_PX):
            raise InputError(f"{who}: image size {self.width} x {self.height} is not a camera's.")
        object.__setattr__(self, "K", _checked_intrinsics(self.K, f"{who}: camera_matrix"))
        if self.depth_K is not None:
            object.__setattr__(self, "depth_K", _checked_intrinsics(self.depth_K, f"{who}: depth_camera_matrix"))
        object.__setattr__(self, "distortion", self._padded_distortion(who))
        if not (np.isfinite(self.depth_scale) and self.depth_scale > 0):
            raise InputError(f"{who}: depth_scale must be positive metres per unit, got {self.depth_scale}.")
        if self.baseline_m is not None and not (np.isfinite(self.baseline_m) and self.baseline_m > 0):
            raise InputError(f"{who}: baseline must be positive metres, got {self.baseline_m}.")

    def _padded_distortion(self, who: str) -> Array:
        if self.distortion_model not in get_args(DistortionModel):
            raise InputError(
                f"{who}: unknown distortion_model {self.distortion_model!r}; known: {', '.join(COEFFICIENTS)}."
            )
        given = np.asarray(self.distortion, dtype=np.float64).ravel()
        allowed = COEFFICIENTS[self.distortion_model]
        extra = given[max(allowed) :]
        if len(given) > max(allowed) and not extra.any():
            given = given[: max(allowed)]
        if len(given) not in allowed:
            raise InputError(
                f"{who}: {self.distortion_model} wants {max(allowed)} distortion_coefficients, got {len(given)}."
            )
        padded = np.concatenate([given, np.zeros(max(allowed) - len(given))])
        return _frozen_array(padded, (max(allowed),), f"{who}: distortion_coefficients")

    @property
    def K_depth(self) -> Array:
        """(3, 3) of the depth image."""
        return self.K if self.depth_K is None else self.depth_K

    @property
    def has_distortion(self) -> bool:
        """Whether pixels differ from those of a pinhole with the same K."""
        return self.distortion_model == "equidistant" or bool(self.distortion.any())


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frame:
    """One image of one camera, with what was measured at the same moment."""

    camera: str
    stamp_ns: int
    image: NDArray[np.uint8]  # (h, w) grey or (h, w, 3) BGR
    digest: str = ""  # SHA-256 of the bytes it was read from, hexadecimal
    depth_m: NDArray[np.float32] | None = None  # (h, w) along the optical axis, NaN where unknown
    confidence: NDArray[np.uint8] | None = None  # (h, w) 0..100, lower is more trustworthy


@dataclass(frozen=True, slots=True)
class BadFrame:
    """A frame that could not be read, and why. Life goes on with the others."""

    camera: str
    stamp_ns: int
    reason: str
    depth_may_be_why: bool = False  # then the image may be readable alone


def name_trouble(name: str) -> str:
    """Why no camera can be called this, in words; empty if one can.

    A camera's name is that of a folder, of an entry in extrinsics files, and of a group in a depth store.
    """
    size = len(name.encode("utf-8", "surrogatepass"))
    if size > MAX_NAME_BYTES:
        return f"its name has {size} bytes, and may have {MAX_NAME_BYTES}"
    if name in ("", ".", "..") or any(sign in name for sign in "/\\\0"):
        return "a folder cannot have this name"
    if name.startswith("_"):
        return "names that start with _ are no cameras in extrinsics files"
    if any("\ud800" <= sign <= "\udfff" for sign in name):
        return "its name is not valid UTF-8"
    return "" if name.isprintable() else "its name holds a sign that cannot be printed"


class Recording(Protocol):
    """What every source of frames offers. Nothing else may be asked of it."""

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras, sorted by name."""
        ...

    def stamps_ns(self, camera: str) -> NDArray[np.int64]:
        """The sorted time stamps of a camera's frames, without decoding them."""
        ...

    def depth_indices(self, camera: str) -> NDArray[np.int64]:
        """Ascending indices of the camera's frames that have depth, as far as is known without decoding them."""
        ...

    def frames(self, camera: str, indices: Sequence[int], *, depth: bool = False) -> Iterator[Frame | BadFrame]:
        """A camera's frames at ascending indices into its stamps, one at a time; depth only when asked for."""
        ...


@runtime_checkable
class KnowsUp(Protocol):
    """A recording whose cameras measured gravity."""

    def up_in_camera(self, camera: str) -> Array | None:
        """(3,) unit vector against gravity in the camera's axes, over the whole recording; None: not measured."""
        ...


class Progress(Protocol):
    """Somebody who wants to know how far a long step has come."""

    def step(self, name: str, done: int, total: int) -> None:
        """``done`` of ``total`` units of the step ``name`` are finished."""
        ...


class _Silent:
    def step(self, name: str, done: int, total: int) -> None:
        pass


SILENT: Progress = _Silent()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Detection:
    """What was found of the target in one image: markers with four corners, or single points of a board (k = 1)."""

    ids: NDArray[np.int64]  # (n,), ascending
    corners_px: Array  # (n, k, 2); a marker's k = 4 corners in ArUco order
    sigma_px: Array  # (n, k) standard deviation of a corner's coordinate, from the fit of its edges

    def __post_init__(self) -> None:
        """Check shapes and freeze."""
        n, shape = len(self.ids), self.corners_px.shape
        if len(shape) != 3 or shape[0] != n or shape[1] < 1 or shape[2] != 2 or self.sigma_px.shape != shape[:2]:
            raise ValueError(f"want (n, k, 2) corners and (n, k) sigmas for {n} ids")
        for array in (self.ids, self.corners_px, self.sigma_px):
            array.setflags(write=False)

    def __len__(self) -> int:
        """How many markers there are."""
        return len(self.ids)

    def only(self, keep: NDArray[np.bool_]) -> Detection:
        """The markers where the mask ``keep`` (n,) is true."""
        return Detection(ids=self.ids[keep], corners_px=self.corners_px[keep], sigma_px=self.sigma_px[keep])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sighting:
    """What one camera saw of the target at one moment: the detection that belongs to a synchronised frame."""

    camera: str
    frame: int  # index of the synchronised frame; equal for all cameras of one moment
    stamp_ns: int
    detection: Detection


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraPose:
    """Where one camera stands in the world, and how well the views agree about it."""

    camera: str
    T_world_cam: Pose
    n_frames: int  # views that took part
    n_markers: int  # distinct markers seen in them
    rms_px: float  # reprojection over all corners, per corner (both coordinates)
    spread_m: float  # root mean square distance of single views from the average
    spread_rad: float
    covariance: Array | None = None  # (6, 6) of the left perturbation (rotation, translation), world axes
    least_known: str = ""  # the least observable direction in words; empty without a covariance
    kept: bool = False  # stands where an earlier calibration put it, to the bit
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check the pose and freeze it."""
        object.__setattr__(self, "T_world_cam", checked_pose(self.T_world_cam, f"{self.camera}.T_world_cam"))


UpAxis = Literal["+y", "-y"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameCounts:
    """What became of one camera's frames."""

    recorded: int = 0
    unpaired: int = 0  # no partner within the synchronisation tolerance
    read: int = 0  # chosen and decoded
    bad: int = 0  # chosen, but unreadable
    with_markers: int = 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Calibration:
    """Every camera's pose in one world, and what is known about how good they are."""

    cameras: tuple[CameraPose, ...]  # sorted by name
    lost: Mapping[str, str]  # camera -> why it has no pose
    up: UpAxis | None  # None: the world is the target's frame, whichever way that lies
    frames: Mapping[str, FrameCounts]
    notes: Mapping[str, Any] = field(default_factory=dict)  # further entries of _meta: aligned, sync, provenance
    origin: str = "target"  # what the world's origin is tied to
    kept: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # cameras of an earlier file: their entries
    kept_meta: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # key of that file's _meta -> camera
    idle: Mapping[str, str] = field(default_factory=dict)  # kept cameras of the recording that took no part: why
    stale: frozenset[str] = frozenset()  # of these, those whose views contradict where they are kept
    parts: tuple[Calibration, ...] = ()  # cameras that nothing connects with these, each group in a world of its own

    @property
    def T_world_cam(self) -> dict[str, Pose]:
        """Camera -> pose."""
        return {camera.camera: camera.T_world_cam for camera in self.cameras}

    @property
    def is_whole(self) -> bool:
        """Whether every camera of the recording has a pose that its views do not contradict."""
        return not self.lost and not self.stale

    @property
    def is_bad(self) -> bool:
        """Whether the checks on what was not used call it bad."""
        return self.notes.get("quality", {}).get("verdict") == "bad"
