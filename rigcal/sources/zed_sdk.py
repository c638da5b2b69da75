"""ZED recordings (SVO, SVO2) through their maker's SDK, where that is installed.

Owns      which settings of the SDK a calibration needs, the stamps of a file, and what becomes of images and errors.
Leaves    SVO2 files without the SDK to svo2; the open camera, seeking and grabbing to zed_player.

Settings: every frame is read (no real-time mode), lengths are metres and axes the image's (x right, y down, z
forward), self-calibration is off (it would change the intrinsics from run to run), and depth is neither filled in nor
smoothed over time: both invent what was not measured, and after a jump in the file the smoothing would mix moments.

The names are those that the SDK's Python API (pyzed.sl, versions 4 and 5) documents; it was only tested against a
stand-in that follows this description, as the SDK needs an NVIDIA GPU.
"""

from __future__ import annotations

import hashlib
import importlib
import os
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from loguru import logger
from numpy.typing import NDArray

from aruco.errors import InputError
from aruco.model import BadFrame, Camera, Frame
from aruco.pose_math import Array
from aruco.svo_sync import MAX_STAMP_NS
from rigcal.sources.image_file import MAX_PIXELS
from rigcal.sources.mcap_records import MAGIC
from rigcal.sources.options import SourceOptions
from rigcal.sources.zed_gravity import up_of
from rigcal.sources.zed_player import NotShownError, Pass, Place, Player


def is_available() -> bool:
    """Whether the SDK's Python API can be imported here."""
    try:
        importlib.import_module("pyzed.sl")
    except (ImportError, OSError, RuntimeError, ValueError) as error:  # the latter: built for another numpy or CUDA
        logger.debug("pyzed: {}", error)
        return False
    return True


def recognises(path: Path, head: bytes) -> bool:
    """Whether this is a file for the SDK: ``.svo``, which only it reads, and SVO2 where the SDK is installed."""
    suffix = path.suffix.lower()
    if suffix not in (".svo", ".svo2") or not os.path.isfile(path) or not any(head):
        return False  # an empty file, or one of zeros, is not the SDK's to explain
    return is_available() if suffix == ".svo2" or head.startswith(MAGIC) else True


def opened(path: Path, options: SourceOptions) -> ZedRecording:
    """Open an SVO or SVO2 file with the SDK.

    Raises:
        RefusedError: The SDK does not open the file.
        InputError: The SDK is not installed, or does not offer the depth mode.
    """
    return ZedRecording(path, options, _sdk(path))


def _sdk(path: Path) -> Any:
    # Not a plain import: it cannot be had from any index, so no checker could follow it.
    try:
        return importlib.import_module("pyzed.sl")
    except ModuleNotFoundError as error:
        if error.name not in ("pyzed", "pyzed.sl"):
            raise _broken(path, error) from error
        raise InputError(
            f"{path}: {path.suffix} files are read by the ZED SDK, whose Python API (pyzed) is not installed here; "
            "install the SDK from stereolabs.com/developers and run the get_python_api.py that comes with it."
        ) from error
    except (ImportError, OSError, RuntimeError, ValueError) as error:
        raise _broken(path, error) from error


def _broken(path: Path, error: Exception) -> InputError:
    reason = " ".join(str(error).split())[:200]
    return InputError(
        f"{path}: the ZED SDK's Python API (pyzed) is installed but cannot be loaded ({reason}); run the "
        "get_python_api.py of the installed SDK again."
    )


def depth_mode_named(name: str, offered: Sequence[str], by: str = "the ZED SDK") -> str:
    """The one of some depth modes that a user named, in whatever case.

    Raises:
        InputError: It is none of them, or invents distances.
    """
    wanted = name.upper()
    if "FILL" in wanted:
        raise InputError(
            f"--depth-mode {name}: FILL invents distances where nothing was measured, and a calibration would believe "
            f"them; choose one of {', '.join(offered)}."
        )
    if wanted not in offered:
        raise InputError(f"--depth-mode {name}: {by} has no such mode; choose {', '.join(offered)}.")
    return wanted


