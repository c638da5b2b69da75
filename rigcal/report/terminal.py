"""The end of a run in a terminal: a table of cameras, and what to know about them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from aruco.model import Calibration, CameraPose
from aruco.uncertainty import camera_sigma

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

# What comes first matters most; a page of symptoms hides it.
MAX_REASONS = 6


def console(*, stderr: bool = False) -> Console:
    """A terminal to print to; plain and wide enough for tables where there is none."""
    from rich.console import Console

    made = Console(stderr=stderr, highlight=False, soft_wrap=True)
    return made if made.is_terminal else Console(stderr=stderr, highlight=False, soft_wrap=True, width=120)


def show_calibration(out: Console, calibration: Calibration) -> None:
    """Per camera: frames, markers, residuals, spread; then warnings, cameras without a pose, and the world."""
    out.print(_table(calibration))
    _show_least_known(out, calibration)
    for camera in calibration.cameras:
        for warning in camera.warnings:
            out.print(f"warning: camera {camera.camera}: {warning}", markup=False)
    for name, reason in calibration.lost.items():
        out.print(f"no pose: camera {name}: {reason}", markup=False)
    _show_target(out, calibration)
    for name in sorted(calibration.kept.keys() - calibration.T_world_cam.keys()):
        why = calibration.idle.get(name)
        told = "not in this recording" if why is None else f"it took no part: {why}"
        out.print(f"kept: camera {name}: as its file says; {told}", markup=False)
    _show_clock(out, calibration)
    _show_verdict(out, calibration)
    out.print(_world(calibration), markup=False)
    for part in calibration.parts:
        names = ", ".join(camera.camera for camera in part.cameras)
        out.print(f"\nNot connected with these: cameras {names}, in a world of their own (_meta.parts)", markup=False)
        show_calibration(out, part)


def _table(calibration: Calibration) -> Table:
    from rich.markup import escape
    from rich.table import Table

    table = Table(title="Cameras", title_justify="left")
    table.add_column("camera")
    adjusted = any(camera.covariance is not None or camera.kept for camera in calibration.cameras)
    known = ("known to\n+- mm", "known to\n+- degrees") if adjusted else ()
    measured = ("frames", "markers", "reprojection\nRMS px", "spread\nmm", "spread\ndegrees")
    for name in (*measured, *known, "x m", "y m", "z m"):
        table.add_column(name, justify="right")
    for camera in calibration.cameras:
        alone = camera.n_frames < 2
        table.add_row(
            escape(camera.camera),
            str(camera.n_frames),
            str(camera.n_markers),
            f"{camera.rms_px:.3f}",
            "-" if alone else f"{1e3 * camera.spread_m:.2f}",
            "-" if alone else f"{math.degrees(camera.spread_rad):.3f}",
            *(_known_to(camera) if adjusted else ()),
            *(f"{value:.3f}" for value in camera.T_world_cam[:3, 3]),
        )
    return table


def _show_least_known(out: Console, calibration: Calibration) -> None:
    known = [
        (camera_sigma(camera.covariance, camera.T_world_cam).total_m, camera)
        for camera in calibration.cameras
        if camera.covariance is not None and camera.least_known
    ]
    if known:
        _, least = max(known, key=lambda pair: pair[0])
        out.print(f"Least known: {least.least_known}.", markup=False)


def _known_to(camera: CameraPose) -> tuple[str, ...]:
    if camera.kept:
        return "kept", "kept"
    if camera.covariance is None:
        return "-", "-"
    sigma = camera_sigma(camera.covariance, camera.T_world_cam)
    return f"{1e3 * sigma.total_m:.2f}", f"{math.degrees(sigma.total_rad):.3f}"


def _show_target(out: Console, calibration: Calibration) -> None:
    found = calibration.notes.get("target_refined")
    if not found or not found["moved_mm"]:
        return
    moved, sigma = found["moved_mm"], found["sigma_mm"]
    worst = max(moved, key=lambda marker: moved[marker])
    out.print(
        f"Marker map: {len(moved)} markers moved, by up to {moved[worst]:.2f} mm (marker {worst}), now known to "
        f"+- {max(sigma.values()):.2f} mm or better",
        markup=False,
    )


def _show_clock(out: Console, calibration: Calibration) -> None:
    clock = calibration.notes.get("sync")
    if not clock or len(calibration.frames) < 2:
        return
    unpaired = {name: counts.unpaired for name, counts in calibration.frames.items() if counts.unpaired}
    without = ", ".join(f"{name} {count}" for name, count in unpaired.items()) or "none"
    out.print(
        f"{clock['used']} of {clock['groups']} synchronised frames used; skew {clock['median_skew_ms']:.1f} ms, "
        f"at most {clock['worst_skew_ms']:.1f} ms; frames without a partner: {without}",
        markup=False,
    )


def _show_verdict(out: Console, calibration: Calibration) -> None:
    quality = calibration.notes.get("quality")
    if not quality:
        return
    out.print(f"Verdict: {quality['verdict']}", markup=False)
    *reasons, last = quality["reasons"]
    for reason in [*reasons[:MAX_REASONS], last]:
        out.print(f"  - {reason}", markup=False)
    if len(reasons) > MAX_REASONS:
        out.print(f"  ({len(reasons) - MAX_REASONS} more under _meta.quality)", markup=False)


def _world(calibration: Calibration) -> str:
    if calibration.kept:
        return "World: that of the cameras that were kept; what others are known to is relative to these."
    if calibration.up is None:
        return "World: the target's frame; which way is up is not known (--auto-align turns it upright)."
    way = "up, against gravity" if calibration.up == "+y" else "down, along gravity (ZED Fusion's frame)"
    aligned = calibration.notes.get("aligned", {})
    by = (
        "by the accelerometers" if aligned.get("up_from") == "imu" else f"level face: {aligned.get('ground_face', '?')}"
    )
    return f"World: origin in the target, y points {way}; {by}."


def show_errors(
    out: Console, calibration: Calibration, pair_errors: Mapping[tuple[str, str], tuple[float, float]], tilt_rad: float
) -> None:
    """A calibration against the truth: the errors of camera pairs beside the spread that was estimated.

    Args:
        out: Where to print.
        calibration: What was estimated.
        pair_errors: (camera, camera) -> error of their relative pose [rad], [m].
        tilt_rad: Angle between the estimated and the true up.
    """
    from rich.markup import escape
    from rich.table import Table

    spread = {camera.camera: camera.spread_m for camera in calibration.cameras}
    table = Table(title="Relative poses of camera pairs against the truth", title_justify="left")
    table.add_column("pair")
    for name in ("error\nmm", "error\ndegrees", "spread of single\nframes mm"):
        table.add_column(name, justify="right")
    for (i, j), (angle, distance) in pair_errors.items():
        both = math.hypot(spread[i], spread[j])
        table.add_row(escape(f"{i} - {j}"), f"{1e3 * distance:.2f}", f"{math.degrees(angle):.4f}", f"{1e3 * both:.2f}")
    out.print(table)
    out.print(f"Up differs from gravity by {math.degrees(tilt_rad):.4f} degrees.", markup=False)
