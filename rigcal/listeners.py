"""Who is told of what a calibration finds beside the poses.

Owns      the callbacks and what they are given.
Leaves    writing any of it to the commands.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from aruco.depth_save import CameraDepth
from aruco.depth_verify import DepthAgreement
from aruco.marker_geometry import Face
from rigcal.detecting import OnFrame

Agreements = Mapping[str, DepthAgreement]


def _nobody(*found: Any) -> None:
    """Nobody wants to know."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Listeners:
    """Everybody may be left out."""

    frame: OnFrame | None = None  # every image that was read, from several threads
    looked: Callable[[], object] = _nobody  # that was every image
    target: Callable[[Sequence[Face]], object] = _nobody  # the target's faces, if their map was corrected
    depth: Callable[[Mapping[str, CameraDepth]], object] = _nobody  # every camera's depth, pooled over time
    # How depth agrees with the target before its bias was taken out, and after (empty if it was not); part by part.
    agreement: Callable[[Agreements, Agreements], object] = _nobody


NOBODY = Listeners()
