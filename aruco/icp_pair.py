"""Two clouds brought together by Open3D, coarse to fine.

Owns      pairwise_icp and the information of a pair of plain clouds.
Leaves    graphs of pairs to icp_graph, global starts to icp_global; what depth cameras know, their bias and the marker
          prior to icp_solve, which registers a rig without this file.

Points here have no noise model. So a result says where the clouds meet, and not whether one should believe it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from aruco.errors import InputError
from aruco.icp_types import VOXELS, ICPConfig, ICPResult
from aruco.pose_math import Array, Pose, checked_pose, exp_se3, invert_transform, log_se3, transform_points

MIN_POINTS = 30  # five for each unknown
NORMAL_RADIUS_VOXELS = 2.0
# Noise of normals over two voxels would pretend to know x, z and yaw over a bare floor to fractions of a millimetre.
# Over six (12 cm at the default) that is 20 times less.
INFORMATION_RADIUS_VOXELS = 6.0
_NORMAL_NEIGHBOURS = 30
# Open3D adds up in whatever order its threads finish, which changes the last digits; what is kept of a twist is this.
_TWIST_STEP = 1e-9
# Distances of points of one voxel are known no better than this part of it, however well the clouds happen to fit.
_LEAST_SIGMA_VOXELS = 0.05


def pairwise_icp(source_pcd: Any, target_pcd: Any, config: ICPConfig, init_transform: Pose) -> ICPResult:
    """Move one cloud onto another, at 4, 2 and 1 voxels, each from where the coarser one ended.

    Args:
        source_pcd: Open3D cloud [m]; points that are not finite are left out. It is not changed.
        target_pcd: The cloud that stands still, likewise.
        config: ``voxel_size``, ``max_iterations`` of each scale, ``method``, ``max_correspondence_distance_factor``
            times the scale's voxel, and ``min_fitness``.
        init_transform: T_target_source to start from.

    Returns:
        T_target_source; the share of the source's points that met the target and their RMS distance at the finest
        scale; the information (6, 6) of a left perturbation in the target's frame, from distances along the target's
        normals, so that directions in which surfaces slide on each other have none. Converged: at least
        ``min_fitness`` met, which does not prove that they met in the right place. With too few points: the start, not
        converged.

    Raises:
        InputError: ``init_transform`` is no rigid transform.
    """
    try:
        T = checked_pose(init_transform, "init_transform")
    except ValueError as error:
        raise InputError(f"{error}; start from inv(T_world_target) @ T_world_source.") from None
    source, target = _finite(source_pcd), _finite(target_pcd)
    with quiet_open3d():
        for voxels, iterations in zip(VOXELS, config.max_iterations):
            voxel_m = voxels * config.voxel_size
            a, b = _thinned(source, voxel_m), _thinned(target, voxel_m)
            if min(len(a.points), len(b.points)) >= MIN_POINTS:
                reach_m = voxel_m * config.max_correspondence_distance_factor
                T = _settled(T, _registered(a, b, reach_m, T, config, iterations))
        a, b = _thinned(source, config.voxel_size), _thinned(target, config.voxel_size)
    if min(len(a.points), len(b.points)) < MIN_POINTS:
        return _failed(T, f"too few points: {len(a.points)} and {len(b.points)}, want {MIN_POINTS} in each")
    return _judged(a, b, T, config)


@contextmanager
def quiet_open3d() -> Iterator[None]:
    """Keep Open3D's warnings off the terminal; what they say is told in results."""
    import open3d as o3d

    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        yield


def cloud_of_points(points: Array, normals: Array | None = None) -> Any:
    """An Open3D cloud of points (n, 3) [m], with normals (n, 3) if given."""
    import open3d as o3d

    cloud = o3d.geometry.PointCloud()
    cloud.points = o3d.utility.Vector3dVector(np.ascontiguousarray(points, dtype=np.float64))
    if normals is not None:
        cloud.normals = o3d.utility.Vector3dVector(np.ascontiguousarray(normals, dtype=np.float64))
    return cloud


