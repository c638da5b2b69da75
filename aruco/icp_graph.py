"""Pairs of clouds as a graph of poses, optimised by Open3D.

Owns      apply_gravity_constraint, build_pose_graph, optimize_pose_graph, the order of a graph's nodes.
Leaves    registering a pair to icp_pair; a rig's joint adjustment, with its prior, to icp_solve.

Nodes are T_world_cam; an edge (source, target) carries T_target_source.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from loguru import logger

from aruco.errors import InputError
from aruco.icp_pair import pairwise_icp, quiet_open3d
from aruco.icp_types import ICPResult, Pair
from aruco.pose_math import (
    Array,
    Pose,
    adjoint,
    checked_pose,
    exp_so3,
    log_so3,
    make_pose,
    swing_twist,
)

__all__ = ["apply_gravity_constraint", "build_pose_graph", "graph_order", "optimize_pose_graph", "pairwise_icp"]

# An uncertain edge whose clouds stand this far apart counts a quarter; Open3D drops those that count less.
EDGE_REACH_M = 0.03
_EDGE_PRUNE_THRESHOLD = 0.25


def apply_gravity_constraint(
    T_icp: Pose, T_original: Pose, penalty_weight: float, *, up: Sequence[float] | Array = (0.0, 1.0, 0.0)
) -> Pose:
    """Take most of the tilt out of a change of pose: levelling knows gravity better than clouds do.

    Args:
        T_icp: T_world_cam as registration wants it.
        T_original: T_world_cam before, in the same world.
        penalty_weight: The angle of tilt is divided by ``1 + penalty_weight``; infinite: no tilt at all.
        up: (3,) along gravity in that world, either way.

    Returns:
        T_world_cam with T_icp's yaw change and position. The change ``R_icp @ R_original.T`` is split into swing and
        twist about gravity; angles of the poses themselves would be singular for a level camera.

    Raises:
        InputError: The poses are not rigid, the weight is below zero, or up is no direction.
    """
    axis = np.asarray(up, dtype=np.float64)
    length = float(np.linalg.norm(axis)) if axis.shape == (3,) else math.nan
    if not (math.isfinite(length) and length > 0 and penalty_weight >= 0):
        raise InputError(f"want a direction up (3,) and a penalty_weight from 0, got {axis} and {penalty_weight}.")
    T_new, T_old = _rigid(T_icp, "T_icp"), _rigid(T_original, "T_original")
    swing, twist = swing_twist(T_new[:3, :3] @ T_old[:3, :3].T, axis / length)
    damped = exp_so3(log_so3(swing) / (1.0 + penalty_weight))
    return make_pose(damped @ twist @ T_old[:3, :3], T_new[:3, 3])


def graph_order(
    serials: Sequence[str], pair_results: Mapping[Pair, ICPResult], reference_serial: str
) -> tuple[list[str], set[Pair]]:
    """The cameras of the graph's nodes, and the pairs that hold it together.

    Returns:
        The reference, then those of ``serials`` that converged pairs connect with it, in the order given; and the
        pairs of the tree that reaches each of them over the best fitness.
    """
    reached: set[str] = {reference_serial}
    tree: set[Pair] = set()
    known = set(serials)
    links = {pair: r for pair, r in pair_results.items() if r.converged and known.issuperset(pair)}
    front = [(-r.fitness, pair) for pair, r in links.items() if reference_serial in pair]
    heapq.heapify(front)
    while front:
        _, pair = heapq.heappop(front)
        fresh = set(pair) - reached
        if not fresh:
            continue
        tree.add(pair)
        reached |= fresh
        for other, r in links.items():
            if fresh & set(other) and not reached.issuperset(other):
                heapq.heappush(front, (-r.fitness, other))
    rest = [name for name in dict.fromkeys(serials) if name in reached and name != reference_serial]
    return [reference_serial, *rest], tree


def build_pose_graph(
    serials: Sequence[str],
    extrinsics: Mapping[str, Pose],
    pair_results: Mapping[Pair, ICPResult],
    reference_serial: str,
    *,
    certain: Collection[Pair] | None = None,
) -> Any:
    """The graph of the cameras that converged pairs connect with a reference.

    Args:
        serials: The cameras.
        extrinsics: Camera -> T_world_cam.
        pair_results: (source, target) -> what registration found of it. Not converged ones are left out.
        reference_serial: Node 0.
        certain: Pairs whose edges may not be switched off. Default: those of the best tree from the reference, without
            which Open3D may switch every edge off and leave cameras to chance.

    Returns:
        An ``open3d.pipelines.registration.PoseGraph`` whose nodes are in the order of ``graph_order``. Cameras out of
        reach are named in a warning.

    Raises:
        InputError: A camera has no pose, the reference is none of the cameras, or a converged pair's transform or
            information is none.
    """
    import open3d as o3d

    registration = o3d.pipelines.registration
    missing = sorted({*serials, reference_serial} - extrinsics.keys())
    if missing or reference_serial not in serials:
        raise InputError(
            f"pose graph: want the reference {reference_serial} among the cameras and a pose of each; no pose of "
            f"{', '.join(missing) or 'none'}."
        )
    order, tree = graph_order(serials, pair_results, reference_serial)
    lost = sorted(set(serials) - set(order))
    if lost:
        logger.warning("No converged pair connects {} with {}; they keep their poses.", ", ".join(lost), order[0])
    graph = registration.PoseGraph()
    for name in order:
        graph.nodes.append(registration.PoseGraphNode(_rigid(extrinsics[name], f"camera {name}")))
    node = {name: k for k, name in enumerate(order)}
    sure = tree if certain is None else set(certain)
    for (source, target), r in sorted(pair_results.items(), key=lambda item: item[0]):
        if r.converged and source in node and target in node and source != target:
            T = _rigid(r.transformation, f"pair {source}, {target}")
            information = _in_source_frame(_checked(r.information_matrix, source, target), T)
            uncertain = (source, target) not in sure
            graph.edges.append(
                registration.PoseGraphEdge(node[source], node[target], T, information, uncertain=uncertain)
            )
    return graph


def _checked(information: Any, source: str, target: str) -> Array:
    matrix = np.asarray(information, dtype=np.float64)
    if matrix.shape != (6, 6) or not np.isfinite(matrix).all():
        raise InputError(f"pair {source}, {target}: its information is no (6, 6) of finite numbers; leave it out.")
    return matrix


def _in_source_frame(information: Array, T_target_source: Pose) -> Array:
    """Information of a left twist, of the target's frame, as that of a right twist, of the source's.

    Open3D's optimizer measures ``inv(T_target_source) @ inv(T_world_target) @ T_world_source``, a twist in the
    source's frame; its information of two clouds is of the target's. For cameras that face each other that would
    confuse what the pair knows with what it does not.
    """
    A = adjoint(T_target_source)
    return A.T @ information @ A


def optimize_pose_graph(pose_graph: Any, *, reach_m: float = EDGE_REACH_M) -> Any:
    """A graph's nodes where its edges agree best, by Levenberg-Marquardt; node 0 keeps its pose.

    Args:
        pose_graph: As of ``build_pose_graph``; it is not changed.
        reach_m: How far apart an uncertain edge's clouds may end before it is dropped, roughly [m].

    Returns:
        A new graph. Uncertain edges that contradict the others are gone.
    """
    import open3d as o3d

    registration = o3d.pipelines.registration
    graph = registration.PoseGraph(pose_graph)
    if len(graph.nodes) < 2 or not len(graph.edges):
        return graph
    with quiet_open3d():
        registration.global_optimization(
            graph,
            registration.GlobalOptimizationLevenbergMarquardt(),
            registration.GlobalOptimizationConvergenceCriteria(),
            registration.GlobalOptimizationOption(
                max_correspondence_distance=reach_m, edge_prune_threshold=_EDGE_PRUNE_THRESHOLD, reference_node=0
            ),
        )
    return graph


def _rigid(T: Any, name: str) -> Pose:
    try:
        return checked_pose(T, name)
    except ValueError as error:
        raise InputError(f"{error}; repair it or leave it out.") from None
