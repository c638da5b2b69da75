"""Places of a surface that look like no other: fast point feature histograms (FPFH) of clouds.

Owns      distinct_spots, matched_spots: which places two clouds may have in common, wherever they stand.
Leaves    what matches say of a pose to icp_votes.

A histogram describes how normals turn around a point (Rusu, Blodow and Beetz, "Fast point feature histograms for 3D
registration", 2009). Of furniture seen from other sides, in noisy depth, few matches are right, hardly more than
chance makes: only many of them that agree mean something.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aruco.icp_agreement import first_of_voxels
from aruco.icp_pair import cloud_of_points, quiet_open3d
from aruco.pose_math import Array

# Stereo depth rounds off what is smaller; of what is larger another camera seldom sees the same part.
SPOT_VOXEL_M = 0.06
RADIUS_M = 0.3
_NEIGHBOURS = 150
# Of each of the three histograms, the bin in which all pairs of points of a plane fall.
_PLANE_BINS = [5, 16, 27]
# Of all entries, those that a plane's points have in these bins: 1. Two planes at a right angle, half and half: 0.5.
_MOST_PLANAR = 0.9
MATCHES_EACH = 5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Spots:
    """Places and what they look like."""

    points: Array  # (n, 3) [m]
    features: Array  # (n, 33)

    def __len__(self) -> int:
        """How many."""
        return len(self.points)


def distinct_spots(points: Array, normals: Array, most: int) -> Spots:
    """The places whose surroundings are least like a plane.

    Args:
        points: (n, 3) [m].
        normals: (n, 3) unit.
        most: So many are kept at most.
    """
    import open3d as o3d

    thin = first_of_voxels(points, SPOT_VOXEL_M)
    if not len(thin):
        return Spots(points=np.zeros((0, 3)), features=np.zeros((0, 33)))
    cloud = cloud_of_points(points[thin], normals[thin])
    around = o3d.geometry.KDTreeSearchParamHybrid(radius=RADIUS_M, max_nn=_NEIGHBOURS)
    with quiet_open3d():
        features = np.asarray(o3d.pipelines.registration.compute_fpfh_feature(cloud, around).data).T
    planar = features[:, _PLANE_BINS].sum(axis=1) / np.maximum(features.sum(axis=1), 1e-12)
    order = np.argsort(planar, kind="stable")[:most]
    # A point without neighbours has an empty histogram.
    keep = order[(planar[order] < _MOST_PLANAR) & (features[order].sum(axis=1) > 0)]
    return Spots(points=points[thin][keep], features=features[keep])


def matched_spots(
    source: Spots, target: Spots, reach_m: Array, most_rise_m: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """For each spot of a source those of a target that look most like it, of the ones it can have moved to.

    Args:
        source: Spots in the world, as the source stands now.
        target: Spots in the world.
        reach_m: (n,) how far each of the source's may be from where it belongs.
        most_rise_m: How far along y.

    Returns:
        Indices (m,) into the source and into the target.
    """
    from scipy.spatial.distance import cdist

    if not len(source) or not len(target):
        return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
    unlike = cdist(source.features, target.features)
    unlike[cdist(source.points, target.points) > reach_m[:, None]] = np.inf
    unlike[np.abs(source.points[:, None, 1] - target.points[None, :, 1]) > most_rise_m] = np.inf
    j = np.argsort(unlike, axis=1, kind="stable")[:, :MATCHES_EACH]
    i = np.repeat(np.arange(len(source), dtype=np.intp), j.shape[1])
    possible = np.isfinite(unlike[i, j.ravel()])
    return i[possible], j.ravel()[possible]
