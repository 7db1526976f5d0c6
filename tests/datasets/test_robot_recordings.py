"""dataset=mcap on recordings of robots."""

from __future__ import annotations

import json
import logging
import struct
import sys
from base64 import b64encode
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.writer import CompressionType, IndexType, Writer
from mcap_protobuf.writer import Writer as ProtobufWriter

from trihedron.datasets.mcap import McapDataset
from trihedron.pipeline.errors import DataError, RecordingError
from trihedron.pipeline.geometry import exp_se3, invert

sys.path.insert(0, str(Path(__file__).parent))
from robot_files import (
    COLOR,
    DEPTH,
    SECOND,
    Message,
    Wall,
    camera_info,
    compressed,
    encoded,
    header,
    image,
    make,
    message,
    pose,
    transforms,
    write_bag,
    write_file,
)

WALL = Wall()
STEP = 33_000_000
BEGIN = 1_700_000_000 * SECOND


def millimetres(depth_m: np.ndarray) -> np.ndarray:
    return np.rint(depth_m * 1000).astype(np.uint16)


def registered(frames: int = 4, color_topic: str = "/camera/color/image_raw", depth_topic: str = "/camera/aligned_depth/image_raw") -> list[Message]:
    """Colour and registered depth (4 ms later), the intrinsics beside each."""
    found = []
    for k in range(frames):
        stamp = BEGIN + k * STEP
        found.append(camera_info("/camera/color/camera_info", stamp, COLOR, WALL.size, WALL.K))
        found.append(image(color_topic, stamp, COLOR, "rgb8", WALL.color() + np.uint8(k)))
        found.append(camera_info("/camera/aligned_depth/camera_info", stamp, COLOR, WALL.size, WALL.K))
        found.append(image(depth_topic, stamp + 4_000_000, COLOR, "16UC1", millimetres(WALL.depth_in_color())))
    return found


def check_registered(dataset: McapDataset, frames: int = 4) -> None:
    assert len(dataset) == frames
    for k in range(frames):
        frame = dataset(k)
        assert frame is not None and (frame.index, frame.stamp_ns) == (k, BEGIN + k * STEP)
        assert (frame.color == WALL.color() + np.uint8(k)).all()
        assert np.abs(frame.depth_m - WALL.depth_in_color()).max() < 0.00051
    assert frame.camera.fx == 60.0 and (frame.camera.width, frame.camera.height) == WALL.size
    assert frame.camera.fps == pytest.approx(1e9 / STEP if frames > 1 else 30.0, abs=0.001)


PACKED = {
    "lz4": {},
    "zstd": {"compression": CompressionType.ZSTD},
    "plain": {"compression": CompressionType.NONE},
    "no chunks": {"use_chunking": False},
    "no index": {"index_types": IndexType.NONE},
    "no message index": {"index_types": IndexType.ALL & ~IndexType.MESSAGE},
    "nothing repeated": {"repeat_channels": False, "repeat_schemas": False, "use_statistics": False},
}


@pytest.mark.parametrize("packed", PACKED)
def test_registered_depth_however_the_file_is_packed(tmp_path: Path, packed: str) -> None:
    check_registered(McapDataset(str(write_file(tmp_path / "robot.mcap", registered(), **PACKED[packed]))))


@pytest.mark.parametrize("zstd", [False, True])
def test_a_folder_that_ros2_bag_would_make(tmp_path: Path, zstd: bool) -> None:
    check_registered(McapDataset(str(write_bag(tmp_path / "bag", registered(), zstd))))


@pytest.mark.parametrize("packed", ["lz4", "plain", "no chunks"])
def test_a_file_that_is_cut_off_is_read_as_far_as_it_is_whole(tmp_path: Path, caplog: pytest.LogCaptureFixture, packed: str) -> None:
    path = write_file(tmp_path / "robot.mcap", registered(20), **{"chunk_size": 20_000, **PACKED[packed]})
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 6 // 10])
    with caplog.at_level(logging.WARNING, logger="trihedron"):
        dataset = McapDataset(str(path))
        assert 9 <= len(dataset) <= 12
    assert caplog.messages == [f"{path} is cut off; what is whole of it is read"]
    assert all(dataset(k) is not None for k in range(len(dataset)))


