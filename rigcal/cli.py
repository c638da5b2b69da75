"""What the commands share: exit codes, logging, progress, previews, the closing table."""

from __future__ import annotations

import io
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import combinations
from pathlib import Path
from typing import Any

import click
from loguru import logger

from aruco.errors import OutputError, RigError
from aruco.model import Calibration
from rigcal.config import AlignConfig, CalibrateConfig, DepthConfig, DetectConfig, FrameConfig
from rigcal.report.progress import showing_progress
from rigcal.report.terminal import console, show_calibration

__all__ = ["beside", "showing_progress", "tell", "telling_errors"]


@contextmanager
def telling_errors(*, debug: bool) -> Iterator[None]:
    """Log to stderr; an error the user can cure becomes one sentence and exit code 1, anything else stays a bug."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal that cannot show a name must not end the run
            stream.reconfigure(errors="backslashreplace")
    logger.remove()
    style = "<level>{level: <7}</level> {message}" if not debug else "{time:HH:mm:ss.SSS} {level: <7} {name}: {message}"
    logger.add(sys.stderr, level="DEBUG" if debug else "INFO", format=style)
    try:
        yield
    except RigError as error:
        raise click.ClickException(str(error)) from error
    except KeyboardInterrupt:
        raise click.ClickException("interrupted.") from None


def calibrate_config(given: Mapping[str, Any]) -> CalibrateConfig:
    """The knobs of a calibration from the options of the command."""
    return CalibrateConfig(
        frames=FrameConfig(
            sync_tolerance_ms=given["sync_tolerance_ms"],
            sample_interval=given["sample_interval"],
            max_samples=given["max_samples"],
        ),
        detect=DetectConfig(dictionary=given["aruco_dictionary"], min_markers=given["min_markers"]),
        align=AlignConfig(
            enabled=given["auto_align"],
            ground_face=given["ground_face"],
            ground_marker_id=given["ground_marker_id"],
            up_axis=given["up_axis"],
            up_from=given.get("up_from", "target"),
        ),
        depth=DepthConfig(
            save=given["save_depth"] is not None,
            verify=given["verify_depth"],
            refine=given["refine_depth"],
            model=given["depth_model"],
            baseline_m=given["baseline"],
        ),
        moving_target=given["moving_target"],
        still=given["still"],
        joint=given["joint"],
        refine_target=given["refine_target"],
        seed=given["seed"],
    )


def refuse_inputs(output: Path, recordings: Sequence[Path], markers: Path | None, kept: Path | None = None) -> None:
    """An output must not replace what it is made from.

    Raises:
        OutputError: It is the marker map or the file of kept cameras, or lies inside a camera's folder.
    """
    goal = output.resolve()
    if markers is not None and goal == markers.resolve():
        raise OutputError(f"{output}: is the marker map, an input; choose another name for it.")
    if kept is not None and goal == kept.resolve():
        raise OutputError(f"{output}: is the file of the cameras to keep, an input; choose another name for it.")
    if goal.exists() and any(goal == path.resolve() for path in recordings):
        raise OutputError(f"{output}: is a recording, an input; choose another name for it.")
    for path in recordings:
        root = path.resolve()
        for folder in goal.parents:
            if (folder == root or root in folder.parents) and (folder / "camera_info.yaml").exists():
                raise OutputError(f"{output}: lies in the camera folder {folder.name}, an input; choose another place.")


def refuse_clashes(outputs: Sequence[Path]) -> None:
    """No output may replace another.

    Raises:
        OutputError: Two have one name.
    """
    for one, other in combinations(outputs, 2):
        if one.resolve() == other.resolve():
            raise OutputError(f"{one}: two outputs have this name; give each its own.")


def beside(output: Path, ending: str) -> Path:
    """Where what goes with an output is written: beside it, named after it."""
    return output.with_name(f"{output.stem}{ending}")


def tell(calibration: Calibration, output: Path) -> None:
    """Print the table, and where the poses went."""
    out = console()
    show_calibration(out, calibration)
    if "target_refined" in calibration.notes:
        out.print(f"Wrote the corrected marker map to {beside(output, '_markers.parquet')}", markup=False)
    apart = sum(len(part.cameras) for part in calibration.parts)
    more = f", and of {apart} in worlds of their own" if apart else ""
    poses = calibration.kept.keys() | calibration.T_world_cam.keys()
    out.print(f"Wrote {len(poses)} camera poses{more} to {output}", markup=False)
