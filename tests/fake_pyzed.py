"""A stand-in for the ZED SDK's Python API, pyzed.sl: its documented names and behaviour, as far as recordings go.

What it copies on purpose, because code that ignores it would seem to work here and fail with the real one: attributes
that do not exist cannot be set; setters refuse other types; lengths come in the unit asked for (millimetres if nobody
asks); arrays of a Mat are views of memory that the next frame is written to; get_linear_acceleration fills and returns
one and the same list; real-time mode drops frames; depth needs a depth mode, and one that is switched on at runtime;
far and near depth is infinite; after the end nothing comes until the position is set.
"""

from __future__ import annotations

import enum
import sys
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import numpy as np

_Enum = enum.Enum


class ERROR_CODE(_Enum):  # noqa: N801
    CORRUPTED_FRAME = -2
    CAMERA_REBOOTING = -1
    SUCCESS = 0
    FAILURE = 1
    NO_GPU_COMPATIBLE = 2
    NOT_ENOUGH_GPU_MEMORY = 3
    CALIBRATION_FILE_NOT_AVAILABLE = 9
    INVALID_SVO_FILE = 11
    END_OF_SVOFILE_REACHED = 13
    INVALID_RESOLUTION = 14
    INVALID_FUNCTION_PARAMETERS = 17
    CUDA_ERROR = 18
    CAMERA_NOT_INITIALIZED = 19
    NO_GPU_DETECTED = 28
    LAST = 33


class DEPTH_MODE(_Enum):  # noqa: N801
    NONE = 0
    PERFORMANCE = 1
    QUALITY = 2
    ULTRA = 3
    NEURAL_LIGHT = 4
    NEURAL = 5
    NEURAL_PLUS = 6
    LAST = 7


class UNIT(_Enum):
    MILLIMETER = 0
    CENTIMETER = 1
    METER = 2


class COORDINATE_SYSTEM(_Enum):  # noqa: N801
    IMAGE = 0
    RIGHT_HANDED_Y_UP = 2


class VIEW(_Enum):
    LEFT = 0
    RIGHT = 1
    LEFT_UNRECTIFIED = 4


class MEASURE(_Enum):
    DISPARITY = 0
    DEPTH = 1
    CONFIDENCE = 2


class MEM(_Enum):
    CPU = 1
    GPU = 2


class TIME_REFERENCE(_Enum):  # noqa: N801
    IMAGE = 0
    CURRENT = 1


METRES = {UNIT.MILLIMETER: 1e-3, UNIT.CENTIMETER: 1e-2, UNIT.METER: 1.0}
IMU_LISTS: list[float] = [0.0, 0.0, 0.0]


@dataclass
class FakeSvo:
    """What a file holds, and how the SDK misbehaves on it."""

    stamps_ns: list[int]
    serial: int = 34563472
    width: int = 32
    height: int = 20
    fx: float = 25.0
    fy: float = 25.5
    cx: float = 15.7
    cy: float = 9.6
    baseline_m: float = 0.12
    accelerations: list[tuple[float, float, float]] | None = None  # one a frame, IMU axes; None: no IMU
    R_cam_imu: np.ndarray = field(default_factory=lambda: np.eye(3))
    corrupted: frozenset[int] = frozenset()
    failing: frozenset[int] = frozenset()
    ends_after: int | None = None  # fewer frames than it promises
    seek_error: int = 0  # frames by which a jump misses
    refused: ERROR_CODE | None = None  # what open() answers
    refused_with_depth: ERROR_CODE | None = None


@dataclass
class FakeSdk:
    """The files it knows, and what was asked of it."""

    files: dict[str, FakeSvo]
    opened: int = 0
    open_now: int = 0
    most_open: int = 0
    grabs: int = 0
    depths: int = 0  # frames whose depth was computed
    seeks: list[int] = field(default_factory=list)
    parameters: list[Any] = field(default_factory=list)  # InitParameters of each open()

    def modules(self) -> dict[str, ModuleType]:
        """What belongs into sys.modules."""
        package, sl = ModuleType("pyzed"), ModuleType("pyzed.sl")
        for name, value in vars(sys.modules[__name__]).items():
            if isinstance(value, type) and not name.startswith(("_", "Fake")):
                setattr(sl, name, value)
        sdk = self

        class Camera(_Camera):
            def __init__(self) -> None:
                super().__init__(sdk)

        sl.Camera = Camera  # type: ignore[attr-defined]
        package.sl = sl  # type: ignore[attr-defined]
        return {"pyzed": package, "pyzed.sl": sl}


def image_bgr(svo: FakeSvo, frame: int) -> np.ndarray:
    """The left rectified picture of a frame."""
    rng = np.random.default_rng([svo.serial, frame])
    return rng.integers(0, 256, (svo.height, svo.width, 3)).astype(np.uint8)


