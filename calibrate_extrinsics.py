#!/usr/bin/env python
"""Recordings of a marker target in, camera poses out: ask, call rigcal.pipeline, tell."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rigcal.depth_options import check_depth_options, depth_options
from rigcal.source_options import source_options

if TYPE_CHECKING:
    from aruco.model import Calibration

DOUBTFUL = 3  # exit code: poses were written, but not of every camera, or they are called bad


@click.command(context_settings={"max_content_width": 100, "help_option_names": ["-h", "--help"]})
@click.option("--svo", "svo", type=click.Path(path_type=Path), multiple=True,
              help="A ZED recording (.svo, .svo2) or a folder of them; repeatable. The same as --input.")  # fmt: skip
@click.option("-i", "--input", "inputs", type=click.Path(path_type=Path), multiple=True,
              help="A recording, or a folder of some of one kind: RGB-D folder, ZED SVO or SVO2, ROS bag, MCAP, video; "
                   "repeatable.")  # fmt: skip
@source_options
@click.option("--markers", type=click.Path(path_type=Path), help="Marker map of the target (parquet).")
@click.option("--board", metavar="SPEC",
              help="A board instead of a marker map: charuco:COLUMNSxROWS:SQUARE_M:MARKER_M:DICTIONARY, "
                   "aprilgrid:COLUMNSxROWS:TAG_M:SPACING[:DICTIONARY[:FIRST_ID]], or a YAML file.")  # fmt: skip
@click.option("--aruco-dictionary", default="DICT_APRILTAG_36h11", show_default=True,
              help="Any predefined OpenCV dictionary.")  # fmt: skip
@click.option("-o", "--output", type=click.Path(path_type=Path), default=Path("extrinsics.json"), show_default=True,
              help="Where the poses go.")  # fmt: skip
@click.option("--moving-target/--resting-target", default=False, show_default=True,
              help="Whether the target is moved between frames. If it rests, its frame is the world; if it is moved, "
                   "the world is the target's frame at the first frame that two cameras see it in.")  # fmt: skip
@click.option("--still", is_flag=True,
              help="For cameras that are not synchronised: move the target and put it down now and then; the stretches "
                   "in which it rests are used instead of single frames.")  # fmt: skip
@click.option("--auto-align/--no-auto-align", default=False, show_default=True,
              help="Turn the world upright: +Y points up, against gravity. A level camera then has "
                   "T[:3,1] = [0,-1,0].")  # fmt: skip
@click.option("--ground-face", metavar="NAME", help="Name of a face of the target that lies level.")
@click.option("--ground-marker-id", metavar="ID", type=int, help="Id of a marker that lies level.")
@click.option("--up-axis", type=click.Choice(["+y", "-y"]), default="+y", show_default=True,
              help="Which way the aligned world's y axis points up: +y up (default), or -y, the same world turned by "
                   "180 degrees about x, in which ZED Fusion files are written: y points down there and a camera 1.2 m "
                   "high stands at y = -1.2.")  # fmt: skip
@click.option("--up-from", type=click.Choice(["target", "imu"]), default="target", show_default=True,
              help="What tells which way is up: the target lying level (where the recording knows gravity, the verdict "
                   "checks it), or the accelerometers of the cameras that have one (ZED).")  # fmt: skip
@click.option("--sync-tolerance-ms", type=click.FloatRange(min=0), metavar="MS",
              help="How far apart frames of one moment may be. Default: half the slowest camera's frame period, at "
                   "most 100 ms.")  # fmt: skip
@click.option("--sample-interval", type=click.IntRange(min=1), default=1, show_default=True, metavar="N",
              help="Use every Nth synchronised frame.")  # fmt: skip
@click.option("--max-samples", type=click.IntRange(min=1), metavar="N",
              help="Use at most N of these, spread over the recording.")  # fmt: skip
@click.option("--min-markers", type=click.IntRange(min=1), default=1, show_default=True, metavar="N",
              help="Leave out views with fewer markers.")  # fmt: skip
@click.option("--joint/--no-joint", default=True, show_default=True,
              help="Adjust all cameras and frames together, with uncertainty; or keep the average.")  # fmt: skip
@click.option("--fix", type=click.Path(path_type=Path), metavar="FILE",
              help="An extrinsics file: its cameras stay where they are, to the bit, and the others of the recording "
                   "are added in its world.")  # fmt: skip
@click.option("--refine-target", is_flag=True,
              help="The marker map is only roughly right: estimate where the markers are on the target too. Each keeps "
                   "its size, which fixes the scale; the corrected map is written beside the output.")  # fmt: skip
@depth_options
@click.option("--preview/--no-preview", default=False, show_default=True,
              help="Write annotated frames into a folder beside the output.")  # fmt: skip
@click.option("--seed", type=int, default=0, show_default=True, help="For every random choice.")
@click.option("--jobs", type=click.IntRange(min=1), metavar="N", help="Threads. Default: all cores.")
@click.option("--debug", is_flag=True, help="Say more about what happens.")
@click.version_option(package_name="rigcal")
def main(**given: Any) -> None:
    """Find out where the cameras of a rig stand.

    Put a box of ArUco or AprilTag markers on the floor, record it with all cameras, and give the recordings here.
    Exit codes: 0 all cameras placed, 1 an error, 2 wrong usage, 3 written, but not for every camera, or called bad.
    """
    if not (given["svo"] or given["inputs"]):
        raise click.UsageError(
            "no recording given; pass --input PATH (or --svo PATH), as often as there are recordings"
        )
    if bool(given["markers"]) == bool(given["board"]):
        raise click.UsageError("give the target: --markers MAP.parquet, or --board SPEC, one of them")
    if given["fix"] and given["auto_align"]:
        raise click.UsageError("--fix keeps the world of its file, upright or not; leave out --auto-align")
    if given["refine_target"] and (given["board"] or not given["joint"]):
        raise click.UsageError("--refine-target estimates a marker map in the joint adjustment: it wants --markers, "
                               "and neither --board nor --no-joint")  # fmt: skip
    check_depth_options(given)
    upright = ("ground_face", "ground_marker_id", "up_axis", "up_from")
    if not given["auto_align"] and any(given[name] not in (None, "+y", "target") for name in upright):
        click.echo("warning: --ground-face, --ground-marker-id, --up-axis and --up-from do nothing without "
                   "--auto-align", err=True)  # fmt: skip
    if given["up_from"] == "imu" and (given["ground_face"] or given["ground_marker_id"] is not None):
        click.echo("warning: --ground-face and --ground-marker-id do nothing with --up-from imu", err=True)
    from rigcal import cli

    with cli.telling_errors(debug=given["debug"]):
        calibration = _run(given)
        raise SystemExit(0 if calibration.is_whole and not calibration.is_bad else DOUBTFUL)


def _run(given: dict[str, Any]) -> Calibration:
    from rigcal import cli
    from rigcal.calibrate_outputs import CalibrateOutputs
    from rigcal.pipeline import calibrate_files
    from rigcal.recordings import options_from

    outputs = CalibrateOutputs.asked_for(given)
    with cli.showing_progress() as progress:
        calibration = calibrate_files(
            [*given["svo"], *given["inputs"]],
            given["markers"],
            cli.calibrate_config(given),
            options=options_from(given),
            board=given["board"],
            fix=given["fix"],
            jobs=given["jobs"],
            progress=progress,
            preview=cli.beside(given["output"], "_preview") if given["preview"] else None,
            listeners=outputs.listeners,
        )
    outputs.write(calibration)
    outputs.tell(calibration)
    return calibration


if __name__ == "__main__":
    main()
