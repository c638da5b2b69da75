"""Markers are found as completely as by plain ArUco and placed ten times as well, and strangers are left out."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from marker_pictures import DICTIONARY, Picture, take_picture
from numpy.typing import NDArray

from aruco.detector import MarkerDetector, diagnose_dictionaries, dictionary_names, get_dictionary
from aruco.errors import InputError
from aruco.model import Detection
from aruco.pose_math import Array

SMALL, LARGE, TINY = (60.0, 110.0), (110.0, 200.0), (20.0, 60.0)
LARGE_PICTURE = (1600, 1200)
MEDIAN_PX, RMS_PX, OFFSET_PX = 0.03, 0.10, 0.01  # see test_corner_fit


def errors_px(detection: Detection, picture: Picture) -> Array:
    return detection.corners_px - picture.corners_px[detection.ids]


def plain(image: NDArray[np.uint8], refinement: int = cv2.aruco.CORNER_REFINE_NONE) -> tuple[NDArray[np.int64], Array]:
    """Ids and corners of OpenCV's own detector."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = refinement
    quads, ids, _ = cv2.aruco.ArucoDetector(get_dictionary(DICTIONARY), parameters).detectMarkers(image)
    return np.asarray(ids, dtype=np.int64).ravel(), np.asarray(quads, dtype=np.float64).reshape(-1, 4, 2)


def upright_marker(name: str, marker: int, side_px: int = 96, at: int = 40) -> tuple[NDArray[np.uint8], Array]:
    """A marker drawn pixel by pixel, and its corners: a pixel reaches half a pixel to each side of its centre."""
    cells = get_dictionary(name).markerSize + 2
    side = side_px // cells * cells
    image = np.full((side + 2 * at, side + 2 * at), 230, np.uint8)
    drawn = cv2.aruco.generateImageMarker(get_dictionary(name), marker, side)
    image[at : at + side, at : at + side] = np.where(drawn > 0, 230, 20)
    a, b = at - 0.5, at + side - 0.5
    blurred = np.asarray(cv2.GaussianBlur(image, (0, 0), 0.7), dtype=np.uint8)
    return blurred, np.array([[a, a], [b, a], [b, b], [a, b]])


