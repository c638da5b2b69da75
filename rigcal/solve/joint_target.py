"""A rig and the target in it, both only roughly known: views judged on the rough map, then the map corrected.

Owns      the order: judge the views, correct the map, judge them again.
Leaves    mathematics to target_shape, judging to judge.

Corners are judged before model noise is looked for: a rough map makes residuals of many pixels, which are not noise.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from aruco.errors import CalibrationError
from aruco.model import Camera
from aruco.pose_math import Array
from aruco.rig_estimate import RigEstimate
from rigcal.solve.joint import Detections, prepared
from rigcal.solve.judge import adjust_judging
from rigcal.solve.target_shape import RefinedTarget, refine_target

# Views that a rough map kept out come back once it is corrected, and correct it a little more.
ROUNDS = 2
# A map is not corrected by what is known worse than a ruler measures it.
HOPELESS_M = 0.01


def refine_rig_target(
    rig: RigEstimate,
    cameras: Sequence[Camera],
    detections: Detections,
    geometry: Mapping[int, Array],
    *,
    moving: bool,
    fixed: Collection[str] = (),
) -> RefinedTarget:
    """The corrected map of a target; see joint.adjust_rig for the arguments.

    Raises:
        CalibrationError: No view fits the rough map.
    """
    corrected, found = geometry, None
    for _ in range(ROUNDS):
        sightings, start, gauge = prepared(rig, cameras, detections, corrected, moving=moving, fixed=fixed)
        judged = adjust_judging(sightings, start if found is None else found.poses, gauge)
        if not judged.kept.any():
            raise CalibrationError("The views contradict each other: nothing is left to correct the marker map with.")
        kept = sightings.only_views(judged.kept)
        found = refine_target(kept, judged.adjustment.poses, judged.gauge, corrected)
        corrected = found.geometry
    assert found is not None, "there is a round at least"
    worst = max(found.sigma_m, key=lambda marker: found.sigma_m[marker], default=None)
    if worst is not None and found.sigma_m[worst] > HOPELESS_M:
        raise CalibrationError(
            f"The marker map cannot be corrected: the views leave open by {1e3 * found.sigma_m[worst]:.0f} mm where "
            f"marker {worst} is; check its ids and sizes, and record more frames in which cameras see several markers."
        )
    return found