def test_frames_come_in_any_order_from_any_thread(tmp_path: Path) -> None:
    path = write_file(tmp_path / "robot.mcap", registered(30), chunk_size=20_000)
    dataset = McapDataset(str(path), frames="5:25")
    assert len(dataset) == 20
    order = np.random.default_rng(0).permutation(np.repeat(np.arange(20), 5)).tolist()
    with ThreadPoolExecutor(4) as pool:
        for k, frame in zip(order, pool.map(dataset, order)):
            assert frame is not None and frame.index == k + 5
            assert (frame.color == WALL.color() + np.uint8(k + 5)).all()


COLORS = {
    "rgb8": (WALL.color(), {}),
    "bgr8": (WALL.color()[..., ::-1], {}),
    "rgba8": (WALL.color(4), {"pad": 3}),
    "bgra8": (WALL.color(4)[..., [2, 1, 0, 3]], {}),
    "8UC3": (WALL.color()[..., ::-1], {"pad": 5}),
}


@pytest.mark.parametrize("encoding", COLORS)
def test_encodings_of_colour(tmp_path: Path, encoding: str) -> None:
    pixels, options = COLORS[encoding]
    messages = registered(1)
    messages[1] = image("/camera/color/image_raw", BEGIN, COLOR, encoding, pixels, **options)
    check_registered(McapDataset(str(write_file(tmp_path / "robot.mcap", messages))), 1)


@pytest.mark.parametrize("sent", ["mono8", "jpeg", "png", "grey png"])
def test_grey_and_compressed_colour(tmp_path: Path, sent: str) -> None:
    messages, grey, smooth = registered(1), WALL.color()[..., 0], cv2.GaussianBlur(WALL.color(), (9, 9), 3)
    if sent == "mono8":
        messages[1], expected = image("/camera/color/image_raw", BEGIN, COLOR, "mono8", grey, pad=1), np.repeat(grey[..., None], 3, axis=2)
    elif sent == "grey png":
        messages[1], expected = (
            compressed("/camera/color/image_raw/compressed", BEGIN, COLOR, "mono8; png compressed", encoded(".png", grey)),
            grey[..., None],
        )
    else:
        form = "rgb8; jpeg compressed bgr8" if sent == "jpeg" else "rgb8; png compressed bgr8"
        expected = smooth if sent == "jpeg" else WALL.color()
        messages[1] = compressed("/camera/color/image_raw/compressed", BEGIN, COLOR, form, encoded(f".{sent}", expected[..., ::-1]))
    frame = McapDataset(str(write_file(tmp_path / "robot.mcap", messages)))(0)
    assert frame is not None
    assert np.abs(frame.color.astype(int) - expected).mean() < (4.0 if sent == "jpeg" else 1e-9)


def depth_message(sent: str) -> Message:
    """The registered depth, with a hole at (3, 7), sent in one of the ways there are."""
    depth, topic, raw = WALL.depth_in_color(), "/camera/aligned_depth/image_raw", "sensor"
    depth[3, 7] = 0.0
    nan = np.where(depth > 0, depth, np.nan).astype(np.float32)
    nan[0, 0] = np.inf
    if sent in ("16UC1", "mono16"):
        return image(topic, BEGIN, COLOR, sent, millimetres(depth), pad=2)
    if sent == "16UC1 big endian":
        return image(topic, BEGIN, COLOR, "16UC1", millimetres(depth), big_endian=True)
    if sent == "32FC1":
        return image(topic, BEGIN, COLOR, "32FC1", nan, pad=4)
    if sent == "32FC1 big endian":
        return image(topic, BEGIN, COLOR, "32FC1", nan, big_endian=True)
    if sent == "png":
        return compressed(f"{topic}/compressed", BEGIN, COLOR, "16UC1; png compressed ", encoded(".png", millimetres(depth)))
    if sent == "16UC1; compressedDepth png":
        return compressed(f"{topic}/compressedDepth", BEGIN, COLOR, sent, struct.pack("<iff", 0, 0.0, 0.0) + encoded(".png", millimetres(depth)))
    assert raw and sent == "32FC1; compressedDepth png"
    a, b = 100.0 * (100.0 + 1.0), 1.0 - 100.0 * (100.0 + 1.0) / 10.0  # quantisation 100, 10 m at most: as compressed_depth_image_transport
    values = np.where(np.isfinite(nan) & (nan > 0), a / np.maximum(depth, 0.1) + b, 0).astype(np.uint16)
    return compressed(f"{topic}/compressedDepth", BEGIN, COLOR, sent, struct.pack("<iff", 0, a, b) + encoded(".png", values))


