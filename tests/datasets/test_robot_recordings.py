"""dataset=mcap on recordings of robots: files however packed, topics chosen, what is missing, truth."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.writer import CompressionType, IndexType
from rosbags.rosbag2.enums import CompressionMode

from trihedron.datasets.readers.folder import Folder
from trihedron.datasets.readers.mcap import McapDataset
from trihedron.datasets.readers.rolling_shutter import SteadyFrames, look_at
from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.errors import DataError, RecordingError
from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.lie import exp_se3
from trihedron.tools.convert import layout_of

sys.path.insert(0, str(Path(__file__).parent))
from robot_files import (
    COLOR,
    Message,
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
    write_ros1,
    write_sqlite,
)
from robot_scene import BEGIN, STEP, WALL, check_registered, millimetres, registered

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


def test_an_unfinished_folder_of_ros2_bag(tmp_path: Path) -> None:
    """Without metadata.yaml, which is written at the end."""
    folder = write_bag(tmp_path / "bag", registered()).parent
    (folder / "metadata.yaml").unlink()
    check_registered(McapDataset(str(folder)))


BAGS: dict[str, Callable[[Path, list[Message]], Path]] = {
    "sqlite3": write_sqlite,
    "sqlite3, file compressed": partial(write_sqlite, compression=CompressionMode.FILE),
    "sqlite3, messages compressed": partial(write_sqlite, compression=CompressionMode.MESSAGE),
    "mcap": lambda path, messages: write_bag(path, messages, zstd=True).parent,
    "ROS 1": lambda path, messages: write_ros1(path.with_suffix(".bag"), messages),
    "ROS 1, lz4": lambda path, messages: write_ros1(path.with_suffix(".bag"), messages, lz4=True),
}


@pytest.mark.parametrize("kind", BAGS)
def test_bags_of_ros(tmp_path: Path, kind: str) -> None:
    """Frames, transforms and poses as in an MCAP file, in any order from any thread."""
    links = [transforms("/tf", [(BEGIN + k * STEP, "map", COLOR, exp_se3(np.full(6, 0.1 * k)))]) for k in range(4)]
    path = BAGS[kind](tmp_path / "bag", [*registered(), *links])
    assert layout_of(path) == "mcap"
    dataset = McapDataset(str(path), truth_from="map")
    check_registered(dataset)
    truth = dataset.truth()
    assert truth is not None and np.allclose(truth.poses, [exp_se3(np.full(6, 0.1 * k)) for k in range(4)])
    order = [3, 0, 2, 1] * 5
    with ThreadPoolExecutor(4) as pool:
        for k, frame in zip(order, pool.map(McapDataset(str(path)), order)):
            assert frame is not None and frame.index == k and (frame.color == WALL.color() + np.uint8(k)).all()


def test_bags_with_messages_of_one_time_and_topics_of_other_types(tmp_path: Path) -> None:
    together = [(topic, kind, BEGIN, data) for topic, kind, _, data in registered()]
    point = make("geometry_msgs/msg/Point", x=1.0, y=2.0, z=3.0)
    path = write_sqlite(tmp_path / "bag", [*together, message("/point", "geometry_msgs/msg/Point", BEGIN, point)])
    check_registered(McapDataset(str(path)))
    with pytest.raises(DataError, match="the topic '/point' holds other things"):
        len(McapDataset(str(path), color_topic="/point"))


@pytest.mark.parametrize("write", [lambda path: write_ros1(path / "a.bag", registered()), lambda path: write_sqlite(path / "a", registered())])
def test_without_rosbags_a_bag_is_not_called_unreadable(tmp_path: Path, write, monkeypatch, capsys) -> None:
    path = write(tmp_path)
    monkeypatch.setitem(sys.modules, "rosbags", None)
    assert main(["run", str(path), "outputs=[keypoints]", f"out={tmp_path / 'out'}"]) == 1
    chosen, error = capsys.readouterr().err.splitlines()
    assert chosen == f"dataset=mcap dataset.path={path}"
    assert error == "trihedron: rosbags: is not installed; install it with: pip install rosbags"


def test_a_damaged_bag_is_one_line(tmp_path: Path) -> None:
    cause = r"cannot be read as a bag of ROS \(.+\); record it again, or convert it with ros2 bag convert$"
    bag = write_ros1(tmp_path / "a.bag", registered())
    data = bag.read_bytes()
    for damaged in (b"", data[:4000], data[: len(data) // 2], b"#ROSBAG V1.2\n" + data[13:], data[:13] + bytes(4096) + data[4109:]):
        bag.write_bytes(damaged)
        with pytest.raises(RecordingError, match=rf"a.bag: {cause}"):
            len(McapDataset(str(bag)))
    folder = write_sqlite(tmp_path / "b", registered())
    (database,) = folder.glob("*.db3")
    metadata = (folder / "metadata.yaml").read_text()
    for text in (
        "",
        "a: &a [*a]",
        "[" * 1000,
        "rosbag2_bagfile_information: {}",
        metadata.replace("sqlite3", "sqlite9"),
        metadata.replace(".db3", ".db4"),
    ):
        (folder / "metadata.yaml").write_text(text)
        with pytest.raises(RecordingError, match=rf"b: {cause}"):
            len(McapDataset(str(folder)))
    (folder / "metadata.yaml").write_text(metadata)
    content = database.read_bytes()
    for damaged in (content[:5000], b"SQLite" + bytes(9000)):
        database.write_bytes(damaged)
        with pytest.raises(RecordingError, match=rf"b: {cause}"):
            len(McapDataset(str(folder)))
    database.unlink()
    os.mkfifo(database)
    with pytest.raises(RecordingError, match=r"is missing, or no regular file"):
        len(McapDataset(str(folder)))


@pytest.mark.parametrize("name, cure", [("walk.mp4", "has no metric depth"), ("k4a.MKV", "azure_kinect_mkv_reader"), ("zed.svo2", "the ZED SDK")])
def test_a_video_is_refused_with_the_cure(tmp_path: Path, name: str, cure: str) -> None:
    (tmp_path / name).write_bytes(b"video")
    for dataset in (McapDataset(str(tmp_path / name)), Folder(str(tmp_path / name))):
        with pytest.raises(DataError, match=rf"{name}: is a video file, which is not read; .*{cure}.*, then use dataset=folder$"):
            len(dataset)


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
    strided = McapDataset(str(path), frames="5:25:8")
    assert len(dataset) == 20 and [frame.index for frame in map(strided, range(len(strided))) if frame] == [5, 13, 21]
    order = np.random.default_rng(0).permutation(np.repeat(np.arange(20), 5)).tolist()
    with ThreadPoolExecutor(4) as pool:
        for k, frame in zip(order, pool.map(dataset, order)):
            assert frame is not None and frame.index == k + 5
            assert (frame.color == WALL.color() + np.uint8(k + 5)).all()


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
    with pytest.raises(DataError, match="the distortion model 'equidistant' of /camera/color/image_raw with 4 coefficients is not known"):
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
    with pytest.raises(DataError, match="'world' does not give the camera"):
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


def test_a_camera_file_describes_the_images_as_they_come_without_it(tmp_path: Path) -> None:
    """Other focal lengths, depth in tenths of a millimetre, and a depth camera beside the colour camera."""
    path = write_file(tmp_path / "robot.mcap", registered())
    stated = McapDataset(path=str(path))
    width, height = WALL.size
    camera = {"width": width, "height": height, "fx": 90.0, "fy": 91.0, "cx": 40.0, "cy": 30.0, "depth_scale": 10_000.0, "fps": 15.0}
    (tmp_path / "camera.yaml").write_text(yaml.safe_dump(camera))
    given = McapDataset(path=str(path), camera=str(tmp_path / "camera.yaml"))
    frames = stated(1), given(1)
    assert (frames[1].camera.fx, frames[1].camera.cy, frames[1].camera.fps) == (90.0, 30.0, 15.0)
    assert np.array_equal(frames[0].color, frames[1].color)
    assert np.allclose(frames[0].depth_m, 10.0 * frames[1].depth_m, rtol=1e-6)
    assert stated.calibration().camera == frames[0].camera and stated.calibration().depth_scale == 1000.0
    assert given.calibration().depth_scale == 10_000.0
    beside = camera | {"depth_scale": 1000.0, "depth_camera": {"fx": 90.0, "fy": 91.0, "cx": 45.0, "cy": 30.0}}
    (tmp_path / "camera.yaml").write_text(yaml.safe_dump(beside))
    moved = McapDataset(path=str(path), camera=str(tmp_path / "camera.yaml"))(1)
    assert np.allclose(moved.depth_m[:, :-5], frames[0].depth_m[:, 5:], rtol=1e-6)


def test_the_skew_of_a_rolling_shutter_is_removed_from_a_recording_as_from_a_folder(tmp_path: Path) -> None:
    path = write_file(tmp_path / "robot.mcap", registered(4))
    width, height = WALL.size
    camera = {"width": width, "height": height, "fx": 90.0, "fy": 90.0, "cx": 40.0, "cy": 30.0, "depth_scale": 1000.0, "readout_s": 0.05}
    (tmp_path / "camera.yaml").write_text(yaml.safe_dump(camera))
    read, steady = McapDataset(path=str(path)), McapDataset(path=str(path), camera=str(tmp_path / "camera.yaml"))
    frames = [read(k) for k in range(4)]
    looks = {k: look_at(k, frame.stamp_ns, frame.color) for k, frame in enumerate(frames)}
    expected = SteadyFrames(steady.calibration().camera, 0.05, 0.0, looks.get)
    assert all(np.array_equal(steady(k).color, expected(k, frames[k]).color) for k in (3, 0, 1, 2))
    assert not np.array_equal(steady(2).color, frames[2].color)
    assert np.array_equal(steady(2).depth_m, frames[2].depth_m)


def test_a_delay_of_the_camera_file_pairs_the_images_of_one_time(tmp_path: Path) -> None:
    path = write_file(tmp_path / "robot.mcap", registered(20))
    width, height = WALL.size
    camera = {"width": width, "height": height, "fx": 90.0, "fy": 90.0, "cx": 40.0, "cy": 30.0, "depth_scale": 1000.0}
    stated = McapDataset(path=str(path))
    period_s = (stated(1).stamp_ns - stated(0).stamp_ns) / 1e9
    (tmp_path / "camera.yaml").write_text(yaml.safe_dump(camera | {"depth_delay_s": -period_s}))
    given = McapDataset(path=str(path), camera=str(tmp_path / "camera.yaml"))
    assert len(given) == 19
    for k in (3, 0, 18):
        assert np.array_equal(given(k).color, stated(k).color) and np.array_equal(given(k).depth_m, stated(k + 1).depth_m)


def test_a_camera_file_of_another_size_is_one_line(tmp_path: Path) -> None:
    path = write_file(tmp_path / "robot.mcap", registered())
    (tmp_path / "camera.yaml").write_text("width: 640\nheight: 480\nfx: 500\nfy: 500\ncx: 320\ncy: 240\ndepth_scale: 1000\n")
    with pytest.raises(DataError) as caught:
        McapDataset(path=str(path), camera=str(tmp_path / "camera.yaml"))(0)
    width, height = WALL.size
    assert str(caught.value) == f"{path}: is {width}×{height} while the camera is 640×480; give the dataset.camera of these images"
