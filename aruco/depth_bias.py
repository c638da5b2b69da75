"""The systematic error of one camera's depth, and taking it out.

Owns      the two models, their derivatives, their layout in ``_meta.depth_bias``.
Leaves    estimating them to depth_refine, random errors to depth_noise.

A stereo camera measures disparity. A constant error d of it, in pixels, and a wrong baseline or focal length bend depth
linearly in its inverse (f B: focal length times baseline):

    1 / z_true = (1 + scale) / z_measured - d / (f B)

Other sensors are told by ``z_true = (1 + scale) z_measured + offset``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from aruco.errors import InputError
from aruco.pose_math import Array

DepthModel = Literal["stereo", "offset"]
# What a rectified camera is off by is a few percent at most; a scale beyond this is another unit.
MAX_SCALE = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthBias:
    """How one camera's depth is wrong."""

    model: DepthModel = "stereo"
    scale: float = 0.0
    inverse_depth: float = 0.0  # d / (f B) [1/m]; of the stereo model
    offset_m: float = 0.0  # of the offset model
    focal_baseline: float | None = None  # f B [px m], where it is known

    def __post_init__(self) -> None:
        """Refuse numbers that are no bias."""
        numbers = (self.scale, self.inverse_depth, self.offset_m)
        if not all(map(math.isfinite, numbers)) or abs(self.scale) > MAX_SCALE:
            raise InputError(f"depth bias {numbers}: want finite numbers, and a scale within {MAX_SCALE:g} of none.")
        if self.focal_baseline is not None and not (math.isfinite(self.focal_baseline) and self.focal_baseline > 0):
            raise InputError(f"depth bias: focal_baseline must be positive pixel metres, got {self.focal_baseline}.")

    @property
    def disparity_px(self) -> float | None:
        """The error of disparity d [px]; None where f B is not known."""
        return None if self.focal_baseline is None else self.inverse_depth * self.focal_baseline

    def corrected(self, depth_m: Array) -> Array:
        """True depth [m] for measured depth of any shape; NaN stays, and so becomes what would lie beyond infinity."""
        z = np.asarray(depth_m, dtype=np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.model == "offset":
                true = (1.0 + self.scale) * z + self.offset_m
            else:
                true = 1.0 / ((1.0 + self.scale) / z - self.inverse_depth)
        return np.where((true > 0) & np.isfinite(true) & (z > 0), true, np.nan)

    def derivative(self, depth_m: Array) -> Array:
        """How true depth (n,) follows (scale, inverse_depth or offset_m) at measured depth (n,): (2, n)."""
        z, true = np.asarray(depth_m, dtype=np.float64), self.corrected(depth_m)
        if self.model == "offset":
            return np.stack([z, np.ones_like(z)])
        return np.stack([-(true**2) / z, true**2])

    def as_dict(self) -> dict[str, float]:
        """The layout of ``_meta.depth_bias``."""
        if self.model == "offset":
            return {"scale": self.scale, "offset_m": self.offset_m}
        if self.focal_baseline is None or self.disparity_px is None:
            return {"scale": self.scale, "inverse_depth": self.inverse_depth}
        return {"scale": self.scale, "disparity_px": self.disparity_px, "focal_baseline": self.focal_baseline}


def bias_from_dict(entry: Any, where: str) -> DepthBias:
    """A bias as ``_meta.depth_bias`` holds it; ``where`` names file and camera.

    Raises:
        InputError: It is none of the three layouts.
    """
    if not isinstance(entry, Mapping) or not all(
        isinstance(x, (int, float)) and not isinstance(x, bool) for x in entry.values()
    ):
        raise InputError(f"{where}: the depth bias is not an object of numbers; run --refine-depth again.")
    given: dict[str, float] = {str(name): float(x) for name, x in entry.items()}
    scale = given.get("scale", 0.0)
    if "offset_m" in given:
        return DepthBias(model="offset", scale=scale, offset_m=given["offset_m"])
    if "inverse_depth" in given:
        return DepthBias(scale=scale, inverse_depth=given["inverse_depth"])
    if "disparity_px" in given and given.get("focal_baseline", 0.0) > 0:
        fB = given["focal_baseline"]
        return DepthBias(scale=scale, inverse_depth=given["disparity_px"] / fB, focal_baseline=fB)
    raise InputError(
        f"{where}: the depth bias wants scale with disparity_px and focal_baseline, inverse_depth, or offset_m; run "
        "--refine-depth again."
    )