WAYS = ["16UC1", "mono16", "16UC1 big endian", "32FC1", "32FC1 big endian", "png", "16UC1; compressedDepth png", "32FC1; compressedDepth png"]


@pytest.mark.parametrize("sent", WAYS)
def test_encodings_of_depth(tmp_path: Path, sent: str) -> None:
    messages = registered(1)
    messages[3] = depth_message(sent)
    frame = McapDataset(str(write_file(tmp_path / "robot.mcap", messages)))(0)
    assert frame is not None and frame.depth_m[3, 7] == 0.0
    expected = WALL.depth_in_color()
    seen = frame.depth_m > 0
    assert seen.sum() == seen.size - (2 if sent.startswith("32FC1") else 1)
    # a step of the quantised inverse depth is z² / a: 0.9 mm at 3 m
    assert np.abs(frame.depth_m - expected)[seen].max() < (0.0011 if sent.startswith("32FC1; c") else 0.00051)


@pytest.mark.parametrize("lens", ["plumb_bob", "rational_polynomial"])
def test_distorted_colour_is_undistorted(tmp_path: Path, lens: str) -> None:
    """A straight edge, bent by the lens, is straight again, and depth goes with it."""
    D = [-0.6, 0.2, 0.001, -0.002, 0.0] if lens == "plumb_bob" else [0.1, -0.1, 0.001, -0.002, 0.01, 0.7, 0.1, -0.01]
    x, y = np.meshgrid(np.arange(64, dtype=np.float32), np.arange(48, dtype=np.float32))
    rays = cv2.undistortPoints(np.stack([x, y], -1).reshape(-1, 1, 2), WALL.K, np.array(D)).reshape(48, 64, 2)
    bent = np.where(rays[..., 0] * 60 + 31.5 < 12.0, 0, 255).astype(np.uint8)
    depth = np.where(bent > 0, 2000, 1000).astype(np.uint16)
    messages = registered(1)
    messages[0] = camera_info("/camera/color/camera_info", BEGIN, COLOR, WALL.size, WALL.K, D, lens)
    messages[1] = image("/camera/color/image_raw", BEGIN, COLOR, "rgb8", np.repeat(bent[..., None], 3, axis=2))
    messages[2:] = [image("/camera/aligned_depth/image_raw", BEGIN, COLOR, "16UC1", depth)]
    frame = McapDataset(str(write_file(tmp_path / "robot.mcap", messages)))(0)
    assert frame is not None
    edges = [int(np.argmax(row > 127)) for row in frame.gray]
    assert max(edges) - min(edges) <= 1 and abs(np.mean(edges) - 12.0) < 1.0
    steps = [int(np.argmax(row > 1.5)) for row in frame.depth_m]
    assert max(steps) - min(steps) <= 1 and abs(np.mean(steps) - 12.0) < 1.0
    bent_edges = [int(np.argmax(row > 127)) for row in bent]
    assert max(bent_edges) - min(bent_edges) >= 2


def test_a_rectified_topic_goes_by_its_projection(tmp_path: Path) -> None:
    P = np.array([[55.0, 0, 30.0, 0], [0, 55.0, 22.0, 0], [0, 0, 1, 0]])
    messages = registered(1, color_topic="/camera/color/image_rect_color")
    messages[0] = camera_info("/camera/color/camera_info", BEGIN, COLOR, WALL.size, WALL.K, [-0.3, 0.1, 0, 0, 0], P=P)
    messages.pop(2)
    frame = McapDataset(str(write_file(tmp_path / "robot.mcap", messages)))(0)
    assert frame is not None and (frame.camera.fx, frame.camera.cx, frame.camera.cy) == (55.0, 30.0, 22.0)
    assert (frame.color == WALL.color()).all()


MOUNT = exp_se3(np.array([0.03, -0.01, 0.005, 0.01, -0.02, 0.015]))


