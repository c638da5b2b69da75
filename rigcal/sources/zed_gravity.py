"""Which way is up, from what a ZED camera's accelerometer measured over a recording.

Owns      when such samples are believed, the same for files read with the ZED SDK and without it.
Leaves    reading the samples and turning them into the camera's axes to zed_sdk and svo2_sensors.
"""

from __future__ import annotations

import numpy as np
from loguru import logger

from aruco.pose_math import Array

# Fewer than this: one knock at the tripod could be the median.
MIN_SAMPLES = 5
# Gravity is 9.76 to 9.83 on Earth; an accelerometer that was calibrated in the factory is off by less than the rest.
# One that gives g instead of m/s^2, or that falls or turns with the camera, lies outside.
GRAVITY_MS2 = (9.0, 10.6)
# Half of the samples lie closer to the median than this while a camera stands still: ten times the sensor's noise.
# A camera that is carried about exceeds it.
MAX_SPREAD_MS2 = 0.5


def up_of(samples: Array, camera: str) -> Array | None:
    """The direction against gravity: the median of a resting accelerometer, which measures what keeps it from falling.

    Args:
        samples: (n, 3) accelerations [m/s^2], in any axes; rows that are not finite do not count.
        camera: For the log.

    Returns:
        (3,) unit vector in the axes of the samples; None where there are too few, or they are not those of a camera
        that stands still on Earth.
    """
    finite = samples[np.isfinite(samples).all(axis=1)]
    if len(finite) < MIN_SAMPLES:
        logger.debug("camera {}: {} accelerometer samples, too few to tell which way is up", camera, len(finite))
        return None
    median = np.median(finite, axis=0)
    size = float(np.linalg.norm(median))
    spread = float(np.median(np.linalg.norm(finite - median, axis=1)))
    if not GRAVITY_MS2[0] <= size <= GRAVITY_MS2[1] or spread > MAX_SPREAD_MS2:
        logger.warning(
            "camera {}: its accelerometer shows {:.2f} m/s2 with a spread of {:.2f}, which is not gravity alone; "
            "it is not asked which way is up",
            camera,
            size,
            spread,
        )
        return None
    logger.debug("camera {}: gravity {:.2f} m/s2, spread {:.2f}, {} samples", camera, size, spread, len(finite))
    up = median / size
    up.setflags(write=False)
    return up
