"""What a calibration says about itself under ``_meta``: counts, clock, adjustment, provenance.

Owns      the wording of these entries; nothing in them depends on time, place or the number of threads.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from aruco.pose_math import Array
from rigcal import __version__
from rigcal.depth_pooling import depth_digest
from rigcal.detecting import Seen, digest_of
from rigcal.evidence import Evidence
from rigcal.frames import Moments
from rigcal.kept import KeptRig
from rigcal.solve.joint import JointRig
from rigcal.solve.target_shape import RefinedTarget


def frame_counts(seen: Mapping[str, Seen]) -> dict[str, Any]:
    """Camera -> what became of its frames."""
    return {
        name: {
            "recorded": s.counts.recorded,
            "unpaired": s.counts.unpaired,
            "read": s.counts.read,
            "unreadable": s.counts.bad,
            "with_markers": s.counts.with_markers,
        }
        for name, s in seen.items()
    }


def clock(moments: Moments) -> dict[str, Any]:
    """How well the frames of the cameras go together."""
    sync = moments.sync
    return {
        "tolerance_ms": sync.tolerance_ns / 1e6,
        "groups": len(sync.groups),
        "used": len(moments.groups),
        "median_skew_ms": sync.median_span_ns / 1e6,
        "worst_skew_ms": sync.worst_span_ns / 1e6,
    }


def adjustment(joint: JointRig) -> dict[str, Any]:
    """What the joint adjustment found out about its input."""
    return {
        "residual_scale": joint.corners.beyond_promise,
        "model_noise_px": joint.corners.noise_px,
        "edge_shift_px": dict(joint.corners.shift_px),
        "doubtful_edge_shift_px": dict(joint.corners.doubtful_shift_px),
        "rejected_views": {name: list(frames) for name, frames in joint.rejected.items()},
        "odd_markers": {str(marker): ratio for marker, ratio in joint.odd_markers.items()},
    }


def corrected_target(found: RefinedTarget, before: Mapping[int, Array]) -> dict[str, Any]:
    """How far the markers of a roughly known target had to be moved, and how well their places are known now."""
    moved = {marker: np.linalg.norm(found.geometry[marker] - before[marker], axis=1) for marker in found.sigma_m}
    return {
        "moved_mm": {str(marker): 1e3 * float(np.sqrt(np.mean(d**2))) for marker, d in moved.items()},
        "sigma_mm": {str(marker): 1e3 * sigma for marker, sigma in found.sigma_m.items()},
        "left_as_they_were": {str(marker): reason for marker, reason in found.unrefined.items()},
        "warnings": list(_warnings(found)),
    }


def _warnings(found: RefinedTarget) -> Iterator[str]:
    if len(found.parts) > 1:
        groups = " | ".join(", ".join(map(str, part)) for part in found.parts)
        yield (
            f"nothing ties these markers to each other, so between the groups the map is as it was: {groups}; record "
            "frames in which a camera sees markers of both, or turn the target more between frames"
        )
    if found.unrefined:
        listed = ", ".join(map(str, found.unrefined))
        yield f"markers that stay as the map has them, for want of views that tie them to others: {listed}"


def provenance(evidence: Evidence, kept: KeptRig) -> dict[str, Any]:
    """Version, every option that changes the result, and hashes of the inputs."""
    inputs = {camera.name: digest_of(evidence.seen[camera.name], camera) for camera in evidence.cameras}
    fixed = {"fixed_cameras": kept.digest} if kept.digest else {}
    depth = {"depth": {name: depth_digest(depth) for name, depth in evidence.pooled.items()}} if evidence.pooled else {}
    return {
        "rigcal": __version__,
        "options": evidence.config.as_dict(),
        "inputs_sha256": {"target": evidence.target.digest, "cameras": inputs, **depth, **fixed},
    }