def unregistered(wall: Wall, links: list[Message], depth_D: Any = (), depth: np.ndarray | None = None) -> list[Message]:
    seen = wall.depth() if depth is None else depth
    return [
        camera_info("/camera/color/camera_info", BEGIN, COLOR, wall.size, wall.K),
        image("/camera/color/image_raw", BEGIN, COLOR, "rgb8", wall.color()),
        camera_info("/camera/depth/camera_info", BEGIN, DEPTH, wall.depth_size, wall.depth_K, depth_D),
        image("/camera/depth/image_rect_raw" if not len(depth_D) else "/camera/depth/image_raw", BEGIN, DEPTH, "32FC1", seen.astype(np.float32)),
        *links,
    ]


def static(T: np.ndarray = MOUNT) -> list[Message]:
    """The way from colour to depth through two other frames, in two messages."""
    on_body = exp_se3(np.array([0.1, 0.2, 0.3, 0.5, -0.4, 0.3]))
    first = transforms("/tf_static", [(BEGIN, "camera_link", COLOR, on_body), (BEGIN, "base_link", "camera_link", np.eye(4))])
    return [first, transforms("/tf_static", [(BEGIN, "camera_link", DEPTH, on_body @ T)])]


@pytest.mark.parametrize("depth_size", [(48, 36), (128, 96)], ids=["coarser", "finer"])
def test_depth_is_registered_to_colour(tmp_path: Path, depth_size: tuple[int, int]) -> None:
    """A slanted wall: at each pixel of colour that the depth camera sees, the depth is that of the wall to half a pixel of slant."""
    scale = depth_size[0] / 48
    K = np.diag([scale, scale, 1.0]) @ Wall().depth_K
    wall = Wall(depth_size=depth_size, depth_K=K, T_color_depth=MOUNT)
    frame = McapDataset(str(write_file(tmp_path / "robot.mcap", unregistered(wall, static()))))(0)
    assert frame is not None
    inside = frame.depth_m[4:-4, 4:-4]
    error = np.abs(inside - wall.depth_in_color()[4:-4, 4:-4])[inside > 0]
    pixel = 1.0 / (40.0 * scale)
    print(
        f"depth of {depth_size}: {np.mean(inside > 0):.4f} of the pixels, error mean {1e3 * error.mean():.2f} mm, largest {1e3 * error.max():.2f} mm"
    )
    assert (inside > 0).mean() > (0.999 if depth_size == (48, 36) else 0.97)
    assert error.max() < 2.0**2 * 0.25 * 1.5 * pixel / 2 + 0.002
    assert error.mean() < error.max() / 2


def test_the_nearest_surface_is_on_top(tmp_path: Path) -> None:
    """A post 1 m away before a wall at 3 m, seen from 20 cm to the right: its place in colour is that of the post alone."""
    T = np.eye(4)
    T[0, 3] = 0.2
    wall = Wall(n=np.array([0.0, 0.0, 1.0]), d=3.0, depth_size=(64, 48), depth_K=Wall().K, T_color_depth=T)
    depth = wall.depth()
    depth[:, 20:30] = 1.0  # x = (20 - 31.5) / 60 .. (30 - 31.5) / 60 at 1 m, 12 pixels further right in colour: 32..42
    frame = McapDataset(str(write_file(tmp_path / "robot.mcap", unregistered(wall, static(T), depth=depth))))(0)
    assert frame is not None
    assert (frame.depth_m[:, 32:42] == 1.0).all()
    assert set(np.unique(frame.depth_m[:, :32])) <= {0.0, 3.0} and set(np.unique(frame.depth_m[:, 42:])) <= {0.0, 3.0}
    assert (frame.depth_m[:, 42:] == 3.0).all()


