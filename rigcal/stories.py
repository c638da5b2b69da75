"""The stories of the command ``rigcal``: a simulated rig on disk, and the demo."""

from __future__ import annotations

import tempfile
from contextlib import ExitStack
from pathlib import Path
from shlex import quote

from aruco.board import board_text
from aruco.errors import OutputError
from aruco.marker_geometry import save_faces
from rigcal import cli
from rigcal.config import AlignConfig, CalibrateConfig, DetectConfig
from rigcal.formats.native import UP_VECTORS, write_extrinsics, write_json
from rigcal.pipeline import calibrate_files
from rigcal.quality.truth import pair_errors, tilt_error
from rigcal.report.terminal import console, show_errors
from rigcal.sim import Simulation, simulate
from rigcal.sources.rgbd_folder import write_recording

MARKER_MAP, TRUTH, EXTRINSICS = "markers.parquet", "truth.json", "extrinsics.json"


def simulate_files(
    name: str,
    out: Path,
    *,
    seed: int = 0,
    n_frames: int | None = None,
    n_cameras: int | None = None,
    resting_face: str | None = None,
    distortion: bool | None = None,
    depth: bool | None = None,
) -> None:
    """Write a simulated recording with its marker map and its truth, and say how to calibrate it."""
    simulation = simulate(
        name,
        seed=seed,
        n_frames=n_frames,
        n_cameras=n_cameras,
        resting_face=resting_face,
        distortion=distortion,
        depth=depth,
    )
    _write(simulation, out)
    moving = " --moving-target" if simulation.rig.moving else ""
    board = simulation.target.board
    target = (
        f"--board {board_text(board)}"
        if board is not None
        else f"--markers {quote(str(out / MARKER_MAP))} --aruco-dictionary {simulation.dictionary}"
    )
    console().print(
        f"Wrote {out}: {len(simulation.recording.cameras)} cameras, the marker map {MARKER_MAP}, and {TRUTH}.\n"
        f"Calibrate it with: calibrate-extrinsics --input {quote(str(out))} {target}{moving} --auto-align",
        markup=False,
    )


def _write(simulation: Simulation, out: Path) -> None:
    with cli.showing_progress() as progress:
        write_recording(simulation.recording, out, depth=simulation.rig.depth, progress=progress)
    save_faces(out / MARKER_MAP, simulation.faces)
    write_json(out / TRUTH, simulation.truth_document())


def demo(*, seed: int, keep: Path | None) -> None:
    """Simulate a small rig, calibrate it upright from its files, and print its errors against the truth."""
    simulation = simulate("demo", seed=seed)
    config = CalibrateConfig(
        detect=DetectConfig(dictionary=simulation.dictionary), align=AlignConfig(enabled=True), seed=seed
    )
    with ExitStack() as stack:
        folder = keep or Path(stack.enter_context(tempfile.TemporaryDirectory())) / "demo"
        recording = folder / "recording"
        _make(folder)
        _write(simulation, recording)
        with cli.showing_progress() as progress:
            calibration = calibrate_files([recording], recording / MARKER_MAP, config, progress=progress)
        write_extrinsics(folder / EXTRINSICS, calibration)
    out = console()
    cli.show_calibration(out, calibration)
    estimated, true = calibration.T_world_cam, simulation.T_world_cam
    show_errors(out, calibration, pair_errors(estimated, true), tilt_error(estimated, true, UP_VECTORS["+y"]))
    if keep is not None:
        out.print(f"Kept in {keep}: the recording, its truth, and {EXTRINSICS}.", markup=False)


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be made ({error.strerror or error}); choose another --output.") from error
