"""An extrinsics file whose rig is levelled: what is read of it, what stays true, what is replaced.

Owns      the rig and its world as the file tells them, the content of the levelled file.
Leaves    reading and checking poses to kept and formats.native; levelling itself to aruco.ground_plane.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from aruco.depth_bias import DepthBias, bias_from_dict
from aruco.errors import InputError
from aruco.model import UpAxis
from aruco.pose_math import Array, Pose, pose_text
from rigcal.formats import native
from rigcal.gravity_witness import heard_again
from rigcal.ground_doubts import GroundDoubts, judged
from rigcal.kept import kept_of

# No rig is that far from its target; in millimetres it is.
FAR_M = 200.0
# Figures of a camera that judge the pose which markers gave it, not the one that the floor or clouds have corrected.
_OF_MARKERS = ("rms_px", "spread_mm", "spread_deg")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RigFile:
    """The rig of an extrinsics file, in a world that stands upright."""

    name: str
    digest: str  # SHA-256 of its bytes
    content: Mapping[str, Any]
    T_world_cam: Mapping[str, Pose]
    covariance: Mapping[str, Array]  # (6, 6), where the file has it
    depth_bias: Mapping[str, DepthBias]  # where it has been estimated
    up: UpAxis
    up_is_assumed: bool  # the file does not say it

    @property
    def meta(self) -> Mapping[str, Any]:
        """What the file says about itself; empty for a file that has only poses."""
        meta = self.content.get("_meta")
        return meta if isinstance(meta, dict) else {}

    @property
    def origin(self) -> str | None:
        """What the file says its world's origin is tied to."""
        world = self.meta.get("world")
        return world.get("origin") if isinstance(world, dict) else None

    @property
    def floor_y(self) -> float:
        """Where a file whose origin is the floor has it: where it was wished when it was levelled."""
        wished = self._levelled("provenance", "options", "target_floor_y")
        return float(wished) if isinstance(wished, (int, float)) else 0.0

    @property
    def is_depth_refined(self) -> bool:
        """Whether the biases of depth were estimated with a floor, perhaps this one."""
        refined = self.meta.get("depth_refined")
        return bool(self.depth_bias) and isinstance(refined, dict) and refined.get("accepted") is True

    @property
    def levelled_with(self) -> str | None:
        """SHA-256 of the depth that the rig was levelled with before."""
        return self._levelled("provenance", "inputs_sha256", "depth")

    @property
    def registered_with(self) -> str | None:
        """SHA-256 of the depth whose clouds have moved cameras before."""
        if self._told("icp_refined", "success") is not True or not self._told("icp_refined", "moved"):
            return None
        return self._told("icp_refined", "provenance", "inputs_sha256", "depth")

    def _levelled(self, *keys: str) -> Any:
        """What an earlier levelling says of itself."""
        return self._told("ground_refined", *keys)

    def _told(self, *keys: str) -> Any:
        found: Any = self.meta
        for key in keys:
            found = found.get(key) if isinstance(found, dict) else None
        return found

    @property
    def apart(self) -> list[str]:
        """Cameras that stand in worlds of their own (``_meta.parts``)."""
        parts = self.meta.get("parts")
        given = [part for part in parts if isinstance(part, dict)] if isinstance(parts, list) else []
        return sorted({name for part in given for name in part if not name.startswith("_")})


def rig_file(path: Path) -> RigFile:
    """The rig of an extrinsics file, and where up is in its world.

    Raises:
        InputError: The file cannot be read, holds a pose, covariance or bias that is none, or its world is not upright.
    """
    content, digest = native.read_json_and_digest(path)
    kept = kept_of(content, path)
    meta = content.get("_meta")
    world = meta.get("world") if isinstance(meta, dict) else None
    says_up = isinstance(world, dict) and "up" in world
    if says_up and kept.up is None:
        raise InputError(
            f"{path}: its world does not say which way is up (_meta.world.up is null), so no plane can be told to be "
            f"the floor; {_what_to_do(kept.origin)}"
        )
    far = {name: float(np.linalg.norm(T[:3, 3])) for name, T in kept.T_world_cam.items()}
    name = max(far, key=lambda name: far[name])
    if far[name] > FAR_M:
        raise InputError(
            f"{path}: camera {name} stands {far[name]:.0f} m from the world's origin, which looks like millimetres; "
            "poses want metres: divide their last column by 1000, or move the world's origin to the rig."
        )
    return RigFile(
        name=path.name,
        digest=digest,
        content=content,
        T_world_cam=kept.T_world_cam,
        covariance=kept.covariance,
        depth_bias={
            name: bias_from_dict(entry, f"{path}: camera {name}") for name, entry in kept.meta["depth_bias"].items()
        },
        up=kept.up or "+y",
        up_is_assumed=not says_up,
    )