def test_a_distorted_depth_camera(tmp_path: Path) -> None:
    D = np.array([-0.25, 0.08, 0.001, 0.0, 0.0])
    wall = Wall(T_color_depth=MOUNT)
    x, y = np.meshgrid(np.arange(48.0), np.arange(36.0))
    rays = cv2.undistortPoints(np.stack([x, y], -1).reshape(-1, 1, 2), wall.depth_K, D).reshape(36, 48, 2)
    R, t = MOUNT[:3, :3], MOUNT[:3, 3]
    seen = (wall.d - wall.n @ t) / (np.concatenate([rays, np.ones((36, 48, 1))], -1) @ (R.T @ wall.n))
    frame = McapDataset(str(write_file(tmp_path / "robot.mcap", unregistered(wall, static(), D, seen))))(0)
    assert frame is not None
    inside = frame.depth_m[4:-4, 4:-4]
    error = np.abs(inside - wall.depth_in_color()[4:-4, 4:-4])[inside > 0]
    assert (inside > 0).mean() > 0.99 and error.max() < 0.02 and error.mean() < 0.008


def test_without_transform_the_error_names_the_frames(tmp_path: Path) -> None:
    path = write_file(tmp_path / "robot.mcap", unregistered(Wall(), []))
    dataset = McapDataset(str(path))
    with pytest.raises(DataError) as caught:
        dataset(0)
    assert str(caught.value) == (
        f"{path}: holds no transform from '{DEPTH}' to '{COLOR}', which registering depth to colour needs; "
        "record /tf_static too, or the topic of registered depth"
    )


def test_several_topics_are_named_and_an_option_chooses(tmp_path: Path) -> None:
    other = [image("/left/image_raw", BEGIN + k * STEP, "left", "bgr8", WALL.color()) for k in range(4)]
    grey = [image("/infra/image_raw", BEGIN + k * STEP, "infra", "mono8", WALL.color()[..., 0]) for k in range(4)]
    copies = [compressed("/camera/color/image_raw/compressed", BEGIN, COLOR, "jpeg", encoded(".jpg", WALL.color()))]
    path = str(write_file(tmp_path / "robot.mcap", [*registered(), *other, *grey, *copies]))
    with pytest.raises(DataError) as caught:
        len(McapDataset(path))
    assert str(caught.value) == (
        f"{path}: holds several topics of colour images: /camera/color/image_raw, /left/image_raw; choose one with dataset.color_topic=TOPIC"
    )
    check_registered(McapDataset(path, color_topic="/camera/color/image_raw"))
    with pytest.raises(DataError, match=r"dataset\.color_topic: the topic '/camera/color/image' is not in the recording; did you mean"):
        len(McapDataset(path, color_topic="/camera/color/image"))
    with pytest.raises(DataError, match=r"the topic '/camera/color/camera_info' holds other things"):
        len(McapDataset(path, color_topic="/left/image_raw", depth_topic="/camera/color/camera_info"))


def test_several_intrinsics_are_named_and_an_option_chooses(tmp_path: Path) -> None:
    messages = [m for m in registered() if m[1] != "sensor_msgs/msg/CameraInfo"]
    messages += [camera_info(f"/camera/color/{name}", BEGIN, COLOR, WALL.size, WALL.K) for name in ("info_1", "info_2")]
    path = str(write_file(tmp_path / "robot.mcap", messages))
    with pytest.raises(DataError) as caught:
        McapDataset(path)(0)
    assert str(caught.value).endswith("/color/info_1, /camera/color/info_2; choose one with dataset.color_info_topic=TOPIC")
    check_registered(McapDataset(path, color_info_topic="/camera/color/info_2", depth_info_topic="/camera/color/info_2"))


