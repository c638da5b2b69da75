"""Camera poses from a target that is moved between frames.

Owns      the best connected tree of camera links, the world it carries, the target's pose in every frame.
Leaves    the relative pose of two cameras to camera_link, a target that rests to resting_target.

The world is the target at its first well-seen frame.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from aruco.camera_link import CameraLink, agreement, link_cameras, weight_of
from aruco.pose_averaging import average_poses
from aruco.pose_math import Pose, adjoint, invert_transform, pose_distance
from aruco.rig_estimate import Placement, RigEstimate
from aruco.view_pose import Candidate, View

# A link that rests on one or two frames cannot check itself: others go first, however sharp its corners are.
ENOUGH_FRAMES = 3

# camera -> the solution that the rig agrees on, for every frame
Chosen = Mapping[int, Mapping[str, Candidate]]


def place_parts(
    views: Sequence[View], scale2: Mapping[str, float], known: Mapping[str, Pose] | None = None
) -> list[RigEstimate]:
    """Every connected part of the rig, each in a world of its own.

    Args:
        views: Of all cameras; views of one moment share their frame index.
        scale2: Camera -> factor on the corners' variances, from the residuals of all its views.
        known: T_world_cam of cameras that stay where they are: the first part is theirs, and its world.

    Returns:
        The part of the known cameras, or the largest, which also says why other cameras are not in it; then the other
        parts of two and more cameras, the largest first. The world of a part without known cameras is the target at
        its first well-seen frame.
    """
    by_camera = {name: {v.frame: v for v in views if v.camera == name} for name in sorted({v.camera for v in views})}
    pairs = combinations(by_camera, 2)
    links = [link for i, j in pairs if (link := link_cameras(by_camera[i], by_camera[j], scale2)) is not None]
    roots = {name: T for name, T in (known or {}).items() if name in by_camera}
    parts = _best_trees(by_camera, links, roots)
    rigs = [_rig(names, tree, roots, by_camera, scale2) for names, tree in parts]
    first = rigs[0] if rigs[0].cameras and (len(rigs[0].cameras) > 1 or len(by_camera) == 1) else _NOTHING
    lost = {name: _why_lost(name, by_camera, links) for name in by_camera if name not in first.cameras}
    others = [rig for rig in rigs[1:] if len(rig.cameras) > 1]
    return [replace(first, lost=lost), *others]


_NOTHING = RigEstimate(cameras={}, lost={}, T_world_target={})


def place_cameras(views: Sequence[View], scale2: Mapping[str, float]) -> RigEstimate:
    """The largest connected part of the rig, and why other cameras are not in it; see place_parts."""
    return place_parts(views, scale2)[0]


def _best_trees(
    cameras: Iterable[str], links: Sequence[CameraLink], known: Collection[str]
) -> list[tuple[list[str], list[CameraLink]]]:
    """Every connected part, that of the known cameras or the largest first: names, and its strongest tree (Kruskal)."""
    together = set(known)
    part = {name: together if name in together else {name} for name in cameras}
    tree: list[CameraLink] = []

    def order(link: CameraLink) -> tuple[int, float, str, str]:
        return -min(len(link.frames), ENOUGH_FRAMES), -link.strength, link.i, link.j

    for link in sorted(links, key=order):
        if part[link.i] is not part[link.j]:
            merged = part[link.i] | part[link.j]
            part.update(dict.fromkeys(merged, merged))
            tree.append(link)
    parts = sorted({tuple(sorted(names)) for names in part.values()}, key=lambda p: (-len(p), p))
    parts.sort(key=lambda names: together.isdisjoint(names))
    return [(list(names), [link for link in tree if link.i in names]) for names in parts]


def _chain(names: Sequence[str], tree: Sequence[CameraLink], known: Mapping[str, Pose]) -> dict[str, Pose]:
    """T_root_cam of every camera of a tree; the root is an end of its strongest link, or the known cameras' world."""
    known = {name: known[name] for name in names if name in known}
    T_root_cam: dict[str, Pose] = dict(known) or {(tree[0].i if tree else names[0]): np.eye(4)}
    waiting = list(tree)
    while waiting:
        link = next(k for k in waiting if k.i in T_root_cam or k.j in T_root_cam)
        waiting.remove(link)
        if link.i in T_root_cam:
            T_root_cam.setdefault(link.j, T_root_cam[link.i] @ link.average.T)
        else:
            T_root_cam[link.i] = T_root_cam[link.j] @ invert_transform(link.average.T)
    return dict(sorted(T_root_cam.items()))


def _rig(
    names: Sequence[str],
    tree: Sequence[CameraLink],
    known: Mapping[str, Pose],
    by_camera: Mapping[str, Mapping[int, View]],
    scale2: Mapping[str, float],
) -> RigEstimate:
    """One part in its world; without a camera where its views leave the target's pose open in every frame."""
    T_root_cam = _chain(names, tree, known)
    chosen = _choose([view for name in names for view in by_camera[name].values()], T_root_cam, scale2)
    if not chosen:
        return _NOTHING
    T_root_target = {frame: _target(chosen[frame], T_root_cam, scale2) for frame in chosen}
    world_frame = _first_well_seen(chosen)
    T_world_root = np.eye(4) if known.keys() & set(names) else invert_transform(T_root_target[world_frame])
    T_world_cam = {name: T_world_root @ T for name, T in T_root_cam.items()}
    return RigEstimate(
        cameras={name: _placement(name, T_world_cam, chosen, by_camera[name], scale2) for name in T_world_cam},
        lost={},
        T_world_target={frame: T_world_root @ T for frame, T in T_root_target.items()},
        world_frame=world_frame,
    )


