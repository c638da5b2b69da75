"""From the numbers of a validation to a verdict that a user can act on.

Owns      which numbers are read, and the sentences for those beyond their limits.
Leaves    limits and the verdict to rigcal.quality.gates, the numbers to rigcal.validation.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from aruco.pose_math import Array, Pose, transform_points
from aruco.rig_estimate import RigEstimate
from aruco.uncertainty import camera_sigma, least_known
from rigcal.depth_scale import DepthScale
from rigcal.gravity_witness import GravityTestimony, gravity_readings, gravity_remarks
from rigcal.kept_check import NOTHING_COMPARED, KeptCheck
from rigcal.quality.gates import GATES, Measured, Quality, Reading, judge
from rigcal.solve.repetition import places
from rigcal.validation import Split, Validation

# Fewer lengths than the sides of two markers are no measurement.
MIN_LENGTHS = 8
# A camera that was bumped: this share of its views rejected on one side of a frame, and of those left on the other.
BUMPED_SHARE = 0.8
SCALE_REMARK = (
    "The scale is that of the marker map: images cannot show a map that is wrong by one factor, so measure the side of "
    "one printed marker."
)
# Factory calibrations are good to about this share of the focal length.
BELIEVED_SHARE = 0.005
CHECK_INPUT = "check that the marker map and every camera_info.yaml belong to this recording"
ROUGH_MAP = "; --refine-target corrects a map that is only roughly measured"
MORE = {
    True: "record more frames, with the target nearer to the cameras, in more places and turned more ways",
    False: "put the target nearer to the cameras, record more frames, or move it between them (--moving-target)",
}


def quality_of(
    validation: Validation,
    *,
    below_target_m: Mapping[str, float] | None = None,
    kept: KeptCheck = NOTHING_COMPARED,
    depth_scale: DepthScale | None = None,
    up_is_guess: bool = False,
    up_by_imu: bool = False,
    gravity: GravityTestimony | None = None,
    target_estimated: bool = False,
) -> Quality:
    """The verdict.

    Args:
        validation: The numbers.
        below_target_m: In an upright world, camera -> how far it stands below the target (``depth_below_target``).
        kept: What the views say about cameras that an earlier calibration placed.
        depth_scale: What depth cameras say of the marker map's scale, where there are any.
        up_is_guess: Whether up is that of a single frame of a moved target.
        up_by_imu: Whether up is that of accelerometers, not the target's.
        gravity: What accelerometers say of up, where the recording has them.
        target_estimated: Whether the marker map was corrected by the same frames.
    """
    v, joint = validation, validation.adjusted
    readings = [
        *_timing(v),
        *_sigmas(v),
        *_residuals(v),
        *_held_out(v),
        *_lengths(v),
        *_splits(v, v.odd_even, "split-half", "Odd and even frames"),
        *_splits(v, v.early_late, "early-late", "The first and the second half of the recording"),
        *_views(v),
        *_kept(v, kept),
        *_heights(below_target_m or {}, up_by_imu=up_by_imu),
        *_scale(depth_scale),
        *_up(up_is_guess and not (gravity is not None and gravity.confirms)),
        *gravity_readings(gravity),
    ]
    return judge(
        Measured(
            readings=readings,
            cameras=tuple(joint.rig.cameras),
            lost={n: why for n, why in joint.rig.lost.items() if n not in joint.fixed and n not in kept.displaced},
            checked=checked_cameras(v, target_estimated=target_estimated),
            to_get_checked=_to_get_checked(v),
            # Motion bends residuals in all ways: what they look like then is no evidence for anything else.
            pattern=None if _taken_apart(v) else v.patterns.clearest,
            remarks=(*_remarks(depth_scale), *gravity_remarks(gravity), _intrinsics_remark(v)),
        )
    )


def checked_cameras(v: Validation, *, target_estimated: bool = False) -> frozenset[str]:
    """The cameras that a check looked at which its own corners did not decide.

    Lengths of a map that the same frames corrected check nothing.
    """
    checked: set[str] = set()
    if v.held_out is not None and v.held_out.from_others:
        checked |= set(v.held_out.median_px)
    if v.lengths is not None and v.lengths_held_out and not target_estimated and v.lengths.n >= MIN_LENGTHS:
        checked |= set(v.lengths.cameras)
    return frozenset(checked)


def _intrinsics_remark(v: Validation) -> str:
    """What every figure takes for granted, in millimetres."""
    name, reach_m = max(((name, _reach_m(v, name)) for name in v.adjusted.rig.cameras), key=lambda pair: pair[1])
    return (
        "Intrinsics are believed: half a percent of focal length is "
        f"{1e3 * BELIEVED_SHARE * reach_m:.0f} mm of the distance of camera {name}."
    )


def _up(is_guess: bool) -> Iterator[Reading]:
    sentence = (
        "Up is that of a single frame, because the target does not lie level in several: put it down on the floor a "
        "few times, or name the level face with --ground-face."
    )
    if is_guess:
        yield Reading(gate="up from one frame only", value=1.0, sentence=sentence)


def depth_below_target(
    rig: RigEstimate, geometry: Mapping[int, Array], up: Sequence[float] | Array = (0.0, 1.0, 0.0)
) -> dict[str, float]:
    """How far each camera of an upright rig stands below the target's lowest corner [m]; negative above it."""
    corners = np.concatenate(list(geometry.values()))
    lowest = min(float((transform_points(T, corners) @ np.asarray(up)).min()) for T in rig.T_world_target.values())
    return {name: lowest - float(p.T_world_cam[:3, 3] @ np.asarray(up)) for name, p in rig.cameras.items()}