def test_what_is_missing_is_said_in_one_line(tmp_path: Path) -> None:
    only_color = [m for m in registered() if "depth" not in m[0]]
    with pytest.raises(DataError, match=r"holds no depth images; its topics are /camera/color/camera_info, /camera/color/image_raw"):
        len(McapDataset(str(write_file(tmp_path / "a.mcap", only_color))))
    blind = [m for m in registered() if m[1] != "sensor_msgs/msg/CameraInfo"]
    with pytest.raises(DataError, match="holds no camera intrinsics for /camera/color/image_raw; record the camera's calibration too"):
        McapDataset(str(write_file(tmp_path / "b.mcap", blind)))(0)
    late = [(topic, kind, log_time, data) for topic, kind, log_time, data in registered(1)]
    late[3] = image("/camera/aligned_depth/image_raw", BEGIN + 50_000_000, COLOR, "16UC1", millimetres(WALL.depth_in_color()))
    path = str(write_file(tmp_path / "c.mcap", late))
    with pytest.raises(DataError, match=r"is within 20 ms of one of .*; raise dataset.max_difference_ms or give dataset.depth_delay_ms"):
        len(McapDataset(path))
    assert len(McapDataset(path, depth_delay_ms=-45.0)) == 1 == len(McapDataset(path, max_difference_ms=60.0))
    with pytest.raises(DataError, match="holds no colour images; its topics are none"):
        len(McapDataset(str(write_file(tmp_path / "d.mcap", []))))
    with pytest.raises(RecordingError, match="is not an MCAP file"):
        (tmp_path / "e.mcap").write_bytes(b"rubbish, much of it")
        len(McapDataset(str(tmp_path / "e.mcap")))
    fisheye = registered(1)
    fisheye[0] = camera_info("/camera/color/camera_info", BEGIN, COLOR, WALL.size, WALL.K, [0.1, 0.0, 0.0, 0.0], "equidistant")
    with pytest.raises(DataError, match="the lens model 'equidistant' of /camera/color/image_raw with 4 coefficients is not known"):
        McapDataset(str(write_file(tmp_path / "f.mcap", fisheye)))(0)