def _what_to_do(origin: str) -> str:
    """About a world of which nobody knows what is up; only calibrate-extrinsics ties one to a target or a floor."""
    if origin not in ("camera", "unknown"):
        return "run calibrate-extrinsics again with --auto-align."
    return (
        "if you know that +y of this world points up, write [0, 1, 0] for up under _meta.world there ([0, -1, 0] if -y "
        "does); if nobody knows, give extrinsics that calibrate-extrinsics has made with --auto-align."
    )


def levelled_content(
    given: RigFile,
    T_world_cam: Mapping[str, Pose],
    covariance: Mapping[str, Array],
    note: Mapping[str, Any],
    doubts: GroundDoubts,
    *,
    corrected: Collection[str],
    registered: Collection[str] = (),
) -> dict[str, Any]:
    """The content of the levelled file: all of the given one, but for what levelling has changed.

    Args:
        given: The file that was levelled; what it says of views and residuals is still said, but as that of its poses.
        T_world_cam: Every camera's new pose.
        covariance: Of these, (6, 6); only cameras that the file had one of are written.
        note: ``_meta.ground_refined``.
        doubts: What the floor contradicts.
        corrected: Cameras that were moved by the floor, beyond the motion common to all.
        registered: Cameras that were moved by clouds after that.
    """
    entries = {
        name: _entry(
            given.content[name],
            T,
            doubts.cameras.get(name),
            since="before_levelling" if name in corrected else "before_icp" if name in registered else None,
        )
        for name, T in sorted(T_world_cam.items())
    }
    world = given.meta.get("world")
    meta = {
        "format": native.FORMAT,
        "version": native.VERSION,
        **given.meta,
        "world": {**(world if isinstance(world, dict) else {}), "up": native.UP_VECTORS[given.up], "origin": "floor"},
    }
    if "quality" in meta:
        meta["quality"] = judged(meta["quality"], doubts)
    if isinstance(meta.get("aligned"), dict):
        meta["aligned"] = _aligned(meta["aligned"], T_world_cam)
    if "accelerometers" in meta:
        meta["accelerometers"] = heard_again(meta["accelerometers"], T_world_cam, given.up)
    if given.covariance:
        meta["covariance"] = {name: [float(x) for x in covariance[name].ravel()] for name in sorted(given.covariance)}
    return {**given.content, **entries, "_meta": {**meta, "ground_refined": dict(note)}}


def _entry(
    entry: Mapping[str, Any], T_world_cam: Pose, contradiction: str | None, *, since: str | None
) -> dict[str, Any]:
    """A camera's entry without what the new pose makes untrue, and with what the floor says against it.

    Args:
        entry: As given.
        T_world_cam: New pose.
        contradiction: What the floor says against it.
        since: Where figures of markers go: by the step that moved the camera first; None: only the whole rig moved.
    """
    # A kept camera is no longer where its old file has it; what was least known of a pose the floor may know well.
    untrue = {"kept", "least_known", *_OF_MARKERS} if since else {"kept"}
    new = {**{key: value for key, value in entry.items() if key not in untrue}, "pose": pose_text(T_world_cam)}
    of_markers = {key: entry[key] for key in _OF_MARKERS if key in entry}
    if since and of_markers:
        new[since] = of_markers
    told = entry.get("warnings")
    if contradiction is not None:
        new["warnings"] = [*(told if isinstance(told, list) else []), contradiction]
    return new


def _aligned(about: Mapping[str, Any], T_world_cam: Mapping[str, Pose]) -> dict[str, Any]:
    """How the world came upright, without the up of the markers, which is the floor's now."""
    new = {key: value for key, value in about.items() if key != "up_in_target"}
    if "camera_up" in new:
        new["camera_up"] = {name: [float(-y) for y in T[:3, 1]] for name, T in sorted(T_world_cam.items())}
    return new