def _to_get_checked(v: Validation) -> str:
    if len(v.adjusted.rig.cameras) == 1:
        return "a single camera has nobody to disagree with; record with a second one that sees the target too"
    if v.moving:
        return "record more frames in which at least one other camera sees the target too (five a pair and more)"
    return (
        "a target at rest checks no pose by itself; turn it so that two cameras see the same marker, or move it "
        "between frames and pass --moving-target"
    )


def _worst(values: Mapping[str, float]) -> tuple[str, float]:
    name = max(values, key=lambda key: math.inf if math.isnan(values[key]) else values[key])
    return name, values[name]


def _taken_apart(v: Validation) -> bool:
    """Whether frames that were not taken at one moment are what is wrong."""
    gate = GATES["frames taken apart"]
    return v.timing is not None and v.timing.is_clear and gate.exceeded(v.timing.error_px, gate.good)


def _timing(v: Validation) -> Iterator[Reading]:
    if v.timing is not None:
        px = v.timing.error_px if v.timing.is_clear else 0.0
        yield Reading(gate="frames taken apart", value=px, sentence=v.timing.sentence)


def _sigmas(v: Validation) -> Iterator[Reading]:
    joint = v.adjusted
    poses: dict[str, Pose] = {name: p.T_world_cam for name, p in joint.rig.cameras.items()}
    sigma = {name: camera_sigma(joint.covariance[name], T) for name, T in poses.items()}
    name, shift = _worst({name: 1e3 * s.total_m for name, s in sigma.items()})
    known = least_known(name, sigma[name], _reach_m(v, name))
    advice = f"{known[0].upper()}{known[1:]}: {MORE[v.moving]}."
    yield Reading(gate="camera position sigma", value=shift, sentence=advice)
    name, turn = _worst({name: math.degrees(s.total_rad) for name, s in sigma.items()})
    advice = f"The rotation of camera {name} is known only to {turn:.2g} degrees: {MORE[v.moving]}."
    yield Reading(gate="camera rotation sigma", value=turn, sentence=advice)


def _reach_m(v: Validation, name: str) -> float:
    """From a camera to the middle of the places where the target was."""
    middle = np.mean([T[:3, 3] for T in v.adjusted.rig.T_world_target.values()], axis=0)
    return float(np.linalg.norm(v.adjusted.rig.cameras[name].T_world_cam[:3, 3] - middle))


def _residuals(v: Validation) -> Iterator[Reading]:
    name, px = _worst(v.reprojection_px)
    advice = f"The corners of camera {name} lie {px:.1f} px from where the poses put them: {CHECK_INPUT}."
    yield Reading(gate="reprojection", value=px, sentence=advice)
    scale = v.adjusted.corners.beyond_promise
    advice = f"Corners are off {scale:.0f} times as much as their edges promise: {CHECK_INPUT}{ROUGH_MAP}."
    yield Reading(gate="residual scale", value=scale, sentence=advice)
    if v.patterns.focal_noticed:
        name, least = _worst(v.patterns.focal_noticed)
        distance_mm = 1e3 * least * _reach_m(v, name)
        wrong = "by any amount" if least > 1 else f"by {100 * least:.1f} percent, {distance_mm:.0f} mm of its distance,"
        sentence = (
            f"A focal length of camera {name} that is wrong {wrong} would not show in these views: be sure of its "
            f"camera_info.yaml, or {MORE[v.moving]}."
        )
        yield Reading(gate="focal length error noticed", value=min(100 * least, 100.0), sentence=sentence)
    odd = v.adjusted.odd_markers
    listed = ", ".join(f"{marker} ({ratio:.0f} times)" for marker, ratio in sorted(odd.items()))
    advice = (
        f"Markers that lie farther off than all others: {listed}; they are loose, bent, or wrong in the marker "
        f"map{ROUGH_MAP}."
    )
    yield Reading(gate="odd markers", value=float(len(odd)), sentence=advice)


