"""Registration where it cannot help, and what it costs: a bare floor, four cameras of 720p, halls of many cameras."""

from __future__ import annotations

import json
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from aruco.camera_depth import CameraDepth
from aruco.depth_save import save_depth_data
from aruco.icp_registration import ICPConfig, refine_with_icp
from aruco.icp_types import ICPMetrics
from aruco.pose_math import Array, Pose, log_so3, pose_text, swing_twist
from benchmarks.child import run_child
from benchmarks.icp_outcomes import harm, spread
from benchmarks.icp_rigs import STARTS, bare_rig, commanded, floors_seen, hall_rig, start_poses
from benchmarks.levelled_rigs import DepthRig, depth_rig, median_mm
from benchmarks.metric import Metric

CORES = 2
# Of the rig whose time is taken; how well it ends is not asked here.
SEED = 0
BARE = range(80, 82)
HALLS = (5, 10, 20)
HALL_SEEDS = range(10, 14)  # the time is that of the first
# The floor that a camera of the hall sees ends eight metres to its left and right: four cameras on each side.
MOST_NEIGHBOURS = 8
UP = np.array([0.0, 1.0, 0.0])


def run(*, quick: bool) -> list[Metric]:
    return [*_bare(BARE[:1] if quick else BARE), *_work(), *_halls(HALLS[:2] if quick else HALLS)]


def _bare(seeds: range) -> list[Metric]:
    found = [figures for of_rig in spread(slides, seeds) for figures in of_rig]
    about = f"after levelling; {len(seeds)} rigs over a floor with nothing on it, rough and good, biased and not"
    return [
        Metric(
            key="bare.shift_worst_mm",
            value=max(shift for shift, _, _ in found),
            unit="mm",
            about=f"largest change of a camera's x, z by registration {about}",
            limit=1.0,
            rel_tol=None,
        ),
        Metric(
            key="bare.yaw_worst_deg",
            value=max(yaw for _, yaw, _ in found),
            unit="deg",
            about=f"largest change of a camera's yaw by registration {about}",
            limit=0.02,
            rel_tol=None,
        ),
        Metric(
            key="bare.told",
            value=float(np.mean([told for _, _, told in found])),
            unit="",
            about=f"share of pairs of which yaw and two shifts are told to be unobservable {about}",
            better="higher",
            limit=1.0,
            rel_tol=0.0,
        ),
    ]


def slides(seed: int) -> list[tuple[float, float, float]]:
    """Change of x, z [mm] and yaw [deg] of a bare rig's cameras, and the share of pairs that say what they lack."""
    found: list[tuple[float, float, float]] = []
    for biased in (False, True):
        rig = bare_rig(seed, biased=biased)
        for start in STARTS:
            poses, covariances = start_poses(rig, start, seed)
            for known in (covariances, None):
                registered = commanded(rig, poses, known, ICPConfig())
                before, after = registered.T_start_cam, registered.T_world_cam
                moves = [_slide(before[name], after[name]) for name in before]
                found.append((max(m[0] for m in moves), max(m[1] for m in moves), _told(registered.metrics)))
    return found


def _slide(before: Pose, after: Pose) -> tuple[float, float]:
    shift = (after[:3, 3] - before[:3, 3])[[0, 2]]
    _, twist = swing_twist(after[:3, :3] @ before[:3, :3].T, UP)
    return 1e3 * float(np.linalg.norm(shift)), float(np.degrees(np.linalg.norm(log_so3(twist))))


def _told(metrics: ICPMetrics) -> float:
    """Share of pairs that lack three directions, one of them yaw; pairs that do not overlap need not say it."""
    pairs = list(metrics.per_pair_results.values())
    lacking = [len(p.unobservable) >= 3 and any("yaw" in word for word in p.unobservable) for p in pairs]
    return float(np.mean(lacking)) if lacking else 1.0


def _work() -> list[Metric]:
    """The whole command on four cameras of 720p, from files to files."""
    rig = depth_rig(SEED, biased=True, furnished=True)
    with tempfile.TemporaryDirectory() as folder:
        poses, depth = Path(folder) / "poses.json", Path(folder) / "depth.h5"
        _write(poses, depth, rig, *start_poses(rig, "good", SEED))
        files = ["-i", str(poses), "-d", str(depth), "-o", str(Path(folder) / "new.json")]
        ran = run_child(["refine_ground_plane.py", *files, "--icp"], cores=CORES)
        plain = run_child(["refine_ground_plane.py", *files], cores=CORES)
    about = "refine-ground-plane --icp on four cameras of 1280 x 720, from files to files, two cores"
    return [
        Metric(key="wall_s", value=ran.wall_s, unit="s", about=about, limit=20.0, rel_tol=0.5, machine=True),
        Metric(
            key="levelling_s",
            value=plain.wall_s,
            unit="s",
            about="the same without --icp",
            rel_tol=None,
            machine=True,
        ),
        Metric(
            key="peak_mb",
            value=ran.peak_mb,
            unit="MB",
            about=f"peak memory of {about}",
            limit=3000.0,
            rel_tol=0.25,
            machine=True,
        ),
    ]


