"""The ZED SDK's camera object playing back one file: opening, seeking, grabbing, closing.

Owns      the settings it is opened with, which frame the SDK has at hand, and copying out what it shows.
Leaves    what a recording is to zed_sdk.

Written after the documentation of the SDK's Python API (pyzed.sl), versions 4 and 5.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from loguru import logger
from numpy.typing import NDArray

from aruco.errors import InputError

# ZED files have a key frame every two seconds at most: 60 frames at 30 a second. The SDK decodes from the last one
# after a jump, so for half of that going on is no dearer.
_NEAR = 30
# Jumps miss by at most so many frames, or are known to miss by more.
_NEAR_MISS = 4
# Where a frame is looked for: at its place, then from some frames before it, then from before the last key frame; once
# more from near by, because a miss that the last search met is known now, but its frame may have gone by unmeasured.
_LEADS = (0, _NEAR_MISS, 64, _NEAR_MISS)
# So many grabs beyond the place still look for a frame.
_LATE = 3
# Grabs that fail in a row before the rest of a file is given up.
_MAX_FAILURES = 100
_NOWHERE = 2**62

# What the SDK answers when it opens a file -> what to do.
_CURES = {
    "INVALID_SVO_FILE": "the file is damaged, no ZED recording, or of a newer SDK; copy it again or update the SDK",
    "SVO_UNSUPPORTED_COMPRESSION": "this computer's GPU cannot decode its compression; read it on another one",
    "CALIBRATION_FILE_NOT_AVAILABLE": "give the folder of the camera's SN<serial>.conf with --zed-conf",
    "INVALID_CALIBRATION_FILE": "replace the camera's SN<serial>.conf, and give its folder with --zed-conf",
    "NO_GPU_DETECTED": "the SDK needs an NVIDIA GPU; read the file on a computer that has one",
    "NO_GPU_COMPATIBLE": "the SDK needs a newer NVIDIA GPU; read the file on a computer that has one",
    "NOT_ENOUGH_GPU_MEMORY": "choose a lighter --depth-mode, or close other programs that use the GPU",
    "CORRUPTED_SDK_INSTALLATION": "install the SDK again, with its AI module for NEURAL depth modes",
}


class RefusedError(InputError):
    """The SDK does not open a file."""


class NotShownError(Exception):
    """A frame that the SDK did not show; the message completes the sentence "frame 7 ..."."""


@dataclass(frozen=True, slots=True)
class Place:
    """A frame as the first pass met it."""

    position: int  # in the file, from 0
    stamp_ns: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shown:
    """What the SDK made of one frame."""

    image: NDArray[np.uint8]  # (h, w, 3) BGR, left eye, rectified
    depth_m: NDArray[np.float32] | None  # (h, w) along the optical axis, NaN where unknown
    confidence: NDArray[np.uint8] | None  # (h, w) 0..100, lower is more trustworthy


@dataclass(frozen=True, slots=True, kw_only=True)
class Pass:
    """What one pass over a file met."""

    places: list[Place]
    accelerations: list[list[float]]  # of the IMU, in its own axes [m/s^2]
    promised: int  # frames that the file says it has
    failed: int  # frames that could not be decoded
    reason: str  # the SDK's last word on that


class Player:
    """One camera object for all who read a file at a time, opened when the first asks and closed by the last."""

    def __init__(self, sl: Any, path: Path, *, depth_mode: Any, conf_folder: Path | None) -> None:
        """Nothing is opened yet.

        Args:
            sl: The module pyzed.sl.
            path: SVO or SVO2 file.
            depth_mode: Of sl.DEPTH_MODE, for frames that are shown with depth.
            conf_folder: Where SN<serial>.conf is looked for before the SDK's own folder.
        """
        self._sl, self._path = sl, path
        self._depth_mode, self._conf_folder = depth_mode, conf_folder
        self._lock = threading.RLock()
        self._users = 0
        self._camera: Any = None
        self._has_depth = False
        self._next = _NOWHERE  # the frame that the next grab reads
        self._miss = 0  # by how many frames jumps have been seen to miss
        self._image, self._measure, self._sensors = sl.Mat(), sl.Mat(), sl.SensorsData()
        self._plain, self._measuring = sl.RuntimeParameters(), sl.RuntimeParameters()
        self._plain.enable_depth = False
        for runtime in (self._plain, self._measuring):
            runtime.enable_fill_mode = False

    @contextmanager
    def held(self) -> Iterator[None]:
        """Keep the file open from the first question to the end of the block."""
        with self._lock:
            self._users += 1
        try:
            yield
        finally:
            with self._lock:
                self._users -= 1
                if not self._users:
                    self._close()

    def information(self) -> Any:
        """The SDK's CameraInformation; raises RefusedError if it refuses the file."""
        with self._lock:
            return self._opened(depth=False).get_camera_information()

    def n_frames(self) -> int:
        """How many frames the file says it has."""
        with self._lock:
            return max(int(self._opened(depth=False).get_svo_number_of_frames()), 0)

    def passed_over(self) -> Pass:
        """Grab every frame once, without depth and without fetching images."""
        sl = self._sl
        places: list[Place] = []
        accelerations: list[list[float]] = []
        failed, row, reason = 0, 0, ""
        with self._lock:
            camera, promised = self._opened(depth=False), self.n_frames()
            self._seek(camera, 0)
            for position in range(promised):
                error = self._grab(camera, self._plain)
                if error == sl.ERROR_CODE.END_OF_SVOFILE_REACHED or row >= _MAX_FAILURES:
                    break
                if _is_failure(sl, error):
                    failed, row, reason = failed + 1, row + 1, str(error)
                    continue
                row = 0
                places.append(Place(position, self._stamp_ns(camera)))
                accelerations += self._acceleration(camera)
        return Pass(places=places, accelerations=accelerations, promised=promised, failed=failed, reason=reason)

    def show(self, place: Place, size: tuple[int, int], *, depth: bool) -> Shown:
        """Find a frame and copy out what the SDK makes of it.

        Args:
            place: Of the frame; it is recognised by its stamp.
            size: (width, height) of the camera's images.
            depth: Whether to compute depth and confidence.

        Raises:
            NotShownError: The SDK cannot decode the frame, calls it corrupted or does not find it.
        """
        with self._lock:
            camera = self._opened(depth=depth)
            if not any(self._reached(camera, place, lead, depth) for lead in _LEADS):
                raise NotShownError("was not found again by its time stamp")
            measures = self._sl.MEASURE
            return Shown(
                image=self._left(camera, size),
                depth_m=_metres(self._measured(camera, measures.DEPTH, size)) if depth else None,
                confidence=_percent(self._measured(camera, measures.CONFIDENCE, size)) if depth else None,
            )

    def _opened(self, *, depth: bool) -> Any:
        """The open camera, with depth if that is asked for: opened anew only where depth comes in addition."""
        if self._camera is not None and (self._has_depth or not depth):
            return self._camera
        self._close()
        sl = self._sl
        camera = sl.Camera()
        error = camera.open(self._parameters(depth))
        if _is_failure(sl, error):
            camera.close()
            cure = _CURES.get(error.name, "try it in the SDK's own ZED Explorer")
            raise RefusedError(f"{self._path}: the ZED SDK cannot open it ({error.name}); {cure}.")
        if error != sl.ERROR_CODE.SUCCESS:
            logger.warning("{}: the ZED SDK opened it with a warning: {}", self._path, error.name)
        self._camera, self._has_depth, self._next = camera, depth, 0
        return camera

    def _parameters(self, depth: bool) -> Any:
        sl = self._sl
        parameters = sl.InitParameters()
        parameters.set_from_svo_file(str(self._path))
        parameters.svo_real_time_mode = False
        parameters.camera_disable_self_calib = True
        parameters.coordinate_units = sl.UNIT.METER
        parameters.coordinate_system = sl.COORDINATE_SYSTEM.IMAGE
        parameters.depth_mode = self._depth_mode if depth else sl.DEPTH_MODE.NONE
        parameters.depth_stabilization = 0
        parameters.sdk_verbose = 0
        if self._conf_folder is not None:
            parameters.optional_settings_path = str(self._conf_folder)
        return parameters

    def _close(self) -> None:
        camera, self._camera, self._has_depth, self._next = self._camera, None, False, _NOWHERE
        if camera is not None:
            camera.close()

    def _seek(self, camera: Any, position: int) -> None:
        if position != self._next:
            camera.set_svo_position(max(position - self._miss, 0))
            self._next = position

    def _grab(self, camera: Any, runtime: Any) -> Any:
        error = camera.grab(runtime)
        # After the end nothing comes until the position is set.
        at_end = error == self._sl.ERROR_CODE.END_OF_SVOFILE_REACHED
        self._next = _NOWHERE if at_end else self._next + 1
        return error

    def _stamp_ns(self, camera: Any) -> int:
        return int(camera.get_timestamp(self._sl.TIME_REFERENCE.IMAGE).get_nanoseconds())

    def _reached(self, camera: Any, place: Place, lead: int, depth: bool) -> bool:
        """Whether the frame was met, starting so many frames before its place; without a lead from where we are."""
        jumps = lead > 0 or not 0 <= place.position - self._next <= _NEAR
        if jumps:
            self._seek(camera, max(place.position - lead, 0))
        while self._next <= place.position + _LATE:
            # On the way depth would be computed for nothing; near the place only where places are unreliable.
            measured = depth and self._next >= place.position - min(lead, _NEAR_MISS)
            error = self._grab(camera, self._measuring if measured else self._plain)
            failed = _is_failure(self._sl, error)
            if not failed and self._stamp_ns(camera) == place.stamp_ns:
                self._miss += place.position - (self._next - 1) if jumps else 0
                self._next = place.position + 1
                self._refuse_unless_whole(error)
                return measured or not depth
            if failed and self._next > place.position:
                self._refuse_unless_whole(error)
        return False

    def _refuse_unless_whole(self, error: Any) -> None:
        codes = self._sl.ERROR_CODE
        if error == codes.CORRUPTED_FRAME:
            raise NotShownError("is corrupted (CORRUPTED_FRAME of the ZED SDK)")
        if _is_failure(self._sl, error) and error != codes.END_OF_SVOFILE_REACHED:
            raise NotShownError(f"cannot be decoded ({error.name} of the ZED SDK)")

    def _left(self, camera: Any, size: tuple[int, int]) -> NDArray[np.uint8]:
        sl = self._sl
        error = camera.retrieve_image(self._image, sl.VIEW.LEFT, sl.MEM.CPU, sl.Resolution(*size))
        bgra = self._data(self._image, error, size)
        # A copy: the SDK writes the next frame to the same memory.
        return np.asarray(cv2.cvtColor(bgra, cv2.COLOR_BGRA2BGR), dtype=np.uint8)

    def _measured(self, camera: Any, measure: Any, size: tuple[int, int]) -> NDArray[np.float32]:
        """(h, w) in memory of the SDK, which the next measure is written to."""
        sl = self._sl
        # The size is given, as a limit on the working resolution would make it smaller than the image.
        error = camera.retrieve_measure(self._measure, measure, sl.MEM.CPU, sl.Resolution(*size))
        return self._data(self._measure, error, size)

    def _data(self, mat: Any, error: Any, size: tuple[int, int]) -> NDArray[Any]:
        if error != self._sl.ERROR_CODE.SUCCESS:
            raise NotShownError(f"cannot be fetched ({error.name} of the ZED SDK)")
        data = mat.get_data()
        if data.shape[:2] != (size[1], size[0]):
            raise NotShownError(f"has shape {data.shape}, but the camera's images are {size[0]} x {size[1]}")
        return data

    def _acceleration(self, camera: Any) -> list[list[float]]:
        """What the accelerometer measured nearest to the image: one vector or none."""
        sl = self._sl
        if camera.get_sensors_data(self._sensors, sl.TIME_REFERENCE.IMAGE) != sl.ERROR_CODE.SUCCESS:
            return []
        imu = self._sensors.get_imu_data()
        if not imu.is_available:
            return []
        # A copy: the SDK's function returns one and the same list every time.
        vector = [float(value) for value in imu.get_linear_acceleration()]
        return [vector] if all(np.isfinite(vector)) and any(vector) else []


def _is_failure(sl: Any, error: Any) -> bool:
    """Whether an ERROR_CODE is more than a warning; those are below SUCCESS."""
    return bool(error.value > sl.ERROR_CODE.SUCCESS.value)


def _metres(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Depth as the SDK gives it: +inf is too far, -inf too near, NaN unknown."""
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(np.nan)).astype(np.float32, copy=False)


def _percent(confidence: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Confidence as whole numbers; what is none is not to be trusted (100)."""
    known = np.where(np.isfinite(confidence), confidence, np.float32(100))
    return np.rint(np.clip(known, 0, 100)).astype(np.uint8)