def _finite(cloud: Any) -> Any:
    points = np.asarray(cloud.points, dtype=np.float64)
    return cloud_of_points(points[np.isfinite(points).all(axis=1)])


def _thinned(cloud: Any, voxel_m: float) -> Any:
    import open3d as o3d

    if not len(cloud.points):
        return cloud
    thin = cloud.voxel_down_sample(voxel_m)
    radius = NORMAL_RADIUS_VOXELS * voxel_m
    thin.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=radius, max_nn=_NORMAL_NEIGHBOURS))
    return thin


def _registered(source: Any, target: Any, reach_m: float, T: Pose, config: ICPConfig, iterations: int) -> Pose:
    import open3d as o3d

    registration = o3d.pipelines.registration
    criteria = registration.ICPConvergenceCriteria(max_iteration=iterations)
    if config.method == "gicp":
        estimation = registration.TransformationEstimationForGeneralizedICP()
        found = registration.registration_generalized_icp(source, target, reach_m, T, estimation, criteria)
    else:
        estimation = registration.TransformationEstimationPointToPlane()
        found = registration.registration_icp(source, target, reach_m, T, estimation, criteria)
    return np.array(found.transformation)


def _settled(T_start: Pose, T_end: Pose) -> Pose:
    """The end of a step without the digits that depend on threads; the start, where the step has left all bounds."""
    try:
        step = log_se3(checked_pose(T_end, "T_target_source") @ invert_transform(T_start))
    except ValueError:
        return T_start
    return exp_se3(np.round(step / _TWIST_STEP) * _TWIST_STEP) @ T_start


def _judged(source: Any, target: Any, T: Pose, config: ICPConfig) -> ICPResult:
    """What the finest clouds say of a transform, in sums whose order is fixed."""
    from scipy.spatial import KDTree

    there = transform_points(T, np.asarray(source.points))
    points = np.asarray(target.points)
    reach_m = config.voxel_size * config.max_correspondence_distance_factor
    distances, nearest = KDTree(points).query(there, distance_upper_bound=reach_m)
    met = np.isfinite(distances)
    n_met = int(met.sum())
    if n_met < MIN_POINTS:
        return _failed(T, f"only {n_met} points met within {1e3 * reach_m:.0f} mm")
    rmse = float(np.sqrt(np.mean(distances[met] ** 2)))
    at = np.asarray(nearest)[met]
    p, n = points[at], _smooth_normals(target, config)[at]
    gaps = ((there[met] - p) * n).sum(axis=1)
    sigma = math.hypot(float(np.sqrt(np.mean(gaps**2))), _LEAST_SIGMA_VOXELS * config.voxel_size)
    fitness = n_met / len(there)
    return ICPResult(
        transformation=T,
        fitness=fitness,
        inlier_rmse=rmse,
        information_matrix=plane_information(p, n) / sigma**2,
        converged=fitness >= config.min_fitness,
        n_points=n_met,
        verdict="" if fitness >= config.min_fitness else f"{100 * fitness:.0f} % of the points met",
    )


def _smooth_normals(cloud: Any, config: ICPConfig) -> Array:
    import open3d as o3d

    smooth = cloud_of_points(np.asarray(cloud.points))
    smooth.estimate_normals(o3d.geometry.KDTreeSearchParamRadius(INFORMATION_RADIUS_VOXELS * config.voxel_size))
    return np.asarray(smooth.normals)


def plane_information(points: Array, normals: Array) -> Array:
    """What unit distances of points (n, 3) along normals (n, 3) tell (6, 6) of a left twist (rotation, translation).

    ``n . (Exp(xi) p) = n . p + (p x n) . rotation + n . translation`` to first order.
    """
    J = np.hstack([np.cross(points, normals), normals])
    return J.T @ J


def _failed(T: Pose, why: str) -> ICPResult:
    return ICPResult(
        transformation=np.array(T),
        fitness=0.0,
        inlier_rmse=0.0,
        information_matrix=np.zeros((6, 6)),
        converged=False,
        verdict=why,
    )
