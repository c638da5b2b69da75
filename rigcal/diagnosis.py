"""What went wrong, in words a user can act on: no markers, wrong dictionary, unreadable frames, doubtful cameras.

Owns      the sentences, and the looking that they need.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from aruco.detector import MarkerDetector, diagnose_dictionaries
from aruco.errors import CalibrationError, InputError
from aruco.model import Camera, Frame, Recording
from aruco.pose_math import Array
from aruco.reprojection import Reprojection
from aruco.rig_estimate import Placement, RigEstimate
from aruco.svo_sync import SyncResult
from rigcal.config import DetectConfig
from rigcal.detecting import Seen
from rigcal.evidence import Evidence
from rigcal.intrinsics_check import other_resolution
from rigcal.target import Target

# Enough to see a marker if there is one, few enough to try two dozen dictionaries on.
FRAMES_TO_TRY = 3
CAMERAS_TO_TRY = 4
# Well calibrated intrinsics and a true map stay far below.
DOUBTFUL_RMS_PX = 1.5
# Beyond this a pose is no pose: a wrong map or somebody else's intrinsics.
MISFIT_PX, MISFIT_SHARE = 5.0, 0.005  # px, or a share of the image's width
# Rooms are smaller, markers in them neither as small nor as large.
FAR_M = 30.0
ROLLED_DEG = 30.0
MIN_USED_SHARE = 0.7
MIRRORED = (
    "The markers show only in the mirrored image: they are seen in a mirror, or the recording is flipped; record the "
    "target itself, and switch off mirroring in the camera's settings."
)
INVERTED = (
    "The markers show only in the inverted image: they are printed white on black; print them black on white, or use a "
    "board (--board), whose inverted prints are read."
)


def require_views(recording: Recording, target: Target, config: DetectConfig, seen: Mapping[str, Seen]) -> None:
    """Go on only if at least one view shows the target.

    Raises:
        InputError: No image could be read.
        CalibrationError: No image shows a marker of the map; the message names what the images do show.
    """
    if any(s.views for s in seen.values()):
        return
    if not any(s.counts.read for s in seen.values()):
        reason = next((s.first_bad for s in seen.values() if s.first_bad), "no image")
        raise InputError(f"No image of any camera could be read ({reason}); check the recording.")
    images = list(_first_images(recording))
    most = max((len(d) for s in seen.values() for d in s.detections.values()), default=0)
    if most >= config.min_markers:
        raise CalibrationError(
            f"Markers of the map were seen, at most {most} at once, but no pose in front of a camera explains them; "
            "check that the marker map and the intrinsics belong to this recording."
        )
    if most:
        raise CalibrationError(
            f"No image shows {config.min_markers} markers of the map at once, at most {most}; lower --min-markers."
        )
    missing = _no_marker(target, config.dictionary, images) if target.dictionary else _no_board(target, images)
    raise CalibrationError(missing)


def _no_marker(target: Target, dictionary: str, images: list[NDArray[np.uint8]]) -> str:
    """Why no marker of the map was found: what the images show instead."""
    geometry = target.geometry
    strangers = _ids_in(images, dictionary)
    if strangers:
        return (
            f"The images show {dictionary} markers {_listed(strangers)}, but the marker map has only "
            f"{_listed(geometry)}; check --markers."
        )
    for turned, told in ((_mirrored, MIRRORED), (_inverted, INVERTED)):
        if set(_ids_in([turned(image) for image in images], dictionary)) & geometry.keys():
            return told
    found = diagnose_dictionaries(images, geometry)
    if found:
        return (
            f"No {dictionary} marker was found, but markers of the map were in {_listed_counts(found)} in the first "
            "frames; pass the right one with --aruco-dictionary."
        )
    return (
        f"No marker of any dictionary was found in the first frames (ids of the map: {_listed(geometry)}); check that "
        "the target is in view, sharp, and larger than about 15 pixels."
    )


def require_kept(recording: Recording, seen: Mapping[str, Seen], kept: Collection[str]) -> None:
    """Go on only if a camera that is to stay where it is sees the target, so that the others can be tied to it.

    Raises:
        CalibrationError: There are such cameras, but none in the recording, or none sees the target.
    """
    here = [camera.name for camera in recording.cameras if camera.name in kept]
    if not kept or any(seen[name].views for name in here):
        return
    if not here:
        names = ", ".join(camera.name for camera in recording.cameras)
        raise CalibrationError(
            f"No camera of the file to keep ({', '.join(sorted(kept))}) is in the recording ({names}): record at least "
            "one of them together with the new ones."
        )
    raise CalibrationError(
        f"Of the cameras to keep, none sees the target ({', '.join(here)}): put it where one of them and a new one "
        "both see it."
    )


def _mirrored(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.ascontiguousarray(image[:, ::-1])


def _inverted(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return 255 - image


def _no_board(target: Target, images: list[NDArray]) -> str:
    from aruco.board_detector import BoardDetector

    if isinstance(target.detector, BoardDetector) and any(target.detector.mirrored(image) for image in images):
        return (
            "The board shows only in the mirrored image: it is seen in a mirror, or the recording is flipped; record "
            "the board itself, and switch off mirroring in the camera's settings."
        )
    if isinstance(target.detector, BoardDetector) and any(target.detector.misplaced(image) for image in images):
        return (
            "Markers of the board are seen, but not where --board puts them: are columns and rows exchanged, is the "
            "print of OpenCV's older pattern (legacy_pattern in a YAML file), or is it another board?"
        )
    return (
        "No corner of the board was found in any image; check --board (columns x rows, sizes, dictionary), and that "
        "the board is in view and sharp."
    )


def _first_images(recording: Recording) -> Iterator[NDArray]:
    for camera in recording.cameras[:CAMERAS_TO_TRY]:
        count = min(FRAMES_TO_TRY, len(recording.stamps_ns(camera.name)))
        frames = recording.frames(camera.name, range(count))
        yield from (frame.image for frame in islice(frames, count) if isinstance(frame, Frame))


def _ids_in(images: list[NDArray], dictionary: str) -> list[int]:
    detector = MarkerDetector(dictionary)
    return sorted({int(i) for image in images for i in detector.detect(image).ids})


def _listed(numbers: Collection[int]) -> str:
    shown = sorted(numbers)
    text = ", ".join(map(str, shown[:12]))
    return text if len(shown) <= 12 else f"{text}, ... ({len(shown)} in all)"


def _listed_counts(found: Mapping[str, int]) -> str:
    return ", ".join(f"{name} ({count})" for name, count in found.items())


def cameras_without_views(recording: Recording, sync: SyncResult, seen: Mapping[str, Seen]) -> dict[str, str]:
    """Camera -> why there is not one view of the target from it."""
    reasons: dict[str, str] = {}
    for camera in recording.cameras:
        s = seen[camera.name]
        counts = s.counts
        if s.views:
            continue
        if not counts.recorded:
            reasons[camera.name] = "has no image named <stamp_ns>.png or .jpg in its image folder"
        elif counts.bad and not counts.read:
            reasons[camera.name] = f"none of its {counts.bad} frames can be read ({s.first_bad})"
        elif not counts.read:
            tolerance = sync.tolerance_ns / 1e6
            reasons[camera.name] = (
                f"none of its {counts.recorded} frames has a partner within {tolerance:.1f} ms: check its clock, raise "
                "--sync-tolerance-ms, or pass --still"
            )
        elif not counts.with_markers:
            reasons[camera.name] = f"never sees the target in {counts.read} frames"
        else:
            reasons[camera.name] = f"none of its {counts.with_markers} frames with markers gives a pose"
    return reasons


def refuse_misfits(rig: RigEstimate, residuals: Mapping[str, Reprojection], evidence: Evidence) -> RigEstimate:
    """The rig without cameras whose corners lie so far from where they should that the pose means nothing.

    Returns:
        The rest; lost cameras are told their intrinsics are of another resolution where the views say so.

    Raises:
        CalibrationError: None is left.
    """
    models = {camera.name: camera for camera in evidence.cameras}
    refused = {n: why for n, r in residuals.items() if (why := _why_misfit(r, models[n]))}
    lost = {name: intrinsics_fault(models[name], evidence) or why for name, why in {**rig.lost, **refused}.items()}
    if len(refused) == len(rig.cameras):
        name = next(iter(refused))
        raise CalibrationError(f"No camera fits: camera {name}: {lost[name]}.")
    kept = {name: placement for name, placement in rig.cameras.items() if name not in refused}
    return replace(rig, cameras=kept, lost=lost)


def _why_misfit(residuals: Reprojection, camera: Camera) -> str:
    if not len(residuals.errors_px):
        return "none of its views agrees with those of other cameras about where the target is"
    if residuals.rms_px <= max(MISFIT_PX, MISFIT_SHARE * camera.width):
        return ""
    return (
        f"the corners lie {residuals.rms_px:.0f} px (RMS) from where the marker map puts them, farthest those of "
        f"{_worst(residuals)}: check that map (ids, corner order, sizes) and intrinsics are this target's and camera's"
    )


def is_doubtful(residuals: Reprojection) -> bool:
    """Whether a camera's corners are off by more than good intrinsics and a true map leave."""
    return residuals.rms_px > DOUBTFUL_RMS_PX