def _held_out(v: Validation) -> Iterator[Reading]:
    if v.held_out is None:
        return
    name, px = _worst(v.held_out.median_px)
    told = "the other cameras predict" if v.held_out.from_others else "the rest of its views predicts"
    advice = f"In frames that were not used, {told} the corners of camera {name} {px:.1f} px off: {CHECK_INPUT}."
    yield Reading(gate="held-out reprojection", value=px, sentence=advice)


def _lengths(v: Validation) -> Iterator[Reading]:
    if v.lengths is None or v.lengths.n < MIN_LENGTHS:
        return
    found = v.lengths
    scales = [s for s in (found.markers_scale_error, found.between_scale_error) if math.isfinite(s)]
    percent = 100 * max(scales, key=abs)
    way = "longer" if percent > 0 else "shorter"
    advice = (
        f"Lengths of the target come out {abs(percent):.1f} percent {way} than the marker map says when cameras "
        f"measure them: measure a printed marker, and {CHECK_INPUT}."
    )
    yield Reading(gate="length scale error", value=abs(percent), sentence=advice)
    rms_mm = 1e3 * found.rms_m
    advice = f"Lengths of the target, measured by the cameras, are off by {rms_mm:.1f} mm: {CHECK_INPUT}."
    yield Reading(gate="length error", value=rms_mm, sentence=advice)
    advice = f"Rays of several cameras to one corner miss each other by {found.miss_px:.1f} px: {CHECK_INPUT}."
    yield Reading(gate="ray miss", value=found.miss_px, sentence=advice)


def _splits(v: Validation, splits: Sequence[Split], gate: str, told: str) -> Iterator[Reading]:
    if not splits:
        return
    cause = "a camera was moved or its clock is off" if v.moving else "a camera or the target was moved"
    values = {
        "position": max((1e3 * s.shift_m, s.i, s.j) for s in splits),
        "rotation": max((math.degrees(s.turn_rad), s.i, s.j) for s in splits),
        "over covariance": max((s.normalised, s.i, s.j) for s in splits),
    }
    (shift, *_), (turn, *_), (ratio, i, j) = values.values()
    sentence = (
        f"{told}, solved apart, put cameras up to {shift:.1f} mm and {turn:.2f} degrees elsewhere, {ratio:.1f} times "
        f"the square that the sigmas of {i} and {j} promise: find out whether {cause}; otherwise {MORE[v.moving]}."
    )
    for kind, (value, *_) in values.items():
        yield Reading(gate=f"{gate} {kind}", value=value, sentence=sentence)


def _views(v: Validation) -> Iterator[Reading]:
    cameras = v.adjusted.rig.cameras
    n_used = {name: len(p.frames) for name, p in cameras.items()}
    rejected = {name: len(_rejected(v, name)) for name in cameras}
    name, share = _worst({name: rejected[name] / max(rejected[name] + n_used[name], 1) for name in cameras})
    sentence = (
        f"{rejected[name]} of {rejected[name] + n_used[name]} views of camera {name} do not fit the rest: it was "
        "moved, its clock is off, or its frames are blurred; look at them and leave the bad ones out."
    )
    yield Reading(gate="rejected views", value=100 * share, sentence=sentence)
    moved = [told for name, p in cameras.items() if (told := bumped(name, p.frames, _rejected(v, name)))]
    if _taken_apart(v):  # the target began or ceased to move
        moved = []
    yield Reading(gate="cameras moved while recorded", value=float(len(moved)), sentence=" ".join(moved))
    name, share = _worst({name: p.n_ambiguous / max(p.n_views, 1) for name, p in cameras.items()})
    sentence = (
        f"Nearly every view of camera {name} leaves two poses possible: turn the target so that it sees two faces."
    )
    yield Reading(gate="ambiguous views", value=100 * share, sentence=sentence)
    name = min(n_used, key=lambda name: n_used[name])
    alone = "only one view" if n_used[name] == 1 else f"only {n_used[name]} views"
    gate = "views of a camera" if v.moving else "views of a camera, target at rest"
    sentence = (
        f"Camera {name} has {alone}, so its errors cannot be seen: record more frames in which it sees the target."
    )
    yield Reading(gate=gate, value=float(n_used[name]), sentence=sentence)
    if v.moving:
        n_places = _n_places(v)
        sentence = (
            f"The target was in only {n_places} place{'s' * (n_places > 1)}: frames that repeat a place repeat its "
            "errors, whatever their number; move it around and turn it."
        )
        yield Reading(gate="places of the target", value=float(n_places), sentence=sentence)
    if v.weakest is not None:
        link = v.weakest
        sentence = (
            f"The rig hangs on {link.n_shared} frames that cameras {link.i} and {link.j} share: put the target where "
            "both see it and record more."
        )
        yield Reading(gate="frames of the weakest link", value=float(link.n_shared), sentence=sentence)


