"""What every format of calibrations holds and offers: camera poses in one world, and a way in and out.

Owns      the Rig, what an exporter may be told, what a format is, turning worlds upright, what a format may demand.
Leaves    each layout to its own file, choosing among them to registry.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from aruco.errors import InputError
from aruco.model import Camera, UpAxis
from aruco.pose_math import Pose, checked_pose, make_pose

# What files that have no place for it say of the world's up, and what it means.
UP_WORDS: Mapping[str, UpAxis] = {"+y": "+y", "-y": "-y"}
# How the word for a camera stands in a pattern.
CAMERA_WORD = "{camera}"

# Half a turn about x: of a world, Y up from Y down and back; of a camera, OpenGL's axes from OpenCV's and back.
HALF_TURN_X = np.diag([1.0, -1.0, -1.0, 1.0])
# What principal points that count from the corner of the top left pixel have more than those from its centre [px].
HALF_PIXEL = 0.5
# (x, y, z) -> (x, -z, y): a world with Z up from one with Y up, a quarter turn about x.
_Z_UP_FROM_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rig:
    """Where the cameras stand, and what is known of world and lenses. Camera axes are OpenCV's, lengths metres."""

    T_world_cam: Mapping[str, Pose]  # sorted by name
    up: UpAxis | None = None  # which axis of the world points against gravity; None: unknown
    origin: str = "unknown"  # what the world's origin is tied to: "target", "floor", "camera", or nobody knows
    cameras: Mapping[str, Camera] = field(default_factory=dict)  # intrinsics, where known; sorted by name

    def __post_init__(self) -> None:
        """Check every pose, sort by name.

        Raises:
            ValueError: A pose is not rigid, or intrinsics are those of another camera, or of one without a pose.
        """
        poses = {name: checked_pose(T, f"{name}.T_world_cam") for name, T in sorted(self.T_world_cam.items())}
        if odd := [name for name, camera in self.cameras.items() if name not in poses or camera.name != name]:
            raise ValueError(f"intrinsics of {sorted(odd)}: of another camera, or of one without a pose")
        object.__setattr__(self, "T_world_cam", poses)
        object.__setattr__(self, "cameras", dict(sorted(self.cameras.items())))


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportOptions:
    """What an exporter may be told besides the rig; each looks at what its Format.takes names."""

    parent_frame: str = "world"  # the frame that the poses are given in
    frame_name: str = "{camera}_left_camera_optical_frame"  # a camera's frame, with the word {camera}
    image_name: str | None = None  # a camera's image, with the word {camera}; None: as the format has it
    into: Path | None = None  # a file of the format, of which only the poses are replaced

    def __post_init__(self) -> None:
        """Refuse patterns that give every camera the same name."""
        for option, pattern in (("--frame-name", self.frame_name), ("--image-name", self.image_name)):
            if pattern is not None and CAMERA_WORD not in pattern:
                raise InputError(f"{option} {pattern!r}: lacks the word {CAMERA_WORD}, where the camera's name goes.")


def filled(pattern: str, camera: str) -> str:
    """A pattern with a camera's name in it."""
    return pattern.replace(CAMERA_WORD, camera)


@dataclass(frozen=True, slots=True, kw_only=True)
class Format:
    """One layout of calibrations. Each format's module offers one as the constant FORMAT."""

    name: str  # as given to --to
    suffix: str  # of the file that is written; "" for a folder
    explain: str  # one line: what the numbers mean: direction, axes, units, world, what is lost
    # The layout's part of write.
    put: Callable[[Rig, Path, ExportOptions], None]
    # Read; raises InputError with a sentence that names the file.
    read: Callable[[Path], Rig]
    # By content: the path and its first 64 KiB (b"" for folders); cheap, never raises.
    recognises: Callable[[Path, bytes], bool]
    # Intrinsics of a file that need not have poses; None: the format has none.
    read_cameras: Callable[[Path], Mapping[str, Camera]] | None = None
    needs_up: bool = False  # writes upright worlds only
    needs_cameras: bool = False  # writes no camera without intrinsics
    takes: frozenset[str] = frozenset()  # the fields of ExportOptions that it looks at

    def write(self, rig: Rig, out: Path, options: ExportOptions) -> None:
        """Write a rig whole or not at all.

        Raises:
            InputError: The format cannot hold it; the message says why and what to do.
            OutputError: The output cannot be written.
        """
        for name in rig.T_world_cam:
            check_name(name, out)
        if self.needs_up:
            check_up(rig, self.name)
        if self.needs_cameras:
            check_cameras(rig, self.name)
        self.put(rig, out, options)


