"""The factory calibration of a ZED camera, ``SN<serial>.conf``: finding it, reading it, rectifying with it.

Owns      where such a file is looked for, its keys old and new, and the stereo pair that it describes.
Leaves    the images to svo2; whether numbers can be a lens to aruco.model.Camera.

The file gives each eye as it is recorded, with its distortion. The ZED SDK hands out rectified images, and so does
svo2: ``stereoRectify`` with alpha 0 and CALIB_ZERO_DISPARITY, from rotation vector (RX, CV, RZ) and translation
(-Baseline, TY, TZ), which map points of the left eye into the right one. The SDK's own rectified matrix may differ a
little, because it may calibrate itself when the camera is opened.
"""

from __future__ import annotations

import configparser
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from loguru import logger
from numpy.typing import NDArray

from aruco.errors import InputError
from aruco.model import Camera
from aruco.pose_math import Array

# Where the ZED SDK puts the files that it downloads, on Linux and on Windows.
USUAL_FOLDERS = (Path("/usr/local/zed/settings"), Path("C:/ProgramData/Stereolabs/settings"))
WHERE_TO_GET = "https://www.stereolabs.com/developers/calib/?SN={serial}"
# A factory file has 2 to 10 kB.
MAX_FILE_BYTES = 64 * 2**10

# Of the names of sections: LEFT_CAM_HD and so on. Heights that are not listed go by the width.
_SECTION_OF_SIZE = {(1920, 1200): "FHD1200"}
_SECTION_OF_WIDTH = {2208: "2K", 1920: "FHD", 1280: "HD", 960: "SVGA", 672: "VGA"}
_PLAIN = ("k1", "k2", "p1", "p2", "k3")  # in OpenCV's order
_RATIONAL = (*_PLAIN, "k4", "k5", "k6")
# Eyes are 50 to 160 mm apart and parallel to a degree: outside of this the numbers mean something else.
_BASELINES_MM = (5.0, 1000.0)
_MAX_ANGLE_RAD = 0.2
_MIN_INSIDE = 0.95
_NAMED_SERIAL = re.compile(r"sn[-_ ]?0*([0-9]{1,12})", re.IGNORECASE)

