"""How far found corners lie from true ones, ours and OpenCV's, on rendered markers of 60-200 px."""

from __future__ import annotations

from aruco.detector import MarkerDetector
from benchmarks.metric import Metric
from benchmarks.plain_detectors import REFINEMENTS, plain_detector
from benchmarks.tag_wall import CornerErrors, Response, TagWall, corner_errors, linear, tag_walls
from benchmarks.tone_curve import srgb
from rigcal.sim.noise import ImageNoise

DICTIONARY = "DICT_APRILTAG_36h11"
SIDES_PX = (60.0, 200.0)
CLEAN = ImageNoise(read_noise=0.0, shot_noise=0.0)
# Name -> sensor, its response to light, whether the lens distorts, and what the table says.
CONDITIONS: dict[str, tuple[ImageNoise, Response, bool, str]] = {
    "clean": (CLEAN, linear, False, "no noise"),
    "bent": (CLEAN, linear, True, "no noise, lens with distortion"),
    "noisy": (ImageNoise(), linear, False, "the simulator's noise, 2 grey levels"),
    "rough": (ImageNoise(blur_px=1.0, read_noise=4.0, shot_noise=0.0), linear, False, "blur 1.0 px, noise 4 levels"),
    "tone": (CLEAN, srgb, False, "no noise, images on the sRGB curve"),
}
LIMITS = {"median_px": 0.03, "rms_px": 0.10, "offset_px": 0.01, "inward_px": 0.01}


def run(*, quick: bool) -> list[Metric]:
    count = 3 if quick else 12
    flat = list(tag_walls(count, SIDES_PX, seed=1, dictionary=DICTIONARY))
    bent = list(tag_walls(count, SIDES_PX, seed=1, dictionary=DICTIONARY, bent=True))
    metrics: list[Metric] = []
    for name, (noise, response, is_bent, about) in CONDITIONS.items():
        metrics += _ours(name, about, _find_ours(bent if is_bent else flat, noise, response))
    ours = _find_ours(flat, CLEAN, linear)
    for refinement in REFINEMENTS:
        metrics += _compared(refinement, ours, _find_plain(flat, CLEAN, refinement))
    return metrics


def _find_ours(walls: list[TagWall], noise: ImageNoise, response: Response) -> CornerErrors:
    detector = MarkerDetector(DICTIONARY)
    found = [detector.detect(wall.photograph(noise, k, response), wall.camera) for k, wall in enumerate(walls)]
    return corner_errors(walls, [(detection.ids, detection.corners_px) for detection in found])


def _find_plain(walls: list[TagWall], noise: ImageNoise, refinement: str) -> CornerErrors:
    detect = plain_detector(DICTIONARY, refinement)
    return corner_errors(walls, [detect(wall.photograph(noise, k)) for k, wall in enumerate(walls)])


def _ours(name: str, about: str, errors: CornerErrors) -> list[Metric]:
    limits = LIMITS if name == "clean" else {}
    values = {
        "median_px": (errors.median_px, "median distance from the truth"),
        "rms_px": (errors.rms_px, "root mean square distance"),
        "offset_px": (errors.offset_px, "length of the mean error"),
        "inward_px": (abs(errors.inward_px), "mean error towards or away from the marker's centre"),
    }
    metrics = [
        Metric(
            key=f"{name}.{key}",
            value=value,
            unit="px",
            about=f"{what}; {about}",
            limit=limits.get(key),
            rel_tol=0.15,
            abs_tol=0.002,  # what another few hundred corners would change the means by
        )
        for key, (value, what) in values.items()
    ]
    found = Metric(
        key=f"{name}.found",
        value=errors.share,
        unit="",
        about=f"share of markers found; {about}",
        better="higher",
        limit=1.0 if name == "clean" else None,
        rel_tol=0.0,
    )
    return [*metrics, found]


def _compared(refinement: str, ours: CornerErrors, plain: CornerErrors) -> list[Metric]:
    about = f"OpenCV's CORNER_REFINE_{refinement.upper()}, no noise"
    # Shown to compare with; what OpenCV does is not ours to judge.
    shown = {
        "median_px": (plain.median_px, "px", f"median distance; {about}"),
        "rms_px": (plain.rms_px, "px", f"root mean square distance; {about}"),
        "offset_px": (plain.offset_px, "px", f"length of the mean error; {about}"),
        "inward_px": (plain.inward_px, "px", f"mean error towards the marker's centre; {about}"),
        "found": (plain.share, "", f"share of markers found; {about}"),
    }
    metrics = [
        Metric(key=f"opencv_{refinement}.{key}", value=value, unit=unit, about=what, rel_tol=None)
        for key, (value, unit, what) in shown.items()
    ]
    ratio = Metric(
        key=f"opencv_{refinement}.ratio",
        value=plain.rms_centred_px / ours.rms_px,
        unit="times",
        about=f"its root mean square distance, mean error taken off, over ours; {about}",
        better="higher",
        limit=1.0,
        rel_tol=0.3,
    )
    return [*metrics, ratio]
