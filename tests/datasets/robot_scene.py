"""A wall as a robot records it: colour, and depth that is registered to it."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from trihedron.datasets.readers.mcap import McapDataset

sys.path.insert(0, str(Path(__file__).parent))
from robot_files import COLOR, SECOND, Message, Wall, camera_info, image

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
