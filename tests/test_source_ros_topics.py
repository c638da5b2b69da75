"""Which topics belong to which camera: the names that drivers give, what is chosen, and --topics."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from bag_writers import SIZE, K, Message, Ros, pictures, write_mcap
from mcap.reader import make_reader
from mcap.writer import Writer as McapWriter

from aruco.errors import InputError
from aruco.model import BadFrame, Camera, Frame
from rigcal.sources import open_recordings
from rigcal.sources.mcap_writer import McapFrames
from rigcal.sources.message_store import Topic, plain_type
from rigcal.sources.options import SourceOptions
from rigcal.sources.ros_streams import First
from rigcal.sources.ros_topics import CameraTopics, paired

IMAGE, COMPRESSED, INFO = "sensor_msgs/Image", "sensor_msgs/CompressedImage", "sensor_msgs/CameraInfo"


def cameras(rows: Sequence[tuple[str, str, str]], given: Sequence[str] = ()) -> dict[str, CameraTopics]:
    """Cameras of (topic, encoding, frame): "info" is a CameraInfo, "eye" that of a second eye, "jpeg" is compressed."""
    topics, firsts = {}, {}
    for name, encoding, frame in rows:
        kind = INFO if encoding in ("info", "eye") else COMPRESSED if "jpeg" in encoding or ";" in encoding else IMAGE
        topics[name] = Topic(name=name, type=kind, encoding="cdr", count=5)
        size = SIZE if kind == IMAGE else None
        firsts[name] = First(encoding=encoding, frame_id=frame, size=size, eyes_apart=encoding == "eye")
    return {camera.name: camera for camera in paired(topics, firsts.__getitem__, given)}


REALSENSE = [
    ("/camera/camera/color/image_raw", "rgb8", "color_optical"),
    ("/camera/camera/color/image_raw/compressed", "rgb8; jpeg compressed bgr8", "color_optical"),
    ("/camera/camera/color/camera_info", "info", "color_optical"),
    ("/camera/camera/depth/image_rect_raw", "16UC1", "depth_optical"),
    ("/camera/camera/depth/camera_info", "info", "depth_optical"),
    ("/camera/camera/aligned_depth_to_color/image_raw", "16UC1", "color_optical"),
    ("/camera/camera/aligned_depth_to_color/camera_info", "info", "color_optical"),
    ("/camera/camera/infra1/image_rect_raw", "mono8", "infra1_optical"),
    ("/camera/camera/infra1/camera_info", "info", "infra1_optical"),
    ("/camera/camera/infra2/image_rect_raw", "mono8", "infra2_optical"),
    ("/camera/camera/infra2/camera_info", "eye", "infra2_optical"),
]
ZED = [
    ("/zed/zed_node/left/image_rect_color", "bgra8", "left"),
    ("/zed/zed_node/left/camera_info", "info", "left"),
    ("/zed/zed_node/left_raw/image_raw_color", "bgra8", "left"),
    ("/zed/zed_node/left_raw/camera_info", "info", "left"),
    ("/zed/zed_node/left_gray/image_rect_gray", "mono8", "left"),
    ("/zed/zed_node/left_gray/camera_info", "info", "left"),
    ("/zed/zed_node/right/image_rect_color", "bgra8", "right"),
    ("/zed/zed_node/right/camera_info", "eye", "right"),
    ("/zed/zed_node/depth/depth_registered", "32FC1", "left"),
    ("/zed/zed_node/depth/camera_info", "info", "left"),
    ("/zed/zed_node/confidence/confidence_map", "32FC1", "left"),
    ("/zed/zed_node/confidence/camera_info", "info", "left"),
]
AZURE = [
    ("/rgb/image_raw", "bgra8", "rgb_camera_link"),
    ("/rgb/camera_info", "info", "rgb_camera_link"),
    ("/depth/image_raw", "16UC1", "depth_camera_link"),
    ("/depth/camera_info", "info", "depth_camera_link"),
    ("/depth_to_rgb/image_raw", "16UC1", "rgb_camera_link"),
    ("/depth_to_rgb/camera_info", "info", "rgb_camera_link"),
    ("/rgb_to_depth/image_raw", "bgra8", "depth_camera_link"),
    ("/rgb_to_depth/camera_info", "info", "depth_camera_link"),
    ("/ir/image_raw", "mono16", "depth_camera_link"),
    ("/ir/camera_info", "info", "depth_camera_link"),
]
ORBBEC = [
    ("/cam_01/color/image_raw", "rgb8", "cam_01_color_optical_frame"),
    ("/cam_01/color/camera_info", "info", "cam_01_color_optical_frame"),
    ("/cam_01/depth/image_raw", "16UC1", "cam_01_color_optical_frame"),
    ("/cam_01/depth/camera_info", "info", "cam_01_color_optical_frame"),
    ("/cam_01/left_ir/image_raw", "mono8", "cam_01_left_ir_optical_frame"),
    ("/cam_01/left_ir/camera_info", "info", "cam_01_left_ir_optical_frame"),
]


def test_realsense_driver():
    found = cameras(REALSENSE)
    assert list(found) == ["camera"]
    camera = found["camera"]
    assert camera.image == "/camera/camera/color/image_raw"  # raw before compressed
    assert camera.info == "/camera/camera/color/camera_info"
    assert camera.depth == "/camera/camera/aligned_depth_to_color/image_raw"
    assert camera.depth_info == "/camera/camera/aligned_depth_to_color/camera_info"
    assert not camera.is_rectified


def test_realsense_driver_without_aligned_depth(told: list[str]):
    camera = cameras([row for row in REALSENSE if "aligned" not in row[0]])["camera"]
    assert camera.depth is None
    assert any(
        "depth /camera/camera/depth/image_rect_raw is left out, it is not in the image's frame 'color_optical'; record "
        "depth that is aligned" in line
        for line in told
    )


def test_zed_driver(told: list[str]):
    found = cameras(ZED)
    assert list(found) == ["zed"]
    camera = found["zed"]
    assert camera.image == "/zed/zed_node/left/image_rect_color"
    assert camera.is_rectified
    assert camera.depth == "/zed/zed_node/depth/depth_registered"
    assert camera.confidence == "/zed/zed_node/confidence/confidence_map"
    assert camera.right_info == "/zed/zed_node/right/camera_info"
    assert any("of one camera's images /zed/zed_node/left/image_rect_color is taken, not" in line for line in told)


def test_newer_zed_driver():
    rows = [
        ("/zed_front/zed_node/rgb/color/rect/image", "bgra8", "left"),
        ("/zed_front/zed_node/rgb/color/rect/camera_info", "info", "left"),
        ("/zed_front/zed_node/rgb/color/raw/image", "bgra8", "left"),
        ("/zed_front/zed_node/rgb/gray/rect/image", "mono8", "left"),
        ("/zed_front/zed_node/rgb/gray/rect/camera_info", "info", "left"),
        ("/zed_front/zed_node/depth/depth_registered", "32FC1", "left"),
    ]
    camera = cameras(rows)["zed_front"]
    assert camera.image == "/zed_front/zed_node/rgb/color/rect/image"
    assert camera.is_rectified
    assert camera.depth == "/zed_front/zed_node/depth/depth_registered"  # of the image's size, so of its intrinsics


def test_azure_kinect_driver():
    camera = cameras(AZURE)["camera"]
    assert (camera.image, camera.depth) == ("/rgb/image_raw", "/depth_to_rgb/image_raw")


def test_orbbec_driver_with_depth_registered_in_its_own_topic():
    camera = cameras(ORBBEC)["cam_01"]
    assert (camera.image, camera.depth) == ("/cam_01/color/image_raw", "/cam_01/depth/image_raw")


def plain(*namespaces: str) -> list[tuple[str, str, str]]:
    return [row for ns in namespaces for row in ((f"/{ns}/image_raw", "rgb8", ns), (f"/{ns}/camera_info", "info", ns))]


def test_plain_cameras_by_namespace():
    rows = [
        (f"/{name}/{topic}", encoding, name)
        for name in ("usb_cam", "cam0", "hall/north")
        for topic, encoding in (("image_raw/compressed", "jpeg"), ("camera_info", "info"))
    ]
    found = cameras(rows)
    assert sorted(found) == ["cam0", "hall_north", "usb_cam"]
    assert found["hall_north"].image == "/hall/north/image_raw/compressed"
    assert found["hall_north"].info == "/hall/north/camera_info"


def test_a_camera_that_simulators_call_depth_camera_has_colour():
    rows = [
        (f"/depth_camera{k}/{t}", e, "f") for k in (1, 2) for t, e in (("image_raw", "rgb8"), ("camera_info", "info"))
    ]
    assert sorted(cameras(rows)) == ["depth_camera1", "depth_camera2"]


@pytest.mark.parametrize(("second", "names"), [("info", ["left", "right"]), ("eye", ["left"])])
def test_left_and_right_are_two_cameras_unless_they_are_two_eyes(second: str, names: list[str]):
    rows = [
        ("/left/image_raw", "bgr8", "left"),
        ("/left/camera_info", "info", "left"),
        ("/right/image_raw", "bgr8", "right"),
        ("/right/camera_info", second, "right"),
    ]
    assert sorted(cameras(rows)) == names


def test_rigs_of_many_drivers_at_once():
    rows = [*REALSENSE, *ZED, *ORBBEC]
    assert sorted(cameras(rows)) == ["cam_01", "camera", "zed"]


def test_the_user_decides():
    found = cameras(REALSENSE, ["ir=/camera/camera/infra1/image_rect_raw", "rgb=/camera/camera/color/image_raw,,"])
    assert found["ir"].info == "/camera/camera/infra1/camera_info"
    assert found["ir"].depth is None  # aligned depth is in the colour image's frame
    assert found["rgb"].info == "/camera/camera/color/camera_info"
    assert found["rgb"].depth is None  # left empty
    both = cameras(REALSENSE, ["x=/camera/camera/color/image_raw,/camera/camera/depth/camera_info"])["x"]
    assert both.info == "/camera/camera/depth/camera_info"
    assert both.depth == "/camera/camera/aligned_depth_to_color/image_raw"  # not mentioned, so found
    packed = cameras([row for row in REALSENSE if row[1] != "rgb8"], ["x=/camera/camera/color/image_raw"])["x"]
    assert packed.image == "/camera/camera/color/image_raw/compressed"


@pytest.mark.parametrize("words", ["x", "=/a", "x=", "x=,b", "x=/a,/b,/c,/d"])
def test_what_the_user_says_must_have_the_form(words: str):
    with pytest.raises(InputError, match="want <camera>=<image topic>"):
        cameras(ZED, [words])


def test_a_topic_that_is_not_there_is_listed_against_what_is():
    with pytest.raises(InputError) as caught:
        cameras(ZED, ["x=/zed/left"])
    text = str(caught.value)
    assert "--topics: /zed/left is no sensor_msgs/Image or sensor_msgs/CompressedImage with messages here" in text
    assert "/zed/zed_node/left/image_rect_color (sensor_msgs/Image, 5)" in text


def test_types_have_one_name_in_ros_1_and_2_and_dds():
    for name in ("sensor_msgs/Image", "sensor_msgs/msg/Image", "sensor_msgs::msg::dds_::Image_"):
        assert plain_type(name) == "sensor_msgs/Image"


def rows_of(topics: dict[str, str], frame: str) -> list[tuple[str, str, str]]:
    return [(topic, encoding, frame) for topic, encoding in topics.items()]


@pytest.mark.parametrize("above", ["", "/rig"])
def test_namespaces_may_be_called_like_streams(above: str):
    """Two RealSenses under /left and /right, also where they stand below another namespace."""
    rows = [
        (row[0].replace("/camera/camera", f"{above}/{side}"), row[1], f"{side}_{row[2]}")
        for side in ("left", "right")
        for row in REALSENSE
    ]
    found = cameras(rows)
    prefix = above.strip("/") + "_" if above else ""
    assert sorted(found) == [f"{prefix}left", f"{prefix}right"]
    for side in ("left", "right"):
        camera = found[f"{prefix}{side}"]
        assert camera.image == f"{above}/{side}/color/image_raw"
        assert camera.depth == f"{above}/{side}/aligned_depth_to_color/image_raw"


@pytest.mark.parametrize("rows", [REALSENSE, ZED], ids=["realsense", "zed"])
@pytest.mark.parametrize("above", ["", "/rig"])
def test_namespaces_called_like_streams_may_have_others_below(above: str, rows: Sequence[tuple[str, str, str]]):
    """/left/camera/color and /right/camera/color, which may have the same frames."""
    all_rows = []
    for side in ("left", "right"):
        all_rows += [(f"{above}/{side}/{topic.split('/', 2)[2]}", kind, frame) for topic, kind, frame in rows]
    found = cameras(all_rows)
    assert len(found) == 2
    (alone,) = cameras(rows).values()
    for side, camera in zip(("left", "right"), found.values()):
        for topic, wanted in ((camera.image, alone.image), (camera.depth, alone.depth), (camera.info, alone.info)):
            assert wanted is not None
            assert topic == f"{above}/{side}/{wanted.split('/', 2)[2]}"


def test_plain_cameras_called_left_and_right_have_their_own_depth():
    rows = []
    for side in ("left", "right"):
        rows += plain(side)
        rows += rows_of({f"/{side}/depth/image_raw": "16UC1", f"/{side}/depth/camera_info": "info"}, side)
    found = cameras(rows)
    assert {name: (c.image, c.depth) for name, c in found.items()} == {
        side: (f"/{side}/image_raw", f"/{side}/depth/image_raw") for side in ("left", "right")
    }


def test_the_newest_zed_drivers_left_images_are_no_namespace():
    rows = [
        ("/zed/zed_node/left/color/rect/image", "bgra8", "left"),
        ("/zed/zed_node/left/color/rect/camera_info", "info", "left"),
        ("/zed/zed_node/left/gray/rect/image", "mono8", "left"),
        ("/zed/zed_node/left/gray/rect/camera_info", "info", "left"),
        ("/zed/zed_node/right/color/rect/image", "bgra8", "right"),
        ("/zed/zed_node/right/color/rect/camera_info", "eye", "right"),
        ("/zed/zed_node/depth/depth_registered", "32FC1", "left"),
    ]
    camera = cameras(rows)["zed"]
    assert camera.image == "/zed/zed_node/left/color/rect/image"
    assert camera.depth == "/zed/zed_node/depth/depth_registered"
    assert camera.right_info == "/zed/zed_node/right/color/rect/camera_info"


def test_grey_and_side_by_side_images_of_a_zed_are_no_cameras(said: list[str]):
    rows, node = list(ZED), "/zed/zed_node"
    for eye, info in (("rgb", "info"), ("left", "info"), ("right", "eye")):
        for way in ("rect", "raw"):
            stream = f"{node}/{eye}{'_raw' if way == 'raw' else ''}_gray"
            frame = "right" if eye == "right" else "left"
            rows += [(f"{stream}/image_{way}_gray", "mono8", frame), (f"{stream}/camera_info", info, frame)]
    for image in ("stereo/image_rect_color", "stereo_raw/image_raw_color", "stereo/color/rect/image"):
        rows.append((f"{node}/{image}", "bgra8", "left"))
    found = cameras(rows)
    assert {name: camera.image for name, camera in found.items()} == {"zed": f"{node}/left/image_rect_color"}
    assert said == []


@pytest.mark.parametrize(
    "namespaces", [("color", "left", "right"), ("oak/rgb", "oak/left", "oak/right"), ("rgb/north", "rgb/south")]
)
def test_images_of_frames_and_camera_infos_of_their_own_are_cameras(namespaces: tuple[str, ...]):
    found = cameras(plain(*namespaces))
    assert {name: camera.image for name, camera in found.items()} == {
        namespace.replace("/", "_"): f"/{namespace}/image_raw" for namespace in namespaces
    }


def test_colour_is_a_camera_beside_left_and_the_second_of_two_eyes_is_none():
    rows = [*plain("oak/rgb", "oak/left"), ("/oak/right/image_raw", "bgr8", "right")]
    assert list(cameras([*rows, ("/oak/right/camera_info", "info", "right")])) == ["oak_left", "oak_rgb", "oak_right"]
    assert list(cameras([*rows, ("/oak/right/camera_info", "eye", "right")])) == ["oak_left", "oak_rgb"]


def test_depth_of_both_eyes_belongs_to_the_image_in_whose_frame_it_is(said: list[str]):
    """As depthai publishes it."""
    rows = [*plain("oak/rgb", "oak/left", "oak/right")]
    rows += [("/oak/stereo/image_raw", "16UC1", "oak/rgb"), ("/oak/stereo/camera_info", "info", "oak/rgb")]
    found = cameras(rows)
    assert {name: camera.depth for name, camera in found.items()} == {
        "oak_rgb": "/oak/stereo/image_raw",
        "oak_left": None,
        "oak_right": None,
    }
    assert found["oak_rgb"].depth_info == "/oak/stereo/camera_info"
    assert said == []


def test_a_pair_of_plain_cameras_may_be_called_stereo():
    assert list(cameras(plain("stereo/left", "stereo/right"))) == ["stereo_left", "stereo_right"]
    assert list(cameras(plain("stereo", "rgb"))) == ["rgb", "stereo"]


def test_what_may_be_a_camera_of_its_own_is_not_left_out_in_silence(said: list[str]):
    assert list(cameras(plain("rgb", "ir"))) == ["camera"]
    assert said == [
        "/ir/image_raw is taken to be of the camera of /rgb/image_raw and left out; where these are several cameras "
        "name all with --topics NAME=IMAGE_TOPIC"
    ]


@pytest.mark.parametrize("without", ["nothing", "/depth", "/rgb_to"])
def test_infrared_of_a_single_kinect_is_nothing_to_warn_of(without: str, told: list[str], said: list[str]):
    rows = [row for row in AZURE if not row[0].startswith(without)]
    assert list(cameras(rows)) == ["camera"]
    assert said == []
    assert any(line.startswith("of one camera's images /rgb/image_raw is taken") and "/ir" in line for line in told)


@pytest.mark.parametrize(
    ("topic", "rectified"),
    [
        ("/front_rect/image_raw", False),
        ("/rig/front_rect/image", False),
        ("/rect/color/image_raw", False),
        ("/cam/image_rect_color", True),
        ("/cam/left/image_rect", True),
        ("/cam/left_rect/image", True),
        ("/cam/infra1/image_rect_raw", True),
        ("/zed/zed_node/rgb/color/rect/image", True),
        ("/cam/left_rect/image_raw", False),
        ("/cam/image_raw_rect", True),
    ],
)
def test_only_a_streams_own_name_says_that_it_is_rectified(topic: str, rectified: bool):
    (camera,) = cameras([(topic, "bgr8", "f")]).values()
    assert camera.is_rectified == rectified


ALIGNED = {
    "/camera/color/image_raw": "rgb8",
    "/camera/color/camera_info": "info",
    "/camera/aligned_depth_to_color/image_raw": "16UC1",
    "/camera/aligned_depth_to_color/camera_info": "info",
}


@pytest.mark.parametrize(
    ("topic", "frame"), [("/camera/confidence/image_rect_raw", "f"), ("/camera/confidence/confidence_map", "other")]
)
def test_confidence_that_is_not_the_zeds_of_this_depth_is_left_out(topic: str, frame: str, said: list[str]):
    camera = cameras([*rows_of(ALIGNED, "f"), (topic, "mono8", frame)])["camera"]
    assert camera.depth == "/camera/aligned_depth_to_color/image_raw"
    assert camera.confidence is None
    assert said == [
        f"camera camera: confidence {topic} is left out: only the ZED driver's is known (confidence_map, of depth's "
        "frame and size)"
    ]


# From here on with files, because intrinsics are in messages.

IMAGES = pictures(2)
PATH = "a.mcap"


def opened(tmp_path: Path, messages: Sequence[Message], **options: object) -> dict[str, Camera]:
    recording = open_recordings([write_mcap(tmp_path / PATH, messages)], SourceOptions(**options))  # type: ignore[arg-type]
    return {camera.name: camera for camera in recording.cameras}


def images(ros: Ros, topic: str = "/cam/image_raw", frame: str = "optical") -> list[Message]:
    return [ros.image(topic, 10**9 * (k + 1), image, "bgr8", frame) for k, image in enumerate(IMAGES)]


P = np.array([[80.0, 0, 30, 0], [0, 80, 22, 0], [0, 0, 1, 0]])


def test_raw_images_have_k_and_distortion_rectified_ones_p(tmp_path: Path):
    ros = Ros(2)
    d = [0.1, -0.2, 0.001, 0.002, 0.03]
    messages = [*images(ros, "/raw/image_raw"), ros.info("/raw/camera_info", d=d, p=P)]
    messages += [*images(ros, "/flat/image_rect_color"), ros.info("/flat/camera_info", d=d, p=P)]
    found = opened(tmp_path, messages)
    np.testing.assert_array_equal(found["raw"].K, K)
    np.testing.assert_array_equal(found["raw"].distortion, d)
    np.testing.assert_array_equal(found["flat"].K, P[:, :3])
    assert not found["flat"].has_distortion


@pytest.mark.parametrize(
    ("model", "d", "expected"),
    [
        ("plumb_bob", [0.1] * 5, "plumb_bob"),
        ("", [], "plumb_bob"),
        ("Plumb_Bob", [0.1] * 4, "plumb_bob"),
        ("rational_polynomial", [0.1] * 8, "rational_polynomial"),
        ("rational_polynomial", [0.1] * 8 + [0.0] * 6, "rational_polynomial"),
        ("equidistant", [0.1] * 4, "equidistant"),
        ("fisheye", [0.0] * 4, "equidistant"),
        ("Brown Conrady", [0.1] * 5, "plumb_bob"),
        ("Kannala Brandt4", [0.1] * 4 + [0.0], "equidistant"),
    ],
)
def test_distortion_models_by_all_their_names(model: str, d: list[float], expected: str, tmp_path: Path):
    ros = Ros(2)
    camera = opened(tmp_path, [*images(ros), ros.info("/cam/camera_info", model=model, d=d)])["cam"]
    assert camera.distortion_model == expected
    assert camera.distortion[:4].tolist() == (d[:4] or [0.0] * 4)


@pytest.mark.parametrize(
    ("info", "message"),
    [
        ({"k": np.zeros((3, 3))}, "camera cam: its CameraInfo is empty"),
        ({"size": (640, 480)}, "images are 64 x 48, but its CameraInfo says 640 x 480"),
        ({"model": "double_sphere", "d": [0.5, 0.5]}, "the distortion model 'double_sphere' is not known"),
        ({"model": "plumb_bob", "d": [0.1] * 7}, "plumb_bob wants 5 distortion_coefficients, got 7"),
        ({"k": np.full((3, 3), np.nan)}, "holds NaN"),
    ],
)
def test_intrinsics_that_cannot_be_used_are_named(info: dict[str, object], message: str, tmp_path: Path):
    ros = Ros(2)
    with pytest.raises(InputError) as caught:
        opened(tmp_path, [*images(ros), ros.info("/cam/camera_info", **info)])  # type: ignore[arg-type]
    assert str(caught.value).startswith(f"{tmp_path / PATH}: camera cam")
    assert message in str(caught.value)


def test_binned_and_cut_out_images_have_their_own_intrinsics(tmp_path: Path):
    """As ROS's image_geometry has it: cut out of the full image, then binned."""
    ros = Ros(2)
    full = np.array([[200.0, 0, 80], [0, 200, 60], [0, 0, 1]])
    info = ros.info("/cam/camera_info", size=(160, 120), k=full, binning=2, roi=(16, 12, 96, 128))
    camera = opened(tmp_path, [*images(ros), info])["cam"]
    np.testing.assert_allclose(camera.K, [[100, 0, 32], [0, 100, 24], [0, 0, 1]])


