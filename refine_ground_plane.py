#!/usr/bin/env python
"""Poses and the rig's own depth in, the same rig on its real floor out: ask, call rigcal.levelling, tell."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rigcal.finite import Finite
from rigcal.icp_options import check_icp_options, icp_config, icp_options

if TYPE_CHECKING:
    from rigcal.levelled_rig import Levelling


PARTIAL = 3  # exit code: written, but not every camera was levelled on a floor that it sees itself


@click.command(context_settings={"max_content_width": 100, "help_option_names": ["-h", "--help"]})
@click.option("-i", "--input-extrinsics", type=click.Path(path_type=Path), required=True, metavar="FILE",
              help="Poses of an upright world: what calibrate-extrinsics --auto-align has written.")  # fmt: skip
@click.option("-d", "--input-depth", type=click.Path(path_type=Path), required=True, metavar="FILE.h5",
              help="Depth of the same cameras: what calibrate-extrinsics --save-depth has written.")  # fmt: skip
@click.option("-o", "--output-extrinsics", type=click.Path(path_type=Path), required=True, metavar="FILE",
              help="Where the levelled poses go; never one of the inputs.")  # fmt: skip
@click.option("--metrics-json", type=click.Path(path_type=Path), metavar="FILE",
              help="Write what was found of the floor into a file of its own too.")  # fmt: skip
@click.option("--plot/--no-plot", default=None,
              help="Write a page that shows the floor before and after, in 3D and as height maps. "
                   "Default: only if --plot-output is given.")  # fmt: skip
@click.option("--plot-output", type=click.Path(path_type=Path), metavar="FILE.html",
              help="Where the page goes. Default: beside the output, named after it.")  # fmt: skip
@click.option("--max-rotation-deg", type=Finite(0, 90, min_open=True), default=5.0, show_default=True, metavar="DEG",
              help="How far one camera may be turned, by --icp too; more is refused. What all others do in common "
                   "does not count.")  # fmt: skip
@click.option("--max-translation-m", type=Finite(0, 10, min_open=True), default=0.1, show_default=True, metavar="M",
              help="How far one camera may be raised or lowered, and by --icp moved, against what all others do in "
                   "common.")  # fmt: skip
@click.option("--ransac-threshold", type=Finite(0, 1, min_open=True), metavar="M",
              help="How near a plane depth must be to be part of it. Default: by the noise of depth.")  # fmt: skip
@click.option("--height-range", type=Finite(-1000, 1000), nargs=2, metavar="MIN MAX",
              help="Look for the floor only between these heights of the input's world [m], counted along up: "
                   "where y points down, the height of a point is -y.")  # fmt: skip
@click.option("--stride", type=click.IntRange(min=1), default=4, show_default=True, metavar="N",
              help="Use every Nth row and column of the depth.")  # fmt: skip
@click.option("--target-floor-y", type=Finite(-1000, 1000), default=0.0, show_default=True, metavar="M",
              help="Where the floor is put on the y axis.")  # fmt: skip
@icp_options
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="For every random choice.")
@click.option("--debug", is_flag=True, help="Say more about what happens.")
@click.version_option(package_name="rigcal")
def main(**given: Any) -> None:
    """Level a calibration on the real floor, seen by the rig's own depth.

    The whole rig is turned and shifted onto the floor that its cameras agree on; then each camera's pitch, roll and
    height are corrected as far as the floor knows them better than its pose. Yaw, x and z stay, unless --icp asks the
    clouds of the cameras for them too.

    Exit codes: 0 all cameras levelled, 1 an error, 2 wrong usage, 3 written, but some camera sees no floor, or one that
    contradicts the others' or its own pose: see its warnings; or clouds could not be registered at all.
    """
    if given["plot"] is False and given["plot_output"]:
        raise click.UsageError("--plot-output names a page that --no-plot forbids: give one of them")
    heights = given["height_range"]
    if heights and heights[0] >= heights[1]:
        raise click.UsageError("--height-range wants the lower height first")
    check_icp_options(click.get_current_context())
    from rigcal import cli

    with cli.telling_errors(debug=given["debug"]):
        levelling = _run(given)
        raise SystemExit(0 if levelling.is_whole else PARTIAL)


def _run(given: dict[str, Any]) -> Levelling:
    from aruco.ground_plane import GroundPlaneConfig
    from rigcal.icp_refining import register_clouds
    from rigcal.levelling import level_files
    from rigcal.levelling_outputs import LevellingOutputs

    config = GroundPlaneConfig(
        max_rotation_deg=given["max_rotation_deg"],
        max_translation_m=given["max_translation_m"],
        ransac_threshold_m=given["ransac_threshold"],
        height_range=given["height_range"],
        stride=given["stride"],
        target_floor_y=given["target_floor_y"],
        seed=given["seed"],
    )
    registering = icp_config(given) if given["icp"] else None
    outputs = LevellingOutputs.asked_for(given)
    levelling = level_files(given["input_extrinsics"], given["input_depth"], config)
    if registering is not None:
        levelling = register_clouds(levelling, registering)
    outputs.write(levelling)
    _tell(levelling, outputs.paths)
    return levelling


def _tell(levelling: Levelling, written: list[Path]) -> None:
    from rigcal.icp_refining import log_registration
    from rigcal.report.floor_table import show_levelling
    from rigcal.report.icp_table import remarks_of, sheets_of, show_registration
    from rigcal.report.terminal import console

    out = console()
    show_levelling(out, levelling.figures, levelling.facts)
    found = levelling.registration
    if found is not None:
        sheets = sheets_of(found.metrics, levelling.T_world_cam.keys(), found.given_bias, found.new_bias.keys())
        show_registration(out, sheets, remarks_of(found.metrics))
        log_registration(found)
    for path in written:
        out.print(f"Wrote {path}", markup=False)


if __name__ == "__main__":
    main()