def y_up(rig: Rig, who: str) -> dict[str, Pose]:
    """T_world_cam of every camera, in the rig's world turned so that its +Y points up.

    Raises:
        InputError: Nobody knows which way is up; ``who`` is the format that wants to.
    """
    check_up(rig, who)
    if rig.up == "+y":
        return dict(rig.T_world_cam)
    return {name: turned(HALF_TURN_X[:3, :3], T) for name, T in rig.T_world_cam.items()}


def z_up(T_world_cam: Pose) -> Pose:
    """The same camera in a world with +Z up, from one with +Y up: (x, y, z) -> (x, -z, y)."""
    return turned(_Z_UP_FROM_Y_UP, T_world_cam)


def y_up_of_z_up(T_world_cam: Pose) -> Pose:
    """The inverse of z_up: (x, y, z) -> (x, z, -y)."""
    return turned(_Z_UP_FROM_Y_UP.T, T_world_cam)


def turned(R: Pose, T_world_cam: Pose) -> Pose:
    """A pose after its world's axes are turned by a (3, 3) rotation."""
    return make_pose(R @ T_world_cam[:3, :3], R @ T_world_cam[:3, 3])


def check_up(rig: Rig, who: str) -> None:
    """See that the rig's world says which way is up.

    Raises:
        InputError: It does not; ``who`` is the format that wants to know.
    """
    if rig.up is not None:
        return
    wish = f"{who} wants a world that stands upright, and this calibration does not say which way is up; "
    if rig.origin not in ("camera", "unknown"):  # rigcal's own: nobody else ties a world to a target or a floor
        raise InputError(f"{wish}calibrate again with --auto-align.")
    raise InputError(
        f"{wish}convert rigcal's own extrinsics of this rig instead, or, if you know that +y of its world points up, "
        "convert it to native first and write [0, 1, 0] for up under _meta.world there."
    )


def check_cameras(rig: Rig, who: str) -> None:
    """See that every camera has intrinsics.

    Raises:
        InputError: Some have none; ``who`` is the format that wants them.
    """
    if missing := listed(rig.T_world_cam.keys() - rig.cameras.keys()):
        raise InputError(
            f"{who} wants intrinsics, and those of camera {missing} are not known; give the recording that the "
            "calibration was made from as --recording."
        )


def pinhole_of(camera: Camera, who: str) -> tuple[float, float, float, float]:
    """Focal lengths and principal point (fx, fy, cx, cy) [px].

    Raises:
        InputError: The pixels' axes are not at right angles, which the format ``who`` cannot say.
    """
    (fx, skew, cx), (_, fy, cy) = camera.K[:2].tolist()
    if skew != 0.0:
        raise InputError(
            f"{who} cannot hold the skew of camera {camera.name} (camera_matrix[0, 1] = {skew:g}); choose another "
            "format, or calibrate the lens without skew."
        )
    return fx, fy, cx, cy


def refuse_distortion(camera: Camera, who: str, held: str) -> InputError:
    """The sentence for a lens that the format ``who`` cannot describe; ``held`` is what it can."""
    return InputError(
        f"{who} cannot hold the {camera.distortion_model} distortion of camera {camera.name}: it has {held}; undistort "
        "the images first, or choose another format."
    )


def check_name(name: str, where: object) -> None:
    """See that a camera's name can be a key of the extrinsics file and a folder's name.

    Raises:
        InputError: It cannot; ``where`` is the file.
    """
    # Text of other programs breaks at signs that cannot be printed, and cv2 crashes at half a surrogate.
    bad = not name.isprintable() or any(sign in name for sign in "/\\")
    if bad or not name or name.startswith("_") or name in (".", ".."):
        raise InputError(
            f"{where}: a camera cannot be called {name[:80]!r}: no slashes, only signs that can be printed, no _ in "
            "front; rename it."
        )


def numbered_name(index: int) -> str:
    """What a camera is called that a file gives no name."""
    return f"cam{index}"


def listed(names: Iterable[str]) -> str:
    """Names for a message."""
    return ", ".join(sorted(names))