def _write(poses: Path, depth: Path, rig: DepthRig, T_world_cam: dict[str, Pose], covariance: dict[str, Array]) -> None:
    meta = {
        "format": "rigcal.extrinsics",
        "version": 1,
        "world": {"up": [0, 1, 0], "origin": "target"},
        "covariance": {name: S.ravel().tolist() for name, S in covariance.items()},
    }
    entries = {name: {"pose": pose_text(T)} for name, T in T_world_cam.items()}
    poses.write_text(json.dumps({**entries, "_meta": meta}), encoding="utf-8")
    cameras = {
        name: CameraDepth(depth=d["depth"], K=d["K"], baseline_m=d["baseline"], n_frames=d["n_frames"])
        for name, d in rig.camera_data.items()
    }
    save_depth_data(depth, cameras)


def _halls(sizes: tuple[int, ...]) -> list[Metric]:
    metrics: list[Metric] = []
    seconds: dict[int, float] = {}
    for n in sizes:
        found, seconds[n] = _hall(n)
        metrics += found
    most, half = sizes[-1], sizes[-2]
    growth = Metric(
        key="hall.growth",
        value=seconds[most] / seconds[half],
        unit="times",
        about=f"time of {most} cameras over that of {half}; 2 if it goes with cameras, 4 if with their square",
        rel_tol=None,
        machine=True,
    )
    return [*metrics, growth]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Hall:
    """One hall before and after."""

    before_mm: float
    after_mm: float
    metrics: ICPMetrics
    seconds: float


def _registered_hall(n: int, seed: int) -> _Hall:
    rig = hall_rig(n, seed)
    poses, covariances = start_poses(rig, "good", seed)
    floors = floors_seen(rig, poses)
    begin = time.perf_counter()
    found, icp = refine_with_icp(rig.camera_data, poses, floors, ICPConfig(), covariances=covariances)
    seconds = time.perf_counter() - begin
    before_mm, after_mm = (median_mm(T, rig.T_world_cam) for T in (poses, found))
    return _Hall(before_mm=before_mm, after_mm=after_mm, metrics=icp, seconds=seconds)


def _hall(n: int) -> tuple[list[Metric], float]:
    """Figures of halls with n cameras, and how long the registration of the first took [s]."""
    halls = [_registered_hall(n, seed) for seed in HALL_SEEDS]
    seconds = halls[0].seconds
    about = f"{n} cameras of 640 x 360 along a hall, {n * (n - 1) // 2} pairs; {len(halls)} halls"
    metrics = [
        Metric(
            key=f"hall_{n}.pairs",
            value=max(hall.metrics.num_pairs_attempted for hall in halls),
            unit="pairs",
            about=f"looked at; {about}",
            # Each camera meets a few to its left and right, however long the hall is.
            limit=MOST_NEIGHBOURS / 2 * n,
            rel_tol=0.0,
        ),
        Metric(
            key=f"hall_{n}.camera_s",
            value=seconds / n,
            unit="s",
            about=f"registering, over the number of cameras; {about}",
            rel_tol=1.0,
            machine=True,
        ),
        Metric(
            key=f"hall_{n}.ratio",
            value=float(np.mean([hall.after_mm / hall.before_mm for hall in halls])),
            unit="",
            about=f"median pair error after over before, good start, mean; {about}",
            limit=1.0,
            rel_tol=0.2,
        ),
        Metric(
            key=f"hall_{n}.harm",
            value=max(harm(hall.before_mm, hall.after_mm) for hall in halls),
            unit="",
            about=f"largest growth of that error in units of what counts as harm; {about}",
            limit=1.0,
            rel_tol=None,
        ),
        Metric(
            key=f"hall_{n}.moved",
            value=float(np.mean([len(hall.metrics.moved) for hall in halls])),
            unit="cameras",
            about=f"moved by registration, mean; {about}",
            better="higher",
            rel_tol=None,
        ),
    ]
    return metrics, seconds
