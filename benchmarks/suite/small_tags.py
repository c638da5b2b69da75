"""How many small markers are found, beside plain ArUco on the same images."""

from __future__ import annotations

from aruco.detector import MarkerDetector
from benchmarks.metric import Metric
from benchmarks.plain_detectors import plain_detector
from benchmarks.tag_wall import CornerErrors, TagWall, corner_errors, tag_walls
from rigcal.sim.noise import ImageNoise

SIZES_PX = {"14_24px": (14.0, 24.0), "24_60px": (24.0, 60.0)}
DICTIONARIES = {"apriltag_36h11": "DICT_APRILTAG_36h11", "aruco_4x4": "DICT_4X4_50"}


def run(*, quick: bool) -> list[Metric]:
    metrics: list[Metric] = []
    for family, dictionary in DICTIONARIES.items():
        for size, sides_px in SIZES_PX.items():
            count = 1 if quick else 4
            walls = list(tag_walls(count, sides_px, seed=2, dictionary=dictionary, at_most=150))
            metrics += _compared(f"{family}.{size}", *_both(walls, dictionary))
    return metrics


def _both(walls: list[TagWall], dictionary: str) -> tuple[CornerErrors, CornerErrors]:
    ours, plain = MarkerDetector(dictionary), plain_detector(dictionary)
    images = [wall.photograph(ImageNoise(), k) for k, wall in enumerate(walls)]
    detections = [ours.detect(image, wall.camera) for image, wall in zip(images, walls)]
    return (
        corner_errors(walls, [(detection.ids, detection.corners_px) for detection in detections]),
        corner_errors(walls, [plain(image) for image in images]),
    )


def _compared(name: str, ours: CornerErrors, plain: CornerErrors) -> list[Metric]:
    what = name.replace(".", ", ").replace("_", " ")
    return [
        Metric(
            key=f"{name}.found",
            value=ours.share,
            unit="",
            about=f"share of markers found; {what}",
            better="higher",
            rel_tol=0.02,
        ),
        Metric(
            key=f"{name}.of_plain",
            value=len(ours.found) / len(plain.found),
            unit="",
            about=f"markers found over those of plain ArUco; {what}",
            better="higher",
            limit=1.0,
            rel_tol=0.0,
        ),
        Metric(
            key=f"{name}.median_px",
            value=ours.median_px,
            unit="px",
            about=f"median distance from the truth; {what}",
            rel_tol=0.15,
        ),
        Metric(
            key=f"{name}.rms_px",
            value=ours.rms_px,
            unit="px",
            about=f"root mean square distance; {what}",
            rel_tol=0.3,
        ),
        Metric(
            key=f"{name}.plain_rms_px",
            value=plain.rms_px,
            unit="px",
            about=f"the same of plain ArUco; {what}",
            rel_tol=None,
        ),
        Metric(
            key=f"{name}.false",
            value=ours.false,
            unit="markers",
            about=f"finds where no such marker is; {what}",
            rel_tol=0.0,
        ),
    ]
