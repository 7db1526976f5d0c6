"""dataset=mcap on recordings of robots: encodings, lenses, and depth of a camera of its own."""

from __future__ import annotations

import struct
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from trihedron.datasets.readers.mcap import McapDataset
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.lie import exp_se3

sys.path.insert(0, str(Path(__file__).parent))
from robot_files import COLOR, DEPTH, Message, Wall, camera_info, compressed, encoded, image, transforms, write_file
from robot_scene import BEGIN, WALL, check_registered, millimetres, registered

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