Sections = Mapping[str, Mapping[str, str]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StereoIntrinsics:
    """Both eyes of a ZED camera as they are recorded, at one resolution."""

    path: Path
    left: Camera
    right: Camera
    R_right_left: Array  # (3, 3)
    t_right_left: Array  # (3,) metres; x is minus the baseline

    def rectification(self) -> Rectification:
        """The pinhole pair without distortion, rows aligned, that alpha 0 gives (no pixel is outside both images)."""
        size = (self.left.width, self.left.height)
        eyes = (self.left.K, self.left.distortion, self.right.K, self.right.distortion)
        R_left, R_right, P_left, P_right, *_ = cv2.stereoRectify(
            *eyes,
            size,
            self.R_right_left,
            self.t_right_left.reshape(3, 1),  # OpenCV 5 wants a column
            flags=cv2.CALIB_ZERO_DISPARITY,
            alpha=0,
            newImageSize=size,
        )
        K = np.asarray(P_left[:, :3], dtype=np.float64)
        maps = [_maps(eye, R, P) for eye, R, P in ((self.left, R_left, P_left), (self.right, R_right, P_right))]
        # With alpha 0 nearly every pixel comes from within the recorded image.
        inside = min(float(((first >= 0) & (first < size)).all(axis=2).mean()) for first, _ in maps)
        # The focal length changes by some per cent; what differs by a factor is no rectification of these eyes.
        if not (np.isfinite(K).all() and 0.3 < K[0, 0] / self.left.K[0, 0] < 3 and inside > _MIN_INSIDE):
            raise InputError(f"{self.path}: its numbers give no usable pair of images; get the camera's file again.")
        return Rectification(
            K=K,
            baseline_m=float(-P_right[0, 3] / P_right[0, 0]),
            left_maps=maps[0],
            right_maps=maps[1],
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rectification:
    """How to turn the two recorded images into those of one pinhole camera at two places."""

    K: Array  # (3, 3) of both rectified images
    baseline_m: float
    left_maps: tuple[NDArray[Any], NDArray[Any]]  # of cv2.remap
    right_maps: tuple[NDArray[Any], NDArray[Any]]

    def left(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The left eye's image (h, w[, 3]), rectified."""
        return np.asarray(cv2.remap(image, *self.left_maps, cv2.INTER_LINEAR), dtype=np.uint8)

    def right(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The right eye's image (h, w[, 3]), rectified."""
        return np.asarray(cv2.remap(image, *self.right_maps, cv2.INTER_LINEAR), dtype=np.uint8)


def _maps(eye: Camera, R: Any, P: Any) -> tuple[NDArray[Any], NDArray[Any]]:
    # Fixed point, in steps of 1/32 pixel, is several times as fast; remap rounds floating maps to the same steps.
    first, second = cv2.initUndistortRectifyMap(eye.K, eye.distortion, R, P, (eye.width, eye.height), cv2.CV_16SC2)
    return first, second


def factory_calibration(path: Path, width: int, height: int) -> StereoIntrinsics:
    """Read a conf file at one resolution.

    Args:
        path: The file; its keys may have any case.
        width: Of one eye's image [px].
        height: Likewise.

    Returns:
        Both eyes and how they stand to each other.

    Raises:
        InputError: The file cannot be read, lacks the resolution or a key, or its numbers cannot be a camera's.
    """
    sections = _parsed(path)
    name = _SECTION_OF_SIZE.get((width, height)) or _SECTION_OF_WIDTH.get(width)
    if name is None:
        raise InputError(
            f"{path}: ZED cameras have no images of {width} x {height}; known widths: "
            f"{', '.join(map(str, sorted(_SECTION_OF_WIDTH)))}."
        )
    there = sorted(key.removeprefix("LEFT_CAM_") for key in sections if key.startswith("LEFT_CAM_"))
    link = WHERE_TO_GET.format(serial=_serial_in(path.name) or "<serial>")
    missing = [key for key in (f"LEFT_CAM_{name}", f"RIGHT_CAM_{name}", "STEREO") if key not in sections]
    if missing:
        raise InputError(
            f"{path}: lacks [{'], ['.join(missing)}], which images of {width} x {height} need (it has "
            f"{', '.join(there) or 'no camera'}); get the camera's whole file from {link} and name it with --zed-conf."
        )
    R_right_left, t_right_left = _stereo(path, sections["STEREO"], name)
    return StereoIntrinsics(
        path=path,
        left=_eye(path, sections, "LEFT", name, (width, height)),
        right=_eye(path, sections, "RIGHT", name, (width, height)),
        R_right_left=R_right_left,
        t_right_left=t_right_left,
    )


def find_conf(serial: str, asked: Path | None, beside: Path) -> Path:
    """The conf file of a camera.

    Args:
        serial: The camera's serial number.
        asked: What the user gave: a folder of such files or one of them; None: nothing.
        beside: The folder that the recording lies in.

    Returns:
        The first file found: in what the user gave, in the SDK's folders, beside the recording.

    Raises:
        InputError: What the user gave does not exist, or no file of this camera is anywhere.
    """
    if asked is not None and not asked.exists():
        raise InputError(f"{asked}: no such file or folder; give --zed-conf a folder with SN{serial}.conf.")
    if asked is not None and asked.is_file():
        named = _serial_in(asked.name)
        if named is None:
            logger.warning("{}: does not say whose calibration it is; taken for that of camera {}", asked, serial)
        if named in (None, serial):
            return asked
    given = [] if asked is None else [asked if asked.is_dir() else asked.parent]
    for folder in (*given, *USUAL_FOLDERS, beside):
        found = _conf_in(folder, serial)
        if found is not None:
            return found
    if asked is not None and asked.is_file():
        why = f"{asked} is the factory calibration of camera {_serial_in(asked.name)}, not of {serial}"
    else:
        why = (
            f"no factory calibration SN{serial}.conf of camera {serial} in {_listed([*given, *USUAL_FOLDERS, beside])}"
        )
    raise InputError(
        f"{why}; give --zed-conf a folder that holds SN{serial}.conf (from {WHERE_TO_GET.format(serial=serial)}, or "
        "from /usr/local/zed/settings of a computer that has run this camera)."
    )


def require_one_camera(asked: Path, serials: Sequence[str]) -> None:
    """Refuse a file whose name has no serial number for more than one camera.

    Args:
        asked: What the user gave: a folder of conf files or one of them.
        serials: Of all cameras that were rectified with what was given.

    Raises:
        InputError: It is one file of nobody knows which camera, and there are several.
    """
    named = sorted(set(serials))
    if len(named) > 1 and asked.is_file() and _serial_in(asked.name) is None:
        raise InputError(
            f"{asked}: does not say whose calibration it is, and cannot be that of cameras {', '.join(named)} all; "
            "give --zed-conf a folder with SN<serial>.conf of each camera."
        )


def _listed(folders: list[Path]) -> str:
    return ", ".join(dict.fromkeys(str(folder) for folder in folders))


def _serial_in(name: str) -> str | None:
    match = _NAMED_SERIAL.search(name)
    return None if match is None else match[1]


def _conf_in(folder: Path, serial: str) -> Path | None:
    try:
        with os.scandir(folder) as entries:
            names = [entry.name for entry in entries if entry.name.lower().endswith(".conf") and entry.is_file()]
    except OSError:
        return None
    fitting = [name for name in names if _serial_in(name) == serial]
    # The name that the SDK gives comes before others that hold the serial number.
    fitting.sort(key=lambda name: (name.lower() != f"sn{serial}.conf", name))
    return folder / fitting[0] if fitting else None


def _parsed(path: Path) -> Sections:
    """The sections by their names in capitals, the keys in small letters."""
    parser = configparser.ConfigParser(interpolation=None, inline_comment_prefixes=(";", "#"))
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise InputError(f"{path}: over {MAX_FILE_BYTES >> 10} KiB, which is not a ZED calibration.")
        parser.read_string(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); give another --zed-conf.") from error
    except (configparser.Error, ValueError) as error:
        reason = " ".join(str(error).split())[:160]
        raise InputError(f"{path}: not a readable ZED calibration ({reason}); get the camera's file again.") from error
    return {section.upper(): dict(parser[section]) for section in parser.sections()}


def _eye(path: Path, sections: Sections, side: str, name: str, size: tuple[int, int]) -> Camera:
    section = f"{side}_CAM_{name}"
    fx, fy, cx, cy = _numbers(path, section, sections[section], ("fx", "fy", "cx", "cy"))
    if not (0 < cx < size[0] and 0 < cy < size[1]):
        raise InputError(
            f"{path}: the centre ({cx:g}, {cy:g}) of [{section}] lies outside its images of {size[0]} x {size[1]}; "
            "get the camera's file again."
        )
    # Newer files give one rational model for all resolutions; where they keep the old keys too, it is the better fit.
    once = f"{side}_DISTO"
    if once in sections:
        values = _numbers(path, once, sections[once], _PLAIN)
        values += _numbers(path, once, {"k4": "0", "k5": "0", "k6": "0", **sections[once]}, _RATIONAL[5:])
    else:
        values = _numbers(path, section, sections[section], _PLAIN)
    try:
        return Camera(
            name=side.lower(),
            width=size[0],
            height=size[1],
            K=np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
            distortion_model="rational_polynomial" if len(values) == len(_RATIONAL) else "plumb_bob",
            distortion=np.array(values),
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _stereo(path: Path, section: Mapping[str, str], name: str) -> tuple[Array, Array]:
    """(R_right_left, t_right_left [m]) of one resolution."""
    (baseline_mm,) = _numbers(path, "STEREO", section, ("baseline",))
    # Files of the first cameras have no offsets; some of the newer ones have one for each resolution.
    offsets = {key: section.get(f"{key}_{name}".lower(), section.get(key, "0")) for key in ("ty", "tz")}
    ty_mm, tz_mm = _numbers(path, "STEREO", offsets, ("ty", "tz"))
    angles = _numbers(path, "STEREO", section, tuple(f"{key}_{name}".lower() for key in ("rx", "cv", "rz")))
    sound = _BASELINES_MM[0] <= baseline_mm <= _BASELINES_MM[1] and max(abs(ty_mm), abs(tz_mm)) < 0.5 * baseline_mm
    if not sound or max(map(abs, angles)) > _MAX_ANGLE_RAD:
        raise InputError(
            f"{path}: [STEREO] says that the eyes are {baseline_mm:g} mm apart (offsets {ty_mm:g}, {tz_mm:g} mm; "
            f"angles {', '.join(f'{angle:g}' for angle in angles)} rad), which is no ZED; get the camera's file again."
        )
    R = np.asarray(cv2.Rodrigues(np.array(angles))[0], dtype=np.float64)
    return R, np.array([-baseline_mm, ty_mm, tz_mm]) / 1000.0


def _numbers(path: Path, section: str, values: Mapping[str, str], keys: tuple[str, ...]) -> list[float]:
    missing = [key for key in keys if key not in values]
    if missing:
        raise InputError(f"{path}: [{section}] lacks {', '.join(missing)}; get the camera's whole file again.")
    numbers = []
    for key in keys:
        try:
            numbers.append(float(values[key]))
        except ValueError:
            numbers.append(float("nan"))
        if not np.isfinite(numbers[-1]):
            raise InputError(f"{path}: {key} of [{section}] must be a number, got {values[key][:40]!r}.")
    return numbers