def test_the_baseline_is_in_the_right_eyes_projection(tmp_path: Path):
    ros = Ros(2)
    right = P.copy()
    right[0, 3] = -80.0 * 0.12
    messages = [
        *images(ros, "/zed/zed_node/left/image_rect_color"),
        ros.info("/zed/zed_node/left/camera_info", p=P),
        ros.info("/zed/zed_node/right/camera_info", p=right),
    ]
    assert opened(tmp_path, messages)["zed"].baseline_m == pytest.approx(0.12)


def test_two_cameras_of_one_name_are_refused(tmp_path: Path):
    ros = Ros(2)
    messages = [m for ns in ("a_b", "a/b") for m in (*images(ros, f"/{ns}/image_raw"), ros.info(f"/{ns}/camera_info"))]
    with pytest.raises(
        InputError, match="camera a_b is both /a/b/image_raw and /a_b/image_raw; name them with --topics"
    ):
        opened(tmp_path, messages)


def test_a_camera_called_like_a_rectified_stream_keeps_its_distortion(tmp_path: Path):
    ros, d = Ros(2), [-0.3, 0.1, 0.0, 0.0, 0.0]
    messages = [*images(ros, "/front_rect/image_raw"), ros.info("/front_rect/camera_info", d=d, p=P)]
    camera = opened(tmp_path, messages)["front_rect"]
    np.testing.assert_array_equal(camera.K, K)
    np.testing.assert_array_equal(camera.distortion, d)


