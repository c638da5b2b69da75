"""The plain recipe of registering a rig's clouds, to be beaten: pairs one by one, then a graph of uncertain edges.

Owns      plain_icp.
Leaves    its steps to aruco.icp_pair and aruco.icp_graph, and everything that would make it better to
          aruco.icp_registration.

Every point with depth in the band above the floor takes part, no depth is masked or weighed, nothing is known of the
given poses, and whatever comes out is believed, but for pairs that moved beyond the bounds: over a bare stretch of
floor those slide by metres. The recipe with a gate believes pairs only of whose points a share meets. At voxels of 2 cm
and depth as noisy as this, about 30 percent meet of clouds brought together well and of clouds that slid, so that such
a gate leaves most rigs as they are, and some on the strength of one pair.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
from loguru import logger

from aruco.floor_plane import FloorPlane, unproject_depth_to_points
from aruco.icp_band import compute_overlap_xz, extract_near_floor_band
from aruco.icp_graph import build_pose_graph, graph_order, optimize_pose_graph
from aruco.icp_pair import cloud_of_points, pairwise_icp
from aruco.icp_types import ICPConfig, ICPResult
from aruco.pose_math import Array, Pose, invert_transform, pose_distance, transform_points

# Noise lies below the plane too.
BELOW_M = 0.05
STRIDE = 4


def plain_icp(
    camera_data: Mapping[str, Mapping[str, Any]],
    T_world_cam: Mapping[str, Pose],
    floors: Mapping[str, FloorPlane],
    config: ICPConfig,
) -> tuple[dict[str, Pose], dict[str, Pose]]:
    """Poses as the plain recipe leaves them, without a gate and with one: ``min_fitness`` of the points must meet.

    The first camera in order, and those out of its reach, keep theirs.

    Args:
        camera_data: Camera -> ``depth`` (h, w) [m] and ``K`` (3, 3).
        T_world_cam: Where to start.
        floors: Camera -> its floor in the world.
        config: Sizes and method.
    """
    names = sorted(camera_data.keys() & T_world_cam.keys() & floors.keys())
    points = {name: _band(camera_data[name], T_world_cam[name], floors[name], config) for name in names}
    results: dict[tuple[str, str], ICPResult] = {}
    for a, b in combinations(names, 2):
        from_a, from_b = (transform_points(T_world_cam[name], points[name]) for name in (a, b))
        if compute_overlap_xz(from_a, from_b, config.overlap_margin) >= config.min_overlap_area:
            T_b_a = invert_transform(T_world_cam[b]) @ T_world_cam[a]
            result = _pair(points[a], points[b], T_b_a, config)
            turn_rad, shift_m = pose_distance(result.transformation, T_b_a)
            if turn_rad <= math.radians(config.max_rotation_deg) and shift_m <= config.max_translation_m:
                results[a, b] = result
    every = {pair: replace(result, converged=result.fitness > 0) for pair, result in results.items()}
    return _together(names, T_world_cam, every), _together(names, T_world_cam, results)


def _together(
    names: list[str], T_world_cam: Mapping[str, Pose], results: Mapping[tuple[str, str], ICPResult]
) -> dict[str, Pose]:
    """Poses by a graph of uncertain edges, one for each pair that has converged."""
    logger.disable("aruco")
    try:
        graph = build_pose_graph(names, T_world_cam, results, names[0], certain=())
    finally:
        logger.enable("aruco")
    order, _ = graph_order(names, results, names[0])
    nodes = [np.array(node.pose) for node in optimize_pose_graph(graph).nodes]
    back = T_world_cam[names[0]] @ invert_transform(nodes[0])
    return {**T_world_cam, **{name: back @ T for name, T in zip(order, nodes)}}


def _band(data: Mapping[str, Any], T_world_cam: Pose, floor: FloorPlane, config: ICPConfig) -> Array:
    """(n, 3) points of the band, camera frame."""
    points = unproject_depth_to_points(data["depth"], data["K"], STRIDE)
    low = -floor.d - BELOW_M
    band = extract_near_floor_band(
        transform_points(T_world_cam, points), low, config.band_height + BELOW_M, floor.normal
    )
    return transform_points(invert_transform(T_world_cam), band)


def _pair(source: Array, target: Array, T_target_source: Pose, config: ICPConfig) -> ICPResult:
    """One pair, with Open3D's own information: of points that meet, as if they held each other in all directions."""
    import open3d as o3d

    a, b = cloud_of_points(source), cloud_of_points(target)
    result = pairwise_icp(a, b, config, T_target_source)
    a, b = (cloud.voxel_down_sample(config.voxel_size) for cloud in (a, b))
    reach_m = config.voxel_size * config.max_correspondence_distance_factor
    information = o3d.pipelines.registration.get_information_matrix_from_point_clouds(
        a, b, reach_m, result.transformation
    )
    return replace(result, information_matrix=np.array(information))
