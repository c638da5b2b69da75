"""An image in, the markers in it out: ids, sub-pixel corners and how sure the corners are.

Owns      dictionaries by name, finding markers, which of them survive, and which dictionary was meant.
Leaves    the measuring of corners to corner_fit, poses to view_pose.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from aruco.corner_fit import fit_corners
from aruco.errors import InputError
from aruco.model import Camera, Detection

DEFAULT_DICTIONARY = "DICT_APRILTAG_36h11"
# Residual of an edge as a share of its contrast: clean and noisy edges stay below 0.1; an occluded edge, one that
# belongs to something else, or a smeared one does not.
MAX_MISFIT = 0.2
# ... unless the residual is what the pixels' own noise makes.
NOISE_ALLOWANCE = 1.5
# An edge that wanders farther across itself than plain ArUco's are ever wrong is another edge.
MAX_SHIFT_PX = 3.0
MAX_SHIFT_SHARE = 0.05  # of the marker's shortest side, for large blurred markers
# Cells below this are too small for an edge fit to be trusted or blamed: such a marker keeps its plain corners.
SMALL_CELL_PX = 3.5
PLAIN_SIGMA_PX = 1.0  # findings: plain ArUco corners err by 0.6 px inward


@dataclass(frozen=True, slots=True)
class _Dictionary:
    name: str
    cv: cv2.aruco.Dictionary

    @property
    def cells(self) -> int:
        return self.cv.markerSize + 2


def dictionary_names() -> list[str]:
    """The names of all predefined OpenCV dictionaries, sorted."""
    return sorted(name for name in vars(cv2.aruco) if name.startswith("DICT_") and not name.endswith("CUSTOM"))


def get_dictionary(name: str) -> cv2.aruco.Dictionary:
    """A predefined OpenCV dictionary by its name, for instance ``DICT_APRILTAG_36h11``.

    Raises:
        InputError: There is none of that name; the message lists those there are.
    """
    if name not in dictionary_names():
        raise InputError(f"--aruco-dictionary {name}: no such dictionary; known: {', '.join(dictionary_names())}.")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


class MarkerDetector:
    """Finds the markers of one dictionary in one image after another.

    Args:
        dictionary: Name of a predefined OpenCV dictionary.
        known_ids: Ids that may be there; others are false finds or strangers and are left out. None: all.

    Raises:
        InputError: Unknown dictionary.
    """

    def __init__(self, dictionary: str = DEFAULT_DICTIONARY, known_ids: Collection[int] | None = None) -> None:
        self._dictionary = _Dictionary(dictionary, get_dictionary(dictionary))
        self._known = None if known_ids is None else np.array(sorted(known_ids), dtype=np.int64)
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
        self._cv = cv2.aruco.ArucoDetector(self._dictionary.cv, parameters)

    def detect(self, image: NDArray[np.uint8], camera: Camera | None = None) -> Detection:
        """The markers of an image.

        Args:
            image: (h, w) grey or (h, w, 3) BGR.
            camera: Whose lens bends the edges; None for a pinhole.

        Returns:
            Ids ascending; an id seen twice in one image is ambiguous and left out altogether.
        """
        grey = _grey(image)
        ids, quads = self._find(grey)
        if not len(ids):
            return Detection(ids=ids, corners_px=quads, sigma_px=np.empty((0, 4)))
        fit = fit_corners(grey, quads, self._dictionary.cells, camera)
        side = np.linalg.norm(np.roll(quads, -1, axis=1) - quads, axis=2).min(axis=1)
        clean = fit.misfit <= MAX_MISFIT
        if not clean.all():  # a dim marker in a noisy image has a large misfit for no fault of its own
            clean |= np.isfinite(fit.misfit) & (fit.noise_grey <= NOISE_ALLOWANCE * _pixel_noise(grey))
        good = clean & (fit.shift_px <= np.maximum(MAX_SHIFT_PX, MAX_SHIFT_SHARE * side))
        small = side / self._dictionary.cells < SMALL_CELL_PX
        corners = np.where(good[:, None, None], fit.corners_px, quads)
        sigma = np.where(good[:, None], fit.sigma_px, PLAIN_SIGMA_PX)
        return Detection(ids=ids, corners_px=corners, sigma_px=sigma).only(good | small)

    def _find(self, grey: NDArray[np.uint8]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Ids (n,) ascending and plain corners (n, 4, 2) [px]."""
        if not grey.size:
            return np.empty(0, np.int64), np.empty((0, 4, 2))
        quads, ids, _ = self._cv.detectMarkers(grey)
        if ids is None or not len(ids):
            return np.empty(0, np.int64), np.empty((0, 4, 2))
        found = np.asarray(ids, dtype=np.int64).ravel()
        corners = np.asarray(quads, dtype=np.float64).reshape(-1, 4, 2)
        unique, counts = np.unique(found, return_counts=True)
        keep = np.isin(found, unique[counts == 1])
        if self._known is not None:
            keep &= np.isin(found, self._known)
        order = np.flatnonzero(keep)[np.argsort(found[keep], kind="stable")]
        return found[order], corners[order]


def diagnose_dictionaries(images: Sequence[NDArray[np.uint8]], known_ids: Collection[int]) -> dict[str, int]:
    """Which dictionaries find markers in some images, for the message when the chosen one finds none.

    Args:
        images: A few (h, w) or (h, w, 3) images.
        known_ids: Ids of the marker map.

    Returns:
        Dictionary name -> markers found with an id of the map, most first. Only dictionaries that find at least a
        quarter of what the best one finds are named: every dictionary decodes some noise.
    """
    # OpenCV spells some names twice (36h11, 36H11), one dictionary each.
    names = {getattr(cv2.aruco, name): name for name in dictionary_names()}.values()
    counts: dict[str, int] = {}
    for name in sorted(names, key=lambda name: (len(get_dictionary(name).bytesList), name)):
        detector = MarkerDetector(name, known_ids)
        counts[name] = sum(len(detector._find(_grey(image))[0]) for image in images)
    best = max(counts.values(), default=0)
    named = {name: n for name, n in counts.items() if n and n >= best / 4}
    # Among equals the smallest dictionary first: it was meant, or finds the same with less noise.
    return dict(sorted(named.items(), key=lambda item: -item[1]))


def _pixel_noise(grey: NDArray[np.uint8]) -> float:
    """Standard deviation of an image's pixel noise [grey levels] (Immerkaer 1996, with a median against texture)."""
    kernel = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]])
    differences = cv2.filter2D(grey, cv2.CV_32F, kernel)
    return float(np.median(np.abs(differences))) / (0.6745 * 6.0)


def _grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    if image.ndim == 2 or not image.size:
        return image
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