def test_confidence_of_other_programs_spoils_no_depth(tmp_path: Path):
    """As an L515's, which has a size and a meaning of its own."""
    ros = Ros(2)
    depth = np.full((SIZE[1], SIZE[0]), 1000, dtype=np.uint16)
    messages = [*images(ros, "/camera/color/image_raw"), ros.info("/camera/color/camera_info")]
    messages += [ros.image("/camera/aligned_depth_to_color/image_raw", 10**9 * k, depth, "16UC1") for k in (1, 2)]
    messages += [ros.info("/camera/aligned_depth_to_color/camera_info")]
    messages += [
        ros.image("/camera/confidence/image_rect_raw", 10**9 * k, IMAGES[0][:24, :32, 0], "mono8") for k in (1, 2)
    ]
    recording = open_recordings([write_mcap(tmp_path / PATH, messages)])
    for frame in recording.frames("camera", range(2), depth=True):
        assert isinstance(frame, Frame), frame
        assert frame.depth_m is not None
        assert frame.confidence is None


def merged(out: Path, *paths: Path) -> Path:
    """The messages of MCAP files in one."""
    with out.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start("ros2")
        for path in paths:
            channels: dict[int, int] = {}
            for schema, channel, message in make_reader(BytesIO(path.read_bytes())).iter_messages():
                assert schema is not None
                if channel.id not in channels:
                    same = writer.register_schema(schema.name, schema.encoding, schema.data)
                    channels[channel.id] = writer.register_channel(channel.topic, "cdr", same, channel.metadata)
                writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    return out


