"""COLMAP's text model: read back, and by COLMAP itself."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from format_rigs import format_rig, lens, pixels, points_before, worst_pose_difference
from loguru import logger

from aruco.errors import InputError, OutputError
from aruco.pose_math import invert_transform
from rigcal.formats.colmap import FORMAT
from rigcal.formats.rig import ExportOptions, Rig

KINDS = {"a": "pinhole", "b12": "brown", "front": "brown_k3", "left": "rational", "z_fish": "fisheye"}
# COLMAP's own arithmetic is double, as ours: a pixel of a thousand keeps 1e-12; its fisheye goes through atan2.
PIXEL_TOLERANCE = 1e-6
# Quaternions and (cx + 0.5) - 0.5 lose the last digits of a double.
ROUND_TRIP = 1e-12


@pytest.fixture
def rig() -> Rig:
    return format_rig(KINDS)


@pytest.fixture
def folder(rig: Rig, tmp_path: Path) -> Path:
    FORMAT.write(rig, tmp_path / "model", ExportOptions())
    return tmp_path / "model"


def _or_nan(pixel: np.ndarray | None) -> np.ndarray:
    return np.full(2, np.nan) if pixel is None else pixel


def colmap_pixels(folder: Path, rig: Rig) -> dict[str, np.ndarray]:
    """Where COLMAP sees every camera's points, in COLMAP's pixels."""
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction()
    model.read_text(str(folder))
    found = {}
    for image in model.images.values():
        name = image.name.split("/")[0]
        found[name] = np.array([_or_nan(image.project_point(p)) for p in points_before(rig, name)])
    return found


def test_what_was_written_comes_back(rig: Rig, folder: Path):
    assert FORMAT.recognises(folder, b"")
    back = FORMAT.read(folder)
    assert worst_pose_difference(rig, back) < ROUND_TRIP
    assert back.up is None
    for name, camera in rig.cameras.items():
        assert (back.cameras[name].width, back.cameras[name].height) == (1280, 720)
        assert np.allclose(back.cameras[name].K, camera.K, rtol=0, atol=ROUND_TRIP)
        points = points_before(rig, name)
        assert np.allclose(pixels(back, name, points), pixels(rig, name, points), rtol=0, atol=1e-9)


def test_colmap_projects_the_same_points_to_the_same_pixels(rig: Rig, folder: Path):
    for name, found in colmap_pixels(folder, rig).items():
        # COLMAP's first pixel has its centre at 0.5.
        assert np.abs(found - 0.5 - pixels(rig, name, points_before(rig, name))).max() < PIXEL_TOLERANCE


def test_a_pose_written_the_wrong_way_round_would_be_seen(rig: Rig, tmp_path: Path):
    inverted = Rig(T_world_cam={n: invert_transform(T) for n, T in rig.T_world_cam.items()}, cameras=rig.cameras)
    FORMAT.write(inverted, tmp_path / "wrong", ExportOptions())
    for name, found in colmap_pixels(tmp_path / "wrong", rig).items():
        off = np.abs(found - 0.5 - pixels(rig, name, points_before(rig, name)))
        assert np.isnan(off).all() or np.nanmax(off) > 100


def test_half_a_pixel_would_be_seen(rig: Rig, folder: Path):
    for name, found in colmap_pixels(folder, rig).items():
        assert np.abs(found - pixels(rig, name, points_before(rig, name))).min() > 0.4


def test_the_rig_configuration_puts_the_cameras_where_the_images_are(rig: Rig, folder: Path):
    pycolmap = pytest.importorskip("pycolmap")
    (config,) = pycolmap.read_rig_config(str(folder / "rig_config.json"))
    names = list(rig.T_world_cam)
    assert [camera.image_prefix for camera in config.cameras] == [f"{name}/" for name in names]
    assert [camera.ref_sensor for camera in config.cameras] == [True, False, False, False, False]
    T_world_ref = rig.T_world_cam[names[0]]
    for name, camera in zip(names[1:], config.cameras[1:], strict=True):
        T_cam_ref = np.vstack([camera.cam_from_rig.matrix(), [0, 0, 0, 1]])
        assert np.abs(T_world_ref @ invert_transform(T_cam_ref) - rig.T_world_cam[name]).max() < ROUND_TRIP
    assert [camera.camera.model.name for camera in config.cameras] == [
        "PINHOLE", "OPENCV", "FULL_OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE",
    ]  # fmt: skip


def test_images_can_be_called_as_they_are(rig: Rig, tmp_path: Path):
    FORMAT.write(rig, tmp_path / "m", ExportOptions(image_name="shots/{camera}/image/17.png"))
    assert "shots/left/image/17.png" in (tmp_path / "m/images.txt").read_text()
    assert list(FORMAT.read(tmp_path / "m").T_world_cam) == list(rig.T_world_cam)
    with pytest.raises(InputError, match="folder"):
        FORMAT.write(rig, tmp_path / "n", ExportOptions(image_name="{camera}.jpg"))
    with pytest.raises(InputError, match="path inside"):
        FORMAT.write(rig, tmp_path / "n", ExportOptions(image_name="../{camera}/1.png"))
    assert not (tmp_path / "n").exists()


@pytest.mark.parametrize("name", ["../x", "a b", "a/b", "..", "a\nb"])
def test_a_name_that_is_no_folder_is_refused(name: str, tmp_path: Path):
    rig = Rig(T_world_cam={name: np.eye(4)}, cameras={name: lens(name, "pinhole")})
    with pytest.raises(InputError, match="rename"):
        FORMAT.write(rig, tmp_path / "m", ExportOptions())
    assert list(tmp_path.iterdir()) == []


def test_missing_intrinsics_are_asked_for(tmp_path: Path):
    with pytest.raises(InputError, match="--recording"):
        FORMAT.write(Rig(T_world_cam={"a": np.eye(4)}), tmp_path / "m", ExportOptions())


def test_an_earlier_model_is_replaced_and_nothing_else(rig: Rig, folder: Path):
    FORMAT.write(format_rig({"only": "pinhole"}), folder, ExportOptions())
    assert list(FORMAT.read(folder).T_world_cam) == ["only"]
    assert [p.name for p in folder.parent.iterdir()] == ["model"]
    (folder / "database.db").write_bytes(b"precious")
    with pytest.raises(OutputError, match=r"database\.db"):
        FORMAT.write(rig, folder, ExportOptions())
    assert (folder / "database.db").read_bytes() == b"precious"


@pytest.mark.parametrize("points", ["1 0.5 0.25 2 128 128 128 0.3 1 0\n", "", None])
def test_a_reconstruction_of_other_programs_is_not_replaced(points: str | None, rig: Rig, folder: Path, tmp_path: Path):
    """Not even where it has our rig configuration, and nothing but the files of a model."""
    (folder / "points3D.txt").unlink()
    if points is not None:
        (folder / "points3D.txt").write_text(points)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(OutputError, match=r"holds cameras\.txt, which was not written here"):
        FORMAT.write(rig, folder, ExportOptions())
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["model"]


def test_an_empty_folder_is_filled(rig: Rig, tmp_path: Path):
    (tmp_path / "model").mkdir()
    FORMAT.write(rig, tmp_path / "model", ExportOptions())
    assert worst_pose_difference(rig, FORMAT.read(tmp_path / "model")) < ROUND_TRIP


@pytest.mark.parametrize(
    ("model", "parameters", "kind", "distortion"),
    [
        ("SIMPLE_PINHOLE", "500 320 240", "plumb_bob", [0, 0, 0, 0, 0]),
        ("RADIAL", "500 320 240 0.1 -0.02", "plumb_bob", [0.1, -0.02, 0, 0, 0]),
        ("SIMPLE_RADIAL_FISHEYE", "500 320 240 0.1", "equidistant", [0.1, 0, 0, 0]),
        ("RADIAL_FISHEYE", "500 320 240 0.1 -0.02", "equidistant", [0.1, -0.02, 0, 0]),
    ],
)
def test_lenses_that_only_other_programs_write_mean_what_colmap_means(
    model: str, parameters: str, kind: str, distortion: list[float], tmp_path: Path
):
    (tmp_path / "cameras.txt").write_text(f"1 {model} 640 480 {parameters}\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a/1.png\n\n")
    rig = FORMAT.read(tmp_path)
    camera = rig.cameras["a"]
    assert (camera.distortion_model, camera.distortion.tolist()) == (kind, distortion)
    pycolmap = pytest.importorskip("pycolmap")
    theirs = pycolmap.Camera(model=model, width=640, height=480, params=[float(word) for word in parameters.split()])
    points = points_before(rig, "a")
    found = np.array([theirs.img_from_cam(point) for point in points])
    assert np.abs(found - 0.5 - pixels(rig, "a", points)).max() < PIXEL_TOLERANCE


def test_models_of_other_programs_are_read(tmp_path: Path):
    (tmp_path / "cameras.txt").write_text("# x\n7 SIMPLE_RADIAL 640 480 500 320 240 0.1\n")
    (tmp_path / "images.txt").write_text(
        "#\n3 1 0 0 0 0 0 2 7 rig1/cam0/1.jpg\n10 20 -1 30 40 5\n4 -1 0 0 0 0 0 2 7 rig1/cam0/2.jpg\n\n"
    )
    rig = FORMAT.read(tmp_path)
    assert list(rig.T_world_cam) == ["cam0"]
    assert rig.T_world_cam["cam0"][:3, 3].tolist() == [0, 0, -2]
    assert rig.cameras["cam0"].K[0].tolist() == [500, 0, 319.5]
    assert rig.cameras["cam0"].distortion.tolist() == [0.1, 0, 0, 0, 0]


@pytest.mark.parametrize(
    ("cameras", "images", "told"),
    [
        ("1 PINHOLE 640 480 500 500 320 240", "1 1 0 0 0 0 0 0 1 a/1\n\n2 1 0 0 0 1 0 0 1 a/2\n", "different places"),
        ("1 PINHOLE 640 480 500 500 320", "1 1 0 0 0 0 0 0 1 a/1.png\n", "wants 4 parameters"),
        ("1 FOV 640 480 500 500 320 240 1", "1 1 0 0 0 0 0 0 1 a/1.png\n", "no counterpart"),
        ("1 PINHOLE 640 480 500 500 320 240", "1 2 0 0 0 0 0 0 1 a/1.png\n", "length"),
        ("1 PINHOLE 640 480 500 500 320 240", "1 1 0 0 0 0 0 nan 1 a/1.png\n", "ordinary number"),
        ("1 PINHOLE 640 480 500 500 320 240", "1 1 0 0 0 0 0 0 2 a/1.png\n", r"not in cameras\.txt"),
        ("1 PINHOLE 640 480 500 500 320 240", "1 1 0 0 0 0 0 0 1\n", "got 9 words"),
        ("1 PINHOLE 640 480 500 500 320 240", "1 1 0 0 0 0 0 0 1 ../1.png\n", "cannot be called"),
        ("1 PINHOLE 640 480 500 500 320 240", "# none\n", "no image"),
        ("1 PINHOLE 99999 480 500 500 320 240", "1 1 0 0 0 0 0 0 1 a/1.png\n", "99999 x 480"),
    ],
)  # fmt: skip
def test_a_damaged_model_is_refused_in_one_sentence(cameras: str, images: str, told: str, tmp_path: Path):
    (tmp_path / "cameras.txt").write_text(cameras + "\n")
    (tmp_path / "images.txt").write_text(images)
    with pytest.raises(InputError, match=told) as caught:
        FORMAT.read(tmp_path)
    assert str(tmp_path) in str(caught.value)


def test_a_binary_model_is_recognised_and_the_cure_named(tmp_path: Path):
    for name in ("cameras.bin", "images.bin"):
        (tmp_path / name).write_bytes(b"\0")
    with pytest.raises(InputError, match="model_converter"):
        FORMAT.read(tmp_path)


def test_a_damaged_rig_configuration_is_refused(folder: Path):
    (folder / "rig_config.json").write_text(json.dumps({"cameras": []}))
    with pytest.raises(InputError, match=r"rig_config\.json"):
        FORMAT.read(folder)


@pytest.mark.parametrize("pattern", ["{camera}.png", "cam_{camera}/1.png", "x/a{camera}/1.png"])
def test_a_camera_wants_a_folder_of_its_own(pattern: str, rig: Rig, tmp_path: Path):
    with pytest.raises(InputError, match="by their folder"):
        FORMAT.write(rig, tmp_path / "m", ExportOptions(image_name=pattern))
    assert not (tmp_path / "m").exists()


def test_images_that_fall_on_one_name_are_named(tmp_path: Path):
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 640 480 500 500 320 240\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a/left/1.png\n\n2 1 0 0 0 1 0 0 1 b/left/1.png\n\n")
    with pytest.raises(InputError, match=r"'a/left/1\.png' and 'b/left/1\.png' .*camera left, by the last folder"):
        FORMAT.read(tmp_path)


def said_of(folder: Path) -> tuple[Rig | None, list[str]]:
    """What reading gives, or None, and the warnings."""
    said: list[str] = []
    handler = logger.add(said.append, level="WARNING")
    try:
        return FORMAT.read(folder), said
    except InputError as error:
        return None, [str(error)]
    finally:
        logger.remove(handler)


@pytest.mark.parametrize("name", ["images.txt", "cameras.txt", "rig_config.json"])
def test_a_model_that_was_cut_anywhere_is_refused_or_told(name: str, rig: Rig, folder: Path):
    whole = (folder / name).read_bytes()
    assert said_of(folder)[1] == []
    # What another camera's numbers would be cut like; the last line and the end of the one before.
    for end in range(len(whole) - 330, len(whole)):
        (folder / name).write_bytes(whole[:end])
        read, said = said_of(folder)
        is_harmless = read is not None and worst_pose_difference_or_inf(read, rig) < ROUND_TRIP
        assert said or (is_harmless and whole[end:].strip(b"]}\n") == b""), end


def worst_pose_difference_or_inf(a: Rig, b: Rig) -> float:
    return worst_pose_difference(a, b) if list(a.T_world_cam) == list(b.T_world_cam) else np.inf


def test_cameras_that_no_image_shows_are_named(folder: Path):
    lines = (folder / "images.txt").read_text().splitlines(keepends=True)
    (folder / "images.txt").write_text("".join(lines[:-2]))
    rig, said = said_of(folder)
    assert rig is not None
    assert "has no image of camera z_fish, which is in rig_config.json" in said[0]
    (folder / "rig_config.json").unlink()
    assert "has no image of camera with id 5, which is in cameras.txt" in said_of(folder)[1][0]


def test_an_image_of_no_camera_of_the_rig_is_refused(folder: Path):
    text = (folder / "images.txt").read_text()
    (folder / "images.txt").write_text(text.replace("z_fish/image.png", "z_f"))
    with pytest.raises(
        InputError, match=r"'z_f' is of no camera in rig_config\.json, which has a, b12, front, left, z"
    ):
        FORMAT.read(folder)


def test_a_camera_outside_the_rig_is_called_after_its_folder_and_told(tmp_path: Path):
    """COLMAP's rig_configurator gives such a camera a rig of its own."""
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 640 480 500 500 320 240\n")
    images = ["left/0.png", "right/0.png", "phone/IMG_1.jpg"]
    lines = (f"{n} 1 0 0 0 {n} 0 0 1 {image}\n\n" for n, image in enumerate(images, start=1))
    (tmp_path / "images.txt").write_text("".join(lines))
    rigs = [{"cameras": [{"image_prefix": "left/", "ref_sensor": True}, {"image_prefix": "right/"}]}]
    (tmp_path / "rig_config.json").write_text(json.dumps(rigs))
    rig, said = said_of(tmp_path)
    assert rig is not None
    assert list(rig.T_world_cam) == ["left", "phone", "right"]
    (told,) = said
    assert "camera phone, called after the folder of its images, is not in rig_config.json" in told
