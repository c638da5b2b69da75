"""Whether a camera that was found elsewhere fits there as well as cameras do that were never in doubt.

Owns      doubt_about: directions that nobody tells, contradictions that are left.
Leaves    held-out distances, bounds and the floor to icp_gates, which has judged the same place before.

Gates compare a place with where the camera stood before, and nearly any place is better than that: on a simulated rig
they once believed one that was 0.35 m off, where 79 of 100 samples contradicted other clouds. At right places hardly
one does once the depth errors estimated there are taken out.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from aruco import icp_bumped_words as words
from aruco.icp_agreement import Witness
from aruco.icp_prior import Prior
from aruco.icp_suspects import MOST_AGAINST, Meeting, Pair, meetings, together
from aruco.icp_types import ICPMetrics
from aruco.pose_math import Pose

# Contradictions that are left at the edges of things, of what could meet, or as many as other cameras have among
# themselves where people walk about; never as many as of a bumped one.
MOST_LEFT = 0.2


def doubt_about(
    camera: str, clouds: Mapping[str, Witness], T_world_cam: Mapping[str, Pose], metrics: ICPMetrics
) -> str:
    """What speaks against a found place, in words; empty: nothing.

    Args:
        camera: Which.
        clouds: Camera -> its cloud, the depth bias of this answer taken out.
        T_world_cam: Poses of this answer.
        metrics: Of this answer, in which the camera was moved.
    """
    unclear = metrics.cameras[camera].unobservable
    if unclear:
        return words.unclear(unclear)
    sure = {name: Prior(T_world_cam=T, covariance=np.zeros((6, 6))) for name, T in T_world_cam.items()}
    met = meetings(clouds, T_world_cam, sure)
    others = [_share(name, {pair: m for pair, m in met.items() if camera not in pair}) for name in clouds]
    most = min(max([MOST_LEFT, *others]), MOST_AGAINST)
    own = _share(camera, met)
    return words.contradicts_there(own, most) if own > most else ""


def _share(camera: str, met: Mapping[Pair, Meeting]) -> float:
    """Of a camera's samples that contradict any other."""
    return together(m for pair, m in met.items() if camera in pair).share