def _n_places(v: Validation) -> int:
    targets = v.adjusted.rig.T_world_target
    return int(places(np.array([targets[frame] for frame in sorted(targets)])).max(initial=-1)) + 1


def _kept(v: Validation, kept: KeptCheck) -> Iterator[Reading]:
    """Cameras that stand elsewhere than their file says; who of several is not said unless it is known."""
    if kept.compared:
        sizes_mm = [1e3 * c.size_m for c in kept.contradictions]
        sentence = " ".join(c.sentence for c in kept.contradictions)
        yield Reading(gate="kept cameras displaced", value=max(sizes_mm, default=0.0), sentence=sentence)
    if not v.adjusted.fixed:
        return
    lost = {name: why for name, why in v.adjusted.rig.lost.items() if name not in v.rig.lost}
    misfits = {name: why for name, why in lost.items() if name in v.adjusted.fixed}
    told = "; ".join(f"camera {name} ({why})" for name, why in misfits.items() if name not in kept.doubtful)
    sentence = (
        f"Kept cameras whose views do not fit: {told}; if one of the kept cameras was moved since, take it out of the "
        "file that keeps it and run again, which places it anew."
    )
    sentence = sentence if told else " ".join(c.sentence for c in kept.contradictions)
    yield Reading(gate="kept cameras that no longer fit", value=float(len(misfits)), sentence=sentence)


def _rejected(v: Validation, name: str) -> tuple[int, ...]:
    if v.moving:
        return v.adjusted.rejected.get(name, ())
    return v.left_out.get(name, ())


def bumped(name: str, kept: Sequence[int], rejected: Sequence[int]) -> str:
    """A sentence if a camera's rejected views lie on one side of a frame and the kept ones on the other; else ""."""
    rows = sorted([(f, False) for f in kept] + [(f, True) for f in rejected])
    bad = np.array([is_bad for _, is_bad in rows], dtype=bool)
    cuts = range(3, len(rows) - 2)
    k = max(cuts, key=lambda k: abs(bad[:k].mean() - bad[k:].mean()), default=None)
    if k is None:
        return ""
    sides = bad[:k].mean(), bad[k:].mean()
    if max(sides) >= BUMPED_SHARE and min(sides) <= 1 - BUMPED_SHARE:
        return (
            f"Camera {name} was moved during the recording, at about frame {rows[k][0]}: views before and after do not "
            "fit one pose; cut the recording there or record again."
        )
    return ""


def _heights(below_target_m: Mapping[str, float], *, up_by_imu: bool) -> Iterator[Reading]:
    if not below_target_m:
        return
    name, depth = _worst(below_target_m)
    way_out = "take up from the target with --up-from target" if up_by_imu else "pass --ground-face"
    sentence = (
        f"Camera {name} stands {depth:.1f} m below the target's lowest point: unless it really does, the world is "
        f"upside down or mirrored; check the order of corners in the marker map and {way_out}."
    )
    yield Reading(gate="camera below the target", value=depth, sentence=sentence)


def _scale(depth: DepthScale | None) -> Iterator[Reading]:
    if depth is None:
        return
    told = "Depth cameras contradict each other about the size of everything"
    if not math.isnan(depth.scale):
        off = 100 * depth.scale
        way = "larger" if off > 0 else "smaller"
        sentence = (
            f"{_witness(depth)} says everything is {abs(off):.3g} percent {way} than the marker map makes it: measure "
            "the side of one printed marker and correct the map (or check the depth_scale in every camera_info.yaml)."
        )
        yield Reading(gate="scale against depth", value=abs(off), sentence=sentence)
        told = "Depth that differs from what the poses predict, and not as other cameras' does"
    listed = ", ".join(f"camera {name} {100 * (depth.cameras[name].ratio - 1):+.3g} percent" for name in depth.odd)
    sentence = f"{told}: {listed}; check depth_scale, camera_matrix and depth_camera_matrix in its camera_info.yaml."
    yield Reading(gate="cameras whose depth contradicts the others", value=float(len(depth.odd)), sentence=sentence)


def _witness(depth: DepthScale) -> str:
    agreeing = [name for name in depth.cameras if name not in depth.odd]
    return "Depth" if len(agreeing) > 1 else f"Depth of camera {agreeing[0]}, the only one to go by,"


def _remarks(depth: DepthScale | None) -> tuple[str, ...]:
    """About the scale; none where a reading already says what is wrong with it."""
    if depth is None or math.isnan(depth.scale):
        return (SCALE_REMARK,)
    gate, percent = GATES["scale against depth"], 100 * abs(depth.scale)
    if gate.exceeded(percent, gate.good):
        return ()
    within = max(percent, 100 * depth.sigma)
    return (f"{_witness(depth)} agrees with the scale of the marker map within {within:.1f} percent.",)
