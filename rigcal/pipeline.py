"""The story: what happens, in which order, from recordings to poses.

Owns      the order of the steps.
Leaves    every step to the tools in aruco and the rooms of rigcal.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from loguru import logger

from aruco import alignment
from aruco.errors import CalibrationError, InputError
from aruco.model import SILENT, Calibration, Progress, Recording
from aruco.rig_estimate import RigEstimate
from rigcal import diagnosis, notes
from rigcal.config import CalibrateConfig, Resources
from rigcal.depth_pooling import pool_recording, require_depth
from rigcal.evidence import Evidence, at_rest, look
from rigcal.finishing import finish
from rigcal.gravity_witness import require_accelerometers
from rigcal.kept import NOTHING_KEPT, KeptRig, kept_from_file
from rigcal.kept_check import NOTHING_COMPARED, KeptCheck, compare_kept
from rigcal.listeners import NOBODY, Listeners
from rigcal.placing import place_with_target
from rigcal.preview_writer import PreviewWriter
from rigcal.recordings import plain_options
from rigcal.solve.graph import GraphHealth, graph_health
from rigcal.solve.target_shape import RefinedTarget
from rigcal.sources import open_recordings
from rigcal.sources.options import SourceOptions
from rigcal.target import Target, board_target, marker_target_from_file


def calibrate(
    recording: Recording,
    target: Target,
    config: CalibrateConfig,
    *,
    kept: KeptRig = NOTHING_KEPT,
    resources: Resources | None = None,
    progress: Progress = SILENT,
    listeners: Listeners = NOBODY,
) -> Calibration:
    """Every camera's pose in the target's world.

    Args:
        recording: Synchronised or to be synchronised images of one or more cameras.
        target: What stands in them.
        config: What changes the result.
        kept: Cameras that stay where an earlier calibration put them; their world is that of the result.
        resources: What changes only time and memory.
        progress: Is told how far the long steps have come.
        listeners: Are told what was found beside the poses.

    Raises:
        InputError: The recording or an option cannot be used.
        CalibrationError: No camera could be placed, or up is ambiguous.
    """
    jobs = (resources or Resources()).jobs
    if config.depth.needed:
        require_depth(recording)
    if config.align.enabled and config.align.up_from == "imu":
        require_accelerometers(recording)
    evidence = look(recording, target, config, jobs=jobs, progress=progress, on_frame=listeners.frame)
    listeners.looked()
    diagnosis.require_views(recording, target, config.detect, evidence.seen)
    if config.depth.needed:
        pooled = pool_recording(recording, config.depth.baseline_m, jobs=jobs, progress=progress)
        listeners.depth(pooled)
        evidence = replace(evidence, pooled=pooled)
    return calibrate_seen(at_rest(evidence) if config.still else evidence, kept=kept, listeners=listeners)


def calibrate_seen(evidence: Evidence, *, kept: KeptRig = NOTHING_KEPT, listeners: Listeners = NOBODY) -> Calibration:
    """The same, from what the cameras saw; see calibrate for arguments and errors."""
    if kept.T_world_cam and evidence.config.align.enabled:
        raise InputError("Cameras that are kept keep their world, upright or not; do not ask to turn it upright.")
    health = _connections(evidence, kept)
    check = _still_there(evidence, kept)
    held = kept.only(kept.T_world_cam.keys() - check.displaced.keys())
    rough = evidence.target
    evidence, (first, *others), found = place_with_target(evidence, held)
    refined: dict[str, Any] = {}
    if found is not None:
        refined = {"target_refined": _noted(found, rough)}
        listeners.target(evidence.target.faces)
    unseen = diagnosis.cameras_without_views(evidence.recording, evidence.moments.sync, evidence.seen)
    first = replace(first, lost={**unseen, **first.lost})
    calibration = _first_part(first, evidence, held, check, listeners)
    about = {
        "frames": notes.frame_counts(evidence.seen),
        "sync": notes.clock(evidence.moments),
        **refined,
        **({} if health is None else {"connections": health.as_dict()}),
        **({"kept": check.as_dict()} if check.compared else {}),
        "provenance": notes.provenance(evidence, kept),
    }
    calibration = replace(
        calibration,
        frames={name: s.counts for name, s in evidence.seen.items()},
        notes={**calibration.notes, **about},
        parts=tuple(part for rig in others if (part := _other_part(rig, evidence, listeners)) is not None),
    )
    return _put_back(calibration, kept, check)


def calibrate_files(
    paths: Sequence[Path],
    markers: Path | None,
    config: CalibrateConfig,
    *,
    options: SourceOptions | None = None,
    board: str | None = None,
    fix: Path | None = None,
    jobs: int | None = None,
    progress: Progress = SILENT,
    preview: Path | None = None,
    listeners: Listeners = NOBODY,
) -> Calibration:
    """The same, from files: recordings and how to read them, a marker map or a board, a folder for wished previews."""
    if board is None:
        assert markers is not None, "the command asks for one of them"
        target = marker_target_from_file(markers, config.detect.dictionary)
    else:
        target = board_target(board)
    if config.align.enabled:
        alignment.specified_face(target.faces, config.align.ground_face, config.align.ground_marker_id)
    kept = NOTHING_KEPT if fix is None else kept_from_file(fix)
    recording = open_recordings(paths, options or plain_options())
    resources = Resources() if jobs is None else Resources(jobs=jobs)
    with _previewing(preview, target, listeners) as listening:
        return calibrate(
            recording,
            target,
            config,
            kept=kept,
            resources=resources,
            progress=progress,
            listeners=listening,
        )


@contextmanager
def _previewing(folder: Path | None, target: Target, listeners: Listeners) -> Iterator[Listeners]:
    """The listeners, and where previews are wished for who writes them."""
    if folder is None:
        yield listeners
        return
    with PreviewWriter(folder, target.geometry) as writer:
        yield replace(listeners, frame=writer, looked=writer.finish)


def _connections(evidence: Evidence, kept: KeptRig) -> GraphHealth | None:
    """Who sees the moved target together with whom, said before anything is solved."""
    if not evidence.config.target_moves or len(evidence.seen) < 2:
        return None
    health = graph_health({name: s.detections.keys() for name, s in evidence.seen.items()}, tied=kept.T_world_cam)
    logger.info(health.summary)
    if health.suggestion:
        logger.warning(health.suggestion)
    return health


def _still_there(evidence: Evidence, kept: KeptRig) -> KeptCheck:
    """What the views say about cameras that are to stay, as soon as it is known."""
    if not evidence.config.joint:
        return NOTHING_COMPARED
    check = compare_kept(evidence, kept)
    for contradiction in check.contradictions:
        logger.warning(contradiction.sentence)
    return check


def _noted(found: RefinedTarget, target: Target) -> dict[str, Any]:
    """What to note about a corrected map, its warnings said."""
    note = notes.corrected_target(found, target.geometry)
    for sentence in note["warnings"]:
        logger.warning(sentence)
    return note


def _first_part(
    rig: RigEstimate, evidence: Evidence, held: KeptRig, check: KeptCheck, listeners: Listeners
) -> Calibration:
    """The part in the world of the kept cameras, if there are any."""
    try:
        return finish(rig, evidence, held, check, listeners)
    except CalibrationError as error:
        if not check.contradictions:
            raise
        raise CalibrationError(" ".join([*(c.sentence for c in check.contradictions), str(error)])) from error


def _other_part(rig: RigEstimate, evidence: Evidence, listeners: Listeners) -> Calibration | None:
    """A part that nothing connects with the first, in a world of its own; its failure costs the first nothing."""
    try:
        return finish(rig, evidence, NOTHING_KEPT, listeners=listeners)
    except CalibrationError as error:
        logger.warning("cameras {} could not be placed on their own: {}", ", ".join(rig.cameras), error)
        return None


def _put_back(calibration: Calibration, kept: KeptRig, check: KeptCheck) -> Calibration:
    """The result with every camera of the earlier file where that has it, whether it took part or not."""
    idle = {name: why for name, why in calibration.lost.items() if name in kept.entries}
    return replace(
        calibration,
        cameras=tuple(c for c in calibration.cameras if c.kept or c.camera not in kept.entries),
        lost={name: why for name, why in calibration.lost.items() if name not in kept.entries},
        kept=kept.entries,
        kept_meta=kept.meta,
        idle={**idle, **calibration.idle, **check.displaced},
    )
