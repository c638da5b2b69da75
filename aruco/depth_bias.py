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
from dataclasses import dataclass, field
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
    covariance: Array | None = field(default=None, compare=False)  # (2, 2) of scale and inverse_depth or offset_m

    def __post_init__(self) -> None:
        """Refuse numbers that are no bias, and freeze."""
        numbers = (self.scale, self.inverse_depth, self.offset_m)
        if not all(map(math.isfinite, numbers)) or abs(self.scale) > MAX_SCALE:
            raise InputError(f"depth bias {numbers}: want finite numbers, and a scale within {MAX_SCALE:g} of none.")
        if self.focal_baseline is not None and not (math.isfinite(self.focal_baseline) and self.focal_baseline > 0):
            raise InputError(f"depth bias: focal_baseline must be positive pixel metres, got {self.focal_baseline}.")
        if self.covariance is not None:
            object.__setattr__(self, "covariance", _checked_covariance(self.covariance))

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
            return {"scale": self.scale, "offset_m": self.offset_m, **self._doubt("offset_m")}
        if self.focal_baseline is None or self.disparity_px is None:
            return {"scale": self.scale, "inverse_depth": self.inverse_depth, **self._doubt("inverse_depth")}
        return {
            "scale": self.scale,
            "disparity_px": self.disparity_px,
            "focal_baseline": self.focal_baseline,
            **self._doubt("disparity_px", self.focal_baseline),
        }

    def _doubt(self, second: str, unit: float = 1.0) -> dict[str, float]:
        """The covariance as plain numbers; the second parameter is written in ``unit`` times its own unit."""
        if self.covariance is None:
            return {}
        sigma = np.sqrt(np.diag(self.covariance))
        product = float(sigma[0] * sigma[1])
        return {
            "sigma_scale": float(sigma[0]),
            f"sigma_{second}": float(sigma[1]) * unit,
            "correlation": float(self.covariance[0, 1]) / product if product > 0 else 0.0,
        }


def _checked_covariance(given: Any) -> Array:
    S = np.array(given, dtype=np.float64)
    # A correlation may be one, and rounding may put it a little beyond.
    if S.shape != (2, 2) or not np.isfinite(S).all() or (np.diag(S) < 0).any() or not np.allclose(S, S.T):
        raise InputError("depth bias: its covariance is not a symmetric 2x2 matrix with variances on its diagonal.")
    if abs(S[0, 1]) > math.sqrt(S[0, 0] * S[1, 1]) * (1 + 1e-6):
        raise InputError("depth bias: its correlation is beyond one.")
    S.setflags(write=False)
    return S


def bias_from_dict(entry: Any, where: str) -> DepthBias:
    """A bias as ``_meta.depth_bias`` holds it; ``where`` names file and camera.

    Raises:
        InputError: It is none of the three layouts, or its numbers are no bias.
    """
    try:
        return _bias_of(_numbers(entry))
    except InputError as error:
        raise InputError(f"{where}: {error} Run --refine-depth again.") from error


def _numbers(entry: Any) -> dict[str, float]:
    """An entry's values, all of them finite."""
    if not isinstance(entry, Mapping) or not all(
        isinstance(x, (int, float)) and not isinstance(x, bool) for x in entry.values()
    ):
        raise InputError("the depth bias is not an object of numbers.")
    try:
        given = {str(name): float(x) for name, x in entry.items()}
    except OverflowError:
        raise InputError("the depth bias holds a number that is too large for any.") from None
    for name, value in given.items():
        if not math.isfinite(value) or (name.startswith("sigma_") and value < 0):
            raise InputError(f"the depth bias holds {name} {value:g}, which cannot be.")
    return given


def _bias_of(given: Mapping[str, float]) -> DepthBias:
    scale = given.get("scale", 0.0)
    if "offset_m" in given:
        covariance = _covariance_of(given, "offset_m")
        return DepthBias(model="offset", scale=scale, offset_m=given["offset_m"], covariance=covariance)
    if "inverse_depth" in given:
        covariance = _covariance_of(given, "inverse_depth")
        return DepthBias(scale=scale, inverse_depth=given["inverse_depth"], covariance=covariance)
    if "disparity_px" in given and given.get("focal_baseline", 0.0) > 0:
        fB = given["focal_baseline"]
        covariance = _covariance_of(given, "disparity_px", fB)
        return DepthBias(
            scale=scale, inverse_depth=given["disparity_px"] / fB, focal_baseline=fB, covariance=covariance
        )
    raise InputError("the depth bias wants scale with disparity_px and focal_baseline, inverse_depth, or offset_m.")


def _covariance_of(given: Mapping[str, float], second: str, unit: float = 1.0) -> Array | None:
    """(2, 2) from the plain numbers of an entry; None where it does not say how well it knows."""
    if "sigma_scale" not in given or f"sigma_{second}" not in given:
        return None
    sigma = np.array([given["sigma_scale"], given[f"sigma_{second}"] / unit])
    with np.errstate(over="ignore", invalid="ignore"):  # numbers without bounds become infinite, and are refused
        covariance = np.outer(sigma, sigma)
        covariance[0, 1] *= given.get("correlation", 0.0)
    covariance[1, 0] = covariance[0, 1]
    return covariance
