"""Cameras whose floor contradicts their pose: what neither covariances nor the bias of depth explain.

Owns      when a camera, or the whole rig, is called contradicted, and by how much.
Leaves    how large errors are to floor_evidence, words to whoever tells a user.

A correction mends pitch, roll and height. Whatever made it that large has spoilt yaw and place too, which no floor
sees: such a pose is not mended, and somebody has to know.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

from aruco.floor_correction import FloorCorrection

# Four floors tell a common factor to two or so, and of rough poses its upper end is taken: honest covariances reached
# 2.7 on 40 simulated rigs with errors from 0.03 to 0.6 degrees; poses three times worse than promised passed 4 mostly.
GIVEN_LIMIT = 4.0
# Poses of which nothing is known may be ten times worse than the default; see floor_model.
DEFAULT_LIMIT = 10.0
# Covariances of markers alone promise thousandths of a degree, which lenses do not keep. Less than this spoils nothing:
# it is what a good calibration may be off.
TILT_DEG = 0.2
RISE_M = 0.005


@dataclass(frozen=True, slots=True, kw_only=True)
class FloorDoubts:
    """Factors on the standard deviations of poses that are too large to be believed."""

    odd: Mapping[str, float] = field(default_factory=dict)  # camera -> factor, where the others are right
    shared: Mapping[str, float] = field(default_factory=dict)  # likewise where nobody knows which is

    @property
    def factors(self) -> dict[str, float]:
        """All of them."""
        return {**self.shared, **self.odd}


def floor_doubts(
    corrections: Mapping[str, FloorCorrection], pose_scales: Mapping[str, float], given: Collection[str]
) -> FloorDoubts:
    """Which cameras are off by far more than was said of their poses.

    Args:
        corrections: Of all cameras that see the floor; what is rejected needs no doubt.
        pose_scales: Camera -> the factor that the floors tell.
        given: Cameras whose covariance somebody has said.
    """
    odd: dict[str, float] = {}
    shared: dict[str, float] = {}
    for known, limit in ((True, GIVEN_LIMIT), (False, DEFAULT_LIMIT)):
        group = {name: scale for name, scale in pose_scales.items() if (name in given) == known}
        common = min(group.values(), default=1.0)
        for name, scale in sorted(group.items()):
            if scale > limit and _matters(corrections[name]):
                (odd if scale > common else shared)[name] = scale
    return FloorDoubts(odd=odd, shared=shared)


def _matters(correction: FloorCorrection) -> bool:
    return correction.accepted and (correction.tilt_before_deg > TILT_DEG or abs(correction.height_before_m) > RISE_M)