def depth_mode_of(sl: Any, name: str) -> Any:
    """The SDK's depth mode of a name.

    Raises:
        InputError: The SDK has no such mode, or the mode invents distances.
    """
    offered = [mode.name for mode in sl.DEPTH_MODE if mode.name not in ("NONE", "LAST")]
    return sl.DEPTH_MODE[depth_mode_named(name, offered, "the installed ZED SDK")]


class ZedRecording:
    """One SVO or SVO2 file, read by the SDK; implements aruco.model.Recording and KnowsUp.

    The SDK tells a frame's stamp only once it has grabbed it. So the first question for stamps costs one pass over the
    file: without depth and without fetching images, which is as fast as the SDK decodes; the accelerometer is read in
    the same pass, and both are kept. Frames are afterwards found by seeking and recognised by their stamp, so that a
    frame can never pass for another where the SDK's positions are off.
    """

    def __init__(self, path: Path, options: SourceOptions, sl: Any) -> None:
        """Open the file and ask the SDK for the camera.

        Raises:
            InputError: The SDK refuses the file or does not offer the depth mode.
        """
        self._path = path
        conf = options.zed_conf
        self._player = Player(
            sl,
            path,
            depth_mode=depth_mode_of(sl, options.depth_mode),
            conf_folder=None if conf is None else (conf.parent if conf.is_file() else conf),
        )
        with self._player.held():
            information = self._player.information()
            self._camera = _camera_of(information, path)
            self._R_cam_imu = _R_cam_imu_of(information)

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The left eye, rectified, named by the camera's serial number."""
        return (self._camera,)

    def stamps_ns(self, camera: str) -> NDArray[np.int64]:
        """The time stamps of the images, strictly ascending; the first call passes over the file."""
        self._check(camera)
        return self._index[0]

    def depth_indices(self, camera: str) -> NDArray[np.int64]:
        """All frames: the SDK computes depth when it is asked for."""
        return np.arange(len(self.stamps_ns(camera)))

    def frames(self, camera: str, indices: Sequence[int], *, depth: bool = False) -> Iterator[Frame | BadFrame]:
        """Frames at ascending indices, one at a time; the SDK computes depth only where it is asked for.

        Several may be read at once, also by several threads: they share one open camera, frame by frame. It is closed
        when the last of them is done.
        """
        self._check(camera)
        return self._frames([int(index) for index in indices], depth)

    def up_in_camera(self, camera: str) -> Array | None:
        """(3,) unit vector against gravity in the axes of the left eye: the median over the recording.

        None for cameras without an accelerometer, files that do not hold what it measured (SVO of version 1), and
        samples that zed_gravity does not believe.
        """
        self._check(camera)
        return self._up

    def _check(self, camera: str) -> None:
        if camera != self._camera.name:
            raise InputError(f"no camera {camera} in the recording; it has {self._camera.name}.")

    @cached_property
    def _up(self) -> Array | None:
        up_imu = None if self._R_cam_imu is None else up_of(self._index[2], self._camera.name)
        if self._R_cam_imu is None or up_imu is None:
            return None
        up = self._R_cam_imu @ up_imu
        up.setflags(write=False)
        return up

    @cached_property
    def _index(self) -> tuple[NDArray[np.int64], tuple[int, ...], Array]:
        """Stamps (n,), the frames' places in the file, and accelerations (m, 3) in the IMU's axes [m/s^2]."""
        with self._player.held():
            logger.info("{}: reading the stamps of {} frames", self._path.name, self._player.n_frames())
            found = self._player.passed_over()
        return _indexed(found, self._path)

    def _frames(self, indices: Sequence[int], depth: bool) -> Iterator[Frame | BadFrame]:
        stamps, positions, _ = self._index
        with self._player.held():
            for index in indices:
                if not 0 <= index < len(stamps):
                    raise InputError(f"{self._path}: has frames 0 to {len(stamps) - 1}, not {index}.")
                yield self._frame(Place(positions[index], int(stamps[index])), depth)

    def _frame(self, place: Place, depth: bool) -> Frame | BadFrame:
        size = (self._camera.width, self._camera.height)
        try:
            shown = self._player.show(place, size, depth=depth)
        except NotShownError as error:
            reason = f"{self._path.name}: frame {place.position} {error}"
            logger.debug("skipped: {}", reason)
            return BadFrame(self._camera.name, place.stamp_ns, reason, depth_may_be_why=depth)
        return Frame(
            camera=self._camera.name,
            stamp_ns=place.stamp_ns,
            image=shown.image,
            # The SDK does not hand out the bytes that it decoded.
            digest=hashlib.sha256(shown.image.data).hexdigest(),
            depth_m=shown.depth_m,
            confidence=shown.confidence,
        )