def depth_m(svo: FakeSvo, frame: int) -> np.ndarray:
    """Depth with infinite, negative, zero and unknown values among it."""
    depth = np.full((svo.height, svo.width), 1.5 + 0.01 * frame, dtype=np.float32)
    depth[0, :5] = [np.nan, np.inf, -np.inf, 0.0, -1.0]
    return depth


def confidence(svo: FakeSvo, frame: int) -> np.ndarray:
    values = np.linspace(0, 100, svo.width * svo.height, dtype=np.float32).reshape(svo.height, svo.width)
    values[0, :2] = [np.nan, np.inf]
    return values


class _Strict:
    """Like a Cython class: what is not declared cannot be set, and what is set must have the type of the default."""

    def __init__(self, **defaults: Any) -> None:
        self.__dict__.update(defaults)

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in self.__dict__:
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        if not isinstance(value, type(self.__dict__[name])):
            raise TypeError(f"{name}: argument is of type {type(value).__name__}")
        self.__dict__[name] = value


class Resolution(_Strict):
    def __init__(self, width: int = 0, height: int = 0) -> None:
        super().__init__(width=width, height=height)


class InitParameters(_Strict):
    def __init__(self) -> None:
        super().__init__(
            svo_real_time_mode=False,
            depth_mode=DEPTH_MODE.NEURAL,
            coordinate_units=UNIT.MILLIMETER,
            coordinate_system=COORDINATE_SYSTEM.IMAGE,
            camera_disable_self_calib=False,
            depth_stabilization=30,
            sdk_verbose=1,
            optional_settings_path="",
            _svo="",
        )

    def set_from_svo_file(self, svo_input_filename: str) -> None:
        self._svo = str.__str__(svo_input_filename)


class RuntimeParameters(_Strict):
    def __init__(self) -> None:
        super().__init__(
            enable_depth=True, enable_fill_mode=False, confidence_threshold=95, texture_confidence_threshold=100
        )


class Timestamp:
    def __init__(self, data_ns: int) -> None:
        self.data_ns = data_ns

    def get_nanoseconds(self) -> int:
        return self.data_ns


class Mat:
    """Keeps its memory as long as the format stays the same."""

    def __init__(self) -> None:
        self._data = np.empty((0, 0))

    def _write(self, data: np.ndarray) -> None:
        if self._data.shape != data.shape or self._data.dtype != data.dtype:
            self._data = np.empty_like(data)
        self._data[...] = data

    def get_data(self, memory_type: MEM = MEM.CPU, deep_copy: bool = False) -> np.ndarray:
        return self._data.copy() if deep_copy else self._data


class Transform:
    def __init__(self, R: np.ndarray | None = None) -> None:
        self.m = np.eye(4)
        if R is not None:
            self.m[:3, :3] = np.float32(R)


class IMUData:
    def __init__(self, acceleration: tuple[float, float, float] | None = None) -> None:
        self._acceleration = acceleration or (0.0, 0.0, 0.0)
        self.is_available = acceleration is not None

    def get_linear_acceleration(self, linear_acceleration: list[float] = IMU_LISTS) -> list[float]:
        linear_acceleration[:] = self._acceleration
        return linear_acceleration


class SensorsData:
    def __init__(self) -> None:
        self._imu = IMUData()

    def get_imu_data(self) -> IMUData:
        return self._imu


class _Record:
    def __init__(self, **fields: Any) -> None:
        self.__dict__.update(fields)


