"""Which way is up, from the accelerometer that an SVO2 file holds.

Owns      the sensor messages.
Leaves    finding the channel to svo2_header, when the samples are believed to zed_gravity.

What is known and what is not: the numbers equal the ``linear_acceleration`` that the ZED SDK gives for the same file
(others have compared them for a ZED X). The SDK documents its default IMAGE axes, x right, y down, z forward, which
are OpenCV's; an accelerometer at rest measures +g upwards, so a level camera must show about -9.8 along y. That has
not been proven here on a real file. Nor is known whether the axes are those of the recorded or of the rectified
image, which differ by some tenths of a degree: no such rotation is applied. How the IMU is mounted behind the left
eye (``camera_imu_transform`` of the SDK, which the file does not hold) is left out as well; zed_sdk applies it.
"""

from __future__ import annotations

import base64
import json
import struct

import numpy as np

from aruco.pose_math import Array
from rigcal.sources.mcap_index import McapIndex
from rigcal.sources.zed_gravity import up_of

# Of the 360 bytes of a sample: the acceleration, three f32 [m/s^2].
_ACCELERATION = struct.Struct("<3f")
_ACCELERATION_AT = 0x64
# A sample in base64 and JSON has about 520 bytes.
_MAX_MESSAGE_BYTES = 4096
# More do not make the median better than the calibration of the accelerometer.
_MAX_SAMPLES = 2000


def up_in_camera(mcap: McapIndex, channel: int, camera: str) -> Array | None:
    """(3,) unit vector against gravity in the left camera's axes, the median over a recording.

    Args:
        mcap: The file.
        channel: Of the camera's sensor messages.
        camera: For the log.

    Returns:
        None where the samples are not believed; see zed_gravity.
    """
    return up_of(_samples(mcap, channel), camera)


def _samples(mcap: McapIndex, channel: int) -> Array:
    """(n, 3) accelerations [m/s^2], evenly over the recording."""
    step = max(1, -(-mcap.count(channel) // _MAX_SAMPLES))
    found = []
    for part in mcap.parts([channel], _MAX_MESSAGE_BYTES, step=step):
        if part.data is not None and part.total <= _MAX_MESSAGE_BYTES:
            found.append(_acceleration(part.data))
    return np.array([sample for sample in found if sample is not None], dtype=np.float64).reshape(-1, 3)


def _acceleration(message: bytes) -> tuple[float, ...] | None:
    try:
        data = base64.b64decode(json.loads(message)["data"], validate=True)
        return _ACCELERATION.unpack_from(data, _ACCELERATION_AT)
    except (ValueError, TypeError, KeyError, RecursionError, struct.error):
        return None