def _indexed(found: Pass, path: Path) -> tuple[NDArray[np.int64], tuple[int, ...], Array]:
    """Stamps (n,), strictly ascending, places in the file and accelerations (m, 3); says what was lost.

    Raises:
        InputError: No frame can be decoded, or they have no stamps.
    """
    if not found.places:
        reason = f" ({found.reason})" if found.reason else ""
        raise InputError(f"{path}: the ZED SDK cannot decode a single frame of it{reason}; copy the file again.")
    position_of: dict[int, int] = {}
    for place in found.places:
        if not 0 < place.stamp_ns <= MAX_STAMP_NS or place.stamp_ns in position_of:
            logger.debug("{}: frame {} is left out, its stamp is {}", path, place.position, place.stamp_ns)
        else:
            position_of[place.stamp_ns] = place.position
    if not position_of:
        raise InputError(f"{path}: its frames have no time stamps, as in files without compression; record it anew.")
    ended = found.promised - len(found.places) - found.failed
    if found.failed:
        logger.warning("{}: {} of {} frames cannot be decoded ({})", path, found.failed, found.promised, found.reason)
    if ended > 1:  # the SDK often ends one frame before the last
        logger.warning("{}: ends after {} of {} frames", path, found.promised - ended, found.promised)
    stamps = np.array(sorted(position_of), dtype=np.int64)
    stamps.setflags(write=False)
    accelerations = np.array(found.accelerations, dtype=np.float64).reshape(-1, 3)
    return stamps, tuple(position_of[stamp] for stamp in stamps.tolist()), accelerations


def _camera_of(information: Any, path: Path) -> Camera:
    """The rectified left eye."""
    configuration = information.camera_configuration
    size = configuration.resolution
    width, height = int(size.width), int(size.height)
    if not 0 < width * height <= MAX_PIXELS:
        raise InputError(f"{path}: the ZED SDK says that its images are {width} x {height}, which is not a camera's.")
    calibration = configuration.calibration_parameters
    left = calibration.left_cam
    K = np.array([[left.fx, 0.0, left.cx], [0.0, left.fy, left.cy], [0.0, 0.0, 1.0]], dtype=np.float64)
    serial = int(information.serial_number)
    try:
        return Camera(
            name=str(serial) if serial > 0 else path.stem,
            width=width,
            height=height,
            K=K,
            # In the unit that the file was opened with.
            baseline_m=float(calibration.get_camera_baseline()),
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _R_cam_imu_of(information: Any) -> Array | None:
    """(3, 3) rotation of the IMU's axes into the left eye's; None where the SDK does not know it."""
    R = np.array(information.sensors_configuration.camera_imu_transform.m, dtype=np.float64)[:3, :3]
    # The SDK holds it in single precision.
    is_rotation = np.allclose(R @ R.T, np.eye(3), atol=1e-4) and np.linalg.det(R) > 0
    return R if is_rotation else None