def intrinsics_fault(camera: Camera, evidence: Evidence) -> str:
    """What a camera's own views say about its intrinsics; empty where they see no fault."""
    return other_resolution(camera, evidence.seen[camera.name].detections, evidence.target.geometry)


def _worst(residuals: Reprojection) -> str:
    return ", ".join(str(marker) for marker in residuals.worst_markers(3))


def warnings(
    placement: Placement, residuals: Reprojection, seen: Seen, up: Array | None, intrinsics: str = ""
) -> Iterator[str]:
    """What a user should know about one camera of the result.

    Args:
        placement: Where it stands.
        residuals: Of its corners.
        seen: What it saw.
        up: (3,) in its world; None where that is unknown.
        intrinsics: What is wrong with them, as far as views show it.
    """
    reach = float(np.median([np.linalg.norm(view.best.T_cam_target[:3, 3]) for view in seen.views]))
    if reach > FAR_M:
        yield f"stands {reach:.0f} m from the target: are the sizes in the marker map metres?"
    if up is not None:
        x, y = (float(axis @ up) for axis in placement.T_world_cam[:3, :2].T)
        roll_deg = math.degrees(math.atan2(abs(x), -y))
        if roll_deg > ROLLED_DEG and math.hypot(x, y) > 0.2:
            yield f"is rolled by {roll_deg:.0f} degrees: mounted sideways or upside down, or the world is not upright"
    left_out = placement.n_views - len(placement.frames)
    if seen.counts.bad:
        frames = "1 unreadable frame" if seen.counts.bad == 1 else f"{seen.counts.bad} unreadable frames"
        yield f"{frames} left out ({seen.first_bad})"
    if left_out > (1 - MIN_USED_SHARE) * placement.n_views:
        yield f"{left_out} of {placement.n_views} views do not fit the others"
    if len(placement.frames) == 1:
        yield "a single view: its spread is unknown"
    if is_doubtful(residuals):
        why = intrinsics or "check the intrinsics and the marker map"
        yield f"reprojection {residuals.rms_px:.1f} px: {why}"