def test_cameras_of_drivers_are_read_beside_those_that_rigcal_wrote(tmp_path: Path):
    """Of the latter the names are in metadata, and front_rect's images are not rectified."""
    ros, messages, d = Ros(2), list[Message](), np.full(5, 0.1)
    for name in ("left", "front"):
        messages += [*images(ros, f"/{name}/image_raw", name), ros.info(f"/{name}/camera_info")]
    frames = McapFrames(
        tmp_path / "own.mcap",
        [Camera(name=name, width=SIZE[0], height=SIZE[1], K=K, distortion=d) for name in ("front_rect", "123")],
        (),
    )
    for name in ("front_rect", "123"):
        frames.store(frames.packed(Frame(camera=name, stamp_ns=10**9, image=IMAGES[0])))
    frames.finish()
    both = merged(tmp_path / "both.mcap", tmp_path / "own.mcap", write_mcap(tmp_path / PATH, messages))
    recording = open_recordings([both])
    assert {camera.name: camera.has_distortion for camera in recording.cameras} == {
        "123": True,
        "front": False,
        "front_rect": True,
        "left": False,
    }
    assert [len(recording.stamps_ns(name)) for name in ("123", "front", "front_rect", "left")] == [1, 2, 1, 2]


def test_without_camera_info_the_remedies_are_named(tmp_path: Path):
    with pytest.raises(InputError) as caught:
        opened(tmp_path, images(Ros(2)))
    assert "no CameraInfo beside /cam/image_raw; record the camera_info topics too, name them with --topics" in str(
        caught.value
    )