class _Camera:
    def __init__(self, sdk: FakeSdk) -> None:
        self._sdk = sdk
        self._svo: FakeSvo | None = None
        self._parameters = InitParameters()
        self._position = 0
        self._at_end = False
        self._shown = -1
        self._has_depth = False

    def open(self, py_init: InitParameters) -> ERROR_CODE:
        self.close()
        svo = self._sdk.files.get(py_init._svo)
        if svo is None:
            return ERROR_CODE.INVALID_SVO_FILE
        with_depth = py_init.depth_mode is not DEPTH_MODE.NONE
        refused = svo.refused or (svo.refused_with_depth if with_depth else None)
        if refused is not None and refused.value > 0:
            return refused
        self._svo, self._parameters, self._position, self._at_end = svo, py_init, 0, False
        self._sdk.parameters.append(py_init)
        self._sdk.opened += 1
        self._sdk.open_now += 1
        self._sdk.most_open = max(self._sdk.most_open, self._sdk.open_now)
        return refused or ERROR_CODE.SUCCESS

    def close(self) -> None:
        if self._svo is not None:
            self._sdk.open_now -= 1
            self._svo = None

    def is_opened(self) -> bool:
        return self._svo is not None

    def grab(self, py_runtime: RuntimeParameters | None = None) -> ERROR_CODE:
        if self._svo is None:
            return ERROR_CODE.CAMERA_NOT_INITIALIZED
        runtime = py_runtime or RuntimeParameters()
        svo, frame = self._svo, self._position
        last = len(svo.stamps_ns) if svo.ends_after is None else svo.ends_after
        if self._at_end or frame >= last:
            self._at_end = True
            return ERROR_CODE.END_OF_SVOFILE_REACHED
        self._position += 2 if self._parameters.svo_real_time_mode else 1
        self._sdk.grabs += 1
        if frame in svo.failing:
            return ERROR_CODE.FAILURE
        self._shown = frame
        self._has_depth = runtime.enable_depth and self._parameters.depth_mode is not DEPTH_MODE.NONE
        self._sdk.depths += self._has_depth
        return ERROR_CODE.CORRUPTED_FRAME if frame in svo.corrupted else ERROR_CODE.SUCCESS

    def set_svo_position(self, frame_number: int) -> None:
        assert self._svo is not None
        self._sdk.seeks.append(frame_number)
        missed = self._svo.seek_error if frame_number else 0
        self._position = min(max(frame_number + missed, 0), len(self._svo.stamps_ns))
        self._at_end = False

    def get_svo_position(self) -> int:
        return -1 if self._svo is None else self._position

    def get_svo_number_of_frames(self) -> int:
        return -1 if self._svo is None else len(self._svo.stamps_ns)

    def get_timestamp(self, time_reference: TIME_REFERENCE) -> Timestamp:
        assert self._svo is not None
        if time_reference is TIME_REFERENCE.CURRENT:
            return Timestamp(1_900_000_000_000_000_000)
        return Timestamp(self._svo.stamps_ns[self._shown] if self._shown >= 0 else 0)

    def get_camera_information(self) -> _Record:
        svo = self._svo
        assert svo is not None
        # Self-calibration changes the intrinsics a little, and another time in another way.
        moved = 0.0 if self._parameters.camera_disable_self_calib else 0.3 + 0.1 * self._sdk.opened
        left = _Record(fx=svo.fx + moved, fy=svo.fy, cx=svo.cx + moved, cy=svo.cy, disto=[0.0] * 12)
        baseline = svo.baseline_m / METRES[self._parameters.coordinate_units]
        calibration = _Record(left_cam=left, get_camera_baseline=lambda: baseline)
        return _Record(
            serial_number=svo.serial,
            camera_configuration=_Record(
                resolution=Resolution(svo.width, svo.height), calibration_parameters=calibration, fps=30.0
            ),
            sensors_configuration=_Record(camera_imu_transform=Transform(svo.R_cam_imu)),
        )

    def retrieve_image(
        self, py_mat: Mat, view: VIEW = VIEW.LEFT, mem_type: MEM = MEM.CPU, resolution: Resolution | None = None
    ) -> ERROR_CODE:
        svo = self._svo
        assert svo is not None
        if resolution is not None and (resolution.width > svo.width or resolution.height > svo.height):
            return ERROR_CODE.INVALID_RESOLUTION
        picture = image_bgr(svo, self._shown)
        if view is not VIEW.LEFT:
            picture = 255 - picture
        py_mat._write(np.dstack([picture, np.full(picture.shape[:2], 255, dtype=np.uint8)]))
        return ERROR_CODE.SUCCESS

    def retrieve_measure(
        self, py_mat: Mat, measure: MEASURE = MEASURE.DEPTH, mem_type: MEM = MEM.CPU, resolution: Any = None
    ) -> ERROR_CODE:
        svo = self._svo
        assert svo is not None
        if not self._has_depth:
            return ERROR_CODE.INVALID_FUNCTION_PARAMETERS
        if measure is MEASURE.DEPTH:
            py_mat._write(depth_m(svo, self._shown) / np.float32(METRES[self._parameters.coordinate_units]))
        else:
            py_mat._write(confidence(svo, self._shown))
        return ERROR_CODE.SUCCESS

    def get_sensors_data(
        self, py_sensor_data: SensorsData, time_reference: TIME_REFERENCE = TIME_REFERENCE.CURRENT
    ) -> ERROR_CODE:
        svo = self._svo
        assert svo is not None
        if svo.accelerations is None:
            py_sensor_data._imu = IMUData()
            return ERROR_CODE.SUCCESS
        now = time_reference is TIME_REFERENCE.CURRENT
        py_sensor_data._imu = IMUData((9.8, 0.0, 0.0) if now else svo.accelerations[self._shown])
        return ERROR_CODE.SUCCESS
