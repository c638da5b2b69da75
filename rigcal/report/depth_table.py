"""How depth agrees with the target: a table in the terminal, and a file with every corner and face.

Owns      the layout of both.
Leaves    the figures to aruco.depth_verify.

The file has one line a corner and one a face: camera, frame, marker (-1: a whole board), corner (0 to 3; empty for the
face), x_px and y_px in the depth image, predicted_m from the poses, recorded_m as the camera measured it, error_m after
a known bias is taken out (positive: too far; of a face, the median of its pixels), sigma_m the standard deviation of
error_m that the noise model promises, n_pixels of a face that took part, n_averaged depth images that were pooled.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping
from dataclasses import astuple, fields
from pathlib import Path
from typing import TYPE_CHECKING

from aruco.atomic import write_whole
from aruco.depth_verify import DepthAgreement, DepthErrors, DepthRow

if TYPE_CHECKING:
    from rich.console import Console

HEADER = tuple(field.name for field in fields(DepthRow))


def show_depth(out: Console, agreements: Mapping[str, DepthAgreement], *, corrected: bool = False) -> None:
    """Per camera: what was compared and how far it is off; then what to think of it."""
    from rich.markup import escape
    from rich.table import Table

    if not agreements:
        out.print("Depth: no camera has depth on the target that could be compared.", markup=False)
        return
    when = ", after refinement, its bias taken out" if corrected else ""
    table = Table(title=f"Depth beside the target (measured minus predicted){when}", title_justify="left")
    table.add_column("camera")
    names = ("markers", "depth\nimages", "range m", "error\nmm", "error\n%", "RMSE\nmm", "RMSE in\nsigmas")
    for name in (*names, "corners", "error at\ncorners mm", "RMSE at\ncorners mm"):
        table.add_column(name, justify="right")
    for name, found in sorted(agreements.items()):
        low, high = found.range_m
        table.add_row(
            escape(name),
            str(found.n_faces),
            str(_images(found)),
            "-" if math.isnan(low) else f"{low:.2f} to {high:.2f}",
            *_figures(found.faces),
            str(len(found.corners)),
            _signed(1e3 * found.corners.median_m, 1),
            _plain(1e3 * found.corners.rmse_m, 1),
        )
    out.print(table)
    for _, found in sorted(agreements.items()):
        out.print(f"  - {found.judgement}", markup=False)


def _images(found: DepthAgreement) -> int:
    """Of a moved target its frames, of a resting one the images that were pooled."""
    return max([found.n_frames, *(row.n_averaged for row in found.rows if found.n_frames == 1)])


def _figures(errors: DepthErrors) -> tuple[str, ...]:
    return (
        _signed(1e3 * errors.median_m, 1),
        _signed(100 * errors.median_share, 2),
        _plain(1e3 * errors.rmse_m, 1),
        _plain(errors.normalised, 2),
    )


def _signed(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:+.{digits}f}"


def _plain(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def csv_rows(agreements: Mapping[str, DepthAgreement]) -> list[tuple[str, ...]]:
    """The lines of the file below its header, camera by camera, frame by frame, each face before its corners."""
    rows = [row for _, found in sorted(agreements.items()) for row in found.rows]
    return [tuple(_cell(value) for value in astuple(row)) for row in rows]


def _cell(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.6f}" if isinstance(value, float) else str(value)


def write_report(path: Path, agreements: Mapping[str, DepthAgreement]) -> None:
    """Write every corner and face as a CSV file, whole or not at all.

    Raises:
        OutputError: The file cannot be written.
    """
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(HEADER)
    writer.writerows(csv_rows(agreements))
    write_whole(path, text.getvalue().encode())
