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
from aruco.icp_words import untold
from rigcal.report.floor_views import told

if TYPE_CHECKING:
    from rich.console import Console

_CAMERAS = "Registration of clouds: what every camera's cloud asked for, and whether it got it"
_OF_CAMERAS = (
    "Turn and shift: of the move that clouds ask for, against the reference. Gap: median distance to other clouds "
    "where it was not fitted. Shrank by: in standard errors, over all cameras that are proved together; 2 are proof. "
    "Off given pose: in standard deviations of what that pose is known to."
)
_PAIRS = "Pairs of clouds: how one moved against the other"
_OF_PAIRS = (
    "Overlap: of the clouds' boxes seen from above, with a margin around. Samples: of the first cloud, every second "
    "one is looked up. Fitness: of what could meet of both clouds, the share that does; RMSE: of the distances; "
    "neither proves a move. Clouds do not tell: of what this pair by itself says less than the given poses."
)
_BIASES = "Depth bias, estimated together with the poses"
_OF_BIASES = (
    "What measured depth is off by: in proportion, and in disparity (px; stereo cameras), by an offset (mm), or in "
    "inverse depth (/km, where no baseline is told: 1 /km is 1 mm at 1 m, 16 mm at 4 m). In file: whether it goes with "
    "the poses that are written, under _meta.depth_bias."
)
# All pairs of six cameras; of more, only those that overlap are listed.
MOST_PAIRS = 15


@dataclass(frozen=True, slots=True, kw_only=True)
class Sheet:
    """A table as text."""

    title: str
    head: tuple[str, ...]  # a line break may divide a name
    words: Collection[str]  # columns that hold words rather than numbers
    rows: Sequence[tuple[str, ...]]
    legend: str = ""  # what the columns mean


def show_registration(out: Console, sheets: Sequence[Sheet], remarks: Sequence[str]) -> None:
    """Print the tables, and why cameras were or were not moved."""
    from rich.markup import escape
    from rich.table import Table

    for sheet in sheets:
        table = Table(title=sheet.title, title_justify="left")
        for name in sheet.head:
            table.add_column(name, justify="left" if name in sheet.words else "right")
        for row in sheet.rows:
            table.add_row(*map(escape, row))
        out.print(table)
        out.print(sheet.legend, markup=False, soft_wrap=False)
    for remark in remarks:
        out.print(remark, markup=False)


def sheets_of(
    metrics: ICPMetrics, cameras: Collection[str], before: Mapping[str, DepthBias], written: Collection[str] = ()
) -> tuple[Sheet, ...]:
    """The tables that have something in them.

    Args:
        metrics: Of the registration.
        cameras: All cameras of the rig.
        before: Biases that were known.
        written: Cameras whose new bias goes with the poses.
    """
    sheets: list[Sheet] = []
    if metrics.cameras:
        sheets.append(_camera_sheet(metrics, cameras))
    if metrics.per_pair_results:
        sheets.append(_pair_sheet(metrics.per_pair_results))
    if metrics.biases:
        sheets.append(_bias_sheet(metrics.biases, before, written))
    return tuple(sheets)


def remarks_of(metrics: ICPMetrics) -> tuple[str, ...]:
    """Why each camera was moved or kept its pose, and what is worth knowing of all."""
    of_cameras = (f"camera {name}: {move.reason}" for name, move in sorted(metrics.cameras.items()) if move.reason)
    return *of_cameras, *metrics.remarks


def _camera_sheet(metrics: ICPMetrics, cameras: Collection[str]) -> Sheet:
    nothing = CameraMove(accepted=False, reason="", rotation_deg=math.nan, translation_mm=math.nan)
    took_part = _overlapping(metrics)
    moves = {name: metrics.cameras.get(name, nothing) if name in took_part else nothing for name in sorted(cameras)}
    return Sheet(
        title=_CAMERAS,
        legend=_OF_CAMERAS,
        head=(
            "camera",
            "outcome",
            "turn\ndegrees",
            "shift\nmm",
            "gap before\nmm",
            "gap after\nmm",
            "shrank by\nsigmas",
            "off given\npose sigmas",
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
                untold(move.unobservable),
            )
            for name, move in moves.items()
        ],
    )


def _overlapping(metrics: ICPMetrics) -> set[str]:
    """Cameras whose cloud overlaps another."""
    return {name for pair, result in metrics.per_pair_results.items() if result.overlaps for name in pair}


def _outcome(name: str, metrics: ICPMetrics) -> str:
    move = metrics.cameras.get(name)
    if name not in _overlapping(metrics) or (move is None and name != metrics.reference_camera):
        return "took no part"
    if name == metrics.reference_camera:
        return "reference"
    if move is not None and move.refusal == "reference":
        return "reference of its part"
    return "moved" if move is not None and move.accepted else "kept"


def _pair_sheet(results: Mapping[tuple[str, str], ICPResult]) -> Sheet:
    listed = {pair: r for pair, r in sorted(results.items()) if r.overlaps or len(results) <= MOST_PAIRS}
    more = len(results) - len(listed)
    return Sheet(
        title=_PAIRS,
        legend=_OF_PAIRS + (f" {more} more pairs of clouds do not overlap." if more else ""),
        head=(
            "cloud",
            "against",
            "overlap\nm2",
            "samples\nthat met",
            "fitness",
            "RMSE\nmm",
            "turn\ndegrees",
            "shift\nmm",
            "clouds do not tell",
            "verdict",
        ),
        words=("cloud", "against", "clouds do not tell", "verdict"),
        rows=[(*pair, *_pair_cells(result)) for pair, result in listed.items()],
    )


def _pair_cells(result: ICPResult) -> tuple[str, ...]:
    if not result.overlaps:
        return told(result.overlap_m2, ".2f"), *["-"] * 5, untold(result.unobservable), result.verdict.split(":")[0]
    return (
        told(result.overlap_m2, ".2f"),
        str(result.n_points),
        told(result.fitness, ".2f"),
        told(1e3 * result.inlier_rmse, ".1f"),
        told(result.rotation_deg, ".3f"),
        told(result.translation_mm, ".1f"),
        untold(result.unobservable),
        result.verdict,
    )


def _bias_sheet(biases: Mapping[str, DepthBias], before: Mapping[str, DepthBias], written: Collection[str]) -> Sheet:
    return Sheet(
        title=_BIASES,
        legend=_OF_BIASES,
        head=("camera", "scale %\nbefore", "scale %\nnow", "known to\n+- %", "disparity or\noffset before",
              "disparity or\noffset now", "known to\n+-", "in file"),
        words=("camera", "in file"),
        rows=[
            (name, *_bias_cells(bias, before.get(name)), "yes" if name in written else "no, pose kept")
            for name, bias in sorted(biases.items())
        ],
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
