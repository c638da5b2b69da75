"""How one camera's depth agrees with where the target is: the figures, line by line and together.

Owns      what depth_verify returns, and its layout in ``_meta.depth_verified``.
Leaves    sentences to depth_words, tables and files to rigcal.report.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from aruco.depth_bias import DepthBias
from aruco.depth_tiles import FACE_UNEVEN_M
from aruco.depth_trends import Trend, Trends
from aruco.depth_words import findings, judgement
from aruco.pose_math import Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthErrors:
    """Measured beside predicted depth, in places of one kind."""

    predicted_m: Array  # (n,)
    errors_m: Array  # (n,) positive: measured too far
    sigma_m: Array  # (n,) standard deviation of one place that the noise model promises

    def __len__(self) -> int:
        """How many places there are."""
        return len(self.errors_m)

    @property
    def median_m(self) -> float:
        """The typical error; NaN without any, like the others."""
        return float(np.median(self.errors_m)) if len(self) else math.nan

    @property
    def median_share(self) -> float:
        """The typical error over the range."""
        return float(np.median(self.errors_m / self.predicted_m)) if len(self) else math.nan

    @property
    def rmse_m(self) -> float:
        """The root mean square error."""
        return float(np.sqrt(np.mean(self.errors_m**2))) if len(self) else math.nan

    @property
    def rmse_of_most_m(self) -> float:
        """That of the nine tenths of the places that agree best: the others may lie on edges, or on something else."""
        best = np.sort(np.abs(self.errors_m))[: math.ceil(0.9 * len(self))]
        return float(np.sqrt(np.mean(best**2))) if len(self) else math.nan

    @property
    def normalised(self) -> float:
        """The root mean square of errors in sigmas: about 1 where noise explains them, more with a bias."""
        return float(np.sqrt(np.mean((self.errors_m / self.sigma_m) ** 2))) if len(self) else math.nan

    def explained_m(self, uneven_m: float) -> float:
        """The root mean square error that noise makes, and a surface that is no plane."""
        return float(np.sqrt(np.mean(self.sigma_m**2 + uneven_m**2))) if len(self) else math.nan

    def as_dict(self) -> dict[str, Any]:
        """Plain values; null where there is nothing."""
        return {
            "n": len(self),
            "median_mm": _plain(1e3 * self.median_m),
            "median_percent": _plain(100 * self.median_share),
            "rmse_mm": _plain(1e3 * self.rmse_m),
            "normalised": _plain(self.normalised),
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthRow:
    """One corner, or one face, as a line of a table."""

    camera: str
    frame: int
    marker: int  # -1: a whole board
    corner: int | None  # its number; None: the whole face
    x_px: float  # in the depth image; of a face its middle
    y_px: float
    predicted_m: float
    recorded_m: float  # before any correction
    error_m: float  # of the corrected measurement, of a face the median of its pixels; positive: too far
    sigma_m: float  # standard deviation of error_m that the noise model promises; no pose has a part in it
    n_pixels: int  # of a face those that took part
    n_averaged: int  # depth images pooled


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthAgreement:
    """How one camera's depth agrees with where the target is."""

    camera: str
    corners: DepthErrors
    faces: DepthErrors  # every pixel well inside of a face
    rows: tuple[DepthRow, ...]
    trends: Trends | None  # None: too little was seen for any
    range_m: tuple[float, float]  # nearest and farthest prediction; NaN without any
    n_faces: int
    n_frames: int
    n_left_out: int  # faces with too few trusted pixels, or with several surfaces on them
    untrusted_share: float  # of the pixels, left out for their confidence
    bias: DepthBias | None  # what was taken out

    @property
    def findings(self) -> tuple[str, ...]:
        """How the error grows with range and over the image, where that is significant."""
        return findings(self.trends)

    @property
    def judgement(self) -> str:
        """One sentence: what a user should think, and do."""
        if not len(self.faces):
            return (
                f"camera {self.camera}: no marker has enough trusted depth of a single surface to compare; look at its "
                "depth and confidence images."
            )
        level = (self.faces.median_m, self.faces.median_share)
        explained_m = self.faces.explained_m(FACE_UNEVEN_M)
        rmse = (self.faces.rmse_m, self.faces.rmse_m / explained_m, self.faces.rmse_of_most_m / explained_m)
        said = judgement(level, rmse, self.range_m, self.trends, corrected=self.bias is not None)
        return f"camera {self.camera}: {said}"

    def as_dict(self) -> dict[str, Any]:
        """The layout of an entry of ``_meta.depth_verified``."""
        found = self.trends
        return {
            "judgement": self.judgement,
            "corners": self.corners.as_dict(),
            "faces": {**self.faces.as_dict(), "markers": self.n_faces, "frames": self.n_frames},
            "range_m": [_plain(r) for r in self.range_m],
            "bias_applied": self.bias is not None,
            "untrusted_percent": _plain(100 * self.untrusted_share),
            "markers_left_out": self.n_left_out,
            "scatter": None if found is None else _plain(found.scatter),
            "trends": {} if found is None else {name: _told(name, trend) for name, trend in found.slopes.items()},
            "looks_like": None if found is None or not found.cause else found.cause,
        }


def _told(name: str, trend: Trend) -> dict[str, Any]:
    return {
        "slope": trend.slope,
        "sigma": trend.sigma,
        "unit": "m per m" if name == "range" else "m per focal length",
        "effect_mm": 1e3 * trend.effect_m,
        "significant": trend.is_significant,
        "told_apart": trend.is_own,
    }


def _plain(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