def test_a_camera_without_camera_info_is_left_out_beside_others(tmp_path: Path, told: list[str]):
    ros = Ros(2)
    messages = [*images(ros, "/a/image_raw"), ros.info("/a/camera_info"), *images(ros, "/b/image_raw")]
    assert sorted(opened(tmp_path, messages)) == ["a"]
    assert any("/b/image_raw is left out, it has no CameraInfo" in line for line in told)


@pytest.mark.parametrize(
    ("info", "why"),
    [
        ({"k": np.zeros((3, 3))}, "its CameraInfo is empty (K is zero)"),
        ({"size": (640, 480)}, "images are 64 x 48, but its CameraInfo says 640 x 480"),
        ({"model": "double_sphere", "d": [0.5, 0.5]}, "the distortion model 'double_sphere' is not known"),
    ],
)
def test_a_camera_of_unusable_camera_info_is_left_out_beside_others(
    info: dict[str, object], why: str, tmp_path: Path, said: list[str]
):
    """As the eyes of an OAK whose colour camera alone is calibrated."""
    ros, messages = Ros(2), list[Message]()
    for name, fields in (("left", info), ("rgb", {}), ("right", info)):
        messages += [*images(ros, f"/oak/{name}/image_raw", name), ros.info(f"/oak/{name}/camera_info", **fields)]  # type: ignore[arg-type]
    assert list(opened(tmp_path, messages)) == ["oak_rgb"]
    assert len(said) == 2
    for line, name in zip(said, ("left", "right")):
        assert line.startswith(f"{tmp_path / PATH}: /oak/{name}/image_raw is left out: camera oak_{name}: ")
        assert why in line


