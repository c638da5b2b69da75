from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import SHARED_DATA
from svo2_writer import LEFT, RIGHT, SIZE, R_rect_left, T_right_left, conf_text, eyes

from aruco.errors import InputError
from aruco.lens import project
from aruco.pose_math import transform_points
from rigcal.sources import zed_conf
from rigcal.sources.zed_conf import factory_calibration, find_conf, require_one_camera

# The HD720 numbers of a real camera (serial 1010, published by Toby Breckon under the MIT licence).
REAL = """[LEFT_CAM_HD]
fx=700.895
fy=700.895
cx=665.54
cy=371.155
k1=-0.175995
k2=0.0265533
k3=0
p1=0
p2=0

[RIGHT_CAM_HD]
fx=699.05
fy=699.05
cx=639.74
cy=374.974
k1=-0.175152
k2=0.0267266
k3=0
p1=0
p2=0

[STEREO]
Baseline=120
TY=0
TZ=0
CV_HD=0.006799
RX_HD=0.00612931
RZ_HD=-0.00194124
"""


@pytest.fixture(autouse=True)
def _no_sdk_folders(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zed_conf, "USUAL_FOLDERS", ())


def _written(folder: Path, text: str, name: str = "SN1010.conf") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_a_real_camera_is_rectified_as_known(tmp_path: Path) -> None:
    rectification = factory_calibration(_written(tmp_path, REAL), 1280, 720).rectification()
    K = rectification.K
    # The figures are given to three decimals, by OpenCV 5.0; 4.14 rounds to the same.
    np.testing.assert_allclose([K[0, 0], K[1, 1], K[0, 2], K[1, 2]], [674.707, 674.707, 658.615, 379.645], atol=2e-3)
    assert rectification.baseline_m == pytest.approx(0.12, abs=1e-9)


def test_real_files_are_read() -> None:
    folder = SHARED_DATA / "zed"
    if not folder.is_dir():
        pytest.skip("needs the real conf files")
    whole = find_conf("1010", folder, folder)
    for size in ((2208, 1242), (1920, 1080), (1280, 720), (672, 376)):
        # This lens loses 2 to 4.3 per cent: that much magnification leaves no black border.
        K = factory_calibration(whole, *size).rectification().K
        assert 0.95 < K[0, 0] / factory_calibration(whole, *size).left.K[0, 0] < 0.99
    partial = find_conf("53386446", folder, folder)
    rectification = factory_calibration(partial, 1920, 1200).rectification()
    assert rectification.baseline_m == pytest.approx(0.0498789, abs=1e-5)
    with pytest.raises(InputError, match="it has FHD1200"):
        factory_calibration(partial, 960, 600)


def test_a_positive_baseline_gives_another_camera(tmp_path: Path) -> None:
    """The sign matters: T points from the right eye to the left one's origin, which lies at -x."""
    stereo = factory_calibration(_written(tmp_path, REAL), 1280, 720)
    assert stereo.t_right_left[0] == pytest.approx(-0.12)
    wrong = cv2.stereoRectify(
        stereo.left.K, stereo.left.distortion, stereo.right.K, stereo.right.distortion, (1280, 720),
        stereo.R_right_left, -stereo.t_right_left[:, None], flags=cv2.CALIB_ZERO_DISPARITY, alpha=0,
    )  # fmt: skip
    assert wrong[3][0, 3] > 0  # a right eye on the left


def test_points_land_where_the_rectified_pinhole_projects_them(tmp_path: Path) -> None:
    """Through the lens of each eye, and back through the maps: the same pixel rows, the disparity f B / Z."""
    stereo = factory_calibration(_written(tmp_path, conf_text()), *SIZE)
    rectification = stereo.rectification()
    points = np.array([[0.1, -0.1, 1.0], [-0.5, 0.2, 2.0], [0.3, 0.3, 1.5], [0.0, 0.0, 0.7]])
    left, right = eyes()
    expected = points @ R_rect_left().T
    expected_px = expected[:, :2] / expected[:, 2:] @ rectification.K[:2, :2].T + rectification.K[:2, 2]
    seen_left = project(left, points)
    seen_right = project(right, transform_points(T_right_left(), points))
    for k in range(len(points)):
        at_left = _looked_up(rectification.left, seen_left[k])
        at_right = _looked_up(rectification.right, seen_right[k])
        disparity = rectification.K[0, 0] * rectification.baseline_m / expected[k, 2]
        # A blurred spot is found again to some hundredths of a pixel; maps are rounded to 1/32.
        np.testing.assert_allclose(at_left, expected_px[k], atol=0.05)
        np.testing.assert_allclose(at_right, expected_px[k] - [disparity, 0], atol=0.05)
        assert np.linalg.norm(seen_left[k] - expected_px[k]) > 1.0  # doing nothing would be noticed