def _choose(
    views: Sequence[View], T_root_cam: Mapping[str, Pose], scale2: Mapping[str, float]
) -> dict[int, dict[str, Candidate]]:
    """For every frame the solutions, at most one a camera, that put the target in one place."""
    by_frame: dict[int, list[View]] = {}
    for view in views:
        if view.camera in T_root_cam:
            by_frame.setdefault(view.frame, []).append(view)
    chosen = {frame: _agreed(by_frame[frame], T_root_cam, scale2) for frame in sorted(by_frame)}
    return {frame: solutions for frame, solutions in chosen.items() if solutions}


def _agreed(views: Sequence[View], T_root_cam: Mapping[str, Pose], scale2: Mapping[str, float]) -> dict[str, Candidate]:
    """The largest set of one frame's solutions that agree; a lone view counts only when it has no rival."""
    if len(views) == 1:
        return {} if views[0].is_ambiguous(scale2[views[0].camera]) else {views[0].camera: views[0].best}
    options = [(view, candidate) for view in views for candidate in view.candidates]
    T = np.array([T_root_cam[view.camera] @ candidate.T_cam_target for view, candidate in options])
    reach = np.array([np.linalg.norm(candidate.T_cam_target[:3, 3]) for _, candidate in options])
    agree = agreement(T, T, reach)
    weight = np.array([weight_of(view, candidate, scale2) for view, candidate in options])
    best: int = int(np.argmax([sum(_heaviest(options, row, weight).values()) for row in agree]))
    solutions: dict[str, Candidate] = {}
    for k in sorted(map(int, np.flatnonzero(agree[best])), key=lambda k: -weight[k]):
        solutions.setdefault(options[k][0].camera, options[k][1])
    if len(solutions) > 1:
        return solutions
    view, _ = options[best]
    return {} if view.is_ambiguous(scale2[view.camera]) else solutions


def _heaviest(options: Sequence[tuple[View, Candidate]], row: np.ndarray, weight: np.ndarray) -> dict[str, float]:
    support: dict[str, float] = {}
    for k in map(int, np.flatnonzero(row)):
        camera = options[k][0].camera
        support[camera] = max(support.get(camera, 0.0), float(weight[k]))
    return support


def _target(
    solutions: Mapping[str, Candidate], T_root_cam: Mapping[str, Pose], scale2: Mapping[str, float], without: str = ""
) -> Pose:
    """The mean pose of the target in one frame, if wished without one camera's word."""
    used = [name for name in solutions if name != without]
    # Information is stated in camera axes; carried to the root's axes it weighs each camera where it knows much.
    poses = [T_root_cam[name] @ solutions[name].T_cam_target for name in used]
    return average_poses(poses, [_carried(solutions[name], T_root_cam[name]) / scale2[name] for name in used]).T


def _carried(candidate: Candidate, T_root_cam: Pose) -> np.ndarray:
    """(6, 6) information of ``T_root_cam @ T_cam_target`` for a left twist in the root's axes."""
    A = adjoint(invert_transform(T_root_cam))
    return A.T @ candidate.information @ A


def _first_well_seen(chosen: Chosen) -> int:
    return next((frame for frame, solutions in chosen.items() if len(solutions) > 1), next(iter(chosen)))


def _placement(
    name: str, T_world_cam: Mapping[str, Pose], chosen: Chosen, views: Mapping[int, View], scale2: Mapping[str, float]
) -> Placement:
    """One camera's placement; its spread compares each view with what the other cameras say of the same frame."""
    mine = {frame: solutions[name] for frame, solutions in chosen.items() if name in solutions}
    errors = [
        pose_distance(
            _target(chosen[frame], T_world_cam, scale2, without=name) @ invert_transform(candidate.T_cam_target),
            T_world_cam[name],
        )
        for frame, candidate in mine.items()
        if len(chosen[frame]) > 1
    ]
    spread = np.sqrt(np.mean(np.square(errors), axis=0)) if errors else np.zeros(2)
    return Placement(
        T_world_cam=T_world_cam[name],
        spread_rad=float(spread[0]),
        spread_m=float(spread[1]),
        frames=tuple(mine),
        n_views=len(views),
        n_ambiguous=sum(view.is_ambiguous(scale2[name]) for view in views.values()),
    )


def _why_lost(name: str, by_camera: Mapping[str, Mapping[int, View]], links: Sequence[CameraLink]) -> str:
    if len(by_camera) == 1:
        return "every view leaves two poses possible: turn the target so that the camera sees two faces"
    shared = {other: len(by_camera[name].keys() & by_camera[other].keys()) for other in by_camera if other != name}
    if not any(shared.values()):
        return "no frame in which another camera sees the target too: put the target where two cameras see it"
    linked = sorted({link.j if link.i == name else link.i for link in links if name in (link.i, link.j)})
    if linked:
        return f"connected only with {', '.join(linked)}, not with the rest: put the target where both groups see it"
    most = max(shared, key=lambda other: shared[other])
    return (
        f"{shared[most]} frames shared with {most} do not agree on one pose: check that both cameras' clocks agree "
        "(--still if they are not triggered together), and record more frames, "
        "a board tilted, a box with two faces in view"
    )
