"""dataset=mcap on recordings with Foxglove's schemas."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.timestamp_pb2 import Timestamp

from trihedron.datasets.readers.mcap import McapDataset

sys.path.insert(0, str(Path(__file__).parent))
from foxglove_files import write_json, write_protobuf
from robot_files import SECOND, encoded
from robot_scene import BEGIN, STEP, WALL, check_registered, millimetres


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


@pytest.mark.parametrize("encoding", ["protobuf", "json"])
def test_foxglove_schemas(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "foxglove.mcap"
    messages = [(topic, BEGIN + k * STEP, value) for k in range(4) for topic, value in foxglove_values(k)]
    (write_protobuf if encoding == "protobuf" else write_json)(path, messages)
    check_registered(McapDataset(str(path)))
    truth = McapDataset(str(path), truth_from="world").truth()
    assert truth is not None
    np.testing.assert_allclose(truth.poses[:, 0, 3], [0.0, 0.25, 0.5, 0.75])
