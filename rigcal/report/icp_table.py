"""The registration of clouds in figures: every camera, every pair, every bias; in a terminal, and as rows for a page.

Owns      what stands in which column.
Leaves    the figures to aruco.icp_registration, the page to icp_page.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from aruco.depth_bias import DepthBias
from aruco.icp_types import CameraMove, ICPMetrics, ICPResult
from rigcal.report.floor_views import told

if TYPE_CHECKING:
    from rich.console import Console

_CAMERAS = "Registration of clouds: what every camera's cloud asked for, and whether it got it"
_PAIRS = "Pairs of clouds, each by itself: how one moved against the other"
_BIASES = "Depth bias, estimated together with the poses"


@dataclass(frozen=True, slots=True, kw_only=True)
class Sheet:
    """A table as text."""

    title: str
    head: tuple[str, ...]  # a line break may divide a name
    words: Collection[str]  # columns that hold words rather than numbers
    rows: Sequence[tuple[str, ...]]


def show_registration(out: Console, sheets: Sequence[Sheet], remarks: Sequence[str], fact: str) -> None:
    """Print the tables, why cameras were or were not moved, and what became of the rig."""
    from rich.markup import escape
    from rich.table import Table

    for sheet in sheets:
        table = Table(title=sheet.title, title_justify="left")
        for name in sheet.head:
            table.add_column(name, justify="left" if name in sheet.words else "right")
        for row in sheet.rows:
            table.add_row(*map(escape, row))
        out.print(table)
    for remark in remarks:
        out.print(remark, markup=False)
    out.print(fact, markup=False)


def sheets_of(metrics: ICPMetrics, cameras: Collection[str], before: Mapping[str, DepthBias]) -> tuple[Sheet, ...]:
    """The tables that have something in them.

    Args:
        metrics: Of the registration.
        cameras: All cameras of the rig.
        before: Biases that were known.
    """
    sheets: list[Sheet] = []
    if metrics.cameras:
        sheets.append(_camera_sheet(metrics, cameras))
    if metrics.per_pair_results:
        sheets.append(_pair_sheet(metrics.per_pair_results))
    if metrics.biases:
        sheets.append(_bias_sheet(metrics.biases, before))
    return tuple(sheets)


def remarks_of(metrics: ICPMetrics) -> tuple[str, ...]:
    """Why each camera was moved or kept its pose."""
    return tuple(f"camera {name}: {move.reason}" for name, move in sorted(metrics.cameras.items()) if move.reason)


def _camera_sheet(metrics: ICPMetrics, cameras: Collection[str]) -> Sheet:
    nothing = CameraMove(accepted=False, reason="", rotation_deg=math.nan, translation_mm=math.nan)
    took_part = {name for pair in metrics.per_pair_results for name in pair}
    moves = {name: metrics.cameras.get(name, nothing) if name in took_part else nothing for name in sorted(cameras)}
    return Sheet(
        title=_CAMERAS,
        head=(
            "camera",
            "outcome",
            "turn\ndegrees",
            "shift\nmm",
            "held-out gap\nbefore mm",
            "held-out gap\nafter mm",
            "shrank by\nsigmas",
            "off given\npose, sigmas",
            "clouds do not tell",
        ),
        words=("camera", "outcome", "clouds do not tell"),
        rows=[
            (
                name,
                _outcome(name, metrics),
                told(move.rotation_deg, ".3f"),
                told(move.translation_mm, ".1f"),
                told(move.held_out_before_mm, ".2f"),
                told(move.held_out_after_mm, ".2f"),
                told(move.gain_sigmas, "+.1f"),
                told(move.prior_sigmas, ".1f"),
                ", ".join(move.unobservable) or "-",
            )
            for name, move in moves.items()
        ],
    )


def _outcome(name: str, metrics: ICPMetrics) -> str:
    if name == metrics.reference_camera:
        return "reference"
    if name not in metrics.cameras or not any(name in pair for pair in metrics.per_pair_results):
        return "took no part"
    return "moved" if metrics.cameras[name].accepted else "kept"


def _pair_sheet(results: Mapping[tuple[str, str], ICPResult]) -> Sheet:
    return Sheet(
        title=_PAIRS,
        head=(
            "cloud",
            "against",
            "overlap\nm2",
            "points\nthat met",
            "fitness",
            "RMSE\nmm",
            "turn\ndegrees",
            "shift\nmm",
            "clouds do not tell",
            "verdict",
        ),
        words=("cloud", "against", "clouds do not tell", "verdict"),
        rows=[
            (
                source,
                target,
                told(result.overlap_m2, ".2f"),
                str(result.n_points),
                told(result.fitness, ".2f"),
                told(1e3 * result.inlier_rmse, ".1f"),
                told(result.rotation_deg, ".3f"),
                told(result.translation_mm, ".1f"),
                ", ".join(result.unobservable) or "-",
                result.verdict,
            )
            for (source, target), result in sorted(results.items())
        ],
    )


def _bias_sheet(biases: Mapping[str, DepthBias], before: Mapping[str, DepthBias]) -> Sheet:
    return Sheet(
        title=_BIASES,
        head=("camera", "scale %\nbefore", "scale %\nnow", "known to\n+- %", "disparity or\noffset before",
              "disparity or\noffset now", "known to\n+-"),
        words=("camera",),
        rows=[(name, *_bias_cells(bias, before.get(name))) for name, bias in sorted(biases.items())],
    )  # fmt: skip


def _bias_cells(bias: DepthBias, before: DepthBias | None) -> tuple[str, ...]:
    sigma = np.full(2, np.nan) if bias.covariance is None else np.sqrt(np.maximum(np.diag(bias.covariance), 0.0))
    factor, unit = _second_unit(bias)
    comparable = before is not None and before.model == bias.model
    return (
        told(100 * before.scale, "+.2f") if before is not None else "-",
        told(100 * bias.scale, "+.2f"),
        told(100 * float(sigma[0]), ".2f"),
        told(factor * _second(before), "+.2f", unit) if before is not None and comparable else "-",
        told(factor * _second(bias), "+.2f", unit),
        told(factor * float(sigma[1]), ".2f", unit),
    )


def _second(bias: DepthBias) -> float:
    return bias.offset_m if bias.model == "offset" else bias.inverse_depth


def _second_unit(bias: DepthBias) -> tuple[float, str]:
    if bias.model == "offset":
        return 1e3, " mm"
    return (1e3, " /km") if bias.focal_baseline is None else (bias.focal_baseline, " px")