def _looked_up(rectify: Callable[[np.ndarray], np.ndarray], pixel: np.ndarray) -> np.ndarray:
    """Where a blurred spot at a recorded pixel is in the rectified image."""
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    spot = 250 * np.exp(-((x - pixel[0]) ** 2 + (y - pixel[1]) ** 2) / (2 * 3.0**2))
    image = rectify(np.rint(spot).astype(np.uint8)).astype(float)
    image[image < 3] = 0
    return np.array([(image * x).sum(), (image * y).sum()]) / image.sum()


def test_new_keys_give_the_rational_model_of_all_resolutions(tmp_path: Path) -> None:
    short = {key: value for key, value in LEFT.items() if key[0] != "k" and key[0] != "p"}
    disto = "k1=0.1\nk2=0.2\np1=0.001\np2=0.002\nk3=0.3\nk4=0.4\nk5=0.5\nk6=0.6\n"
    text = conf_text(short, short) + f"[LEFT_DISTO]\n{disto}[RIGHT_DISTO]\n{disto}"
    stereo = factory_calibration(_written(tmp_path, text), *SIZE)
    assert stereo.left.distortion_model == "rational_polynomial"
    np.testing.assert_array_equal(stereo.left.distortion, [0.1, 0.2, 0.001, 0.002, 0.3, 0.4, 0.5, 0.6])


def test_new_keys_come_before_old_ones_in_the_same_file(tmp_path: Path) -> None:
    disto = "k1=-0.18\nk2=0.02\np1=0\np2=0\nk3=0\nk4=0\nk5=0\nk6=0\n"
    text = conf_text() + f"[LEFT_DISTO]\n{disto}[RIGHT_DISTO]\n{disto}"
    assert factory_calibration(_written(tmp_path, text), *SIZE).left.distortion[0] == -0.18


def test_case_comments_and_a_byte_order_mark_do_not_matter(tmp_path: Path) -> None:
    plain = factory_calibration(_written(tmp_path, conf_text()), *SIZE)
    text = "\ufeff" + conf_text().replace("LEFT_CAM_VGA", "left_cam_VGA").replace("fx", "FX").replace("CV_", "cv_")
    other = factory_calibration(_written(tmp_path, text.replace("=120", "=120 ; mm"), "SN7.conf"), *SIZE)
    np.testing.assert_array_equal(plain.left.K, other.left.K)
    np.testing.assert_array_equal(plain.R_right_left, other.R_right_left)
    np.testing.assert_array_equal(plain.t_right_left, other.t_right_left)


def test_offsets_for_each_resolution_come_before_common_ones(tmp_path: Path) -> None:
    stereo = factory_calibration(_written(tmp_path, conf_text() + "TY_VGA=0.7\n"), *SIZE)
    assert stereo.t_right_left[1] == pytest.approx(0.7e-3)


@pytest.mark.parametrize(("size", "section"), [((1920, 1200), "FHD1200"), ((1920, 1080), "FHD"), ((2208, 1242), "2K")])
def test_the_size_chooses_the_section(tmp_path: Path, size: tuple[int, int], section: str) -> None:
    path = _written(tmp_path, conf_text(section=section))
    assert factory_calibration(path, *size).left.width == size[0]
    with pytest.raises(InputError, match="LEFT_CAM_HD"):
        factory_calibration(path, 1280, 720)