def in_colour(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.repeat(image[..., None], 3, axis=2)


# --- accuracy -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("side_px", "size_px"), [(SMALL, (1280, 720)), (LARGE, LARGE_PICTURE)])
@pytest.mark.parametrize(("blur_px", "noise"), [(0.5, 0.0), (0.7, 2.0), (1.0, 5.0)])
def test_corners_are_right_to_hundredths_of_a_pixel(
    side_px: tuple[float, float], size_px: tuple[int, int], blur_px: float, noise: float
) -> None:
    picture = take_picture(side_px, size_px=size_px)
    detection = MarkerDetector().detect(picture.taken(blur_px, noise))
    errors = errors_px(detection, picture)
    assert np.median(np.linalg.norm(errors, axis=2)) <= MEDIAN_PX
    assert np.sqrt(np.mean(np.sum(errors**2, axis=2))) <= RMS_PX
    assert np.abs(errors.mean(axis=(0, 1))).max() < OFFSET_PX


@pytest.mark.parametrize("refinement", ["CORNER_REFINE_NONE", "CORNER_REFINE_SUBPIX", "CORNER_REFINE_CONTOUR"])
def test_opencvs_refinements_miss_the_accuracy(refinement: str) -> None:
    picture = take_picture(SMALL)
    ids, corners = plain(picture.taken(0.7, 2.0), getattr(cv2.aruco, refinement))
    assert np.median(np.linalg.norm(corners - picture.corners_px[ids], axis=2)) > 3 * MEDIAN_PX


def test_opencvs_apriltag_refinement_has_an_offset_that_this_has_not() -> None:
    picture = take_picture(SMALL)
    image = picture.taken(0.7, 2.0)
    ids, corners = plain(image, cv2.aruco.CORNER_REFINE_APRILTAG)
    theirs = (corners - picture.corners_px[ids]).mean(axis=(0, 1))
    ours = errors_px(MarkerDetector().detect(image), picture).mean(axis=(0, 1))
    assert theirs.min() > 0.3  # it counts pixels from their upper left corners
    assert np.abs(ours).max() < OFFSET_PX


def test_a_known_lens_is_used() -> None:
    picture = take_picture((60.0, 150.0), lens_model="plumb_bob")
    image = picture.taken(0.7, 2.0)
    known, unknown = MarkerDetector().detect(image, picture.camera), MarkerDetector().detect(image)
    assert np.median(np.linalg.norm(errors_px(known, picture), axis=2)) <= MEDIAN_PX
    assert np.median(np.linalg.norm(errors_px(unknown, picture), axis=2)) > 3 * MEDIAN_PX


def test_sigma_is_what_errors_are() -> None:
    picture = take_picture(SMALL)
    errors, sigmas = [], []
    for seed in range(5):
        detection = MarkerDetector().detect(picture.taken(0.8, 4.0, seed))
        errors.append(errors_px(detection, picture) / detection.sigma_px[..., None])
        sigmas.append(detection.sigma_px)
    # 500 coordinates tell the ratio to 3 %; the model of the noise is honest within a factor of two.
    assert 0.5 < np.sqrt(np.mean(np.concatenate(errors) ** 2)) < 2.0
    assert np.concatenate(sigmas).min() >= 0.01
    assert np.concatenate(sigmas).max() < 0.1


# --- which markers --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("blur_px", [0.5, 1.0])
@pytest.mark.parametrize("side_px", [TINY, SMALL])
def test_no_marker_of_plain_aruco_is_lost(side_px: tuple[float, float], blur_px: float) -> None:
    image = take_picture(side_px).taken(blur_px, 2.0)
    assert set(plain(image)[0]) <= set(MarkerDetector().detect(image).ids)


def test_most_markers_are_found() -> None:
    picture = take_picture(SMALL)
    assert len(MarkerDetector().detect(picture.taken())) >= 0.8 * len(picture.corners_px)


def test_ids_ascend_and_unknown_ones_are_left_out() -> None:
    image = take_picture(SMALL).taken()
    everything = MarkerDetector().detect(image)
    assert (np.diff(everything.ids) > 0).all()
    some = everything.ids[[1, 4]]
    known = MarkerDetector(DICTIONARY, [*some.tolist(), 500]).detect(image)
    assert known.ids.tolist() == some.tolist()
    np.testing.assert_allclose(known.corners_px, everything.corners_px[[1, 4]], atol=1e-9)


def test_an_id_seen_twice_is_left_out() -> None:
    a, _ = upright_marker(DICTIONARY, 7)
    b, _ = upright_marker(DICTIONARY, 9)
    assert MarkerDetector().detect(np.hstack([a, b])).ids.tolist() == [7, 9]
    assert MarkerDetector().detect(np.hstack([a, b, a])).ids.tolist() == [9]
    assert len(MarkerDetector().detect(np.hstack([a, a]))) == 0


def test_corners_begin_at_the_upper_left_of_the_print() -> None:
    image, corners = upright_marker(DICTIONARY, 7)
    for turns in range(4):
        detection = MarkerDetector().detect(np.ascontiguousarray(np.rot90(image, -turns)))
        # Each turn to the right makes the next corner in line the upper left one.
        np.testing.assert_allclose(np.roll(detection.corners_px[0], turns, axis=0), corners, atol=0.02)


def test_a_marker_that_leaves_the_image_is_not_measured_and_a_marker_at_its_border_is() -> None:
    image, corners = upright_marker(DICTIONARY, 7, at=30)
    for cut in range(1, 40):
        detection = MarkerDetector().detect(np.ascontiguousarray(image[:, cut:]))
        # A border that lies in the marker hides its edge: whatever is reported then must not be a guess.
        if len(detection):
            error = np.abs(detection.corners_px[0] + [cut, 0] - corners).max()
            assert error < max(0.03, 3 * detection.sigma_px.max()), f"cut {cut}: {error:.2f} px"
    assert len(MarkerDetector().detect(np.ascontiguousarray(image[:, 20:]))) == 1
    assert len(MarkerDetector().detect(np.ascontiguousarray(image[:, 45:]))) == 0


def test_a_half_covered_edge_drops_the_marker() -> None:
    image, corners = upright_marker(DICTIONARY, 7)
    left, right = int(corners[0, 0] + 0.3 * 96), int(corners[0, 0] + 0.75 * 96)
    covered = image.copy()
    covered[34:43, left:right] = 120
    assert len(plain(covered)[0]) == 1  # plain ArUco does not mind
    assert len(MarkerDetector().detect(covered)) == 0


# --- what images there are ------------------------------------------------------------------------------------------


def test_colour_and_grey_give_the_same() -> None:
    image = take_picture(SMALL).taken(0.7, 2.0)
    grey, colour = MarkerDetector().detect(image), MarkerDetector().detect(in_colour(image))
    assert grey.ids.tolist() == colour.ids.tolist()
    # OpenCV's weights of the three colours sum to one.
    np.testing.assert_array_equal(grey.corners_px, colour.corners_px)


@pytest.mark.parametrize("shape", [(0, 0), (0, 5), (0, 0, 3), (1, 1), (3, 3, 3), (7, 7), (1, 900), (900, 1), (40, 40)])
def test_an_image_without_markers_gives_none(shape: tuple[int, ...]) -> None:
    detection = MarkerDetector().detect(np.full(shape, 128, np.uint8))
    assert len(detection) == 0
    assert detection.corners_px.shape == (0, 4, 2)
    assert detection.sigma_px.shape == (0, 4)


def test_noise_gives_no_markers() -> None:
    image = np.random.default_rng(3).integers(0, 256, (480, 640), dtype=np.uint8)
    assert len(MarkerDetector().detect(image)) == 0


def test_the_same_image_gives_the_same_bytes() -> None:
    image = take_picture(SMALL).taken(0.7, 2.0)
    detector = MarkerDetector()
    a, b = detector.detect(image), detector.detect(image.copy())
    assert a.corners_px.tobytes() == b.corners_px.tobytes()
    assert a.sigma_px.tobytes() == b.sigma_px.tobytes()


# --- dictionaries ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", dictionary_names())
def test_every_dictionary_finds_its_markers(name: str) -> None:
    image, corners = upright_marker(name, 3)
    detection = MarkerDetector(name).detect(image)
    assert detection.ids.tolist() == [3]
    # Edges that run exactly between pixels: rounding to whole grey levels pulls all pixels of an edge alike.
    assert np.abs(detection.corners_px[0] - corners).max() < 0.02


def test_the_names_are_opencvs() -> None:
    names = dictionary_names()
    assert {"DICT_4X4_50", "DICT_7X7_1000", "DICT_ARUCO_ORIGINAL", DICTIONARY} <= set(names)
    assert names == sorted(names)


def test_an_unknown_dictionary_is_told_with_the_known_ones() -> None:
    with pytest.raises(InputError, match=r"DICT_3X3.*known: .*DICT_4X4_50.*DICT_APRILTAG_36h11"):
        MarkerDetector("DICT_3X3")
    with pytest.raises(InputError, match="no such dictionary"):
        get_dictionary("getPredefinedDictionary")


@pytest.mark.parametrize("name", ["DICT_APRILTAG_36h11", "DICT_4X4_50", "DICT_5X5_100", "DICT_ARUCO_ORIGINAL"])
def test_the_dictionary_that_was_meant_is_named_first(name: str) -> None:
    image = np.hstack([upright_marker(name, marker)[0] for marker in (1, 60 if "50" not in name else 30)])
    found = diagnose_dictionaries([image, in_colour(image)], range(100))
    assert next(iter(found)) == name
    assert found[name] == 4
    assert list(found.values()) == sorted(found.values(), reverse=True)
    assert len({key.upper() for key in found}) == len(found)


def test_no_markers_name_no_dictionary() -> None:
    image, _ = upright_marker(DICTIONARY, 7)
    assert diagnose_dictionaries([np.full((100, 100), 128, np.uint8)], range(100)) == {}
    assert diagnose_dictionaries([], range(100)) == {}
    assert DICTIONARY not in diagnose_dictionaries([image], [8])
