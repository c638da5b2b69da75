"""Which way is up, from the accelerometer that an SVO2 file holds.

Owns      the sensor messages, and when their answer is believed.
Leaves    finding the channel to svo2_header, what up is used for to rigcal's steps.

What is known and what is not: the numbers equal the ``linear_acceleration`` that the ZED SDK gives for the same file
(others have compared them for a ZED X). The SDK documents its default IMAGE axes, x right, y down, z forward, which
are OpenCV's; an accelerometer at rest measures +g upwards, so a level camera must show about -9.8 along y. That has
not been proven here on a real file. Nor is known whether the axes are those of the recorded or of the rectified
image, which differ by some tenths of a degree: no such rotation is applied.
"""

from __future__ import annotations

import base64
import json
import struct

import numpy as np
from loguru import logger

from aruco.pose_math import Array
from rigcal.sources.mcap_index import McapIndex

# Of the 360 bytes of a sample: the acceleration, three f32 [m/s^2].
_ACCELERATION = struct.Struct("<3f")
_ACCELERATION_AT = 0x64
# A sample in base64 and JSON has about 520 bytes.
_MAX_MESSAGE_BYTES = 4096
# More do not make the median better than the calibration of the accelerometer.
_MAX_SAMPLES = 2000
_MIN_SAMPLES = 5
# Gravity is 9.78 to 9.83 on Earth; a factory calibrated accelerometer is off by less than the rest.
_GRAVITY_MS2 = (9.0, 10.6)
# Half of the samples lie closer to the median than this while a camera stands still: ten times the sensor's noise.
# A camera that is carried about exceeds it.
_MAX_SPREAD_MS2 = 0.5


def up_in_camera(mcap: McapIndex, channel: int, camera: str) -> Array | None:
    """(3,) unit vector against gravity in the left camera's axes, the median over a recording.

    Args:
        mcap: The file.
        channel: Of the camera's sensor messages.
        camera: For the log.

    Returns:
        None where there are too few samples, or they are not those of a camera that stands still on Earth.
    """
    samples = _samples(mcap, channel)
    if len(samples) < _MIN_SAMPLES:
        logger.debug("camera {}: {} accelerometer samples, too few to tell which way is up", camera, len(samples))
        return None
    median = np.median(samples, axis=0)
    size = float(np.linalg.norm(median))
    spread = float(np.median(np.linalg.norm(samples - median, axis=1)))
    if not _GRAVITY_MS2[0] <= size <= _GRAVITY_MS2[1] or spread > _MAX_SPREAD_MS2:
        logger.warning(
            "camera {}: its accelerometer shows {:.2f} m/s2 with a spread of {:.2f}, which is not gravity alone; "
            "it is not asked which way is up",
            camera,
            size,
            spread,
        )
        return None
    logger.debug("camera {}: gravity {:.2f} m/s2, spread {:.2f}, {} samples", camera, size, spread, len(samples))
    return median / size


def _samples(mcap: McapIndex, channel: int) -> Array:
    """(n, 3) accelerations [m/s^2], evenly over the recording."""
    step = max(1, -(-mcap.count(channel) // _MAX_SAMPLES))
    found = []
    for part in mcap.parts([channel], _MAX_MESSAGE_BYTES):
        if part.index % step == 0 and part.data is not None and part.total <= _MAX_MESSAGE_BYTES:
            found.append(_acceleration(part.data))
    samples = np.array([sample for sample in found if sample is not None], dtype=np.float64).reshape(-1, 3)
    return samples[np.isfinite(samples).all(axis=1)]


def _acceleration(message: bytes) -> tuple[float, ...] | None:
    try:
        data = base64.b64decode(json.loads(message)["data"], validate=True)
        return _ACCELERATION.unpack_from(data, _ACCELERATION_AT)
    except (ValueError, TypeError, KeyError, RecursionError, struct.error):
        return None