def test_a_damaged_image_is_one_warning_and_no_frame(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    messages = registered(4)
    topic, kind, log_time, data = messages[9]  # colour of frame 2
    messages[9] = (topic, kind, log_time, data[:200])
    topic, kind, log_time, data = messages[15]  # depth of frame 3, of another size
    messages[15] = image(topic, BEGIN + 3 * STEP, COLOR, "16UC1", np.ones((48, 40), np.uint16))
    path = write_file(tmp_path / "robot.mcap", messages)
    dataset = McapDataset(str(path))
    assert len(dataset) == 4
    with caplog.at_level(logging.WARNING, logger="trihedron"):
        assert [dataset(k) is None for k in range(4)] == [False, False, True, True]
    assert caplog.messages[-1] == f"{path}: image 3 of /camera/aligned_depth/image_raw is 40×48 while the first is 64×48; frame 3 is skipped"
    assert "image 2 of /camera/color/image_raw" in caplog.messages[0] and len(caplog.messages) == 2


def motion(seconds: float) -> np.ndarray:
    return exp_se3(np.array([0.5 * seconds, 0.1, 0.0, 0.0, 0.3 * seconds, 0.1]))


def test_truth_from_transforms(tmp_path: Path) -> None:
    """map -> odom -> base -> camera, the second of them moving, said at other times than the images'."""
    mount = exp_se3(np.array([0.2, 0.0, 0.1, 0.3, 0.2, -0.1]))
    T_map_odom = exp_se3(np.array([1.0, 2.0, 0.0, 0.0, 0.0, 0.5]))
    links = [transforms("/tf_static", [(BEGIN, "base", COLOR, mount), (BEGIN, "map", "odom", T_map_odom)])]
    links += [transforms("/tf", [(BEGIN + k * 20_000_000 + 7_000_000, "odom", "base", motion(k * 0.02 + 0.007))]) for k in range(8)]
    path = str(write_file(tmp_path / "robot.mcap", [*registered(6), *links]))
    truth = McapDataset(path, truth_from="map").truth()
    assert truth is not None
    assert truth.stamps_ns.tolist() == [BEGIN + k * STEP for k in range(1, 5)]  # never beyond what was said: 7 ms to 147 ms
    for stamp, T in zip(truth.stamps_ns, truth.poses):
        expected = T_map_odom @ motion((stamp - BEGIN) / 1e9) @ mount
        assert np.abs(invert(expected) @ T - np.eye(4)).max() < 2e-5
    assert McapDataset(path).truth() is None
    with pytest.raises(DataError, match="'world' says nothing of the camera"):
        McapDataset(path, truth_from="world").truth()


def test_truth_from_a_topic_of_poses(tmp_path: Path) -> None:
    mount = exp_se3(np.array([0.2, 0.0, 0.1, 0.3, 0.2, -0.1]))
    stamped, said = "geometry_msgs/msg/PoseStamped", []
    for k in range(5):
        stamp = BEGIN + k * 10_000_000
        said.append(message("/mocap/pose", stamped, stamp, make(stamped, header=header(stamp, "world"), pose=pose(motion(k)))))
        covariance = make("geometry_msgs/msg/PoseWithCovariance", pose=pose(motion(k)), covariance=np.zeros(36))
        zero = make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        twist = make(
            "geometry_msgs/msg/TwistWithCovariance", twist=make("geometry_msgs/msg/Twist", linear=zero, angular=zero), covariance=np.zeros(36)
        )
        odometry = make("nav_msgs/msg/Odometry", header=header(stamp, "odom"), child_frame_id="base", pose=covariance, twist=twist)
        said.append(message("/odom", "nav_msgs/msg/Odometry", stamp, odometry, little_endian=False))
    links = [transforms("/tf_static", [(BEGIN, "base", COLOR, mount)])]
    path = str(write_file(tmp_path / "robot.mcap", [*registered(2), *said, *links]))
    for topic, on_body in (("/mocap/pose", np.eye(4)), ("/odom", mount)):
        truth = McapDataset(path, truth_from=topic).truth()
        assert truth is not None and len(truth.stamps_ns) == 5
        np.testing.assert_allclose(truth.poses, [motion(k) @ on_body for k in range(5)], atol=1e-9)
    with pytest.raises(DataError, match="did you mean '/mocap/pose'"):
        McapDataset(path, truth_from="/mocap/poses").truth()


def foxglove_values(k: int) -> list[tuple[str, Any]]:
    stamp = Timestamp(seconds=BEGIN // SECOND, nanos=k * STEP)
    depth = millimetres(WALL.depth_in_color())
    calibration = CameraCalibration(
        timestamp=stamp, frame_id="cam", width=64, height=48, distortion_model="plumb_bob", D=[0.0] * 5, K=WALL.K.reshape(-1),
        R=np.eye(3).reshape(-1), P=np.column_stack([WALL.K, np.zeros(3)]).reshape(-1),
    )  # fmt: skip
    picture = encoded(".png", (WALL.color() + np.uint8(k))[..., ::-1])
    raw = RawImage(timestamp=stamp, frame_id="cam", width=64, height=48, encoding="16UC1", step=128, data=depth.tobytes())
    link = FrameTransform(timestamp=stamp, parent_frame_id="world", child_frame_id="cam")
    link.translation.x, link.rotation.w = 0.25 * k, 1.0
    return [
        ("/camera/calibration", calibration),
        ("/camera/image", CompressedImage(timestamp=stamp, frame_id="cam", data=picture, format="png")),
        ("/camera/depth", raw),
        ("/tf", link),
    ]


def as_json(value: Any) -> dict[str, Any]:
    """Foxglove's JSON: times as sec and nsec, bytes as base64."""
    found: dict[str, Any] = {}
    for field in value.DESCRIPTOR.fields:
        content = getattr(value, field.name)
        if field.name == "timestamp":
            content = {"sec": content.seconds, "nsec": content.nanos}
        elif isinstance(content, bytes):
            content = b64encode(content).decode()
        elif field.message_type is not None:
            content = as_json(content)
        elif not isinstance(content, (str, int, float)):
            content = list(content)
        found[field.name] = content
    return found


@pytest.mark.parametrize("encoding", ["protobuf", "json"])
def test_foxglove_schemas(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "foxglove.mcap"
    with open(path, "wb") as file:
        if encoding == "protobuf":
            with ProtobufWriter(file) as writer:
                for k in range(4):
                    for topic, value in foxglove_values(k):
                        writer.write_message(topic, value, BEGIN + k * STEP, BEGIN + k * STEP)
        else:
            plain = Writer(file)
            plain.start()
            channels: dict[str, int] = {}
            for k in range(4):
                for topic, value in foxglove_values(k):
                    if topic not in channels:
                        schema = plain.register_schema(value.DESCRIPTOR.full_name, "jsonschema", b"{}")
                        channels[topic] = plain.register_channel(topic, "json", schema)
                    plain.add_message(channels[topic], BEGIN + k * STEP, json.dumps(as_json(value)).encode(), BEGIN + k * STEP)
            plain.finish()
    check_registered(McapDataset(str(path)))
    truth = McapDataset(str(path), truth_from="world").truth()
    assert truth is not None
    np.testing.assert_allclose(truth.poses[:, 0, 3], [0.0, 0.25, 0.5, 0.75])
