"""The options of refine-ground-plane that concern the registration of clouds, and what they are given with.

Owns      their names, defaults and help; light to import, so that --help answers at once.
Leaves    what they do to icp_refining.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import click
from click.core import ParameterSource

from rigcal.finite import Finite

if TYPE_CHECKING:
    from collections.abc import Mapping

    from aruco.icp_types import ICPConfig

Command = TypeVar("Command", bound=Callable[..., Any])

_OPTIONS = (
    click.option("--icp/--no-icp", default=False, show_default=True,
                 help="After levelling, move cameras so that their clouds meet: each only as far as clouds know better "
                      "than its pose, and only where that proves true on points that were held out."),
    click.option("--icp-method", type=click.Choice(["point_to_plane", "gicp"]), default="point_to_plane",
                 show_default=True,
                 help="Distances along the normal of the other cloud's surface; or weighed by the covariances of both "
                      "surfaces, which is not the GICP of Open3D."),
    click.option("--icp-voxel-size", type=Finite(0, 1, min_open=True), default=0.02, show_default=True,
                 metavar="M", help="Clouds are thinned to one point in each cube of this size; for a scene on a desk "
                                   "give less."),
    click.option("--icp-region", type=click.Choice(["floor", "hybrid", "full"]), default="hybrid", show_default=True,
                 help="What takes part: the floor and what lies just above it, that and whatever stands upright, or "
                      "everything."),
    click.option("--icp-depth-bias/--no-icp-depth-bias", default=True, show_default=True,
                 help="Write each camera's depth bias, which is estimated together with the poses; else it is only "
                      "allowed for."),
    click.option("--icp-global-init", is_flag=True,
                 help="Also look for cameras that were bumped, by what their clouds look like: up to 30 degrees and "
                      "0.6 m from where they are said to stand, or as far as --max-rotation-deg and "
                      "--max-translation-m allow if that is farther."),
)  # fmt: skip
_FLAGS = {
    "icp_method": "--icp-method",
    "icp_voxel_size": "--icp-voxel-size",
    "icp_region": "--icp-region",
    "icp_depth_bias": "--icp-depth-bias",
    "icp_global_init": "--icp-global-init",
}


def icp_options(command: Command) -> Command:
    """The command with these options, listed in this order."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


def check_icp_options(context: click.Context) -> None:
    """Refuse options of a registration that was not asked for.

    Raises:
        click.UsageError: What to give besides.
    """
    if context.params["icp"]:
        return
    given = [flag for name, flag in _FLAGS.items() if context.get_parameter_source(name) is not ParameterSource.DEFAULT]
    if given:
        raise click.UsageError(f"{', '.join(given)} would do nothing: the registration of clouds wants --icp too")


def icp_config(given: Mapping[str, Any]) -> ICPConfig:
    """How clouds are registered, by the options of the command; which way is up the rig says."""
    from aruco.icp_types import ICPConfig

    return ICPConfig(
        method=given["icp_method"],
        voxel_size=given["icp_voxel_size"],
        region=given["icp_region"],
        depth_bias=given["icp_depth_bias"],
        global_init=given["icp_global_init"],
        max_rotation_deg=given["max_rotation_deg"],
        max_translation_m=given["max_translation_m"],
        stride=given["stride"],
        seed=given["seed"],
    )