def test_a_file_without_the_resolution_says_what_it_has(tmp_path: Path) -> None:
    path = _written(tmp_path, conf_text(section="FHD1200"))
    with pytest.raises(InputError, match=r"lacks \[LEFT_CAM_VGA\].*it has FHD1200.*SN=1010"):
        factory_calibration(path, *SIZE)
    with pytest.raises(InputError, match="no images of 640 x 480"):
        factory_calibration(path, 640, 480)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (conf_text().replace("fx=351.2", "fx=seven"), "fx of .* must be a number"),
        (conf_text().replace("fx=351.2\n", ""), "lacks fx"),
        (conf_text().replace("fx=351.2", "fx=nan"), "must be a number"),
        (conf_text().replace("fx=351.2", "fx=-1"), "must be positive"),
        (conf_text().replace("cx=341.3", "cx=1341.3"), "lies outside"),
        (conf_text().replace("Baseline=120", "Baseline=0.12"), "no ZED"),
        (conf_text().replace("Baseline=120", "Baseline=-120"), "no ZED"),
        (conf_text().replace("CV_VGA=0.0068", "CV_VGA=0.68"), "no ZED"),
        (conf_text().replace("RX_VGA", "RX_HD"), "lacks rx_vga"),
        (conf_text().replace("k1=-0.174", "k1=-900"), "no usable pair"),
        ("<html>not found</html>", "not a readable ZED calibration"),
        (conf_text() + "[STEREO]\n", "not a readable ZED calibration"),
        ("\0" * 70_000, "over 64 KiB"),
        ("", "lacks"),
    ],
)
def test_files_that_cannot_be_used_get_a_sentence(tmp_path: Path, text: str, said: str) -> None:
    path = _written(tmp_path, text)
    with pytest.raises(InputError, match=said) as caught:
        factory_calibration(path, *SIZE).rectification()
    assert str(path) in str(caught.value)


def test_files_are_found_in_the_order_given_sdk_beside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given, sdk, beside = tmp_path / "given", tmp_path / "sdk", tmp_path / "beside"
    for folder in (given, sdk, beside):
        folder.mkdir()
        _written(folder, "")
    monkeypatch.setattr(zed_conf, "USUAL_FOLDERS", (sdk,))
    assert find_conf("1010", given, beside) == given / "SN1010.conf"
    assert find_conf("1010", None, beside) == sdk / "SN1010.conf"
    (sdk / "SN1010.conf").unlink()
    assert find_conf("1010", None, beside) == beside / "SN1010.conf"
    # A folder that lacks one camera's file does not keep it from being found elsewhere.
    (given / "SN1010.conf").unlink()
    assert find_conf("1010", given, beside) == beside / "SN1010.conf"


def test_names_of_other_forms_are_found(tmp_path: Path) -> None:
    other = _written(tmp_path, "", "zed-cam-sn-1010.CONF")
    assert find_conf("1010", None, tmp_path) == other
    plain = _written(tmp_path, "")
    assert find_conf("1010", None, tmp_path) == plain
    with pytest.raises(InputError):
        find_conf("101", None, tmp_path)  # not a part of another number


def test_a_file_of_another_camera_is_refused(tmp_path: Path) -> None:
    path = _written(tmp_path, conf_text(), "SN222.conf")
    with pytest.raises(InputError, match=r"of camera 222, not of 1010.*SN1010\.conf"):
        find_conf("1010", path, tmp_path)
    beside = _written(tmp_path, conf_text())
    assert find_conf("1010", path, tmp_path) == beside


def test_a_file_without_a_serial_number_is_taken_and_told(tmp_path: Path, said: list[str]) -> None:
    path = _written(tmp_path, conf_text(), "mine.conf")
    assert find_conf("1010", path, tmp_path / "other") == path
    assert any("does not say whose" in line for line in said)


def test_a_file_without_a_serial_number_is_not_that_of_two_cameras(tmp_path: Path) -> None:
    path = _written(tmp_path, conf_text(), "mine.conf")
    require_one_camera(path, ["1010", "1010"])
    with pytest.raises(InputError, match=r"mine\.conf: does not say whose .* cannot be that of cameras 1010, 222 all"):
        require_one_camera(path, ["222", "1010"])
    require_one_camera(tmp_path, ["1010", "222"])
    require_one_camera(_written(tmp_path, conf_text()), ["1010", "222"])  # find_conf has looked for the other one's


def test_no_file_names_the_option_and_where_to_get_it(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"SN1010\.conf.*--zed-conf.*stereolabs\.com.*SN=1010"):
        find_conf("1010", None, tmp_path)
    with pytest.raises(InputError, match="no such file or folder"):
        find_conf("1010", tmp_path / "missing", tmp_path)


def test_the_right_eye_differs(tmp_path: Path) -> None:
    stereo = factory_calibration(_written(tmp_path, conf_text()), *SIZE)
    assert stereo.left.K[0, 2] == LEFT["cx"]
    assert stereo.right.K[0, 2] == RIGHT["cx"]