def test_where_all_camera_info_is_unusable_the_first_is_named(tmp_path: Path, said: list[str]):
    ros, messages = Ros(2), list[Message]()
    for name in "ab":
        messages += [*images(ros, f"/{name}/image_raw", name), ros.info(f"/{name}/camera_info", k=np.zeros((3, 3)))]
    with pytest.raises(InputError, match="camera a: its CameraInfo is empty"):
        opened(tmp_path, messages)
    assert said == []


def test_intrinsics_that_change_are_told(tmp_path: Path, told: list[str]):
    ros = Ros(2)
    other = K.copy()
    other[0, 0] += 1
    infos = [ros.info("/cam/camera_info", 10**9), ros.info("/cam/camera_info", 2 * 10**9, k=other)]
    np.testing.assert_array_equal(opened(tmp_path, [*images(ros), *infos])["cam"].K, K)
    assert any("/cam/camera_info changes during the recording; the first is used" in line for line in told)


@pytest.mark.parametrize("name", ["..", "a/b", "../x"])
def test_names_that_lead_elsewhere_are_refused(name: str, tmp_path: Path):
    ros = Ros(2)
    with pytest.raises(InputError, match="a folder cannot have this name"):
        opened(tmp_path, [*images(ros), ros.info("/cam/camera_info")], topics=(f"{name}=/cam/image_raw",))


