"""``rigcal``: a rig for people without one, and what surrounds the two calibration commands."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from rigcal.convert_options import HELP, convert_options, export_choices, inputs_and_output, use_of


@click.group(context_settings={"max_content_width": 100, "help_option_names": ["-h", "--help"]})
@click.version_option(package_name="rigcal")
def main() -> None:
    """Find out where the cameras of a depth-camera rig stand, and prove it.

    The main job is the command calibrate-extrinsics; see its --help.
    """


@main.command()
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Another seed, another rig.")
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), help="Keep the recording and the result in this folder."
)
@click.option("--debug", is_flag=True, help="Say more about what happens.")
def demo(**given: Any) -> None:
    """Simulate a small rig, calibrate it upright, and print the errors against the truth."""
    from rigcal import cli, stories

    with cli.telling_errors(debug=given["debug"]):
        stories.demo(seed=given["seed"], keep=given["output"])


@main.command()
@click.argument("name")
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Another seed, another rig.")
@click.option("--frames", type=click.IntRange(min=1), metavar="N", help="Frames a camera instead of the rig's own.")
@click.option("--cameras", type=click.IntRange(min=1), metavar="N", help="Cameras instead of the rig's own number.")
@click.option("--resting-face", metavar="FACE", help="Which face of the target lies on the floor.")
@click.option("--distortion/--no-distortion", default=None, help="Whether lenses distort.")
@click.option("--depth/--no-depth", default=None, help="Whether cameras measure depth.")
@click.option("--debug", is_flag=True, help="Say more about what happens.")
def simulate(**given: Any) -> None:
    """Render the rig NAME into the folder OUT: a recording, its marker map, and the truth.

    Rigs: box-static, box-moved, corner-static, board-moved, demo, hd.
    """
    from rigcal import cli, stories

    with cli.telling_errors(debug=given["debug"]):
        stories.simulate_files(
            given["name"],
            given["out"],
            seed=given["seed"],
            n_frames=given["frames"],
            n_cameras=given["cameras"],
            resting_face=given["resting_face"],
            distortion=given["distortion"],
            depth=given["depth"],
        )


@main.command(help=HELP)
@convert_options
@click.option("--debug", is_flag=True, help="Say more about what happens.")
def convert(**given: Any) -> None:
    """Convert a calibration, or a recording, or explain a format."""
    use = use_of(given)
    from rigcal import cli

    with cli.telling_errors(debug=given["debug"]):
        if use == "recording":
            click.echo(_convert_recording(given))
        elif use == "calibration":
            click.echo(_convert_calibration(given))
        else:
            click.echo(_explained(given["explain"]))


def _convert_calibration(given: dict[str, Any]) -> str:
    from rigcal.exporting import export
    from rigcal.formats.registry import format_named
    from rigcal.formats.rig import ExportOptions
    from rigcal.recordings import options_from

    to = format_named(given["to"])
    (calibration,), out = inputs_and_output(given)
    return export(
        calibration,
        out,
        to=to,
        options=ExportOptions(**export_choices(given, to.takes)),
        recordings=given["recordings"],
        source_options=options_from(given),
    )


def _convert_recording(given: dict[str, Any]) -> str:
    from rigcal import cli
    from rigcal.exporting import refuse_calibration
    from rigcal.recording_conversion import convert_recording
    from rigcal.recordings import options_from

    paths, out = inputs_and_output(given)
    refuse_calibration(paths[0])
    with cli.showing_progress() as progress:
        return convert_recording(
            paths,
            out,
            options=options_from(given),
            every=given["every"] or 1,
            depth=given["depth"],
            progress=progress,
        ).sentence


def _explained(name: str | None) -> str:
    from rigcal.formats.registry import NAMES, format_named

    return format_named(name).explain if name else "\n".join(f"{n}: {format_named(n).explain}" for n in NAMES)


if __name__ == "__main__":
    main()