def test_an_image_of_another_size_is_a_bad_frame(tmp_path: Path):
    ros = Ros(2)
    small = ros.image("/cam/image_raw", 3 * 10**9, IMAGES[0][:10], "bgr8")
    path = write_mcap(tmp_path / PATH, [*images(ros), small, ros.info("/cam/camera_info")])
    found = list(open_recordings([path]).frames("cam", range(3)))
    assert [isinstance(frame, Frame) for frame in found] == [True, True, False]
    assert isinstance(found[2], BadFrame)
    assert "is 64 x 10, but the intrinsics are of 64 x 48" in found[2].reason


def test_depth_of_a_distorted_image_is_straightened(tmp_path: Path):
    """A depth edge, seen through the image's lens, comes out where a pinhole with the same K has it."""
    ros = Ros(2)
    d = [4.0, 0.0, 0.0, 0.0, 0.0]  # far more than a sensor has, to see it in 64 pixels
    lens = Camera(name="x", width=SIZE[0], height=SIZE[1], K=K, distortion=np.array(d))
    from aruco.lens import straighten

    columns, rows = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    pinhole = straighten(lens, np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float))
    edge = 50.0
    recorded = np.where(pinhole[:, 0] < edge, 1000, 2000).reshape(SIZE[1], SIZE[0]).astype(np.uint16)
    messages = [
        *images(ros, "/cam/color/image_raw"),
        ros.info("/cam/color/camera_info", d=d),
        *(ros.image("/cam/aligned_depth_to_color/image_raw", 10**9 * k, recorded, "16UC1") for k in (1, 2)),
        ros.info("/cam/aligned_depth_to_color/camera_info", d=d),
    ]
    recording = open_recordings([write_mcap(tmp_path / PATH, messages)])
    (frame,) = recording.frames("cam", [0], depth=True)
    assert isinstance(frame, Frame)
    assert frame.depth_m is not None
    wanted = np.where(columns < edge, np.float32(1.0), np.float32(2.0))
    inner = (columns > 2) & (columns < 61) & (rows > 2) & (rows < 45)
    wrong = inner & (np.abs(frame.depth_m - wanted) > 0.5)
    # The nearest pixel is taken, so the edge may be one column away.
    assert set(columns[wrong]) <= {49, 50}
    as_recorded = inner & (np.abs(recorded * 0.001 - wanted) > 0.5)
    assert len(set(columns[as_recorded])) >= 3
